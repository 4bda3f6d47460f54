"""Decoding of a JPEG with flaws that lose no pixel, such as bytes before a restart marker or a missing end.

A decoder warns of these as of real damage. The pixels tell the difference: bytes that are appended to the
coded data change pixels only if coded data are missing.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.errors import FrameError
from ipsys_log.vision.jpeg import JpegHeader, check_restarts, read_header

_END, _SCAN = b"\xff\xd9", 0xDA
_RESTARTS = re.compile(rb"\xff([\xd0-\xd7])")
# Coded data that change every block: a long code, which stands for a large value, and noise without 0xff,
# which begins a marker.
_NOISE = b"\xfe\xfd" + np.random.default_rng(5).integers(0, 255, 32, np.uint8).tobytes()
# Most surplus bytes at the end of coded data that count as a flaw. After damage within the data, the decoder
# gets out of step, and surplus bytes remain, too: of 400 bit flips in an image of the lab, 2 % pass as a flaw
# (test_few_bit_flips_pass_as_a_flaw); 63 to 70 % cause no warning at all.
_MOST_BETWEEN_MARKERS, _MOST_AT_END = 6, 16
# The coded data of grey blocks may end with zeros: a byte for a block, and 0xff is followed by one.
_MOST_REAL_ZEROS = 3
# With more surplus bytes in this share of at least so many pieces, the camera makes them.
_USUAL_SHARE, _LEAST_PIECES = 0.5, 4


def remove_stray_bytes(data: bytes) -> bytes:
    """Return a JPEG without the bytes between the segments of its header that belong to none."""
    clean, offset = bytearray(data[:2]), 2
    while offset + 4 <= len(data):
        if data[offset] != 0xFF or data[offset + 1] in (0x00, 0xFF):
            offset += 1
            continue
        end = offset + 2 + int.from_bytes(data[offset + 2 : offset + 4], "big")
        clean += data[offset:end]
        if data[offset + 1] == _SCAN:
            return bytes(clean) + data[end:]
        offset = end
    return bytes(clean)


def decode_flawed(data: bytes) -> NDArray[np.uint8] | None:
    """Return the grey image (height, width) of a baseline JPEG whose flaws lose no pixel; None after a loss.

    Parameters
    ----------
    data : a JPEG of which a decoder warns, after :func:`remove_stray_bytes`.
    """
    header = read_header(data)
    if header is None:
        return None
    try:
        pieces = _split(data[header.data_at :], header)
        jpeg = _Pieces(data[: header.data_at])
        try:
            return jpeg.decode(pieces, "GRAY", strict=True)[..., 0]
        except ValueError:  # surplus bytes that are no filler
            pass
        pixels = jpeg.decode(pieces)
        if not np.array_equal(pixels, jpeg.decode([piece + _NOISE for piece in pieces])):
            return None
        most = _MOST_BETWEEN_MARKERS if len(pieces) > 1 else _MOST_AT_END
        shorter = jpeg.decode([piece[:-most].rstrip(b"\xff") + _NOISE for piece in pieces])
        surplus = ~_changed_pieces((pixels != shorter).any(axis=2), header)
        is_usual = len(pieces) >= _LEAST_PIECES and surplus.mean() >= _USUAL_SHARE
        return None if surplus.any() and not is_usual else jpeg.decode(pieces, "GRAY")[..., 0]
    except (ValueError, FrameError):
        return None


class _Pieces:
    """A JPEG of a header and of pieces of coded data between restart markers."""

    def __init__(self, header: bytes) -> None:
        self._header = header

    def decode(
        self, pieces: Sequence[bytes], colours: str = "BGR", strict: bool = False
    ) -> NDArray[np.uint8]:
        """Decode pieces, by default with colours: a piece ends with them."""
        parts = [self._header]
        for number, piece in enumerate(pieces):
            parts += (piece, bytes([0xFF, 0xD0 + number % 8]))
        parts[-1] = _END
        quick = colours != "GRAY"
        return np.asarray(
            simplejpeg.decode_jpeg(
                b"".join(parts), colorspace=colours, fastdct=quick, fastupsample=quick, strict=strict
            )
        )


def _split(coded: bytes, header: JpegHeader) -> list[bytes]:
    """Return the coded data between restart markers, with little filler (zeros or 0xff) at their ends.

    Raises
    ------
    FrameError
        Restart markers are missing or out of order.
    """
    end = coded.find(_END)
    coded = coded if end < 0 else coded[:end]
    check_restarts(np.frombuffer(b"".join(_RESTARTS.findall(coded)), np.uint8), header)
    pieces = []
    for piece in _RESTARTS.split(coded)[::2]:
        length = len(piece.rstrip(b"\0\xff"))
        pieces.append(piece[: length + _MOST_REAL_ZEROS].rstrip(b"\xff"))
    return pieces


def _changed_pieces(changed: NDArray[np.bool_], header: JpegHeader) -> NDArray[np.bool_]:
    """Return for each piece of coded data whether one of its pixels has changed."""
    height, width = changed.shape
    rows, step = -(-height // header.block_px), header.block_width_px
    blocks = np.zeros((rows * header.block_px, header.blocks * step), dtype=bool)
    blocks[:height, :width] = changed
    flags = blocks.reshape(rows, header.block_px, header.blocks, step).any(axis=(1, 3)).ravel()
    interval = header.interval or len(flags)
    padded = np.pad(flags, (0, -len(flags) % interval))
    return np.asarray(padded.reshape(-1, interval).any(axis=1))
