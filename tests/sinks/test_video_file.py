"""A video shows the cameras with their markers, and the robots at their places on the floor."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
import pytest
from numpy.typing import NDArray

import ipsys_log as ipsys
from ipsys_log import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedVideo, RawImage
from ipsys_log.sinks.colours import MARKER_COLOUR, robot_colour
from ipsys_log.vision.video import Video
from tests.conftest import Ipsys
from tests.exchange.pictured_lab import COLOUR, RUN, SIZE, START_NS, STEP_NS, PicturedLab, image, jpeg, track

Picture = NDArray[np.uint8]
WIDTH, HEIGHT = 640, 360
# Lossy compression and halved colours: a colour of a few pixels changes by less than this.
NEAR = 45


class Film(NamedTuple):
    """The pictures of a video in the order RGB, its duration in s, and its stream."""

    pictures: list[Picture]
    duration_s: float
    codec: str
    pixels: str
    rate_hz: Fraction


def film(path: Path) -> Film:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        pictures = [
            np.asarray(frame.to_ndarray(format="rgb24"), dtype=np.uint8) for frame in container.decode(stream)
        ]
        assert stream.duration is not None
        assert stream.time_base is not None
        assert stream.average_rate is not None
        duration = float(stream.duration * stream.time_base)
        context = stream.codec_context
        return Film(pictures, duration, context.name, str(context.pix_fmt), stream.average_rate)


def export(log: Path, path: Path, **options: Any) -> Film:
    settings: dict[str, Any] = {"run": RUN, "rate_hz": 10.0, "size_px": (WIDTH, HEIGHT), **options}
    with ipsys.open(log) as opened:
        opened.export(path, **settings)
    return film(path)


def near(picture: Picture, colour: tuple[int, ...], tolerance: float = NEAR) -> NDArray[np.bool_]:
    """Return the pixels (height, width) near a colour in the order RGB."""
    return np.asarray((np.abs(picture.astype(np.int16) - colour) < tolerance).all(axis=2))


def place_on_floor(picture: Picture, colour: tuple[int, int, int]) -> tuple[float, float] | None:
    """Return x and y of a colour as shares of the floor, whose light edge is in the picture."""
    rows, columns = floor_edges(picture)
    found = np.argwhere(near(picture, colour))
    if len(found) < 10:
        return None
    y, x = np.median(found, axis=0)
    return (x - columns[0]) / (columns[1] - columns[0]), (rows[1] - y) / (rows[1] - rows[0])


def floor_edges(picture: Picture) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the first and last row, and the first and last column, of the edge of the floor."""
    panel = picture[:, WIDTH // 2 :].mean(axis=2)
    light = panel > 62
    rows = np.flatnonzero(light.sum(axis=1) > 0.6 * panel.shape[1])
    columns = np.flatnonzero(light.sum(axis=0) > 0.5 * panel.shape[0]) + WIDTH // 2
    assert len(rows) >= 2, "the edge of the floor is not visible"
    assert len(columns) >= 2, "the edge of the floor is not visible"
    return (int(rows[0]), int(rows[-1])), (int(columns[0]), int(columns[-1]))


def moving(jump: int, count: int = 20) -> PicturedLab:
    """Return a lab whose robot jumps from (1.0, 0.75) to (3.0, 2.25) at an instant."""
    rows = {n: (track(1.0, 0.75) if n < jump else track(3.0, 2.25),) for n in range(count)}
    return PicturedLab({n: image(n) for n in range(count)}, rows, frozenset(range(count)))


def test_robot_is_at_its_place_and_time(tmp_path: Path) -> None:
    """The floor is 4 m x 3 m; the places are at a quarter and at three quarters of it."""
    found = export(moving(12).write(tmp_path / "lab.mcap"), tmp_path / "lab.mp4")
    places = [place_on_floor(picture, robot_colour(0)) for picture in found.pictures]
    assert len(places) == 20
    for number in (0, 5, 11):
        assert places[number] == pytest.approx((0.25, 0.25), abs=0.015)
    # The trail and the name are at the old place and beside the new one.
    last = found.pictures[12]
    rows, columns = floor_edges(last)
    x = columns[0] + 0.75 * (columns[1] - columns[0])
    y = rows[1] - 0.75 * (rows[1] - rows[0])
    assert near(last, robot_colour(0))[round(y), round(x)]
    assert not near(found.pictures[11], robot_colour(0))[round(y), round(x)]


def test_file_has_the_stated_rate_size_and_duration(tmp_path: Path) -> None:
    log = moving(50).write(tmp_path / "lab.mcap")
    for rate_hz, frames in ((10.0, 20), (25.0, 49), (30000 / 1001, 58)):
        path = tmp_path / f"{frames}.mp4"
        with ipsys.open(log) as opened:
            exported = opened.export(path, run=RUN, rate_hz=rate_hz, size_px=(202, 160))
        found = film(path)
        assert (exported.rows, len(found.pictures)) == (frames, frames)
        assert (found.codec, found.pixels) == ("h264", "yuv420p")
        assert found.rate_hz == Fraction(rate_hz).limit_denominator(1001)
        # From the first to the last message 1.9 s, and the time of the last frame.
        assert found.duration_s == pytest.approx(frames / rate_hz, abs=1e-3)
        assert found.duration_s == pytest.approx(1.9 + 1 / rate_hz, abs=1 / rate_hz)
        assert found.pictures[0].shape == (160, 202, 3)


def camera_part(picture: Picture) -> tuple[Picture, int, int]:
    """Return the picture of the only camera with its place, by its colour."""
    rows, columns = np.nonzero(near(picture, COLOUR[::-1], 20))
    left, right, top, bottom = columns.min(), columns.max() + 1, rows.min(), rows.max() + 1
    return picture[top:bottom, left:right], int(left), int(top)


def test_camera_shows_its_picture_with_markers(tmp_path: Path) -> None:
    lab = replace(moving(50, 4), marked=frozenset({1}))
    pictures = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "lab.mp4", size_px=(1280, 720)).pictures
    part, _, _ = camera_part(pictures[0])
    assert part.shape[1] / part.shape[0] == pytest.approx(SIZE[0] / SIZE[1], rel=0.02)
    scale = part.shape[1] / SIZE[0]
    assert np.median(part, axis=(0, 1)) == pytest.approx(COLOUR[::-1], abs=8)
    marked, left, top = camera_part(pictures[1])
    assert marked.shape == part.shape
    # The middles of the first two sides of the marker.
    for x, y in ((120.1, 61.1), (139.6, 81.4)):
        row, column = round((y + 0.5) * scale - 0.5), round((x + 0.5) * scale - 0.5)
        near_edge = pictures[1][top + row - 2 : top + row + 3, left + column - 2 : left + column + 3]
        greenest = near_edge.reshape(-1, 3)[np.argmax(near_edge[..., 1].ravel())].astype(float)
        assert greenest == pytest.approx(MARKER_COLOUR, abs=NEAR)
        before = pictures[0][top + row - 2 : top + row + 3, left + column - 2 : left + column + 3]
        assert before.reshape(-1, 3).astype(float) == pytest.approx(np.tile(COLOUR[::-1], (25, 1)), abs=20)
    assert not near(pictures[2], MARKER_COLOUR).any(), "markers of an earlier picture are shown"


