"""Connections to the page, limited in number and time, so that a recorder keeps its file descriptors.

The public options of uvicorn cannot do this. Above ``limit_concurrency`` it refuses the phone, too (status
503), and it never closes a silent connection: 1,150 of them stop a server that has 1,024 file descriptors. So
this module uses parts of uvicorn that are not public; ``tests/web/test_connections.py`` names them.
"""

from __future__ import annotations

import asyncio
import resource
import socket
from collections.abc import Iterable
from typing import NamedTuple

import h11
from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

# The page gets one of this many descriptors. Cameras, the log and libraries of a recorder need the others.
_SHARE_OF_DESCRIPTORS = 8
_MIN_TOTAL, _MAX_TOTAL = 12, 64
# A browser opens up to six connections.
_MIN_PER_ADDRESS = 8
_REQUEST_TIMEOUT_S = 20.0
# At most 500 connections are accepted per second, so that many of them do not slow down the recorder.
_PAUSE_S = 0.002
_RETRY_S = 0.2


class PageLimits(NamedTuple):
    """The limits of open connections.

    Attributes
    ----------
    total, per_address : most connections that are open at the same time.
    request_s : longest time from the opening, or the last answer, to the end of the next answer.
    """

    total: int
    per_address: int
    request_s: float = _REQUEST_TIMEOUT_S


def derive_limits() -> PageLimits:
    """Return the limits that leave most file descriptors of this process to the recorder."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    share = _MAX_TOTAL if soft == resource.RLIM_INFINITY else soft // _SHARE_OF_DESCRIPTORS
    total = min(max(share, _MIN_TOTAL), _MAX_TOTAL)
    return PageLimits(total, max(total // 4, _MIN_PER_ADDRESS))


class Connections:
    """The open connections of the page.

    The guard closes a connection when it refuses a request. So an open connection with an answer belongs to
    a user of the page. To make room, only connections without an answer are closed, the oldest first.
    """

    def __init__(self, limits: PageLimits, config: Config, state: ServerState) -> None:
        self._limits, self._config, self._state = limits, config, state
        self._addresses: dict[_Connection, str] = {}  # the oldest first

    async def accept(self, listening: socket.socket) -> None:
        """Accept connections until this task is cancelled; ``listening`` must not block."""
        loop = asyncio.get_running_loop()
        while True:
            try:
                peer, _ = await loop.sock_accept(listening)
            except OSError:  # no file descriptor is free, or the client has disconnected already
                await asyncio.sleep(_RETRY_S)
                continue
            try:
                await loop.connect_accepted_socket(self._connection, peer)
            except OSError:
                peer.close()
            await asyncio.sleep(_PAUSE_S)

    def abort(self) -> None:
        """Close all connections without waiting for their clients."""
        for connection in list(self._addresses):
            connection.abort()

    def add(self, connection: _Connection, address: str) -> None:
        """Add a new connection, and close another one to make room if necessary."""
        self._addresses[connection] = address
        neighbours = [other for other, other_address in self._addresses.items() if other_address == address]
        if len(neighbours) > self._limits.per_address:
            self._close_oldest(neighbours)
        elif len(self._addresses) > self._limits.total:
            self._close_oldest(self._addresses)

    def remove(self, connection: _Connection) -> None:
        """Remove a closed connection from the list."""
        self._addresses.pop(connection, None)

    def _connection(self) -> _Connection:
        return _Connection(self, self._limits.request_s, self._config, self._state)

    def _close_oldest(self, connections: Iterable[_Connection]) -> None:
        # The new connection has no answer yet. If all others have an answer, the new connection is closed.
        oldest = next(connection for connection in connections if not connection.is_answered)
        self.remove(oldest)
        oldest.abort()


class _Connection(H11Protocol):
    """A connection; it is aborted if an answer takes too long, because of the server or the client."""

    def __init__(self, owner: Connections, request_s: float, config: Config, state: ServerState) -> None:
        super().__init__(config, state, {})
        self._owner, self._request_s = owner, request_s
        self._timer: asyncio.TimerHandle | None = None
        self._is_answered = False

    @property
    def is_answered(self) -> bool:
        """True if the guard has accepted a request: an answer is complete, or a long one has begun."""
        return self._is_answered or getattr(self.cycle, "response_started", False)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._restart_timer()
        self._owner.add(self, self.client[0] if self.client else "")

    def on_response_complete(self) -> None:
        self._is_answered = True
        self._restart_timer()
        super().on_response_complete()

    def send_400_response(self, msg: str) -> None:
        """Answer an invalid request instead of the app, whose answer would be an internal error by now."""
        if self.cycle is not None:
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            super().send_400_response(msg)
        else:
            self.transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._owner.remove(self)
        super().connection_lost(exc)

    def abort(self) -> None:
        """Close the connection at once; an unread answer is lost."""
        self.transport.abort()

    def _restart_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self._timer = self.loop.call_later(self._request_s, self.abort)
