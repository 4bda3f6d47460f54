"""Reading parts of a compressed chunk in place.

Images do not compress: the compressors store them as raw blocks inside their frames. A message that
lies in raw blocks can be read straight from the file. Frame formats: RFC 8878 (zstd), lz4_Frame_format.md.
"""

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass, field

from ipsys_log.log.byte_source import View

__all__ = ["EqualBlocks", "RawBlocks", "find_blocks"]

_ZSTD_MAGIC = (0xFD2FB528).to_bytes(4, "little")
_LZ4_MAGIC = (0x184D2204).to_bytes(4, "little")
_ZSTD_BLOCK = 128 << 10  # the most that one block holds, and what compressors put into each but the last
_HEAD = 24  # more than the longest frame head of both formats


@dataclass(frozen=True, slots=True)
class _Block:
    start: int  # in the uncompressed chunk
    length: int
    offset: int  # in the file


@dataclass(frozen=True, slots=True)
class EqualBlocks:
    """A frame of raw blocks that are all full but the last; the first begins at `offset` in the file.

    A compressor never makes a block longer. So if the length of the frame is the sum over raw blocks,
    they are. Should a crafted frame deceive, no message of the time in the index is found: that is
    checked for every message.
    """

    view: View
    offset: int
    size: int
    head: int
    extra: int  # head and checksum

    def read(self, start: int, end: int) -> bytes | None:
        """Bytes `start` to `end` of the uncompressed chunk."""
        first = start // self.size
        at = self.offset + self.head + first * self.extra
        if end <= (first + 1) * self.size:
            return self.view.read(at + start, end - start)
        parts = []
        while start < end:
            stop = min(end, (first + 1) * self.size)
            parts.append(self.view.read(at + start, stop - start))
            first, at, start = first + 1, at + self.extra, stop
        return b"".join(parts)


@dataclass(slots=True)
class RawBlocks:
    """The raw blocks at the beginning of a frame, found one by one as far as they are asked for."""

    view: View
    _blocks: Iterator[_Block]
    _known: list[_Block] = field(default_factory=list)

    def read(self, start: int, end: int) -> bytes | None:
        """Bytes `start` to `end` of the uncompressed chunk, None if they do not all lie in raw blocks."""
        known = self._known
        while not known or known[-1].start + known[-1].length < end:
            block = next(self._blocks, None)
            if block is None:
                return None
            known.append(block)
        parts = []
        for block in known[bisect_right(known, start, key=_start) - 1 :]:
            if block.start >= end:
                break
            low, high = max(start, block.start), min(end, block.start + block.length)
            parts.append(self.view.read(block.offset + low - block.start, high - low))
        return parts[0] if len(parts) == 1 else b"".join(parts)


def find_blocks(
    view: View, compression: str, offset: int, size: int, content: int
) -> EqualBlocks | RawBlocks | None:
    """How to read parts of the frame of `size` bytes at `offset`, which holds `content` bytes.

    None if the frame is not of a format known here.
    """
    head = view.read(offset, min(_HEAD, size))
    end = offset + size
    if compression == "zstd" and len(head) == _HEAD and head.startswith(_ZSTD_MAGIC):
        flags, single = head[4], head[4] >> 5 & 1
        first = offset + 5 + (1 - single) + (0, 1, 2, 4)[flags & 3] + (single, 2, 4, 8)[flags >> 6]
        block, before, extra, after = _ZSTD_BLOCK, 3, 3, (flags >> 2 & 1) * 4
        blocks = _zstd_blocks(view, first, end)
    elif compression == "lz4" and len(head) == _HEAD and head.startswith(_LZ4_MAGIC):
        flags = head[4]
        first = offset + 7 + (flags >> 3 & 1) * 8 + (flags & 1) * 4
        checksum = (flags >> 4 & 1) * 4
        block, before = 1 << (8 + 2 * (head[5] >> 4 & 7)), 4
        extra, after = 4 + checksum, 4 + (flags >> 2 & 1) * 4
        blocks = _lz4_blocks(view, first, end, checksum)
    else:
        return None
    if end - first - after == content + extra * -(-content // block):
        return EqualBlocks(view, first, block, before, extra)
    return RawBlocks(view, blocks)


def _start(block: _Block) -> int:
    return block.start


def _zstd_blocks(view: View, offset: int, end: int) -> Iterator[_Block]:
    start, last = 0, 0
    while not last and offset + 3 <= end:
        word = int.from_bytes(view.read(offset, 3), "little")
        last, kind, size = word & 1, word >> 1 & 3, word >> 3
        if kind != 0 or offset + 3 + size > end:
            return
        yield _Block(start, size, offset + 3)
        start, offset = start + size, offset + 3 + size


def _lz4_blocks(view: View, offset: int, end: int, checksum: int) -> Iterator[_Block]:
    start = 0
    while offset + 4 <= end:
        word = int.from_bytes(view.read(offset, 4), "little")
        size = word & 0x7FFFFFFF
        if not word >> 31 or offset + 4 + size + checksum > end:
            return
        yield _Block(start, size, offset + 4)
        start, offset = start + size, offset + 4 + size + checksum
