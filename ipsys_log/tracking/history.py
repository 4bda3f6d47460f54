"""The recent sightings of one robot in order of time, each with the state after it."""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass, field
from typing import NamedTuple

from ipsys_log.tracking.filter import Sightings, States
from ipsys_log.units import NS_PER_S

__all__ = ["HISTORY_NS", "History", "Record"]

# A sighting that is older than the newest one by more than this is left out.
HISTORY_NS = NS_PER_S // 2
# More instants than this are checked for those that no late sighting can reach.
_MOST_ROWS = 256


class Record(NamedTuple):
    """An accepted sighting, and the state after it: one row each of the arrays of a message.

    ``inside`` is the flag of the position, see :class:`ipsys_log.messages.Position`.
    """

    time_ns: int
    camera: str
    inside: bool | None
    sightings: Sightings
    sighting: int
    states: States
    state: int


@dataclass(slots=True)
class History:
    """The records of one robot, for as long as a late sighting can change them.

    ``rows_ns`` are the instants of the poses that were given out. A ``complete`` history forgets nothing, for
    processing after the recording. ``began_ns`` is the time of the first record.
    """

    records: list[Record] = field(default_factory=list)
    rows_ns: set[int] = field(default_factory=set)
    complete: bool = False
    began_ns: int = 0

    @property
    def newest(self) -> Record:
        """The record with the latest time."""
        return self.records[-1]

    def place_of(self, time_ns: int) -> int:
        """Return the number of records at or before a time; those of the same time come first."""
        if time_ns >= self.records[-1].time_ns:
            return len(self.records)
        return bisect_right(self.records, time_ns, key=lambda record: record.time_ns)

    def replace_from(self, place: int, records: list[Record]) -> None:
        """Replace the records from a place on, and forget those that no late sighting can reach."""
        if not self.records or records[0].time_ns < self.began_ns:
            self.began_ns = records[0].time_ns
        self.records[place:] = records
        if self.complete:
            return
        oldest_ns = self.newest.time_ns - HISTORY_NS
        # The last record before the oldest time stays: a sighting at that time starts from it.
        kept = 0
        while kept + 1 < len(self.records) and self.records[kept + 1].time_ns <= oldest_ns:
            kept += 1
        del self.records[:kept]
        if len(self.rows_ns) > _MOST_ROWS:
            self.rows_ns = {time_ns for time_ns in self.rows_ns if time_ns >= oldest_ns}

    def recent(self, time_ns: int, window_ns: int) -> list[Record]:
        """Return the records of a window that ends at a time."""
        place = self.place_of(time_ns)
        first = place
        while first and self.records[first - 1].time_ns >= time_ns - window_ns:
            first -= 1
        return self.records[first:place]
