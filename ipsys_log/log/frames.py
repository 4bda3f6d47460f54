"""Reading parts of a compressed chunk in place.

Images do not compress: the compressors store them as raw blocks inside their frames. A message that
lies in raw blocks can be read straight from the file. Frame formats: RFC 8878 (zstd), lz4_Frame_format.md.
"""

import struct
from bisect import bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from ipsys_log.log.view import View

__all__ = ["RawBlocks"]

_ZSTD_MAGIC = 0xFD2FB528
_LZ4_MAGIC = 0x184D2204
_HEAD = 24  # more than the longest frame head of both formats


@dataclass(frozen=True, slots=True)
class _Block:
    start: int  # in the uncompressed chunk
    length: int
    offset: int  # in the file


@dataclass(slots=True)
class RawBlocks:
    """The raw blocks at the beginning of one compressed frame, found as far as they are asked for."""

    view: View
    _blocks: Iterator[_Block]
    _known: list[_Block] = field(default_factory=list)

    @classmethod
    def of(cls, view: View, compression: str, offset: int, size: int) -> "RawBlocks | None":
        """For the frame at `offset` in the file, None if its format is not known here."""
        walker = _WALKERS.get(compression)
        return None if walker is None else cls(view, walker(view, offset, offset + size))

    def read(self, start: int, end: int) -> bytes | None:
        """Bytes `start` to `end` of the uncompressed chunk, None if they do not all lie in raw blocks."""
        while not self._known or self._known[-1].start + self._known[-1].length < end:
            block = next(self._blocks, None)
            if block is None:
                return None
            self._known.append(block)
        parts = []
        for block in self._known[bisect_right(self._known, start, key=lambda known: known.start) - 1 :]:
            if block.start >= end:
                break
            low, high = max(start, block.start), min(end, block.start + block.length)
            parts.append(self.view.read(block.offset + low - block.start, high - low))
        return b"".join(parts)


def _zstd_blocks(view: View, offset: int, end: int) -> Iterator[_Block]:
    head = view.read(offset, min(_HEAD, end - offset))
    if len(head) < 6 or struct.unpack_from("<I", head)[0] != _ZSTD_MAGIC:
        return
    flags = head[4]
    single = flags >> 5 & 1
    content_size = (single, 2, 4, 8)[flags >> 6]
    offset += 5 + (1 - single) + (0, 1, 2, 4)[flags & 3] + content_size
    start, last = 0, 0
    while not last and offset + 3 <= end:
        word = int.from_bytes(view.read(offset, 3), "little")
        last, kind, size = word & 1, word >> 1 & 3, word >> 3
        if kind != 0 or offset + 3 + size > end:
            return
        yield _Block(start, size, offset + 3)
        start, offset = start + size, offset + 3 + size


def _lz4_blocks(view: View, offset: int, end: int) -> Iterator[_Block]:
    head = view.read(offset, min(_HEAD, end - offset))
    if len(head) < 7 or struct.unpack_from("<I", head)[0] != _LZ4_MAGIC:
        return
    flags = head[4]
    offset += 7 + (flags >> 3 & 1) * 8 + (flags & 1) * 4
    checksum = (flags >> 4 & 1) * 4
    start = 0
    while offset + 4 <= end:
        word = int.from_bytes(view.read(offset, 4), "little")
        size = word & 0x7FFFFFFF
        if not word >> 31 or offset + 4 + size + checksum > end:
            return
        yield _Block(start, size, offset + 4)
        start, offset = start + size, offset + 4 + size + checksum


_WALKERS: dict[str, Callable[[View, int, int], Iterator[_Block]]] = {
    "zstd": _zstd_blocks,
    "lz4": _lz4_blocks,
}