def test_picture_is_shown_from_its_time_on(tmp_path: Path) -> None:
    later = (60, 160, 60)
    images = {n: image(n, jpeg(COLOUR if n < 2 else later)) for n in range(4)}
    log = PicturedLab(images, {0: (track(1.0, 1.0),)}).write(tmp_path / "lab.mcap")
    pictures = export(log, tmp_path / "lab.mp4").pictures
    shown = [near(picture, later[::-1], 20).sum() > 1000 for picture in pictures]
    assert shown == [False, False, True, True]


def test_robot_without_newer_poses_disappears(tmp_path: Path) -> None:
    lab = PicturedLab({n: image(n) for n in range(20)}, {n: (track(2.0, 1.5),) for n in range(5)})
    pictures = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "lab.mp4", size_px=(400, 240)).pictures
    # A trail stays for some more time; it is much smaller than a robot that stands.
    shown = [near(picture, robot_colour(0)).sum() > 30 for picture in pictures]
    # The last pose is at 0.4 s. Poses of 10 Hz fade after 1 s.
    assert shown == [True] * 15 + [False] * 5


def test_long_silence_is_shortened(tmp_path: Path) -> None:
    hour = 36_000
    numbers = [*range(5), *range(hour, hour + 5)]
    lab = PicturedLab({n: image(n) for n in numbers}, {n: (track(1.0, 1.0),) for n in numbers})
    found = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "lab.mp4", size_px=(160, 160))
    # The picture before the silence of an hour stays for 2 s.
    assert len(found.pictures) == 4 + 20 + 5


