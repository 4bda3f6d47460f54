"""Take away what is no longer seen, instead of letting it freeze for ever."""

from __future__ import annotations

import heapq
from collections.abc import Callable

from ipsys_log.messages import Message

__all__ = ["Fading"]

Entity = tuple[str, ...]


class Fading:
    """Remember when things were seen last, and ``clear`` them at the instant they are overdue.

    ``clear`` is called with the entity and that instant, in publish and in log time (ns).
    """

    def __init__(self, clear: Callable[[Entity, int, int], None]) -> None:
        self._clear = clear
        self._seen: dict[Entity, tuple[int, int]] = {}  # expiry time, in publish and in log time
        # One entry for each entity, not later than its expiry: it may have been drawn again since.
        self._checks: list[tuple[int, Entity]] = []

    def seen(self, entity: Entity, message: Message, fade_ns: int) -> None:
        """Note that an entity is drawn; with 0 it stays until it is drawn again."""
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
