"""Markers from frame to frame: new, lost and hidden markers, and unusual frames."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    CameraCalibration,
    Event,
    Marker,
    Markers,
    Message,
    RawImage,
    Rig,
    RigCamera,
    RigMarker,
)
from ipsys_log.stages.detect import Detect
from tests.stages.drawing import (
    FISHEYE,
    VGA,
    Array,
    Look,
    Picture,
    Print,
    at_px,
    calibrated,
    corners_px,
    draw,
    each_time,
    frame,
    jpeg,
    print_px,
    rig,
    strewn,
)

LENGTH_M = 0.4
# Number of frames to find a marker again: the whole image is decoded every tenth time.
SOON = 10
RESTARTS = (cv2.IMWRITE_JPEG_RST_INTERVAL, 40)


def lying(marker_id: int, x: float, y: float, heading_rad: float = 0.3) -> Print:
    return at_px(VGA, marker_id, (x, y), 2.0, heading_rad, LENGTH_M)


@cache
def floor() -> Picture:
    return draw(VGA, [], Look())


@cache
def with_marker() -> Picture:
    return draw(VGA, [lying(5, 330, 240)], Look())


def started(lens: CameraCalibration = VGA) -> Detect:
    detect = Detect("edges")
    for message in (rig(), calibrated(lens)):
        assert list(detect(message)) == []
    return detect


def feed(detect: Detect, messages: Iterable[Message]) -> list[list[Any]]:
    """Return the messages of a stage for each frame, without the drawing for viewers."""
    kinds = (Markers, Event)
    return [[one for one in detect(message) if isinstance(one, kinds)] for message in messages]


def film(pictures: Iterable[Picture], camera: str = "red", *options: int) -> list[Message]:
    """Return images as a camera sends them at 30 Hz; equal images are encoded once."""
    packed: dict[int, bytes] = {}
    kept = list(pictures)
    for picture in kept:
        packed.setdefault(id(picture), jpeg(picture, 90, *options))
    times = each_time(len(kept))
    return [frame(packed[id(p)], time_ns, camera) for p, time_ns in zip(kept, times, strict=True)]


def ids(answers: Iterable[list[Any]]) -> list[list[int]]:
    """Return the ids of the markers in each frame."""
    return [[m.id for one in made if isinstance(one, Markers) for m in one.markers] for made in answers]


def markers(made: list[Any]) -> tuple[Marker, ...]:
    (found,) = (one.markers for one in made if isinstance(one, Markers))
    return found


def off_px(made: list[Any], one: Print, lens: CameraCalibration = VGA) -> float:
    """Return the largest corner error of a marker."""
    (marker,) = (marker for marker in markers(made) if marker.id == one.id)
    return float(np.hypot(*(marker.corners_px - corners_px(lens, one)).T).max())


def same(one: Sequence[list[Any]], other: Sequence[list[Any]]) -> bool:
    """Compare bit for bit."""
    return [list(map(bits, made)) for made in one] == [list(map(bits, made)) for made in other]


def bits(payload: Any) -> Any:
    if not isinstance(payload, Markers):
        return payload
    found = [
        (m.id, m.corners_px.tobytes(), np.asarray(m.covariance_px2).tobytes(), m.edge_offset_px)
        for m in payload.markers
    ]
    return payload.timestamp, payload.width, payload.height, found


@cache
def driven() -> tuple[Picture, ...]:
    """Return two moving markers; one leaves the image."""
    return tuple(
        draw(VGA, [lying(5, 200 + 12 * n, 240, 0.1 * n), lying(7, 520 + 16 * n, 120)], Look(seed=n))
        for n in range(12)
    )


# --- the same again -----------------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), RESTARTS], ids=["plain", "restarts"])
def test_the_same_frames_give_the_same_markers(options: tuple[int, ...]) -> None:
    """A replay equals the live result bit for bit, for any frames of other cameras."""
    red, white = film(driven(), "red", *options), film(reversed(driven()), "white", *options)
    alone = feed(started(), red)
    assert [5, 7] in ids(alone)
    assert [5] in ids(alone)
    assert same(feed(started(), red), alone)
    detect = started()
    list(detect(replace(calibrated(VGA), camera="white")))
    mixed = [message for pair in zip(red, white, strict=True) for message in pair]
    assert same(feed(detect, mixed)[::2], alone)


def test_equal_calibration_changes_nothing() -> None:
    """Recorders repeat the calibration regularly."""
    frames, detect = film(driven()), started()
    answers = []
    for message in frames:
        list(detect(replace(calibrated(replace(VGA, timestamp=message.publish_time_ns)), log_time_ns=1)))
        answers += feed(detect, [message])
    assert same(answers, feed(started(), frames))


def test_markers_are_followed_as_well_as_they_are_found() -> None:
    frames = film(driven())
    followed = feed(started(), frames)
    for n, message in enumerate(frames):
        one = lying(5, 200 + 12 * n, 240, 0.1 * n)
        (alone,) = feed(started(), [message])
        assert off_px(followed[n], one) < 0.12
        assert off_px(alone, one) < 0.12


# --- undecodable frames -------------------------------------------------------------------------


DAMAGES: dict[str, Callable[[bytes], bytes]] = {
    "truncated": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "text": lambda data: b"HTTP/1.1 503 Service Unavailable",
    "hole": lambda data: data[:700] + b"\0" * 900 + data[1600:],
}


@pytest.mark.parametrize("at", [1, 4, 5])
@pytest.mark.parametrize("damage", DAMAGES)
def test_corrupt_frame_is_reported_and_changes_nothing_else(damage: str, at: int) -> None:
    frames = film([with_marker()] * 8)
    bad = frame(DAMAGES[damage](frames[at].payload.data), frames[at].publish_time_ns)
    answers = feed(started(), [*frames[:at], bad, *frames[at + 1 :]])
    if damage != "hole" or not markers_or_event(answers[at]):
        assert [one.kind for one in answers[at]] == ["corrupt_frame"]
    assert ids(answers[at + 1 :]) == [[5]] * (7 - at)
    for made in answers[at + 1 :]:
        assert off_px(made, lying(5, 330, 240)) < 0.1


def markers_or_event(made: list[Any]) -> bool:
    """Damage below the decoded rows is not detected: then the marker has to be correct."""
    return isinstance(made[0], Markers) and off_px(made, lying(5, 330, 240)) < 0.1


# --- new and lost markers -----------------------------------------------------------------------


@pytest.mark.parametrize("options", [(), RESTARTS], ids=["plain", "restarts"])
def test_a_marker_is_put_down_covered_uncovered_and_taken_away(options: tuple[int, ...]) -> None:
    covered = with_marker().copy()
    cv2.circle(covered, (345, 250), 75, 95, -1)
    long = SOON + 1
    pictures = [floor(), with_marker(), covered, with_marker(), floor()]
    frames = film([picture for picture in pictures for _ in range(long)], "red", *options)
    answers = feed(started(), frames)
    seen = [found == [5] for found in ids(answers)]
    empty, put_down, hidden, uncovered, taken = (seen[n * long : (n + 1) * long] for n in range(5))
    assert not any(empty + hidden + taken)
    assert put_down[-1]
    assert uncovered[-1]
    for n in (2 * long - 1, 4 * long - 1):
        assert off_px(answers[n], lying(5, 330, 240)) < 0.1


def test_a_second_marker_is_put_beside_a_first() -> None:
    first, second = lying(5, 200, 240), lying(9, 450, 260)
    pictures = [draw(VGA, [first], Look()), draw(VGA, [first, second], Look())]
    seen = ids(feed(started(), film([pictures[0]] * 7 + [pictures[1]] * (SOON + 1), "red", *RESTARTS)))
    assert seen[7 + SOON] == [5, 9]


SIDES = {"left": (-1, 0), "right": (1, 0), "top": (0, -1), "bottom": (0, 1)}


@pytest.mark.parametrize("side", SIDES)
def test_a_marker_that_enters_is_seen_soon_after_it_is_whole(side: str) -> None:
    """Another marker is tracked, so only some rows are decoded."""
    towards = np.array(SIDES[side])
    beside = draw(VGA, [lying(9, 530, 385)], Look(noise=0.0)).astype(np.float64)
    starts_px = np.abs(towards) * (380, 300)
    path = [np.array([320, 240]) + towards * np.maximum(starts_px - 25 * n, 0) for n in range(17)]
    places = [lying(5, float(x), float(y)) for x, y in path]
    frames = film([draw(VGA, [one], Look(floor=beside, seed=n)) for n, one in enumerate(places)])
    seen = ids(feed(started(), frames))
    whole = [inside(print_px(VGA, one, Look())) for one in places]
    first = whole.index(True)
    assert first < len(places) - SOON
    assert not any(5 in found for found in seen[: max(first - 3, 0)])
    assert all(found == [5, 9] for found in seen[first + SOON :])


def inside(points_px: Array) -> bool:
    return bool(((points_px > 0) & (points_px < [VGA.width - 1, VGA.height - 1])).all())


def test_a_marker_at_the_corner_of_the_image() -> None:
    """The black square reaches the last pixels; the margin is outside."""
    for x, y in ((34, 30), (604, 30), (34, 448), (604, 448)):
        one = lying(5, x, y, 0.05)
        (made,) = feed(started(), film([draw(VGA, [one], Look())]))
        if markers(made):
            assert off_px(made, one) < 0.5
        half_out = lying(5, 0 if x < 300 else 639, y, 0.05)
        (made,) = feed(started(), film([draw(VGA, [half_out], Look())]))
        assert markers(made) == ()


def test_a_hundred_markers_at_once() -> None:
    rng = np.random.default_rng(0)
    prints = strewn(FISHEYE, 100, rng, length_m=0.07)
    data = jpeg(draw(FISHEYE, prints, Look()))
    answers = feed(started(FISHEYE), [frame(data, time_ns) for time_ns in each_time(3)])
    for made in answers:
        assert len(markers(made)) >= 85
        assert [m.id for m in markers(made)] == sorted({m.id for m in markers(made)})
        for one in prints:
            if one.id in {m.id for m in markers(made)}:
                assert off_px(made, one, FISHEYE) < 1.0


def test_two_markers_of_one_id_are_ambiguous_in_every_frame() -> None:
    """Neither of them is reported, because the robot could be either."""
    picture = draw(VGA, [lying(5, 180, 240), lying(5, 470, 240), lying(7, 330, 100)], Look())
    answers = feed(started(), film([picture] * 8))
    assert ids(answers) == [[7]] * 8
    assert [[one.kind for one in made if isinstance(one, Event)] for made in answers] == [
        ["ambiguous_marker"]
    ] * 8


def test_a_marker_that_is_not_in_the_rig_is_named_once() -> None:
    detect = Detect("edges")
    known = Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", 0.2, (RigMarker(3),)))
    for message in (known, calibrated(VGA)):
        list(detect(message))
    answers = feed(detect, film([with_marker()] * 3))
    assert ids(answers) == [[], [], []]
    assert [[one.kind for one in made if isinstance(one, Event)] for made in answers] == [
        ["unknown_marker"],
        [],
        [],
    ]


# --- odd logs -----------------------------------------------------------------------------------


@pytest.mark.parametrize("row_time_ns", [None, 31_000])
@pytest.mark.parametrize(
    "times_ns",
    [
        [5, 5, 5, 5, 5],
        [500_000_000, 400_000_000, 300_000_000, 200_000_000, 100_000_000],
        [0, 33_000_000, 10, 66_000_000, 66_000_001],
        [0, 1, 2, 3, 4],
        [0, 33_000_000, 66_000_000, 90 * 86_400 * 10**9, 90 * 86_400 * 10**9 + 33_000_000],
    ],
    ids=["equal", "backwards", "mixed", "nanoseconds", "months later"],
)
def test_odd_time_stamps_lose_no_marker(times_ns: list[int], row_time_ns: int | None) -> None:
    """The search region depends on the time, and a marker may be stationary."""
    detect = Detect("edges")
    for message in (rig(RigCamera("red", row_time_ns=row_time_ns)), calibrated(VGA)):
        list(detect(message))
    pictures = [draw(VGA, [lying(5, 330 + (n % 2), 240)], Look(seed=n)) for n in range(2)]
    data = [jpeg(picture) for picture in pictures]
    answers = feed(detect, [frame(data[n % 2], time_ns) for n, time_ns in enumerate(times_ns)])
    assert ids(answers) == [[5]] * len(times_ns)


@pytest.mark.parametrize(("step_px", "gap_s"), [(0, 10), (12, 5)], ids=["at rest", "driving"])
def test_after_a_gap_a_marker_is_found_at_once(step_px: int, gap_s: int) -> None:
    """A camera was lost for some seconds; the robot is stationary, or stopped soon after the last frame."""
    data = [jpeg(draw(VGA, [lying(5, 200 + step_px * n, 240)], Look(seed=n))) for n in (0, 1, 2, 4)]
    times_ns = [0, 33_000_000, 67_000_000, 67_000_000 + gap_s * 10**9]
    answers = feed(started(), [frame(d, t) for d, t in zip(data, times_ns, strict=True)])
    assert ids(answers) == [[5]] * 4


def test_the_frame_size_changes_in_the_middle_of_a_log() -> None:
    """A camera gets another frame size, and its calibration follows."""
    large, small = at_px(FISHEYE, 5, (900, 500)), lying(5, 330, 240)
    frames = [frame(jpeg(draw(FISHEYE, [large], Look())), 1), frame(jpeg(with_marker()), 34_000_000)]
    detect = started(FISHEYE)
    (first,) = feed(detect, frames[:1])
    # Without its calibration, no result can be correct.
    ((early,),) = feed(detect, [replace(frames[1], publish_time_ns=20_000_000)])
    assert early.kind == "wrong_size"
    assert "1920 x 1080" in early.text
    list(detect(calibrated(VGA)))
    (second,) = feed(detect, frames[1:])
    assert off_px(first, large, FISHEYE) < 0.1
    assert off_px(second, small) < 0.1
    assert (second[0].width, second[0].height) == (640, 480)


def test_a_calibration_of_another_size_is_refused() -> None:
    """With intrinsics of twice the focal length, corners look correct and poses are wrong."""
    for lens, picture in ((FISHEYE, with_marker()), (VGA, draw(FISHEYE, [], Look()))):
        with pytest.raises(IpsysError, match="calibration"):
            feed(started(lens), film([picture]))


def test_edges_need_a_calibration() -> None:
    detect = Detect("edges")
    list(detect(rig()))
    with pytest.raises(IpsysError, match="no calibration"):
        list(detect(film([floor()])[0]))


# --- kinds of frames ----------------------------------------------------------------------------


def raw(picture: Picture, encoding: str, pad: int = 0) -> RawImage:
    channels = {"mono8": 1, "bgr8": 3, "rgba8": 4}[encoding]
    pixels = np.repeat(picture[..., None], channels, axis=2).reshape(len(picture), -1)
    rows = np.pad(pixels, ((0, 0), (0, pad)))
    height, width = picture.shape
    return RawImage(0, "red", width, height, encoding, rows.shape[1], rows.tobytes())


def with_factors(name: str) -> Callable[[Picture], bytes]:
    return lambda picture: jpeg(picture, 90, *FACTORS[name])


FACTORS = {
    "4:2:0": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420),
    "4:2:2": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    "4:4:4": (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
}
KINDS: dict[str, Callable[[Picture], bytes | RawImage]] = {
    **{name: with_factors(name) for name in FACTORS},
    "4:2:2 with restarts": lambda picture: jpeg(picture, 90, *FACTORS["4:2:2"], *RESTARTS),
    "restarts within rows": lambda picture: jpeg(picture, 90, cv2.IMWRITE_JPEG_RST_INTERVAL, 7),
    "progressive": lambda picture: jpeg(picture, 90, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "optimized": lambda picture: jpeg(picture, 90, cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    "grey": lambda picture: cv2.imencode(".jpg", picture)[1].tobytes(),
    "zeros after its end": lambda picture: jpeg(picture) + b"\0" * 300,
    "png": lambda picture: cv2.imencode(".png", picture)[1].tobytes(),
    "mono8": lambda picture: raw(picture, "mono8"),
    "bgr8": lambda picture: raw(picture, "bgr8"),
    "rgba8 with padded rows": lambda picture: raw(picture, "rgba8", 12),
}


@pytest.mark.parametrize("kind", KINDS)
def test_any_kind_of_frame(kind: str) -> None:
    """The marker is tracked over some frames, so that only rows are decoded if possible."""
    data = KINDS[kind](with_marker())
    for made in feed(started(), [frame(data, time_ns) for time_ns in each_time(4)]):
        assert off_px(made, lying(5, 330, 240)) < 0.1


def test_kinds_of_frames_may_take_turns() -> None:
    """Images are decoded into the memory of earlier ones; the memory of a raw frame belongs to its owner."""
    kinds = [KINDS[kind](with_marker()) for kind in ("mono8", "4:2:0", "png", "4:2:2 with restarts", "bgr8")]
    first = kinds[0]
    assert isinstance(first, RawImage)
    before = bytes(first.data)
    for made in feed(started(), [frame(kinds[n % 5], t) for n, t in enumerate(each_time(15))]):
        assert off_px(made, lying(5, 330, 240)) < 0.1
    assert bytes(first.data) == before


def test_corrupt_first_frame_loses_only_itself() -> None:
    frames = film([with_marker()] * 4)
    broken = replace(frames[0], payload=replace(frames[0].payload, data=b"\xff\xd8 no picture"))
    answers = feed(started(), [broken, *frames[1:]])
    assert isinstance(answers[0][0], Event)
    assert ids(answers[1:]) == [[5]] * 3
