"""Take away what is no longer seen, instead of letting it freeze for ever."""

from __future__ import annotations

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
        self._seen: dict[Entity, tuple[int, int, int]] = {}

    def seen(self, entity: Entity, message: Message, fade_ns: int) -> None:
        """Note that something is drawn; with 0 it stays until the next time."""
        if fade_ns > 0:
            self._seen[entity] = (message.publish_time_ns, message.log_time_ns, fade_ns)

    def advance(self, log_time_ns: int) -> None:
        """Clear what is overdue by now."""
        overdue = [e for e, (_, last_ns, fade_ns) in self._seen.items() if log_time_ns > last_ns + fade_ns]
        for entity in overdue:
            publish_ns, last_ns, fade_ns = self._seen.pop(entity)
            self._clear(entity, publish_ns + fade_ns, last_ns + fade_ns)
