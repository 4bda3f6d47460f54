"""Partial decoding of a JPEG gives the same pixels as full decoding, and damage is detected."""

import threading
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
import simplejpeg
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.errors import FrameError, SizeError
from ipsys_log.messages import CompressedImage, RawImage
from ipsys_log.stages.detect.follow import MarkerTracker
from ipsys_log.vision import decode
from ipsys_log.vision.decode import decode_grey, decode_rows, frame_size
from ipsys_log.vision.jpeg import cut_rows, read_layout, whole_rows
from tests.stages.drawing import VGA, Array, Look, Picture, at_px, corners_px, draw, jpeg

SAMPLINGS = {
    "4:1:1": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_411,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:4:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_440,
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
}
ENOUGH = settings(max_examples=60, derandomize=True)


def colourful(width: int, height: int, seed: int) -> Picture:
    rng = np.random.default_rng(seed)
    small = rng.integers(0, 256, (height // 7 + 2, width // 7 + 2, 3), np.uint8)
    noise = rng.integers(0, 30, (height, width, 3), np.uint8)
    return np.asarray(cv2.add(cv2.resize(small, (width, height)), noise), dtype=np.uint8)


def packed(picture: Picture, sampling: str | None, interval: int, quality: int = 85) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_RST_INTERVAL, interval]
    if sampling is None:
        picture = np.ascontiguousarray(picture[..., 0])
    else:
        options += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLINGS[sampling]]
    return bytes(cv2.imencode(".jpg", picture, options)[1])


@st.composite
def jpegs(draw: st.DrawFn) -> bytes:
    width, height = draw(st.integers(1, 150)), draw(st.integers(1, 150))
    sampling = draw(st.sampled_from([None, *SAMPLINGS]))
    interval = draw(st.one_of(st.just(0), st.integers(1, 40)))
    picture = colourful(width, height, draw(st.integers(0, 9)))
    return packed(picture, sampling, interval, draw(st.integers(1, 100)))


@ENOUGH
@given(jpegs())
def test_frame_size_is_that_of_the_decoded_image(data: bytes) -> None:
    height, width = decode_grey(CompressedImage(0, "a", data, "jpeg")).shape
    assert frame_size(CompressedImage(0, "a", data, "jpeg")) == (width, height)


def test_frame_size_of_other_images_is_that_of_the_pixels() -> None:
    picture = colourful(90, 70, 0)
    progressive = bytes(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1])
    png = bytes(cv2.imencode(".png", picture)[1])
    raw = RawImage(0, "a", 90, 70, "bgr8", 270, picture.tobytes())
    frames = CompressedImage(0, "a", progressive, "jpeg"), CompressedImage(0, "a", png, "png"), raw
    assert [frame_size(frame) for frame in frames] == [(90, 70)] * 3


def test_frame_size_needs_no_pixels_of_a_jpeg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(simplejpeg, "decode_jpeg")
    data = packed(colourful(150, 90, 1), "4:2:0", 0)
    assert frame_size(CompressedImage(0, "a", data, "jpeg")) == (150, 90)
    with pytest.raises(FrameError, match="too few for a JPEG of 10000 x 10000 px"):
        frame_size(CompressedImage(0, "a", resized(data, 10_000), "jpeg"))


def resized(data: bytes, size_px: int) -> bytes:
    """Return a JPEG whose header states another size."""
    layout = read_layout(data)
    assert layout is not None
    at, size = layout.height_at, size_px.to_bytes(2, "big")
    return data[:at] + size + size + data[at + 4 :]


ROWS = st.lists(st.tuples(st.integers(0, 200), st.integers(0, 200)), max_size=4)


@given(data=jpegs(), wanted=ROWS, fill=st.booleans())
@ENOUGH
def test_rows_are_those_of_the_whole(data: bytes, wanted: list[tuple[int, int]], fill: bool) -> None:
    """For any baseline JPEG, the decoded rows equal those of the full image bit for bit."""
    whole = simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]
    frame = CompressedImage(0, "red", data + b"\0" * 5 * fill, "jpeg")
    rows = [slice(*sorted(pair)) for pair in wanted]
    grey, shown = decode_rows(frame, rows)
    assert grey.shape == whole.shape
    have = np.zeros(len(whole), dtype=bool)
    for part in shown:
        assert not have[part].any()
        have[part] = True
        np.testing.assert_array_equal(grey[part], whole[part])
    for part in rows:
        assert have[part].all()


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_restart_markers_save_the_rows_above(sampling: str) -> None:
    """Images with restart markers are not decoded from the top."""
    data = packed(colourful(320, 480, 1), sampling, interval=40)
    layout = read_layout(data)
    assert layout is not None
    shown = whole_rows(layout, [slice(200, 210), slice(400, 410)])
    assert len(shown) == 2
    assert sum(part.stop - part.start for part in shown) < 200
    pieces = cut_rows(data, layout, shown, bytearray(len(data)))
    assert sum(len(piece) for piece in pieces) < 0.6 * len(data)


