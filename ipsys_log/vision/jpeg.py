"""Baseline JPEGs: rows without the other rows, and decoding in spite of flaws that lose no pixel.

A smaller height in the header gives only the rows from the top. If a camera sends restart markers, rows can
also begin farther down, because the coding starts again after each restart marker. A decoder spends most of
its time on codes that it reads one after the other, so omitted rows save time.

A decoder warns of flaws as of real damage. The pixels tell the difference: bytes that are appended to the
coded data change pixels only if coded data are missing.
"""

import re
from collections.abc import Iterable, Sequence
from math import lcm
from typing import NamedTuple

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from ipsys_log.errors import FrameError

_END = b"\xff\xd9"
_BASELINE = (0xC0, 0xC1)
_SCAN, _RESTART_INTERVAL, _RESTART = 0xDA, 0xDD, 0xD0
# Restart markers have the cyclic numbers 0 to 7.
_CYCLE = 8
# A separate JPEG takes as long as this number of rows: nearer rows are decoded together.
_NEAR_PX = 32
_AT_ONCE = 65_536


class JpegHeader(NamedTuple):
    """The header of a baseline JPEG.

    ``width`` and ``height`` are its size in px. ``block_px`` is the height of a row of blocks in px,
    ``block_width_px`` their width, and ``blocks`` the number of blocks in a row. ``height_at`` and
    ``data_at`` are the offsets in the file of the height and of the pixel data. ``interval`` is the number of
    blocks between two restart markers (0: there are no restart markers).
    """

    width: int
    height: int
    block_px: int
    block_width_px: int
    blocks: int
    height_at: int
    data_at: int
    interval: int

    @property
    def rows_px(self) -> int:
        """Return the least height in px of whole rows that begin and end at a restart marker."""
        return self.block_px * lcm(self.interval, self.blocks) // self.blocks


def read_layout(data: bytes) -> JpegHeader | None:
    """Return the layout of a whole baseline JPEG in one scan; None for all other data."""
    # Some cameras append zeros.
    if data[:2] != b"\xff\xd8" or not (data.endswith(_END) or data.rstrip(b"\0").endswith(_END)):
        return None
    return read_header(data)


def read_header(data: bytes) -> JpegHeader | None:
    """Return the header of a baseline JPEG in one scan, also of a truncated one; None for all other data."""
    offset, frame, interval = 2, None, 0
    while offset + 4 <= len(data) and data[offset] == 0xFF:
        kind, size = data[offset + 1], int.from_bytes(data[offset + 2 : offset + 4], "big")
        if kind in _BASELINE:
            frame = offset
        elif kind == _RESTART_INTERVAL:
            interval = int.from_bytes(data[offset + 4 : offset + 6], "big")
        elif kind == _SCAN:
            return None if frame is None else _layout(data, frame, offset, size, interval)
        offset += 2 + size
    return None


