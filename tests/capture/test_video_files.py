"""Videos and images with times, as frames of a log and as live cameras."""

from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from ipsys_log.capture.devices import open_source
from ipsys_log.capture.frames import Clock, Frame, SourceError
from ipsys_log.engine.output import write_log
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.image_folders import find_images, find_times, parse_time, read_images
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, CompressedVideo, Message, RigCamera, image_topic
from ipsys_log.units import NS_PER_S
from tests.capture.streams import encode, make_jpegs
from tests.conftest import Ipsys

X264 = ("-c:v", "libx264", "-bf", "0", "-g", "10", "-pix_fmt", "yuv420p")
START_NS = 1_577_836_800 * NS_PER_S


def images(log: Path, camera: str) -> list[CompressedImage | CompressedVideo]:
    with Session([log]) as session:
        messages = list(session.messages([session.images[camera]]))
    assert all(message.publish_time_ns == message.payload.timestamp for message in messages)
    return [message.payload for message in messages]


def test_videos_are_logged_unchanged(tmp_path: Path, ipsys: Ipsys) -> None:
    pictures = make_jpegs(tmp_path, 20)
    red = encode(tmp_path, "red.avi", "-c:v", "copy")
    white = encode(tmp_path, "white.mp4", *X264, rate=25)
    log = tmp_path / "log.mcap"
    done = ipsys("import", "videos", f"red={red}", f"white={white}", "-o", log)
    assert (done.code, done.err) == (0, "")
    assert done.out == f"{log} written: frames: 20 of red, 20 of white\n"
    frames = images(log, "red")
    assert [frame.data for frame in frames] == pictures
    assert {(type(frame), frame.format) for frame in frames} == {(CompressedImage, "jpeg")}
    expected = START_NS + np.arange(20) * NS_PER_S / 30
    assert np.abs([f.timestamp - t for f, t in zip(frames, expected.astype(int), strict=True)]).max() < 2e6
    frames = images(log, "white")
    assert {(type(frame), frame.format) for frame in frames} == {(CompressedVideo, "h264")}
    assert [frame.timestamp for frame in frames] == [START_NS + n * 40_000_000 for n in range(20)]
    assert all(frames[n].data.find(b"\x00\x00\x01\x67") >= 0 for n in (0, 10))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("-c:v", "libx264", "-bf", "2", "-qp", "10"), "has frames that need later ones"),
        (("-c:v", "mpeg4", "-q:v", "1"), "has mpeg4 video"),
    ],
)
def test_formats_that_no_log_stores_are_encoded_again(
    tmp_path: Path, ipsys: Ipsys, options: tuple[str, ...], said: str
) -> None:
    pictures = make_jpegs(tmp_path, 8)
    log = tmp_path / "log.mcap"
    done = ipsys("import", "videos", f"red={encode(tmp_path, 'red.mp4', *options)}", "-o", log)
    assert done.code == 0
    assert said in done.err
    frames = images(log, "red")
    assert {frame.format for frame in frames} == {"jpeg"}
    assert np.diff([frame.timestamp for frame in frames]).min() > 0
    for frame, picture in zip(frames, pictures, strict=True):
        grey, true = (simplejpeg.decode_jpeg(data, colorspace="GRAY") for data in (frame.data, picture))
        assert np.abs(grey.astype(float) - true).mean() < 8


def test_invalid_video_leaves_no_log(tmp_path: Path, ipsys: Ipsys) -> None:
    (tmp_path / "text.mp4").write_text("no video" * 100)
    for name in ("text.mp4", "none.mp4"):
        done = ipsys("import", "videos", f"red={tmp_path / name}", "-o", tmp_path / "log.mcap")
        assert done.code == 1
        assert f"{tmp_path / name}: cannot be read as a video: " in done.err
        assert done.err.count("\n") == 1
    assert not (tmp_path / "log.mcap").exists()
    done = ipsys("import", "videos", "red.mp4", "-o", tmp_path / "log.mcap")
    assert "red.mp4: has no camera name; write camera=file.mp4" in done.err


def folder(tmp_path: Path, names: list[str]) -> dict[str, list[Path]]:
    for name in names:
        path = tmp_path / "pictures" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(name.encode())
    return find_images(tmp_path / "pictures")


