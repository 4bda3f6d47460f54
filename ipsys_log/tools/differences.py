"""Differences between two runs, or between a run and a repetition of its stage, message by message."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby, zip_longest
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraPoints, Markers, Message, Positions, Tracks
from ipsys_log.units import NS_PER_S, format_time


@dataclass(frozen=True, slots=True)
class Comparison:
    """The differences of one channel.

    ``left`` and ``right`` are the numbers of messages on both sides. ``together`` is the number of pairs of
    the same frame, and ``same`` the number of pairs that are equal byte for byte. ``first`` is the first
    difference. ``rms`` and ``greatest`` are distances between common markers of both sides, in ``unit``:
    corners in px, points in m. They are None without common markers.
    ``repeated`` is False for a copied channel that is compared with the hash of the copy.
    """

    topic: str
    left: int
    right: int
    together: int
    same: int
    first: str | None = None
    first_ns: int | None = None
    unit: str | None = None
    rms: float | None = None
    greatest: float | None = None
    repeated: bool = True

    @property
    def equal(self) -> bool:
        return self.left == self.right == self.same


@dataclass(frozen=True, slots=True, eq=False)
class Extent:
    """The cameras, ascending log times (n,) in ns, and marker ids of one side of a comparison."""

    cameras: frozenset[str]
    times_ns: NDArray[np.int64]
    ids: frozenset[int]


def explain_no_overlap(first: Extent, second: Extent) -> str | None:
    """Return the reason why two sides have nothing in common; None if they have common data.

    The extents are those of the markers, points, positions or tracks of both sides.
    """
    if not (len(first.times_ns) and len(second.times_ns)):
        side = "second" if len(first.times_ns) else "first"
        text = f"the {side} has no markers, camera points, positions or tracks: run 'ipsys replay' on its log"
        return text if len(first.times_ns) or len(second.times_ns) else None
    if first.cameras and second.cameras and not first.cameras & second.cameras:
        sides = _names(first.cameras), _names(second.cameras)
        return f"no camera in common: the first has {sides[0]}, the second {sides[1]}"
    reason = _explain_times(first, second)
    if reason is None and first.ids.isdisjoint(second.ids):
        return f"no marker id in common: the first has {_names(first.ids)}, the second {_names(second.ids)}"
    return reason


def _explain_times(first: Extent, second: Extent) -> str | None:
    """Return the reason why two sides have no frame in common; None if they have a common frame."""
    advice = "Compare logs of one recording"
    if first.times_ns[-1] < second.times_ns[0] or second.times_ns[-1] < first.times_ns[0]:
        sides = _range(first), _range(second)
        return f"the time ranges do not overlap: the first has {sides[0]}, the second {sides[1]}. {advice}"
    if not len(np.intersect1d(first.times_ns, second.times_ns)):
        return (
            "no frame in common: the time ranges overlap, but no two frames have the same log time. The "
            f"nearest differ by {_nearest_ns(first, second) / NS_PER_S:.6f} s. {advice}"
        )
    return None


def marker_ids(payload: Any) -> set[int]:
    """Return the ids of the markers in a message of a run."""
    return set(_values(payload))


def _names(values: Iterable[Any]) -> str:
    return ", ".join(map(str, sorted(values))) or "none"


def _range(extent: Extent) -> str:
    return f"{format_time(int(extent.times_ns[0]))} to {format_time(int(extent.times_ns[-1]))}"


def _nearest_ns(first: Extent, second: Extent) -> int:
    """Return the least difference between a time of one side and a time of the other."""
    after = np.searchsorted(second.times_ns, first.times_ns).clip(1, len(second.times_ns) - 1)
    before_ns, after_ns = second.times_ns[after - 1], second.times_ns[after]
    nearest = np.minimum(np.abs(first.times_ns - before_ns), np.abs(first.times_ns - after_ns))
    return int(nearest.min())


# A message, and the bytes of its payload.
Stored = tuple[Message, bytes]
# Log time, publish time, bytes, and coordinates by marker id.
_Row = tuple[int, int, bytes, dict[int, Array]]


def compare_channels(left: Iterable[Stored], right: Iterable[Stored]) -> list[Comparison]:
    """Compare messages channel by channel; compare those of one channel and log time by their order.

    Parameters
    ----------
    left, right : messages with their bytes, in log order, of the same topics. The function does not keep all
        of them in memory.
    """
    tallies: dict[str, _Tally] = {}
    for ours, theirs in _together(_by_time(left), _by_time(right)):
        for topic in {**ours, **theirs}:
            tally = tallies.setdefault(topic, _Tally())
            for our_row, their_row in zip_longest(ours.get(topic, ()), theirs.get(topic, ())):
                tally.add(our_row, their_row)
    return [tally.found(topic) for topic, tally in sorted(tallies.items())]


def _by_time(messages: Iterable[Stored]) -> Iterator[tuple[int, dict[str, list[_Row]]]]:
    """Yield the messages of one log time after the other, by topic."""
    for time_ns, group in groupby(messages, key=lambda stored: stored[0].log_time_ns):
        rows: dict[str, list[_Row]] = defaultdict(list)
        for message, data in group:
            rows[message.topic].append(
                (message.log_time_ns, message.publish_time_ns, data, _values(message.payload))
            )
        yield time_ns, rows


_Group = tuple[int, dict[str, list[_Row]]]


def _together(
    left: Iterator[_Group], right: Iterator[_Group]
) -> Iterator[tuple[dict[str, list[_Row]], dict[str, list[_Row]]]]:
    """Yield the rows of both sides for each log time; an empty dictionary for a side without rows."""
    ours, theirs = next(left, None), next(right, None)
    while ours is not None or theirs is not None:
        if theirs is None or (ours is not None and ours[0] < theirs[0]):
            assert ours is not None
            yield ours[1], {}
            ours = next(left, None)
        elif ours is None or theirs[0] < ours[0]:
            yield {}, theirs[1]
            theirs = next(right, None)
        else:
            yield ours[1], theirs[1]
            ours, theirs = next(left, None), next(right, None)


@dataclass(slots=True)
class _Tally:
    """Counts and differences of one channel so far; in px for markers, in m for all other channels."""

    left: int = 0
    right: int = 0
    both: int = 0
    same: int = 0
    first: str | None = None
    first_ns: int | None = None
    measured: int = 0
    squares: float = 0.0
    greatest: float = 0.0

    def add(self, one: _Row | None, other: _Row | None) -> None:
        """Add a message of both sides, or of one side."""
        self.left += one is not None
        self.right += other is not None
        if one is None or other is None or one[:3] != other[:3]:
            if self.first_ns is None:
                self.first = _describe(one, other)
                self.first_ns = min(row[0] for row in (one, other) if row is not None)
        else:
            self.same += 1
        if one is not None and other is not None:
            self.both += 1
            for n in one[3].keys() & other[3].keys():
                distances = np.linalg.norm(one[3][n] - other[3][n], axis=1)
                self.measured += len(distances)
                self.squares += float((distances**2).sum())
                self.greatest = max(self.greatest, float(distances.max()))

    def found(self, topic: str) -> Comparison:
        counts = self.left, self.right, self.both, self.same
        if not self.measured:
            return Comparison(topic, *counts, self.first, self.first_ns)
        unit = "px" if topic.endswith("/markers") else "m"
        rms = float(np.sqrt(self.squares / self.measured))
        return Comparison(topic, *counts, self.first, self.first_ns, unit, rms, self.greatest)


def _values(payload: Any) -> dict[int, Array]:
    """Return the coordinates by marker id: (n, 2) in px or (1, 3) in m."""
    if isinstance(payload, Markers):
        return {marker.id: marker.corners_px for marker in payload.markers}
    points: tuple[Any, ...] = ()
    if isinstance(payload, CameraPoints):
        points = payload.points
    elif isinstance(payload, Positions):
        points = payload.positions
    elif isinstance(payload, Tracks):
        points = payload.tracks
    return {p.id: np.array([[p.x_m, p.y_m, p.z_m]]) for p in points}


def _describe(left: _Row | None, right: _Row | None) -> str:
    """Describe the difference of two messages."""
    if left is None or right is None:
        row = left or right
        assert row is not None
        side = "second" if left is None else "first"
        return f"a message that only the {side} has, at {format_time(row[0])} ({row[0]} ns)"
    time_text = f"at {format_time(left[0])} ({left[0]} ns)" if left[0] else "for all times"
    if left[1] != right[1]:
        return f"publish times differ by {right[1] - left[1]} ns, {time_text}"
    ids = sorted(left[3].keys() ^ right[3].keys())
    if ids:
        return f"marker {ids[0]} is only in one of the messages, {time_text}"
    return f"content differs, {time_text}"