def _layout(data: bytes, frame: int, scan: int, scan_size: int, interval: int) -> JpegHeader | None:
    parts = data[frame + 9]
    if not 1 <= parts <= 4 or frame + 10 + 3 * parts > scan:
        return None
    if scan_size != 6 + 2 * parts:  # several scans: a row needs all of them
        return None
    height, width = (int.from_bytes(data[frame + n : frame + n + 2], "big") for n in (5, 7))
    factors = [data[frame + 11 + 3 * n] for n in range(parts)]
    if parts == 1:
        factors = [0x11]
    if not (width and height and all(f >> 4 and f & 15 for f in factors)):
        return None
    across, down = max(f >> 4 for f in factors), max(f & 15 for f in factors)
    blocks = -(-width // (8 * across))
    return JpegHeader(width, height, 8 * down, 8 * across, blocks, frame + 5, scan + 2 + scan_size, interval)


def whole_rows(layout: JpegHeader, rows: Iterable[slice]) -> list[slice]:
    """Return the rows of a JPEG that must be decoded to get ``rows``: each row once, from the top.

    Without restart markers, these are all rows from the top of the image.
    """
    step = layout.rows_px if layout.interval else layout.block_px
    merged: list[slice] = []
    for part in sorted((part for part in rows if part.start < part.stop), key=lambda part: part.start):
        low = part.start // step * step if layout.interval else 0
        high = min(-(-part.stop // step) * step, layout.height)
        if merged and low <= merged[-1].stop + _NEAR_PX:
            merged[-1] = slice(merged[-1].start, max(high, merged[-1].stop))
        elif low < high:
            merged.append(slice(low, high))
    return merged


def cut_rows(
    data: bytes, layout: JpegHeader, rows: Sequence[slice], memory: bytearray
) -> list[bytearray | memoryview]:
    """Return one JPEG for each slice of rows.

    Parameters
    ----------
    data, layout : the whole JPEG, and its :func:`read_layout`.
    rows : slices from :func:`whole_rows`.
    memory : buffer for a JPEG, at least as long as ``data``. The caller uses it again for the next JPEG,
        because allocation of new memory takes longer than filling it.

    Returns
    -------
    A JPEG for each slice. Without restart markers, it ends with data that no row needs.
    """
    pieces: list[bytearray | memoryview]
    if layout.interval or not rows:
        pieces = [*_between(data, layout, rows)]
    else:
        pieces = [memoryview(memory)[: len(data)]]
        pieces[0][:] = data
    for piece, part in zip(pieces, rows, strict=True):
        piece[layout.height_at : layout.height_at + 2] = (part.stop - part.start).to_bytes(2, "big")
    return pieces


def _find_restarts(codes: NDArray[np.uint8], layout: JpegHeader) -> NDArray[np.intp]:
    """Return the offsets of restart markers; search in pieces that fit into the processor's cache."""
    offsets = [np.empty(0, dtype=np.intp)]
    for start in range(layout.data_at, len(codes) - 1, _AT_ONCE):
        ends = np.flatnonzero(codes[start : min(start + _AT_ONCE, len(codes) - 1)] == 0xFF) + start
        offsets.append(ends[(codes[ends + 1] & 0xF8) == _RESTART])
    return np.concatenate(offsets)


def check_restarts(codes: NDArray[np.uint8], layout: JpegHeader) -> None:
    """Check that all restart markers are present and in order, because their count identifies rows."""
    blocks = layout.blocks * -(-layout.height // layout.block_px)
    wanted = _RESTART + np.arange(-(-blocks // (layout.interval or blocks)) - 1) % _CYCLE
    if not np.array_equal(codes, wanted):
        raise FrameError("restart markers are missing or out of order")


def _between(data: bytes, layout: JpegHeader, rows: Sequence[slice]) -> list[bytearray]:
    """Return JPEGs of the header and the data of some rows, from one restart marker to another."""
    if not rows:
        return []
    # Some cameras append other data, such as a smaller image.
    end = data.find(_END, layout.data_at) + len(_END)
    codes = np.frombuffer(data, dtype=np.uint8, count=end)
    restarts = _find_restarts(codes, layout)
    check_restarts(codes[restarts + 1], layout)
    starts = [layout.data_at, *(restarts + 2).tolist(), end]
    pieces = []
    for part in rows:
        first, last = (
            row // layout.block_px * layout.blocks // layout.interval for row in (part.start, part.stop)
        )
        if part.stop == layout.height:
            last = len(restarts) + 1
        start, stop = starts[first], starts[last]
        piece = bytearray(data[: layout.data_at]) + data[start:stop]
        for number, offset in enumerate(restarts[first : last - 1].tolist()):
            piece[layout.data_at + offset - start + 1] = _RESTART + number % _CYCLE
        piece[-2:] = _END
        pieces.append(piece)
    return pieces


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

    ``data`` is a JPEG of which a decoder warns, after :func:`remove_stray_bytes`.
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
    """Return the coded data between restart markers, with little filler (zeros or 0xff) at their ends."""
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
