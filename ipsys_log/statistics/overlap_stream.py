"""Disagreement of cameras in a stream of positions, message by message."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ipsys_log.log.contents import run_of_topic
from ipsys_log.messages import Message, Position, Positions, Rig
from ipsys_log.statistics.disagreement import LONGEST_GAP_NS
from ipsys_log.units import MM_PER_M

# Number of the last differences of a pair that a summary uses.
_REMEMBERED = 5_000
_FEWEST = 10
# A display has room for so many pairs. A hall of 24 cameras has dozens.
_MOST_LINES = 6


class Difference(NamedTuple):
    """The difference in x and y, in m, of the positions of two cameras at an instant; first minus second.

    ``place_x_m`` and ``place_y_m`` are the position of the marker.
    """

    cameras: tuple[str, str]
    marker_id: int
    time_ns: int
    x_m: float
    y_m: float
    place_x_m: float
    place_y_m: float


class OverlapStream:
    """The differences of cameras in a stream; it reads the first run with positions.

    A new sighting of one camera ends a line that passes the last sightings of the other cameras. There, the
    difference is known.

    Parameters
    ----------
    rig : names the reference markers, which are left out.
    """

    def __init__(self, rig: Rig | None = None) -> None:
        self._rig, self._run = rig, ""
        # By marker, the last sighting of each camera: a hall has many cameras, and few see the same marker.
        self._last: dict[int, dict[str, tuple[int, Position]]] = {}

    def __call__(self, message: Message) -> Iterator[Difference]:
        """Yield the differences that a message completes."""
        if not isinstance(message.payload, Positions):
            return
        self._run = self._run or str(run_of_topic(message.topic))
        if run_of_topic(message.topic) != self._run:
            return
        camera = str(message.camera)
        for position in message.payload.positions:
            is_reference = self._rig is not None and self._rig.is_reference(position.id)
            if position.inside is not False and not is_reference:
                time_ns = message.payload.timestamp + (position.time_offset_ns or 0)
                sightings = self._last.setdefault(position.id, {})
                yield from self._compare(sightings, camera, time_ns, position)
                sightings[camera] = time_ns, position

    def _compare(
        self, sightings: dict[str, tuple[int, Position]], camera: str, time_ns: int, position: Position
    ) -> Iterator[Difference]:
        before = sightings.get(camera)
        if before is None or not 0 < time_ns - before[0] <= LONGEST_GAP_NS:
            return
        for other, (other_ns, seen) in sightings.items():
            if other == camera or not before[0] <= other_ns < time_ns:
                continue
            share = (other_ns - before[0]) / (time_ns - before[0])
            x_m = (1 - share) * before[1].x_m + share * position.x_m - seen.x_m
            y_m = (1 - share) * before[1].y_m + share * position.y_m - seen.y_m
            sign = 1.0 if camera < other else -1.0
            pair = min(camera, other), max(camera, other)
            yield Difference(pair, position.id, other_ns, sign * x_m, sign * y_m, seen.x_m, seen.y_m)


class OverlapSummary:
    """The disagreement of each pair of cameras over the last minutes, for a display."""

    def __init__(self) -> None:
        self._stream = OverlapStream()
        self._lengths_m: dict[tuple[str, str], deque[float]] = {}

    def __call__(self, message: Message) -> None:
        """Handle one message; the rig names the reference markers."""
        if isinstance(message.payload, Rig):
            self._stream = OverlapStream(message.payload)
        for difference in self._stream(message):
            lengths_m = self._lengths_m.setdefault(difference.cameras, deque(maxlen=_REMEMBERED))
            lengths_m.append(float(np.hypot(difference.x_m, difference.y_m)))

    def lines(self) -> list[str]:
        """Return one line for each pair of cameras; of many pairs, only those that differ most."""
        pairs = {
            pair: (np.percentile(lengths_m, [50, 95]) * MM_PER_M).tolist()
            for pair, lengths_m in sorted(self._lengths_m.items())
            if len(lengths_m) >= _FEWEST
        }
        shown = sorted(sorted(pairs, key=lambda pair: -pairs[pair][0])[:_MOST_LINES])
        lines = []
        for first, second in shown:
            median_mm, p95_mm = pairs[first, second]
            figures = f"{median_mm:.1f} mm (median), {p95_mm:.1f} mm (p95)"
            lines.append(f"positions of cameras {first} and {second} differ by {figures}")
        if len(pairs) > len(shown):
            lines.append(f"the other {len(pairs) - len(shown)} pairs of cameras differ less")
        return lines
