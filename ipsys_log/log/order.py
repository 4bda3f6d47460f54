"""Log order: by log time, then by offset in the file."""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from ipsys_log.log.contents import RawMessage

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
