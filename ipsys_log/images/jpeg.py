"""Only some rows of a JPEG: a baseline JPEG of fewer rows is made from it, whose pixels are the same.

Rows from the top are had by a smaller height in the header. A camera that sends restart markers lets rows
begin further down as well: between two of them everything is coded anew. Most of a decoder's time goes into
codes that it has to read one after the other, so rows that are left out are time saved.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import lcm
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FrameError

__all__ = ["Layout", "cut_rows", "read_layout", "whole_rows"]

_END = b"\xff\xd9"
_BASELINE = (0xC0, 0xC1)
_SCAN, _RESTART_INTERVAL, _RESTART = 0xDA, 0xDD, 0xD0
# Restart markers are numbered 0 to 7, over and over.
_CYCLE = 8
# A JPEG of its own costs as much as some rows.
_NEAR_PX = 32
_AT_ONCE = 65_536


class Layout(NamedTuple):
    """What the header of a baseline JPEG says: its size in px; the height of a row of blocks in px, and how
    many blocks are in it; where in the file the height is written and the pixels' data begin; and how many
    blocks lie between two restart markers (0: there are none)."""

    width: int
    height: int
    block_px: int
    blocks: int
    height_at: int
    data_at: int
    interval: int

    @property
    def rows_px(self) -> int:
        """Height of what begins at a restart marker and ends at one, in whole rows."""
        return self.block_px * lcm(self.interval, self.blocks) // self.blocks


def read_layout(data: bytes) -> Layout | None:
    """The layout of a whole baseline JPEG in one scan; None for anything else."""
    # Some cameras fill up with zeros.
    if data[:2] != b"\xff\xd8" or not (data.endswith(_END) or data.rstrip(b"\0").endswith(_END)):
        return None
    at, frame, interval = 2, None, 0
    while at + 4 <= len(data) and data[at] == 0xFF:
        kind, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if kind in _BASELINE:
            frame = at
        elif kind == _RESTART_INTERVAL:
            interval = int.from_bytes(data[at + 4 : at + 6], "big")
        elif kind == _SCAN:
            return None if frame is None else _layout(data, frame, at, size, interval)
        at += 2 + size
    return None


def _layout(data: bytes, frame: int, scan: int, scan_size: int, interval: int) -> Layout | None:
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
    return Layout(width, height, 8 * down, blocks, frame + 5, scan + 2 + scan_size, interval)


def whole_rows(layout: Layout, rows: Iterable[slice]) -> list[slice]:
    """The rows of a JPEG that have to be decoded for some rows of it, each once, from the top.

    Without restart markers these are all rows from the top.
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
    data: bytes, layout: Layout, rows: Sequence[slice], memory: bytearray
) -> list[bytearray | memoryview]:
    """JPEGs of some rows each.

    Parameters
    ----------
    data, layout : the whole JPEG, and :func:`read_layout` of it.
    rows : as :func:`whole_rows` has them.
    memory : where a JPEG may be put, to be used again for the next one: new memory would cost more than to
        fill it. It grows as needed.

    Returns
    -------
    A JPEG for each; without restart markers, data follows in it that no row needs.

    Raises
    ------
    FrameError
        Where restart markers are missing or out of order.
    """
    pieces: list[bytearray | memoryview]
    if layout.interval or not rows:
        pieces = [*_between(data, layout, rows)]
    else:
        memory.extend(bytes(max(len(data) - len(memory), 0)))
        pieces = [memoryview(memory)[: len(data)]]
        pieces[0][:] = data
    for piece, part in zip(pieces, rows, strict=True):
        piece[layout.height_at : layout.height_at + 2] = (part.stop - part.start).to_bytes(2, "big")
    return pieces


def _find_restarts(codes: NDArray[np.uint8], layout: Layout) -> NDArray[np.intp]:
    """Where restart markers are: by pieces, which stay in the processor's cache."""
    found = []
    for start in range(layout.data_at, len(codes) - 1, _AT_ONCE):
        ends = np.flatnonzero(codes[start : min(start + _AT_ONCE, len(codes) - 1)] == 0xFF) + start
        found.append(ends[(codes[ends + 1] & 0xF8) == _RESTART])
    return np.concatenate(found)


def _check_restarts(codes: NDArray[np.uint8], layout: Layout) -> None:
    """See that all restart markers are there, in their order: rows are found by counting them."""
    blocks = layout.blocks * -(-layout.height // layout.block_px)
    wanted = _RESTART + np.arange(-(-blocks // layout.interval) - 1) % _CYCLE
    if not np.array_equal(codes, wanted):
        raise FrameError("restart markers are missing or out of order")


def _between(data: bytes, layout: Layout, rows: Sequence[slice]) -> list[bytearray]:
    """The header, and the data of some rows, from one restart marker to another."""
    if not rows:
        return []
    codes = np.frombuffer(data, dtype=np.uint8)
    restarts = _find_restarts(codes, layout)
    _check_restarts(codes[restarts + 1], layout)
    starts = [layout.data_at, *(restarts + 2).tolist(), len(data)]
    pieces = []
    for part in rows:
        begin, end = (
            row // layout.block_px * layout.blocks // layout.interval for row in (part.start, part.stop)
        )
        if part.stop == layout.height:
            end = len(restarts) + 1
        start, stop = starts[begin], starts[end]
        piece = bytearray(data[: layout.data_at]) + data[start:stop]
        for number, at in enumerate(restarts[begin : end - 1].tolist()):
            piece[layout.data_at + at - start + 1] = _RESTART + number % _CYCLE
        piece[-2:] = _END
        pieces.append(piece)
    return pieces
