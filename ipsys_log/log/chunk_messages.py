"""Messages in log order: by log time, then by offset in the file; those of a chunk with few system calls."""

import heapq
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import chain
from typing import NamedTuple

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import check_compression, parse_chunk_contents, unpack
from ipsys_log.log.contents import RawMessage
from ipsys_log.log.records import (
    CHUNK_HEAD_SIZE,
    HEAD_SIZE,
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    ChunkRef,
    parse_chunk_head,
    parse_message_index,
)

_NEVER = 1 << 64  # ns, later than any log time


@dataclass(slots=True)
class Cursor:
    """The wanted messages of one chunk, in log order; `read_rows` yields the messages of a range of rows.

    `chunk_offset` is the offset of the chunk. It is None for messages outside of chunks: then the
    offsets of the messages define their order.
    """

    chunk_offset: int | None
    times: list[int]
    offsets: list[int]
    read_rows: Callable[[int, int], Iterator[RawMessage]]

    def key(self, row: int) -> tuple[int, int, int]:
        """Return the sort key of message `row` for log order."""
        offset = self.offsets[row]
        return self.times[row], offset if self.chunk_offset is None else self.chunk_offset, offset


class PendingChunk(NamedTuple):
    """A chunk that is opened only when its start time is reached, so that a log is never loaded whole."""

    start_ns: int
    offset: int
    open: Callable[[], Cursor]


def in_log_order(pending: Sequence[PendingChunk], fault: Callable[[int], Exception]) -> Iterator[RawMessage]:
    """Merge chunks, which may overlap in time, into one stream.

    `fault` returns the error for a chunk, given by its offset, with a message before the start of the chunk.
    """
    return chain.from_iterable(_split_by_chunk(pending, fault))


def _split_by_chunk(
    pending: Sequence[PendingChunk], fault: Callable[[int], Exception]
) -> Iterator[Iterator[RawMessage]]:
    """Yield the stream in parts; a new part begins if the next message comes from another chunk."""
    waiting = sorted(pending, key=lambda chunk: (chunk.start_ns, chunk.offset))
    heap: list[tuple[tuple[int, int, int], int, Cursor]] = []
    opened, last_ns = 0, 0
    while heap or opened < len(waiting):
        while opened < len(waiting) and (not heap or waiting[opened].start_ns <= heap[0][0][0]):
            chunk = waiting[opened]
            cursor = chunk.open()
            opened += 1
            if cursor.times:
                heapq.heappush(heap, (cursor.key(0), 0, cursor))
        if not heap:
            return
        (time, offset, _), row, cursor = heapq.heappop(heap)
        if time < last_ns:
            raise fault(offset)
        # Yield messages of this chunk up to the first message that another chunk has, or may have.
        until_ns = heap[0][0][0] if heap else _NEVER
        if opened < len(waiting) and waiting[opened].start_ns < until_ns:
            until_ns = waiting[opened].start_ns
        stop = bisect_left(cursor.times, until_ns, row + 1)
        yield cursor.read_rows(row, stop)
        last_ns = cursor.times[stop - 1]
        if stop < len(cursor.times):
            heapq.heappush(heap, (cursor.key(stop), stop, cursor))


ALWAYS = (0, (1 << 64) - 1)  # ns
_GAP = 4096  # bytes: to read a smaller gap costs less than another system call
_RUN = 256 << 10  # bytes read at once
_LONG = 16 << 10  # bytes: to copy a longer message costs more than another system call
Rows = NDArray[np.uint64]  # shape (N, 2): log time in ns, offset in the chunk or the file
Entries = Mapping[int, Rows]  # by channel id
Run = tuple[int, int]  # start and end of a byte range


def to_rows(entries: Mapping[int, list[tuple[int, int]]]) -> Entries:
    return {channel: np.array(rows, np.uint64).reshape(-1, 2) for channel, rows in entries.items()}


def chunk_entries(
    view: LogBytes, chunk: ChunkRef, searched: dict[int, Entries], wanted: set[int] | None = None
) -> Entries:
    """Return the rows of a chunk's messages, from its message indexes if there are any.

    `searched` caches the rows of chunks without indexes by chunk offset. So each such chunk is searched once.
    """
    if not chunk.index_offsets or not chunk.index_length:
        if chunk.offset not in searched:
            data = unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
            searched[chunk.offset] = to_rows(parse_chunk_contents(view, chunk.offset, data).entries)
        return searched[chunk.offset]
    start = chunk.offset + chunk.length
    data = view.read(start, chunk.index_length)
    entries = {}
    for channel, offset in chunk.index_offsets.items():
        if wanted is None or channel in wanted:
            rows = parse_message_index(view, data, offset - start, channel, offset)
            entries[channel] = np.frombuffer(rows, "<u8").reshape(-1, 2)
    return entries


