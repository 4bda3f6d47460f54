"""The data of all pages: each part is made once, as a server-sent event, however many pages read it."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Callable, Hashable
from dataclasses import dataclass
from typing import Any

from ipsys_log.app.web.dashboard.state import Dashboard

# A page gets at most 30 updates per second. All pages wake at the same times: an update is made once.
_TICK_S = 1 / 30
# Shortest time between two versions of a part. The status is made again after a second even without news.
# A wake-up is never exact, so these times are half a tick shorter than their number of ticks.
_ROBOTS_S, _TILES_S, _URGENT_S, _STATUS_S = 0.5 * _TICK_S, 2.5 * _TICK_S, 2.5 * _TICK_S, 1.0
# A stream ends after this time, and the page asks for the next one. So the limit of an answer holds for it,
# too, and a page that does not read is disconnected.
_STREAM_S, _RETRY_MS = 15.0, 200


@dataclass(slots=True)
class _Part:
    """A part of the data: its newest event, its number, and the time and the version of its making."""

    name: str
    make: Callable[[], Any]
    every_s: float
    always_s: float = float("inf")
    number: int = 0
    event: bytes = b""
    made_s: float = float("-inf")
    version: Hashable = None

    def renew(self, now_s: float, version: Hashable) -> None:
        """Make the event again if its version changed, or after ``always_s``."""
        age_s = now_s - self.made_s
        if age_s < self.every_s or (version == self.version and age_s < self.always_s):
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
        # In the order of the versions of the dashboard.
        self._parts = (
            _Part("robots", dashboard.robots, _ROBOTS_S),
            _Part("tiles", dashboard.tiles, _TILES_S),
            _Part("status", dashboard.status, _URGENT_S, _STATUS_S),
        )

    def newest(self, sent: dict[str, int], now_s: float) -> bytes:
        """Return the events that a page does not have, and note them in ``sent``."""
        for part, version in zip(self._parts, self._dashboard.versions(), strict=True):
            part.renew(now_s, version)
        news = [part for part in self._parts if sent.get(part.name) != part.number]
        sent.update({part.name: part.number for part in news})
        return b"".join(part.event for part in news)

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
            events = self.newest(sent, now_s())
            if events:
                yield events
            if self._dashboard.end is not None and self._is_complete(sent):
                return
            # A sleep of a whole tick would add the time of the work and of the wake-up to each tick.
            await sleep(_TICK_S - now_s() % _TICK_S)

    def _is_complete(self, sent: dict[str, int]) -> bool:
        """Return whether a page has the newest version of each part."""
        versions = self._dashboard.versions()
        return all(
            part.version == version and sent.get(part.name) == part.number
            for part, version in zip(self._parts, versions, strict=True)
        )
