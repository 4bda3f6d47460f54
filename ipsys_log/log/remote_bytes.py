"""Bytes of a log in a store: few requests for exact ranges, joined by a plan, in a bounded cache.

A request takes as long as some hundred kilobytes. So ranges that the reader is going to need are joined over
small gaps, and a sequence of reads without a plan is read ahead, twice as far each time.
"""

import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import BoundError, LogBytes, ReadLimits
from ipsys_log.log.location import LogUrl
from ipsys_log.log.remote_object import RemoteObject, open_object

Range = tuple[int, int]  # start and end, in bytes

_TAIL = 256 << 10  # bytes: the summary of most logs, and the last runs before it
_HEAD = 96 << 10  # bytes: the start of the file with its schemas, up to the first chunk
GAP = 64 << 10  # bytes: to fetch a smaller gap costs less than another request
_LONGEST_JOINED = 2 << 20  # bytes: only a part of a plan may be needed
_FIRST_AHEAD = 64 << 10  # bytes
_LONGEST_AHEAD = 8 << 20
_CACHE_BYTES = 64 << 20


def join_ranges(ranges: Iterable[Range], gap: int = GAP, longest: int = _LONGEST_JOINED) -> list[Range]:
    """Return ranges joined over gaps of at most `gap` bytes, sorted; only one range may exceed `longest`.

    Examples
    --------
    >>> join_ranges([(0, 10), (12, 20), (100, 110), (105, 108)], gap=5)
    [(0, 20), (100, 110)]
    """
    joined: list[Range] = []
    for start, end in sorted(ranges):
        if joined and start <= joined[-1][1] + gap and max(end, joined[-1][1]) - joined[-1][0] <= longest:
            joined[-1] = joined[-1][0], max(end, joined[-1][1])
        elif not joined or end > joined[-1][1]:
            joined.append((max(start, joined[-1][1]) if joined else start, end))
    return joined


@dataclass(slots=True)
class RemoteRanges:
    """The fetched ranges of an object: a cache with the plans of what is fetched together.

    Several threads may read.
    """

    source: RemoteObject
    capacity: int = _CACHE_BYTES
    _plans: dict[str, list[Range]] = field(default_factory=dict)
    _blocks: OrderedDict[int, bytes] = field(default_factory=OrderedDict)  # by start, the oldest read first
    _starts: list[int] = field(default_factory=list)
    _held: int = 0
    _ahead_from: int = -1
    _ahead: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __post_init__(self) -> None:
        size = self.source.size
        self._plans["ends"] = join_ranges([(0, min(_HEAD, size)), (max(0, size - _TAIL), size)])

    def plan(self, name: str, ranges: Iterable[Range]) -> None:
        """Replace the plan of this name: a read in one of its joined ranges fetches the whole range."""
        with self._lock:
            self._plans[name] = join_ranges(ranges)

    def read(self, offset: int, length: int) -> bytes:
        """Return exactly `length` bytes at `offset`."""
        parts, position, end = [], offset, offset + length
        with self._lock:
            while position < end:
                start, block = self._block_at(position) or self._fetched(position, end)
                part = block[position - start : end - start]
                parts.append(part)
                position += len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def _block_at(self, position: int) -> tuple[int, bytes] | None:
        number = bisect_right(self._starts, position) - 1
        if number < 0:
            return None
        start = self._starts[number]
        if position >= start + len(self._blocks[start]):
            return None
        self._blocks.move_to_end(start)
        return start, self._blocks[start]

    def _fetched(self, position: int, end: int) -> tuple[int, bytes]:
        """Fetch the missing block at `position`, with what is planned around it or read ahead."""
        low, high = self._free_around(position)
        start, stop = self._planned(position) or self._read_ahead(position, end)
        start, stop = max(start, low), min(stop, high)
        data = self.source.fetch(start, stop)
        self._keep(start, data)
        return start, data

    def _free_around(self, position: int) -> Range:
        """Return the range around `position` that no block covers."""
        number = bisect_right(self._starts, position)
        before = self._starts[number - 1] if number else 0
        low = before + len(self._blocks[before]) if number else 0
        return low, self._starts[number] if number < len(self._starts) else self.source.size

    def _planned(self, position: int) -> Range | None:
        for ranges in self._plans.values():
            number = bisect_right(ranges, (position, self.source.size)) - 1
            if number >= 0 and ranges[number][0] <= position < ranges[number][1]:
                return ranges[number]
        return None

    def _read_ahead(self, position: int, end: int) -> Range:
        """Return the range from `position` to `end`, and more if the last read ended just before."""
        follows = 0 <= position - self._ahead_from <= GAP
        self._ahead = min(2 * self._ahead, _LONGEST_AHEAD) if follows and self._ahead else 0
        stop = min(max(end, position + self._ahead), self.source.size)
        if not self._ahead:
            self._ahead = _FIRST_AHEAD // 2
        self._ahead_from = stop
        return position, stop

    def _keep(self, start: int, data: bytes) -> None:
        self._blocks[start] = data
        self._starts.insert(bisect_right(self._starts, start), start)
        self._held += len(data)
        while self._held > self.capacity and len(self._blocks) > 1:
            oldest, dropped = self._blocks.popitem(last=False)
            self._held -= len(dropped)
            self._starts.remove(oldest)


@dataclass(slots=True)
class RemoteBytes(LogBytes):
    """The bytes of a log in a store, at the version that was opened."""

    path: LogUrl
    ranges: RemoteRanges
    bytes_read: int = 0
    size: int = field(init=False)
    read_limits: ReadLimits = field(init=False)

    def __post_init__(self) -> None:
        self.size = self.ranges.source.size
        self.read_limits = ReadLimits(self.size)

    @staticmethod
    def open(url: LogUrl) -> "RemoteBytes":
        """Look an object up; nothing of it is read yet."""
        return RemoteBytes(url, RemoteRanges(open_object(url)))

    def identity(self) -> tuple[object, object]:
        return self.path, self.ranges.source.version

    def read(self, offset: int, length: int) -> bytes:
        if offset < 0 or length < 0 or offset + length > self.size:
            excess = offset + length - self.size
            raise self.fault(offset, f"a record reaches {excess} bytes beyond the end of the file")
        self.bytes_read += length
        return self.ranges.read(offset, length)

    def plan(self, name: str, ranges: Iterable[Range]) -> None:
        self.ranges.plan(name, ranges)

    def fault(self, offset: int, reason: str) -> LogError:
        return LogError(
            f"{self.path} is damaged at byte {offset}: {reason}. Download it, and run: ipsys repair FILE"
        )

    def refusal(self, reason: str) -> BoundError:
        return BoundError(
            f"{self.path} is refused: {reason}. If it is a true recording, download and unpack it"
        )
