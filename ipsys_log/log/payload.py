"""Getting at the messages of one chunk while reading no more of it than is needed."""

from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ipsys_log.log.chunks import check_compression, look_inside, unpack
from ipsys_log.log.frames import RawBlocks
from ipsys_log.log.order import Cursor
from ipsys_log.log.records import HEADER, MESSAGE, ChunkRef, parse_chunk_head, parse_message_index
from ipsys_log.log.types import RawMessage
from ipsys_log.log.view import View

__all__ = ["Blocks", "chunk_entries", "open_chunk", "open_loose"]

_CACHE_BYTES = 64 << 20
_GAP = 4096  # bytes: reading across less than this costs less than another system call
_RUN = 4 << 20  # bytes read at once
_SMALL = 64 << 10  # a compressed chunk below this is decompressed whole without looking at its blocks

Entries = Mapping[int, NDArray[Any]]


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
    runs: list[tuple[int, int]]
    read: Callable[[int, int], bytes]

    def load(self, row: int) -> RawMessage:
        """The message of `row`; what its record says must agree with the index."""
        offset, (low, high) = self.offsets[row], self.runs[row]
        data = self.blocks.get((self.place, low), lambda: self.read(low, high))
        start = offset - low
        if start + MESSAGE.size > len(data):
            data, start = self.read(offset, offset + MESSAGE.size), 0
        opcode, length, channel, _, time, published = MESSAGE.unpack_from(data, start)
        end = start + HEADER.size + length
        if opcode != Opcode.MESSAGE or time != self.times[row] or channel not in self.topics or length < 22:
            raise self.view.fault(self.place or offset, "a message index points to no message of its time")
        if end > len(data):
            data = self.read(offset, offset + HEADER.size + length)
            start, end = 0, len(data)
        return RawMessage(self.topics[channel], time, published, data[start + MESSAGE.size : end])


def chunk_entries(view: View, chunk: ChunkRef, wanted: set[int] | None = None) -> Entries:
    """Per channel id the (log time in ns, offset in the chunk) of its messages, from the indexes if any."""
    if not chunk.index_offsets or not chunk.index_length:
        data = unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
        return look_inside(view, chunk.offset, data).arrays()
    start = chunk.offset + chunk.length
    data = view.read(start, chunk.index_length)
    return {
        channel: parse_message_index(view, data, offset - start, channel, offset)
        for channel, offset in chunk.index_offsets.items()
        if wanted is None or channel in wanted
    }


def open_chunk(
    view: View, blocks: Blocks, chunk: ChunkRef, topics: Mapping[int, str], span: tuple[int, int]
) -> Cursor:
    """A cursor over the messages of the channels in `topics` with start <= log time < end."""
    _, head = parse_chunk_head(view, chunk.offset)
    check_compression(view, head.compression)
    entries = chunk_entries(view, chunk)
    times, offsets = _rows(entries, topics, span)
    runs = _runs(entries, offsets, head.uncompressed_size)
    raw = None
    if head.compression and head.data_size > _SMALL and sum(b - a for a, b in set(runs)) * 2 < head.data_size:
        raw = RawBlocks.of(view, head.compression, head.data_offset, head.data_size)

    def read(low: int, high: int) -> bytes:
        if low < 0 or high > head.uncompressed_size:
            raise view.fault(chunk.offset, "a message reaches beyond the end of its chunk")
        if not head.compression:
            if high > head.data_size:
                raise view.fault(chunk.offset, "a message reaches beyond the end of its chunk")
            return view.read(head.data_offset + low, high - low)
        data = raw.read(low, high) if raw is not None else None
        if data is None:
            data = blocks.get((chunk.offset, -1), lambda: unpack(view, chunk.offset, head))[low:high]
        return data

    messages = _Messages(view, blocks, topics, chunk.offset, times, offsets, runs, read)
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
    parts = [rows for channel, rows in entries.items() if channel in topics]
    if not parts:
        return [], []
    rows = np.concatenate(parts)
    rows = rows[(rows[:, 0] >= span[0]) & (rows[:, 0] <= span[1])]
    rows = rows[np.lexsort((rows[:, 1], rows[:, 0]))]
    return rows[:, 0].tolist(), rows[:, 1].tolist()


def _runs(entries: Entries, offsets: list[int], end: int) -> list[tuple[int, int]]:
    """For each offset the stretch to read: neighbours that lie close together are read at once.

    An index does not say how long a message is; it ends where the next one begins at the latest.
    """
    if not offsets:
        return []
    starts = np.unique(np.concatenate([rows[:, 1] for rows in entries.values()]))
    stops = np.append(starts[1:], np.uint64(end))
    ordered = sorted(set(offsets))
    limits = stops[np.searchsorted(starts, np.array(ordered, np.uint64))].tolist()
    run_of: dict[int, tuple[int, int]] = {}
    group: list[int] = []
    low, high = ordered[0], ordered[0]
    for offset, limit in zip(ordered, limits, strict=True):
        if offset - high > _GAP or (group and limit - low > _RUN):
            run_of.update(dict.fromkeys(group, (low, high)))
            group, low = [], offset
        group.append(offset)
        high = max(limit, offset)
    run_of.update(dict.fromkeys(group, (low, high)))
    return [run_of[offset] for offset in offsets]
