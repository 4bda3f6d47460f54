"""Flaws of JPEG streams that lose no pixel are read; damage stays an error."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from ipsys_log.errors import FrameError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage
from ipsys_log.vision.decode import decode_grey, decode_rows
from ipsys_log.vision.jpeg import read_header
from tests.images.test_jpeg import colourful, packed
from tests.tiers import first_fast

CASES = Path(os.environ.get("IPSYS_CASES", "../shared/cases"))
PLAIN = packed(colourful(320, 240, 1), "4:2:2", 0)
RESTARTS = packed(colourful(320, 240, 1), "4:2:2", 20)


def header_end(data: bytes) -> int:
    header = read_header(data)
    assert header is not None
    return header.data_at


def restarts(data: bytes) -> list[int]:
    start = header_end(data)
    return [match.start() for match in re.finditer(b"\xff[\xd0-\xd7]", data) if match.start() >= start]


def before_restarts(data: bytes, surplus: bytes, every: int = 1) -> bytes:
    offsets = restarts(data)[::every]
    pieces = [data[begin:end] for begin, end in zip([0, *offsets], [*offsets, len(data)], strict=True)]
    return surplus.join(pieces)


HARMLESS: dict[str, Callable[[], bytes]] = {
    "a_zero_before_restarts": lambda: before_restarts(RESTARTS, b"\0"),
    "bytes_before_restarts": lambda: before_restarts(RESTARTS, b"\x12\x34\x56"),
    "bytes_before_some_restarts": lambda: before_restarts(RESTARTS, b"\x12\x34\x56", 5),
    "many_bytes_before_restarts": lambda: before_restarts(RESTARTS, bytes(range(1, 40))),
    "filler_before_some_restarts": lambda: before_restarts(RESTARTS, bytes(100), 5),
    "no_end_marker": lambda: PLAIN[:-2],
    "no_end_marker_but_zeros": lambda: RESTARTS[:-2] + bytes(500),
    "bytes_before_end_marker": lambda: PLAIN[:-2] + b"\x12\x34\x56\x78" + PLAIN[-2:],
    "zeros_before_end_marker": lambda: PLAIN[:-2] + bytes(100) + PLAIN[-2:],
    "bytes_after_end_marker": lambda: RESTARTS + b"\r\n",
    "second_image_after_end_marker": lambda: RESTARTS + RESTARTS,
    "bytes_between_segments": lambda: PLAIN[:20] + b"\x11\x22" + PLAIN[20:],
}


@pytest.mark.parametrize("flaw", HARMLESS)
def test_flaw_that_loses_no_pixel_is_read(flaw: str) -> None:
    frame = CompressedImage(0, "red", HARMLESS[flaw](), "jpeg")
    pixels = decode_grey(CompressedImage(0, "red", PLAIN, "jpeg"))
    np.testing.assert_array_equal(decode_grey(frame), pixels)
    grey, rows = decode_rows(frame, [slice(100, 110), slice(200, 210)])
    for part in rows:
        np.testing.assert_array_equal(grey[part], pixels[part])


def test_zeros_at_the_end_of_coded_data_are_no_filler() -> None:
    """The coded colours of grey blocks are zeros, up to the end of the data."""
    rng = np.random.default_rng(2)
    for _ in range(40):
        grey = np.repeat(rng.integers(0, 256, (60, 80, 1), np.uint8), 3, axis=2)
        grey[32:] = 128
        for interval in (0, 5):
            data = packed(grey, "4:2:0", interval)
            surplus = before_restarts(data, b"\x12\x34\x56")
            for flawed in (data[:-2], data[:-2] + bytes(9), surplus):
                frame = CompressedImage(0, "red", flawed, "jpeg")
                np.testing.assert_array_equal(
                    decode_grey(frame), simplejpeg.decode_jpeg(data, colorspace="GRAY")[..., 0]
                )


DAMAGED: dict[str, Callable[[], bytes]] = {
    "half": lambda: PLAIN[: len(PLAIN) // 2],
    "half_with_end_marker": lambda: PLAIN[: len(PLAIN) // 2] + PLAIN[-2:],
    "half_filled_with_zeros": lambda: PLAIN[: len(PLAIN) // 2].ljust(len(PLAIN), b"\0"),
    "last_bytes_missing": lambda: PLAIN[:-42] + PLAIN[-2:],
    "restart_marker_missing": lambda: (
        RESTARTS[: restarts(RESTARTS)[3]] + RESTARTS[restarts(RESTARTS)[3] + 2 :]
    ),
    "piece_missing": lambda: RESTARTS[: restarts(RESTARTS)[3]] + RESTARTS[restarts(RESTARTS)[4] :],
    "packet_missing": lambda: PLAIN[:4000] + PLAIN[4500:],
    "packet_missing_between_restarts": lambda: before_restarts(
        RESTARTS[: restarts(RESTARTS)[5] - 80] + RESTARTS[restarts(RESTARTS)[5] :], b"\0"
    ),
}


@pytest.mark.parametrize("damage", DAMAGED)
def test_damage_that_loses_pixels_is_an_error(damage: str) -> None:
    with pytest.raises(FrameError):
        decode_grey(CompressedImage(0, "red", DAMAGED[damage](), "jpeg"))


@pytest.mark.parametrize("interval", first_fast(1, [20, 0]))
def test_few_bit_flips_pass_as_a_flaw(interval: int) -> None:
    """At most 5 of 200 flips pass that a decoder warns of: the limits for surplus bytes hold this bound."""
    data, rng = packed(colourful(320, 240, 1), "4:2:2", interval), np.random.default_rng(1)
    warned = passed = 0
    while warned < 200:
        damaged = bytearray(data)
        damaged[rng.integers(header_end(data), len(data) - 2)] ^= 1 << int(rng.integers(8))
        try:
            simplejpeg.decode_jpeg(bytes(damaged), colorspace="GRAY")
            continue
        except ValueError:
            warned += 1
        try:
            decode_grey(CompressedImage(0, "red", bytes(damaged), "jpeg"))
        except FrameError:
            continue
        passed += 1
    assert passed <= 5


@pytest.mark.parametrize(("case", "is_read"), [("halfframe", False), ("restart_clean", True)])
def test_streams_of_cases(case: str, is_read: bool) -> None:
    log = CASES / "images" / case / f"{case}.mcap"
    if not log.exists():
        pytest.skip(f"no {log}; set IPSYS_CASES")
    with Session([log]) as session:
        for message in session.messages([*session.images.values()]):
            if is_read:
                decode_grey(message.payload)
                continue
            with pytest.raises(FrameError):
                decode_grey(message.payload)
