"""Log order: by log time, then by place in the file."""

import heapq
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

from ipsys_log.log.contents import RawMessage

__all__ = ["Cursor", "Pending", "in_log_order"]

_NEVER = 1 << 64  # ns, later than any log time


@dataclass(slots=True)
class Cursor:
    """The wanted messages of one chunk, in log order; `between` gives those of a range of rows.

    `place` is the offset of the chunk, None if the messages lie in none: then theirs count.
    """

    place: int | None
    times: list[int]
    offsets: list[int]
    between: Callable[[int, int], Iterator[RawMessage]]

    def key(self, row: int) -> tuple[int, int, int]:
        """Where message `row` stands in log order."""
        offset = self.offsets[row]
        return self.times[row], offset if self.place is None else self.place, offset


class Pending(NamedTuple):
    """A chunk that is opened when its time has come: no earlier, so that a log is never loaded whole."""

    start_ns: int
    offset: int
    open: Callable[[], Cursor]


def in_log_order(pending: Sequence[Pending], fault: Callable[[int], Exception]) -> Iterator[RawMessage]:
    """Merge chunks, which may overlap in time, into one stream.

    `fault` makes the error for a chunk (by its offset) that holds a message from before its own start.
    """
    return chain.from_iterable(_turns(pending, fault))


def _turns(pending: Sequence[Pending], fault: Callable[[int], Exception]) -> Iterator[Iterator[RawMessage]]:
    """The stream, cut where the next message comes from another chunk."""
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
        (time, place, _), row, cursor = heapq.heappop(heap)
        if time < last_ns:
            raise fault(place)
        # It is this chunk's turn up to the first message that another one has, or may have.
        until = heap[0][0][0] if heap else _NEVER
        if opened < len(waiting) and waiting[opened].start_ns < until:
            until = waiting[opened].start_ns
        stop = bisect_left(cursor.times, until, row + 1)
        yield cursor.between(row, stop)
        last_ns = cursor.times[stop - 1]
        if stop < len(cursor.times):
            heapq.heappush(heap, (cursor.key(stop), stop, cursor))