def planned_range(chunk: ChunkRef) -> Run:
    """Return the range of a chunk that its first reader needs: its message indexes, or all of it.

    A chunk of images has indexes that are often read alone, and little else that is needed without them.
    """
    is_whole = chunk.length <= _SMALL or chunk.compressed_size < _PACKED * chunk.uncompressed_size
    return chunk.offset if is_whole or not chunk.index_length else chunk.offset + chunk.length, chunk.end


def _row_ranges(chunk: ChunkRef, entries: Entries, rows: Rows) -> Iterator[Run]:
    """Yield the range in the file of each wanted row of an uncompressed chunk."""
    starts = sorted({offset for part in entries.values() for offset in part[:, 1].tolist()})
    first = chunk.offset + CHUNK_HEAD_SIZE
    for offset in rows[:, 1].tolist():
        number = bisect_right(starts, offset)
        stop = starts[number] if number < len(starts) else chunk.uncompressed_size
        yield first + offset, min(first + max(stop, offset), chunk.end)


def wanted_rows(entries: Entries, topics: Mapping[int, str], span: tuple[int, int]) -> Rows:
    """Return the rows of channels in `topics` with start <= log time <= end, sorted by time and offset."""
    parts = [rows for channel, rows in entries.items() if channel in topics]
    if not parts:
        return np.empty((0, 2), np.uint64)
    rows = parts[0] if len(parts) == 1 else np.concatenate(parts)
    if span != ALWAYS:
        rows = rows[(rows[:, 0] >= span[0]) & (rows[:, 0] <= span[1])]
    return rows[np.lexsort((rows[:, 1], rows[:, 0]))]


def runs(entries: Entries, wanted: Rows, end: int) -> list[Run]:
    """Return the byte range to read for each wanted row; rows in the same range share one object.

    Messages that lie close together are read at once. An index does not have the length of a message. A
    message ends at the start of the next message or before. A long message has an empty range: it is read
    without a copy, after its head has given its length.
    """
    starts = sorted({offset for rows in entries.values() for offset in rows[:, 1].tolist()})
    starts.append(end)
    offsets = wanted[:, 1].tolist()
    run_of: dict[int, Run] = {}
    group: list[int] = []
    low = high = 0
    for offset in sorted(offsets):
        stop = starts[bisect_right(starts, offset)] if offset < end else offset
        if stop - offset > _LONG:
            run_of[offset] = (offset, offset)
            continue
        if group and (offset - high > _GAP or stop - low > _RUN):
            run_of |= dict.fromkeys(group, (low, high))
            group = []
        low = low if group else offset
        group.append(offset)
        high = stop
    run_of |= dict.fromkeys(group, (low, high))
    return [run_of[offset] for offset in offsets]


_CACHE_BYTES = 64 << 20
_SMALL = 64 << 10  # bytes: the indexes of a smaller chunk are not worth a read of their own
_PACKED = 0.75  # of its size: a chunk that is compressed to less has no images
_OPCODE = int(Opcode.MESSAGE)
_SHORTEST = MESSAGE_HEAD_SIZE - HEAD_SIZE  # bytes: the length of a Message record without payload
_new = tuple.__new__  # RawMessage(...) calls a Python function and takes twice as long


@dataclass(slots=True, eq=False)
class RangeCache:
    """A cache of the byte ranges read last. Its memory is bounded, even if many chunks overlap in time."""

    capacity: int = _CACHE_BYTES
    searched: dict[int, Entries] = field(default_factory=dict)  # rows of chunks without message indexes
    _cache: "OrderedDict[tuple[int, int, int], bytes]" = field(default_factory=OrderedDict)
    _size: int = 0

    def fetch(self, chunk_offset: int, read: Callable[[int, int], bytes], low: int, high: int) -> bytes:
        """Return bytes `low` to `high` of the chunk at `chunk_offset`; `read` reads missing bytes."""
        if low == high:
            return b""
        key = (chunk_offset, low, high)
        data = self._cache.get(key)
        if data is not None:
            self._cache.move_to_end(key)
            return data
        data = read(low, high)
        self._cache[key] = data
        self._size += len(data)
        while self._size > self.capacity and len(self._cache) > 1:
            self._size -= len(self._cache.popitem(last=False)[1])
        return data