def test_frames_of_a_video_are_decoded_in_colour(video_log: Path, tmp_path: Path) -> None:
    with Session([video_log]) as session:
        frames = session.payloads([session.images["red"]])[:6]
    images = {
        n: CompressedVideo(START_NS + n * STEP_NS, "red", f.data, f.format) for n, f in enumerate(frames)
    }
    lab = PicturedLab(images, {n: (track(1.0, 1.0),) for n in images})
    pictures = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "lab.mp4").pictures
    video = Video("h264", with_colours=True)
    decoded = [video(frame) for frame in images.values()]
    last = decoded[-1]
    assert isinstance(last, RawImage)
    pixels = np.frombuffer(last.data, np.uint8).reshape(last.height, last.step // 3, 3)[..., ::-1]
    # The shown picture is at the left, below its title; its brightness follows that of the frame.
    expected = pixels[:, : last.width].mean()
    left = pictures[-1][:, : WIDTH // 2 - 4]
    assert left[left.mean(axis=2) > 40].mean() == pytest.approx(expected, abs=12)


@pytest.mark.parametrize("fault", [KeyboardInterrupt, OSError])
def test_interrupted_video_leaves_the_old_file(fault: type[BaseException], tmp_path: Path) -> None:
    log = moving(50).write(tmp_path / "lab.mcap")
    (tmp_path / "lab.mp4").write_bytes(b"old")

    def stop(_: str, done: int, __: int | None) -> None:
        if done == 40:
            assert list(tmp_path.glob("lab.mp4.*.partial"))
            raise fault

    with ipsys.open(log) as opened, pytest.raises(fault):
        opened.export(tmp_path / "lab.mp4", run=RUN, size_px=(160, 160), progress=stop)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab.mcap", "lab.mp4"]
    assert (tmp_path / "lab.mp4").read_bytes() == b"old"


def test_wild_numbers_of_other_programs_are_drawn_or_left_out(tmp_path: Path) -> None:
    wild = [
        track(1e12, -1e12),
        track(float("nan"), 1.0),
        track(1.0, 1.0, heading_rad=float("nan")),
        replace(track(1.0, 1.0), covariance_m2=np.diag([1e300, -1.0, 0.0])),
        replace(track(1.0, 1.0), covariance_m2=np.full((3, 3), np.nan)),
    ]
    rows = {n: (row,) for n, row in enumerate([*wild, track(1.0, 0.75)])}
    log = PicturedLab({n: image(n) for n in rows}, rows, frozenset(rows)).write(tmp_path / "lab.mcap")
    last = export(log, tmp_path / "lab.mp4").pictures[-1]
    assert place_on_floor(last, robot_colour(0)) == pytest.approx((0.25, 0.25), abs=0.02)


def test_same_log_gives_the_same_bytes(tmp_path: Path) -> None:
    log = moving(5, 8).write(tmp_path / "lab.mcap")
    for name in ("one", "two"):
        export(log, tmp_path / f"{name}.mp4")
    assert (tmp_path / "one.mp4").read_bytes() == (tmp_path / "two.mp4").read_bytes()


def test_damaged_picture_is_named_in_its_title(tmp_path: Path) -> None:
    images = {0: image(0), 1: image(1, b"\xff\xd8 no picture"), 2: image(2)}
    lab = PicturedLab(images, {0: (track(1.0, 1.0),)}, rig=None)
    pictures = export(lab.write(tmp_path / "lab.mcap"), tmp_path / "lab.mp4").pictures
    coloured = [bool(near(picture, COLOUR[::-1], 20).any()) for picture in pictures]
    assert coloured == [True, False, True]


def test_bad_requests_are_refused_in_one_line(tmp_path: Path, lab: Path, ipsys: Ipsys) -> None:
    log = moving(50, 2).write(tmp_path / "own.mcap")
    without = PicturedLab({}, {0: (track(1.0, 1.0),)}).write(tmp_path / "without.mcap")
    run = ("--run", RUN)
    for source, options, text in (
        (lab, (), "no run has tracks (it is in: none); compute them: ipsys replay"),
        (without, run, "has no images for a video; export a log with images"),
        (log, (*run, "--size", "641x360"), "--size 641x360: is not valid; give two even numbers"),
        (log, (*run, "--size", "16x16"), "from 160 to 4096"),
        (log, (*run, "--size", "wide"), "--size wide: is not a size; write the width and the height"),
        (log, (*run, "--frame-rate", "0"), "--frame-rate 0: is not valid; give 1 to 120"),
        (log, (*run, "--frame-rate", "nan"), "--frame-rate nan: is not valid"),
        (log, (*run, "--robot", "eva"), "has no robot 'eva' (it has: ada)"),
        (log, (*run, "--table", "events"), "a video has no table events"),
    ):
        before = sorted(tmp_path.iterdir())
        done = ipsys("export", source, "-o", tmp_path / "new.mp4", *options)
        assert done.code == 1
        assert text in done.err
        assert done.err.count("\n") == 1
        assert sorted(tmp_path.iterdir()) == before


def test_one_robot_is_drawn_in_its_colour(tmp_path: Path) -> None:
    rows = {n: (track(1.0, 0.75), track(3.0, 2.25, "bob")) for n in range(3)}
    log = PicturedLab({n: image(n) for n in range(3)}, rows).write(tmp_path / "lab.mcap")
    both = export(log, tmp_path / "both.mp4").pictures[-1]
    only = export(log, tmp_path / "bob.mp4", robot="bob").pictures[-1]
    assert place_on_floor(both, robot_colour(0)) == pytest.approx((0.25, 0.25), abs=0.02)
    assert place_on_floor(only, robot_colour(0)) is None
    assert place_on_floor(only, robot_colour(1)) == pytest.approx((0.75, 0.75), abs=0.02)
    with pytest.raises(IpsysError, match="one run"), ipsys.open(log) as opened:
        opened.export(tmp_path / "x.mp4", run=[RUN, RUN])