def test_times_are_in_the_names(tmp_path: Path) -> None:
    names = ["red/1700000000000000500.jpg", "red/2023-11-14T22-13-21.5.jpg", "white/1700000000.25.png"]
    pictures = folder(tmp_path, names)
    messages = list(read_images(pictures, None, {}, 1.0, find_times(pictures, "names")))
    start = 1_700_000_000 * NS_PER_S
    assert [(m.payload.data.decode(), m.publish_time_ns - start) for m in messages] == [
        (names[0], 500),
        (names[2], NS_PER_S // 4),
        (names[1], 3 * NS_PER_S // 2),
    ]


def test_times_are_in_a_table(tmp_path: Path, ipsys: Ipsys) -> None:
    folder(tmp_path, ["red/a.jpg", "red/b.jpg", "white/a.jpg"])
    table = tmp_path / "times.csv"
    table.write_text("time,file\n1700000000.5,red/b.jpg\n1700000001,red/a.jpg\n1700000000.5,white/a.jpg\n")
    log = tmp_path / "log.mcap"
    done = ipsys("import", "images", tmp_path / "pictures", "--times", table, "-o", log)
    assert (done.code, done.err) == (0, "")
    assert [frame.data for frame in images(log, "red")] == [b"red/b.jpg", b"red/a.jpg"]
    assert images(log, "white")[0].timestamp == 1_700_000_000_500_000_000


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("file,time\nred/a.jpg,1700000000\n", "times.csv: has no row for red/b.jpg; add it"),
        ("file,time\nred/a.jpg,noon\n", "times.csv: line 2: 'noon' is not a time; write s, ms"),
        ("file,time\nred/c.jpg,1700000000\n", "times.csv: line 2: picture 'red/c.jpg' does not exist"),
        ("file,time\nred/a.jpg,1700000000\nred/b.jpg,1700000000\n", "b.jpg: has the same time as a.jpg"),
        ("picture,time\n", "the first line must name the columns file and time"),
    ],
)
def test_a_table_that_does_not_fit_is_named(tmp_path: Path, text: str, said: str) -> None:
    pictures = folder(tmp_path, ["red/a.jpg", "red/b.jpg"])
    (tmp_path / "times.csv").write_text(text)
    with pytest.raises(IpsysError) as error:
        find_times(pictures, str(tmp_path / "times.csv"))
    assert said in str(error.value)


@pytest.mark.parametrize(
    "text", ["", "12", "17000000000", "nan", "inf", "-1700000000", "2023-13-14T22:13:20"]
)
def test_invalid_times_are_refused(text: str) -> None:
    with pytest.raises(ValueError):  # noqa: PT011
        parse_time(text)


def test_a_time_with_a_zone() -> None:
    assert parse_time("2023-11-14T23:13:20.000000001+01:00") == 1_700_000_000_000_000_001


def play(source: str, name: str = "red", clock: Clock | None = None) -> list[tuple[int, Frame]]:
    """Return the frames and their delay after their stamps."""
    clock = clock or Clock()
    with open_source(RigCamera(name, source=source), clock, lambda _: None) as frames:
        return [
            (clock.now_ns() - (frame.time_ns or 0), frame) for frame in frames if isinstance(frame, Frame)
        ]


class SleptClock(Clock):
    """A clock that advances only while the player sleeps: a busy machine has no effect."""

    def __init__(self) -> None:
        self.ns = 1_700_000_000_000_000_000

    def now_ns(self) -> int:
        return self.ns

    def sleep(self, duration_s: float) -> None:
        self.ns += round(duration_s * 1e9)


def test_a_file_is_played_in_real_time(tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = make_jpegs(tmp_path, 16)
    video = encode(tmp_path, "red.avi", "-c:v", "copy", rate=20)
    log = tmp_path / "log.mcap"
    assert ipsys("import", "videos", f"red={video}", "-o", log).code == 0
    for source, name in ((f"file:{video}", "red"), (f"file:{log}", "red"), (f"file:{log}?red", "left")):
        clock = SleptClock()
        monkeypatch.setattr("ipsys_log.capture.frames.time.sleep", clock.sleep)
        start_ns = clock.ns
        came = play(source, name, clock)
        assert (clock.ns - start_ns) / 1e9 == pytest.approx(0.75, abs=0.001)
        assert [frame.data for _, frame in came] == pictures
        assert all(0 <= late_ns < 1000 for late_ns, _ in came)
        steps = np.diff([frame.time_ns or 0 for _, frame in came])
        assert np.abs(steps - 50e6).max() < 1e6
    with pytest.raises(SourceError, match=r"does not have this camera; it has .*log.mcap\?red"):
        play(f"file:{log}", "left")
    with pytest.raises(SourceError, match="does not exist"):
        play("file:nowhere.mp4")


def test_cameras_of_a_played_log_keep_their_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One camera opens 0.2 s after the other."""
    delays_ns = {"red": 0, "white": 11_000_000}
    images = [
        Message(image_topic(name), time_ns, time_ns, CompressedImage(time_ns, name, b"-", "jpeg"), name)
        for frame in range(5)
        for name, delay_ns in delays_ns.items()
        for time_ns in [START_NS + frame * NS_PER_S + delay_ns]
    ]
    write_log(tmp_path / "log.mcap", images)
    clock, first_ns = SleptClock(), {}
    monkeypatch.setattr("ipsys_log.capture.frames.time.sleep", clock.sleep)
    with ExitStack() as stack:
        for name in delays_ns:
            camera = RigCamera(name, source=f"file:{tmp_path / 'log.mcap'}?{name}")
            frames = stack.enter_context(open_source(camera, clock, lambda _: None))
            first_ns[name] = next(one.time_ns or 0 for one in frames if isinstance(one, Frame))
            clock.sleep(0.2)
    assert first_ns["white"] - first_ns["red"] == delays_ns["white"]


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (None, "has no source in the rig"),
        ("firewire:0", "source 'firewire:0' has an unknown type; use one of http:, https:"),
    ],
)
def test_a_source_that_nothing_opens(source: str | None, said: str) -> None:
    with pytest.raises(IpsysError, match=said):
        open_source(RigCamera("red", source=source), Clock(), lambda _: None)
