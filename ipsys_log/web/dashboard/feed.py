"""The data of all pages: each part is made once, as a server-sent event, however many pages read it."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable, Hashable
from dataclasses import dataclass
from typing import Any

from ipsys_log.web.dashboard.state import Dashboard

__all__ = ["Feed"]

# A page gets at most 30 updates per second.
_TICK_S = 1 / 30
# Time after which a part is made again: robots and tiles if they changed, the status always.
_ROBOTS_S, _TILES_S, _STATUS_S, _URGENT_S = _TICK_S, 0.1, 1.0, 0.1
# A stream ends after this time, and the page asks for the next one. So the limit of an answer holds for it,
# too, and a page that does not read is disconnected.
_STREAM_S, _RETRY_MS = 15.0, 200


@dataclass(slots=True)
class _Part:
    """A part of the data: its newest event, its number, and the time and the version of its making."""

    name: str
    make: Callable[[], Any]
    every_s: float
    number: int = 0
    event: bytes = b""
    made_s: float = float("-inf")
    version: Hashable = None

    def renew(self, now_s: float, version: Hashable, always_s: float = float("inf")) -> None:
        """Make the event again if its version changed, or after ``always_s``."""
        age_s = now_s - self.made_s
        if age_s < self.every_s or (version == self.version and age_s < always_s):
            return
        text = json.dumps(self.make(), separators=(",", ":"), allow_nan=False)
        self.event = f"event: {self.name}\ndata: {text}\n\n".encode()
        self.number, self.made_s, self.version = self.number + 1, now_s, version


class Feed:
    """The server-sent events of a dashboard. For one thread.

    Parameters
    ----------
    dashboard : gives the data.
    """

    def __init__(self, dashboard: Dashboard) -> None:
        self._dashboard = dashboard
        self._robots = _Part("robots", dashboard.robots, _ROBOTS_S)
        self._tiles = _Part("tiles", dashboard.tiles, _TILES_S)
        self._status = _Part("status", dashboard.status, _URGENT_S)

    def newest(self, sent: dict[str, int], now_s: float) -> bytes:
        """Return the events that a page does not have, and note them in ``sent``."""
        robots, tiles, urgent = self._dashboard.versions()
        self._robots.renew(now_s, robots)
        self._tiles.renew(now_s, tiles)
        self._status.renew(now_s, urgent, _STATUS_S)
        parts = [p for p in (self._robots, self._tiles, self._status) if sent.get(p.name) != p.number]
        sent.update({part.name: part.number for part in parts})
        return b"".join(part.event for part in parts)

    async def stream(self, now_s: Callable[[], float], sleep: Callable[[float], Any]) -> AsyncIterator[bytes]:
        """Yield events for one page, for a limited time. A page that reads slowly misses the older ones.

        Parameters
        ----------
        now_s : the clock of the event loop.
        sleep : waits without blocking the loop.
        """
        sent: dict[str, int] = {}
        end_s = now_s() + _STREAM_S
        yield f"retry: {_RETRY_MS}\n\n".encode()
        while now_s() < end_s:
            has_ended = self._dashboard.end is not None
            events = self.newest(sent, now_s())
            if events:
                yield events
            if has_ended:
                return
            await sleep(_TICK_S)