@pytest.mark.parametrize(
    "options", [(cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_OPTIMIZE, 1), ()], ids=str
)
def test_any_kind_of_jpeg_is_shown(options: tuple[int, ...]) -> None:
    picture = colourful(200, 170, 3)
    data = bytes(cv2.imencode(".jpg", picture, options)[1])
    whole = simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]
    grey, shown = decode_rows(CompressedImage(0, "red", data, "jpeg"), [slice(50, 60)])
    for part in shown:
        np.testing.assert_array_equal(grey[part], whole[part])
    assert any(part.start <= 50 and part.stop >= 60 for part in shown)


def test_pictures_of_one_canvas_do_not_mix() -> None:
    """Sizes and formats may change from frame to frame; a returned image is not overwritten."""
    png = cv2.imencode(".png", colourful(90, 70, 2))[1].tobytes()
    for data in (
        packed(colourful(64, 48, 1), "4:2:0", 0),
        png,
        packed(colourful(90, 70, 1), "4:2:2", 9),
        png,
    ):
        frame = CompressedImage(0, "red", data, "")
        grey, shown = decode_rows(frame)
        np.testing.assert_array_equal(grey, decode_grey(frame))
        assert shown == [slice(0, len(grey))]


# --- damage -------------------------------------------------------------------------------------


class Filmed:
    """Return frames of a stationary marker, from a camera with and without restart markers."""

    def __init__(self, interval: int) -> None:
        # Rows of blocks are 8 px high at 4:2:2: an image shifted by one row might still be tracked.
        self.marker = at_px(VGA, 5, (350, 300), 0.7)
        grey = draw(VGA, [self.marker], Look())
        options = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLINGS["4:2:2"], cv2.IMWRITE_JPEG_RST_INTERVAL)
        self.data = jpeg(grey, 85, *options, interval)
        self.truth_px = corners_px(VGA, self.marker)

    def after(self, damaged: bytes, frames: int) -> Array | None:
        """Return the corners in a damaged frame after other frames. None means a lost marker.

        FrameError and SizeError mean detected damage.
        """
        follow = MarkerTracker("DICT_4X4_100", VGA, None, 0.0)
        for n in range(frames):
            follow(CompressedImage(0, "red", self.data, "jpeg"), n * 33_000_000)
        fits, _, _ = follow(CompressedImage(0, "red", damaged, "jpeg"), frames * 33_000_000)
        assert {fit.pose.id for fit in fits} <= {5}
        assert len(fits) <= 1
        return fits[0].corners_px if fits else None


@cache
def filmed(interval: int) -> Filmed:
    return Filmed(interval)


def check(scene: Filmed, damaged: bytes, frames: int) -> None:
    try:
        found = scene.after(damaged, frames)
    except (FrameError, SizeError):
        return
    if found is not None:
        # A wrong bit that a decoder cannot detect disturbs some blocks, but must not shift the image.
        assert np.hypot(*(found - scene.truth_px).T).max() < 2.0


def flips(data: bytes, count: int, rng: np.random.Generator, first: int = 0) -> bytes:
    """Invert some bits."""
    damaged = bytearray(data)
    for at in rng.integers(first, len(data), count).tolist():
        damaged[at] ^= 1 << int(rng.integers(8))
    return bytes(damaged)


def kinds(data: bytes, rng: np.random.Generator) -> Iterator[bytes]:
    """Damage the header, the codes or the end; remove or repeat a part."""
    layout = read_layout(data)
    assert layout is not None
    low, high = sorted(rng.integers(layout.data_at, len(data), 2).tolist())
    yield flips(data[: layout.data_at], 1, rng) + data[layout.data_at :]
    yield flips(data, 1, rng, layout.data_at)
    yield flips(data, 20, rng, layout.data_at)
    yield data[:high]
    yield data[:high] + b"\xff\xd9"
    yield data[:low] + data[high:]
    yield data[:high] + data[low:]
    yield data[:low] + b"\0" * (high - low) + data[high:]


def damage(interval: int, rounds: int, frames: int) -> None:
    rng, scene = np.random.default_rng(interval + frames), filmed(interval)
    for _ in range(rounds):
        for damaged in kinds(scene.data, rng):
            check(scene, damaged, frames)


@pytest.mark.parametrize("interval", [0, 40], ids=["plain", "restarts"])
@pytest.mark.parametrize("rounds", [6, pytest.param(120, marks=pytest.mark.slow)])
def test_damage_gives_no_wrong_marker(interval: int, rounds: int) -> None:
    """Check that a damaged frame gives an error, no marker, or the right marker."""
    damage(interval, rounds, 0)


