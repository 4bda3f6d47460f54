"""Two runs, or what a run says and what its stage makes of the same input now: message by message."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.log.codec import encode
from ipsys_log.messages import CameraPoints, Markers, Message, Positions, Tracks
from ipsys_log.units import format_time

__all__ = ["Comparison", "compare_channels"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Comparison:
    """Of one channel: messages on both sides, how many of them speak of one frame, how many of these are the
    same byte for byte, and the first that is not.

    ``rms`` and ``greatest`` are distances between what both sides have, in ``unit``: of corners in px, of
    points in m. None where there is nothing to measure.
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

    @property
    def equal(self) -> bool:
        return self.left == self.right == self.same


def compare_channels(left: Iterable[Message], right: Iterable[Message]) -> list[Comparison]:
    """Compare messages channel by channel; those of one channel by their order.

    Parameters
    ----------
    left, right : in log order, of the same topics.
    """
    sides = [_by_topic(left), _by_topic(right)]
    return [
        _compare(topic, sides[0].get(topic, []), sides[1].get(topic, []))
        for topic in sorted({*sides[0], *sides[1]})
    ]


# Log time, publish time, bytes, and what can be measured in them.
_Row = tuple[int, int, bytes, dict[int, Array]]


def _by_topic(messages: Iterable[Message]) -> dict[str, list[_Row]]:
    found: dict[str, list[_Row]] = defaultdict(list)
    for message in messages:
        row = (
            message.log_time_ns,
            message.publish_time_ns,
            encode(message.payload),
            _values(message.payload),
        )
        found[message.topic].append(row)
    for rows in found.values():
        # Stages that share a channel have written one after the other, or in turns.
        rows.sort(key=lambda row: row[0])
    return found


def _values(payload: Any) -> dict[int, Array]:
    """What can be measured, by marker: (n, 2) in px or (1, 3) in m."""
    if isinstance(payload, Markers):
        return {marker.id: marker.corners_px for marker in payload.markers}
    if isinstance(payload, CameraPoints):
        return {p.id: np.array([[p.x_m, p.y_m, p.z_m]]) for p in payload.points}
    if isinstance(payload, Positions):
        return {p.id: np.array([[p.x_m, p.y_m, p.z_m]]) for p in payload.positions}
    if isinstance(payload, Tracks):
        return {p.id: np.array([[p.x_m, p.y_m, p.z_m]]) for p in payload.tracks}
    return {}


def _compare(topic: str, left: list[_Row], right: list[_Row]) -> Comparison:
    both = same = 0
    first, first_ns = None, None
    distances: list[Array] = []
    for a, b in _together(left, right):
        both += a is not None and b is not None
        if a is not None and b is not None and a[:3] == b[:3]:
            same += 1
        elif first_ns is None or min(row[1] for row in (a, b) if row is not None) < first_ns:
            first, first_ns = _said(a, b), min(row[1] for row in (a, b) if row is not None)
        if a is not None and b is not None:
            distances += [
                np.linalg.norm(a[3][n] - b[3][n], axis=1) for n in a[3] if n in b[3] and len(a[3][n])
            ]
    counts = len(left), len(right), both, same
    if not distances:
        return Comparison(topic, *counts, first, first_ns)
    values = np.concatenate(distances)
    unit = "px" if topic.endswith("/markers") else "m"
    rms, greatest = float(np.sqrt(np.mean(values**2))), float(values.max())
    return Comparison(topic, *counts, first, first_ns, unit, rms, greatest)


def _together(left: list[_Row], right: list[_Row]) -> Iterator[tuple[_Row | None, _Row | None]]:
    """Pairs of messages that speak of one frame; None where a side has none."""
    # The same frame has the same publish time in every log, whenever it was written there.
    waiting: dict[int, list[_Row]] = defaultdict(list)
    for row in right:
        waiting[row[1]].append(row)
    for row in left:
        others = waiting.get(row[1])
        yield row, others.pop(0) if others else None
    for rows in waiting.values():
        yield from ((None, row) for row in rows)


def _said(left: _Row | None, right: _Row | None) -> str:
    """Where two messages differ, in words."""
    if left is None or right is None:
        there = left or right
        assert there is not None
        side = "second" if left is None else "first"
        return f"a message that only the {side} has, at {format_time(there[1])} ({there[1]} ns)"
    where = f"at {format_time(left[1])} ({left[1]} ns)"
    if left[0] != right[0]:
        return f"log times differ by {right[0] - left[0]} ns, {where}"
    ids = sorted(left[3].keys() ^ right[3].keys())
    if ids:
        return f"marker {ids[0]} is only in one of them, {where}"
    return f"content differs, {where}"
