"""Trails of robots, and the removal of entities that are no longer seen."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Generic, TypeVar

from ipsys_log.messages import Message

Entity = tuple[str, ...]


class Fading:
    """The times of the last sightings of entities; ``clear`` is called when an entity is overdue.

    The arguments of ``clear`` are the entity and this instant, in publish time and in log time (ns).
    """

    def __init__(self, clear: Callable[[Entity, int, int], None]) -> None:
        self._clear = clear
        self._seen: dict[Entity, tuple[int, int]] = {}  # expiry time, in publish and in log time
        # One entry for each entity, not later than its expiry; the entity may have a newer drawing by then.
        self._checks: list[tuple[int, Entity]] = []

    def seen(self, entity: Entity, message: Message, fade_ns: int) -> None:
        """Note that an entity is drawn; with 0 it stays until the next drawing."""
        if fade_ns <= 0:
            return
        overdue_ns = message.log_time_ns + fade_ns
        if entity not in self._seen:
            heapq.heappush(self._checks, (overdue_ns, entity))
        self._seen[entity] = (message.publish_time_ns + fade_ns, overdue_ns)

    def advance(self, log_time_ns: int) -> None:
        """Clear the expired entities."""
        while self._checks and self._checks[0][0] < log_time_ns:
            _, entity = self._checks[0]
            publish_ns, overdue_ns = self._seen[entity]
            if overdue_ns < log_time_ns:
                heapq.heappop(self._checks)
                del self._seen[entity]
                self._clear(entity, publish_ns, overdue_ns)
            else:
                heapq.heapreplace(self._checks, (overdue_ns, entity))


Point = tuple[float, float, float]
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True, slots=True)
class Segment:
    """A path from one pose to the next, in m, and the time of the second pose in ns."""

    start_m: Point
    end_m: Point
    publish_time_ns: int
    log_time_ns: int


@dataclass(frozen=True, slots=True)
class _Pose:
    publish_time_ns: int
    log_time_ns: int
    point_m: Point


class Trails(Generic[Key]):
    """The trails of robots: it joins the poses of each robot, and passes each segment to ``draw``.

    Several poses of one instant count as the last of them: tracks of earlier versions have one from each
    camera. So a pose waits until the next instant. There is no line over a gap.
    """

    def __init__(self, draw: Callable[[Key, Segment], None]) -> None:
        self._draw = draw
        self._before: dict[Key, _Pose] = {}
        self._waiting: dict[Key, _Pose] = {}
        self._gap_ns: dict[Key, int] = {}

    def add(self, key: Key, message: Message, point_m: Point, gap_ns: int) -> None:
        """Add a pose; poses with more than ``gap_ns`` of silence between them are not joined."""
        pose = _Pose(message.publish_time_ns, message.log_time_ns, point_m)
        waiting = self._waiting.get(key)
        if waiting is not None and pose.publish_time_ns < waiting.publish_time_ns:
            return
        self._gap_ns[key] = gap_ns
        if waiting is not None and pose.publish_time_ns > waiting.publish_time_ns:
            self._finish(key, waiting)
        self._waiting[key] = pose

    def close(self) -> None:
        """Draw the last segment of each robot."""
        for key, pose in self._waiting.items():
            self._finish(key, pose)
        self._waiting.clear()

    def _finish(self, key: Key, pose: _Pose) -> None:
        before = self._before.get(key)
        self._before[key] = pose
        if before is not None and pose.publish_time_ns - before.publish_time_ns <= self._gap_ns[key]:
            segment = Segment(before.point_m, pose.point_m, pose.publish_time_ns, pose.log_time_ns)
            self._draw(key, segment)