@pytest.mark.slow
@pytest.mark.parametrize("interval", [0, 40], ids=["plain", "restarts"])
def test_damage_gives_no_wrong_marker_where_rows_are_decoded(interval: int) -> None:
    damage(interval, 60, 2)


def test_a_wrong_bit_above_a_marker_does_not_move_it() -> None:
    """It shifts all later blocks by one; the missing data are only visible at the end."""
    scene, rng = filmed(0), np.random.default_rng(1)
    layout = read_layout(scene.data)
    assert layout is not None
    for _ in range(60):
        check(scene, flips(scene.data, 1, rng, layout.data_at), 2)


def restarts_of(data: bytes) -> list[int]:
    """Return the offsets of the restart markers."""
    layout = read_layout(data)
    assert layout is not None
    return [
        n for n in range(layout.data_at, len(data) - 1) if data[n] == 0xFF and 0xD0 <= data[n + 1] <= 0xD7
    ]


@pytest.mark.parametrize("which", [0, 3])
def test_a_lost_restart_marker_does_not_shift_the_picture(which: int) -> None:
    """Rows are found by the count of restart markers: a missing marker must not shift the rows."""
    scene = filmed(40)
    at = restarts_of(scene.data)[which]
    check(scene, scene.data[: at + 1] + b"\0" + scene.data[at + 2 :], 2)


def test_a_lost_interval_does_not_shift_the_picture() -> None:
    scene = filmed(40)
    marks = restarts_of(scene.data)
    check(scene, scene.data[: marks[2]] + scene.data[marks[3] :], 2)


def test_an_interval_too_many_does_not_shift_the_picture() -> None:
    scene = filmed(40)
    marks = restarts_of(scene.data)
    check(scene, scene.data[: marks[3]] + scene.data[marks[2] :], 2)


@pytest.mark.parametrize("interval", [0, 64])
@pytest.mark.parametrize("size", [(512, 256), (1024, 64)])
def test_any_bit_of_the_header_may_be_wrong(size: tuple[int, int], interval: int) -> None:
    """A frame of an untrusted log gives a FrameError or an image, and no other error."""
    data = packed(colourful(*size, 0), "4:2:0", interval)
    layout = read_layout(data)
    assert layout is not None
    frame_at = layout.height_at - 5
    where = [*range(2, 24), *range(frame_at, frame_at + 19), *range(layout.data_at - 20, layout.data_at)]
    for at in where:
        for bit in range(8):
            damaged = bytearray(data)
            damaged[at] ^= 1 << bit
            with suppress(FrameError):
                decode_rows(CompressedImage(0, "red", bytes(damaged), "jpeg"), [slice(20, 40)])


@given(data=st.binary(max_size=80))
@ENOUGH
def test_jpeg_header_without_an_image_is_damaged(data: bytes) -> None:
    for whole in (data, b"\xff\xd8" + data, b"\xff\xd8\xff\xc0" + data + b"\xff\xd9"):
        with pytest.raises(FrameError):
            decode_rows(CompressedImage(0, "red", whole, "jpeg"), [slice(0, 9)])


def test_larger_frame_is_decoded_while_a_profiler_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A profiler in another thread, such as that of Dask, holds the local variables of this thread."""
    held: list[object] = []
    real = decode._decode_jpeg

    def held_decode(data: Any, *given: Any, **options: Any) -> Any:
        held.append(data)
        return real(data, *given, **options)

    monkeypatch.setattr(decode, "_decode_jpeg", held_decode)
    monkeypatch.setattr(decode, "_THREAD", threading.local())
    for height in (100, 200, 400):
        data = packed(colourful(320, height, 1), "4:2:0", 0)
        whole = simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]
        grey, (part,) = decode_rows(CompressedImage(0, "red", data, "jpeg"), [slice(40, 60)])
        np.testing.assert_array_equal(grey[part], whole[part])
    assert len(held) == 3


@pytest.mark.parametrize("interval", [0, 40], ids=["plain", "restarts"])
def test_undecoded_rows_do_not_show_an_earlier_image(interval: int) -> None:
    """All cameras of a thread are decoded into the same memory: undecoded rows are black."""
    first, second = (packed(colourful(320, 480, n), "4:2:0", interval) for n in (1, 2))
    decode_rows(CompressedImage(0, "red", first, "jpeg"))
    grey, shown = decode_rows(CompressedImage(0, "white", second, "jpeg"), [slice(100, 120), slice(300, 310)])
    black = np.ones(len(grey), dtype=bool)
    for part in shown:
        black[part] = False
    assert black.any()
    assert not grey[black].any()
    assert grey[~black].any()
