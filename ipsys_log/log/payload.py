"""Getting at the messages of one chunk while reading no more of it than is needed."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from ipsys_log.log.chunks import check_compression, look_inside, unpack
from ipsys_log.log.frames import EqualBlocks, RawBlocks, find_blocks
from ipsys_log.log.order import Cursor
from ipsys_log.log.records import (
    CHUNK_HEAD_SIZE,
    ENTRY,
    HEADER,
    MESSAGE,
    ChunkRef,
    parse_chunk_head,
    parse_message_index,
)
from ipsys_log.log.types import RawMessage
from ipsys_log.log.view import View

__all__ = ["Blocks", "chunk_entries", "open_chunk", "open_loose"]

_CACHE_BYTES = 64 << 20
_GAP = 4096  # bytes: reading across less than this costs less than another system call
_RUN = 4 << 20  # bytes read at once
_SMALL = 64 << 10  # a compressed chunk below this is decompressed whole without looking at its blocks

Entries = Mapping[int, list[tuple[int, int]]]


@dataclass(slots=True)
class Blocks:
    """The stretches of records read last, so that memory stays bounded however many chunks overlap."""

    capacity: int = _CACHE_BYTES
    _held: "OrderedDict[tuple[int, int], bytes]" = field(default_factory=OrderedDict)
    _size: int = 0

    def get(self, key: tuple[int, int], read: Callable[[], bytes]) -> bytes:
        """The block under `key`, by `read` if it is not held."""
        data = self._held.get(key)
        if data is not None:
            self._held.move_to_end(key)
            return data
        data = read()
        self._held[key] = data
        self._size += len(data)
        while self._size > self.capacity and len(self._held) > 1:
            self._size -= len(self._held.popitem(last=False)[1])
        return data


@dataclass(slots=True)
class _Messages:
    """Rows of messages of one chunk: where each lies and which stretch to read for it."""

    view: View
    blocks: Blocks
    topics: Mapping[int, str]
    place: int  # the chunk's offset, 0 for messages in no chunk
    times: list[int]
    offsets: list[int]
    runs: list[tuple[int, int, bool]]
    read: Callable[[int, int], bytes]

    def load(self, row: int) -> RawMessage:
        """The message of `row`; what its record says must agree with the index."""
        offset, (low, high, shared) = self.offsets[row], self.runs[row]
        if shared:
            data = self.blocks.get((self.place, low), lambda: self.read(low, high))
        else:
            data = self.read(low, high)
        start = offset - low
        if start + MESSAGE.size > len(data):
            data, start = self.read(offset, offset + MESSAGE.size), 0
        opcode, length, channel, _, time, published = MESSAGE.unpack_from(data, start)
        topic = self.topics.get(channel)
        if opcode != Opcode.MESSAGE or time != self.times[row] or topic is None or length < 22:
            raise self.view.fault(self.place or offset, "a message index points to no message of its time")
        end = start + HEADER.size + length
        if end > len(data):
            data = self.read(offset, offset + HEADER.size + length)
            start, end = 0, len(data)
        return RawMessage(topic, time, published, data[start + MESSAGE.size : end])


@dataclass(slots=True)
class _Records:
    """The records of one chunk, by their offsets in it, read in place where that is possible."""

    view: View
    chunk: ChunkRef
    raw: EqualBlocks | RawBlocks | None
    whole: bytes | None = None

    def read(self, low: int, high: int) -> bytes:
        chunk = self.chunk
        if low < 0 or high > chunk.uncompressed_size:
            raise self.view.fault(chunk.offset, "a message reaches beyond the end of its chunk")
        if not chunk.compression:
            return self.view.read(chunk.offset + CHUNK_HEAD_SIZE + low, high - low)
        data = self.raw.read(low, high) if self.raw is not None else None
        return self._whole()[low:high] if data is None else data

    def _whole(self) -> bytes:
        """Decompressed once, and held while messages of it are due: chunks may overlap in time."""
        if self.whole is None:
            at = self.chunk.offset
            self.whole = unpack(self.view, at, parse_chunk_head(self.view, at)[1])
        return self.whole


def chunk_entries(view: View, chunk: ChunkRef, wanted: set[int] | None = None) -> Entries:
    """Per channel id the (log time in ns, offset in the chunk) of its messages, from the indexes if any."""
    if not chunk.index_offsets or not chunk.index_length:
        data = unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
        return look_inside(view, chunk.offset, data).entries
    start = chunk.offset + chunk.length
    data = view.read(start, chunk.index_length)
    return {
        channel: list(ENTRY.iter_unpack(parse_message_index(view, data, offset - start, channel, offset)))
        for channel, offset in chunk.index_offsets.items()
        if wanted is None or channel in wanted
    }


def open_chunk(
    view: View, blocks: Blocks, chunk: ChunkRef, topics: Mapping[int, str], span: tuple[int, int]
) -> Cursor:
    """A cursor over the messages of the channels in `topics` with start <= log time <= end."""
    check_compression(view, chunk.compression)
    entries = chunk_entries(view, chunk)
    times, offsets = _rows(entries, topics, span)
    runs = _runs(entries, offsets, chunk.uncompressed_size)
    raw: EqualBlocks | RawBlocks | None = None
    if chunk.compression and chunk.compressed_size > _SMALL and len(runs) * _GAP < chunk.compressed_size:
        at = chunk.offset + CHUNK_HEAD_SIZE + len(chunk.compression)
        raw = find_blocks(view, chunk.compression, at, chunk.compressed_size, chunk.uncompressed_size)
    records = _Records(view, chunk, raw)
    messages = _Messages(view, blocks, topics, chunk.offset, times, offsets, runs, records.read)
    return Cursor(chunk.offset, times, offsets, messages.load)


def open_loose(
    view: View, blocks: Blocks, entries: Entries, topics: Mapping[int, str], span: tuple[int, int], end: int
) -> Cursor:
    """The same for messages that lie in no chunk; `end` is where the data section ends."""
    times, offsets = _rows(entries, topics, span)
    runs = _runs(entries, offsets, end)
    messages = _Messages(
        view, blocks, topics, 0, times, offsets, runs, lambda low, high: view.read(low, high - low)
    )
    return Cursor(None, times, offsets, messages.load)


def _rows(entries: Entries, topics: Mapping[int, str], span: tuple[int, int]) -> tuple[list[int], list[int]]:
    """Times and offsets of the wanted messages, sorted by (time, offset)."""
    low, high = span
    rows = [
        row
        for channel, found in entries.items()
        if channel in topics
        for row in found
        if low <= row[0] <= high
    ]
    rows.sort()
    return [time for time, _ in rows], [offset for _, offset in rows]


def _runs(entries: Entries, offsets: list[int], end: int) -> list[tuple[int, int, bool]]:
    """For each offset the stretch to read, and whether several messages share it.

    Neighbours that lie close together are read at once. An index does not say how long a message is; it
    ends where the next one begins at the latest.
    """
    starts = sorted({offset for rows in entries.values() for _, offset in rows})
    starts.append(end)
    run_of: dict[int, tuple[int, int, bool]] = {}
    group: list[int] = []
    low = high = 0
    for offset in sorted(offsets):
        stop = starts[bisect_right(starts, offset)] if offset < end else offset
        if group and (offset - high > _GAP or stop - low > _RUN):
            _close(run_of, group, low, high)
            group = []
        low = low if group else offset
        group.append(offset)
        high = stop
    _close(run_of, group, low, high)
    return [run_of[offset] for offset in offsets]


def _close(run_of: dict[int, tuple[int, int, bool]], group: list[int], low: int, high: int) -> None:
    run = (low, high, len(group) > 1)
    for offset in group:
        run_of[offset] = run