@dataclass(slots=True)
class _Messages:
    """The wanted messages of one chunk, by row.

    `runs` has the byte range to `fetch` first for each message. `read` reads bytes outside of this range.
    """

    view: LogBytes
    topics: Mapping[int, str]
    chunk_offset: int  # the chunk's offset, 0 for messages in no chunk
    times: list[int]
    offsets: list[int]
    runs: list[Run]
    fetch: Callable[[int, int], bytes]
    read: Callable[[int, int], bytes]
    spare: int  # bytes: limit for the remaining messages together; if they have more, messages overlap

    def read_rows(self, first: int, stop: int) -> Iterator[RawMessage]:
        """Yield the messages of rows `first` to `stop`; each record must agree with the index."""
        # Reading small messages spends its time here. So most of them need no call of a Python function.
        unpack, topic_of = MESSAGE.unpack_from, self.topics.get
        data, low, size, fetched = b"", 0, 0, None
        largest = self.view.read_limits.max_payload
        rows = slice(first, stop)
        for indexed_time, offset, run in zip(
            self.times[rows], self.offsets[rows], self.runs[rows], strict=True
        ):
            if run is not fetched:
                data, low, fetched = self.fetch(*run), run[0], run
                size = len(data)
            start = offset - low
            if start + MESSAGE_HEAD_SIZE <= size:
                opcode, length, channel, _, time, published = unpack(data, start)
            else:
                head = self.read(offset, offset + MESSAGE_HEAD_SIZE)
                opcode, length, channel, _, time, published = unpack(head)
            topic = topic_of(channel)
            if time != indexed_time or opcode != _OPCODE or length < _SHORTEST or topic is None:
                fault_offset = self.chunk_offset or offset
                raise self.view.fault(fault_offset, "a message index points to no message of its time")
            if largest < length < self.spare:
                raise self.view.refusal(f"one of its messages has {length} bytes, more than {largest}")
            end = start + HEAD_SIZE + length
            if end <= size:
                payload = data[start + MESSAGE_HEAD_SIZE : end]
            else:
                payload = self.read(offset + MESSAGE_HEAD_SIZE, offset + HEAD_SIZE + length)
            self.spare -= length
            if self.spare < 0:
                raise self.view.fault(self.chunk_offset, "its message indexes name bytes more than once")
            yield _new(RawMessage, (topic, time, published, payload))


@dataclass(slots=True)
class _Records:
    """The records of one chunk, by their offsets in the chunk. A compressed chunk is unpacked once.

    Unpacked records stay in memory until the last message is read, because chunks may overlap in time.
    """

    view: LogBytes
    chunk: ChunkRef
    whole: bytes | None = None

    def read(self, low: int, high: int) -> bytes:
        if low < 0 or high > self.chunk.uncompressed_size:
            raise self.view.fault(self.chunk.offset, "a message reaches beyond the end of its chunk")
        if not self.chunk.compression:
            return self.view.read(self.chunk.offset + CHUNK_HEAD_SIZE + low, high - low)
        data = self.unpacked()[low:high]
        if len(data) != high - low:
            raise self.view.fault(self.chunk.offset, "a message reaches beyond the end of its chunk")
        return data

    def unpacked(self, *_: int) -> bytes:
        """Return all records; their CRC is checked."""
        if self.whole is None:
            offset = self.chunk.offset
            self.whole = unpack(self.view, offset, parse_chunk_head(self.view, offset)[1])
        return self.whole


def open_chunk(
    view: LogBytes,
    cache: RangeCache,
    chunk: ChunkRef,
    topics: Mapping[int, str],
    span: tuple[int, int],
    is_checked: bool = False,
) -> Cursor:
    """Return a cursor over the messages of the channels in `topics` with start <= log time <= end.

    With `is_checked`, the chunk is read as a whole, and its CRC is checked.
    """
    offset, size = chunk.offset, chunk.uncompressed_size
    check_compression(view, chunk.compression)
    entries = chunk_entries(view, chunk, cache.searched)
    rows = wanted_rows(entries, topics, span)
    records = _Records(view, chunk)
    if is_checked or chunk.compression:
        ranges, fetch = [(0, size)] * len(rows), records.unpacked
    else:
        view.plan("messages", _row_ranges(chunk, entries, rows))
        ranges, fetch = runs(entries, rows, size), partial(cache.fetch, offset, records.read)
    times, offsets = rows.T.tolist()
    messages = _Messages(view, topics, offset, times, offsets, ranges, fetch, records.read, size)
    return Cursor(offset, times, offsets, messages.read_rows)


def open_unchunked(
    view: LogBytes,
    cache: RangeCache,
    entries: Entries,
    topics: Mapping[int, str],
    span: tuple[int, int],
    end: int,
) -> Cursor:
    """Return a cursor over messages that lie in no chunk; `end` is the end offset of the data section."""

    def read(low: int, high: int) -> bytes:
        return view.read(low, high - low)

    rows = wanted_rows(entries, topics, span)
    ranges, fetch = runs(entries, rows, end), partial(cache.fetch, 0, read)
    times, offsets = rows.T.tolist()
    messages = _Messages(view, topics, 0, times, offsets, ranges, fetch, read, end)
    return Cursor(None, times, offsets, messages.read_rows)
