"""The server of a page in a separate thread, its unexpected exceptions, and the limits of its connections.

Connections are limited in number and time, so that a recorder keeps its file descriptors. The public options
of uvicorn cannot do this. Above ``limit_concurrency`` it refuses the phone, too (status 503), and it never
closes a silent connection: 1,150 of them stop a server that has 1,024 file descriptors. So this module uses
parts of uvicorn that are not public; ``tests/web/test_connections.py`` names them.
"""

from __future__ import annotations

import asyncio
import errno
import ipaddress
import resource
import secrets
import socket
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Thread
from typing import Any, NamedTuple

import cv2
import h11
import uvicorn
from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.server import ServerState

from ipsys_log.app.web.requests import Guard
from ipsys_log.errors import IpsysError


class ServerExceptions:
    """The unexpected exceptions in the server's thread: their number, and the first traceback."""

    def __init__(self) -> None:
        self.count = 0
        self.first = ""

    def add(self, error: BaseException) -> None:
        """Count an exception."""
        while isinstance(error, BaseExceptionGroup) and len(error.exceptions) == 1:
            (error,) = error.exceptions
        self.count += 1
        self.first = self.first or "".join(traceback.format_exception(error)).rstrip()

    def watch_loop(self, loop: asyncio.AbstractEventLoop) -> None:
        """Count exceptions of an event loop that no other code handles."""

        def handle(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
            self.add(context.get("exception") or RuntimeError(str(context.get("message"))))

        loop.set_exception_handler(handle)

    def watch_app(self, app: ASGIApp) -> ASGIApp:
        """Count exceptions of an app; the server answers such a request with the status 500."""

        async def call(scope: Scope, receive: Receive, send: Send) -> None:
            try:
                await app(scope, receive, send)
            except Exception as error:
                self.add(error)

        return call


_LOOPBACK = "127.0.0.1"
_STEP_S = 0.02
_TURN_S = 0.1
_BACKLOG = 128
_TOKEN_BYTES = 12
# A browser also sends cookies of other programs on this machine, up to 4 kB each.
_MAX_HEADER_BYTES = 64 << 10
# The server prints nothing, because the recorder uses the terminal. ServerExceptions stores the exceptions.
_SILENT: dict[str, Any] = {
    "version": 1,
    "disable_existing_loggers": False,
    "handlers": {"none": {"class": "logging.NullHandler"}},
    "loggers": {name: {"handlers": ["none"], "propagate": False} for name in ("uvicorn", "asyncio")},
}


@dataclass(frozen=True, slots=True)
class PageServer:
    """A running server of a page.

    It has its address (with the token if needed), its thread and its exceptions. ``view_url`` is the address
    for devices that may only read; None if the page has no secret for them.
    """

    url: str
    thread: Thread
    exceptions: ServerExceptions
    view_url: str | None = None

    def wait(self, stopped: Callable[[], bool]) -> None:
        """Wait until the server ends, or until `stopped` is true."""
        while self.thread.is_alive() and not stopped():
            self.thread.join(_TURN_S)


@contextmanager
def serve_app(
    app: ASGIApp,
    host: str | None = None,
    port: int = 8000,
    limits: PageLimits | None = None,
    has_viewers: bool = False,
    option: str = "--port",
) -> Iterator[PageServer]:
    """Serve a page until the end of the with-block.

    Parameters
    ----------
    app : the page, without a guard.
    host : address to listen on. None: the page is only for this machine, and needs no token.
    port : port to listen on; 0 means any free port.
    limits : limits of connections. None: the limits of :func:`derive_limits`.
    has_viewers : a page with a host has a second address, for devices that may only read.
    option : the option of the port, in errors.

    Raises
    ------
    IpsysError
        The port is in use or not allowed, the host is not this machine, or the server does not start.
    """
    token = None if host is None else secrets.token_urlsafe(_TOKEN_BYTES)
    view_token = secrets.token_urlsafe(_TOKEN_BYTES) if has_viewers and token is not None else None
    with _listen(host or _LOOPBACK, port, option) as listening:
        names = {socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        names |= {host.lower()} if host else set()
        exceptions = ServerExceptions()
        config = uvicorn.Config(
            exceptions.watch_app(Guard(app, frozenset(names), token, view_token)),
            log_config=_SILENT, access_log=False, lifespan="off", ws="none", http="h11", loop="asyncio",
            server_header=False, timeout_graceful_shutdown=1, h11_max_incomplete_event_size=_MAX_HEADER_BYTES,
        )  # fmt: skip
        server = uvicorn.Server(config)
        run = (server, listening, limits or derive_limits(), exceptions)
        thread = Thread(target=_run, args=run, name="page", daemon=True)
        thread.start()
        while thread.is_alive() and not server.started:
            thread.join(_STEP_S)
        if not server.started:
            raise IpsysError(f"the page cannot be served: {exceptions.first.splitlines()[-1]}")
        own_port = listening.getsockname()[1]
        view_url = None if view_token is None else _url(host, own_port, view_token)
        try:
            yield PageServer(_url(host, own_port, token), thread, exceptions, view_url)
        finally:
            server.should_exit = True
            thread.join()


def _run(
    server: uvicorn.Server, listening: socket.socket, limits: PageLimits, exceptions: ServerExceptions
) -> None:
    """Serve until ``server.should_exit`` is true; an exception ends only this thread."""
    try:
        asyncio.run(_serve(server, listening, limits, exceptions))
    except Exception as error:
        exceptions.add(error)


async def _serve(
    server: uvicorn.Server, listening: socket.socket, limits: PageLimits, faults: ServerExceptions
) -> None:
    faults.watch_loop(asyncio.get_running_loop())
    listening.setblocking(False)
    server.config.load()
    connections = Connections(limits, server.config, server.server_state)
    async with asyncio.TaskGroup() as tasks:
        accepting = tasks.create_task(connections.accept(listening))
        try:
            await server.serve(sockets=[])
        finally:
            accepting.cancel()
            connections.abort()


def check_port_free(host: str | None, port: int, option: str = "--port") -> None:
    """Check that a page can be served at an address and a port; ``option`` names the port in errors."""
    _listen(host or _LOOPBACK, port, option).close()


def _listen(host: str, port: int, option: str) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family, backlog=_BACKLOG)
    except (socket.gaierror, UnicodeError) as error:
        raise IpsysError(
            f"--host {host}: is not an address of this machine; use 0.0.0.0 for all its addresses"
        ) from error
    except OverflowError as error:
        raise IpsysError(f"{option} {port}: is not a port; give one from 1024 to 65535") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise IpsysError(f"{option} {port}: is in use by another program; give another port") from error
        if error.errno == errno.EACCES:
            raise IpsysError(f"{option} {port}: is not allowed; give one from 1024 to 65535") from error
        raise IpsysError(
            f"--host {host}: the server cannot listen on this address: {error.strerror}"
        ) from error


def _url(host: str | None, port: int, token: str | None) -> str:
    name = host or _LOOPBACK
    try:
        if ipaddress.ip_address(name).is_unspecified:
            name = _address()
    except ValueError:
        pass
    if ":" in name:
        name = f"[{name}]"
    return f"http://{name}:{port}/" + (f"?token={token}" if token else "")


def _address() -> str:
    """Return the address that this machine sends from in its network; the probe sends no data."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # RFC 5737: an address reserved for documentation
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def qr_code(text: str) -> str:
    """Return a QR code as text of half blocks, readable as light on dark and as dark on light."""
    modules = cv2.QRCodeEncoder.create().encode(text) == 0
    if len(modules) % 2:
        modules = cv2.copyMakeBorder(modules.astype("uint8"), 0, 1, 0, 0, cv2.BORDER_CONSTANT, value=0) == 1
    blocks = {(False, False): "█", (True, False): "▄", (False, True): "▀", (True, True): " "}
    return "\n".join(
        "".join(blocks[bool(top), bool(low)] for top, low in zip(*rows, strict=True))
        for rows in zip(modules[::2], modules[1::2], strict=True)
    )


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
