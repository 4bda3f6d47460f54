"""The server of the page, in a thread of its own beside whatever else goes on."""

from __future__ import annotations

import errno
import ipaddress
import secrets
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Thread

import cv2
import uvicorn

from ipsys_log.errors import IpsysError
from ipsys_log.measuring.scene import Scene
from ipsys_log.web.app import build_app
from ipsys_log.web.guard import Guard

__all__ = ["Served", "check_free", "qr_code", "serving"]

_LOOPBACK = "127.0.0.1"
_STEP_S = 0.02
_TURN_S = 0.1


@dataclass(frozen=True, slots=True)
class Served:
    """A page that is served: its address, with the token where one is needed."""

    url: str
    thread: Thread

    def wait(self, stopped: Callable[[], bool]) -> None:
        """Wait until the server ends, or until `stopped` is true."""
        while self.thread.is_alive() and not stopped():
            self.thread.join(_TURN_S)


@contextmanager
def serving(scene: Scene, host: str | None = None, port: int = 8000) -> Iterator[Served]:
    """Serve the page of a scene until the with-block is left.

    Parameters
    ----------
    host : the address to listen on; None: this machine alone, without a token.
    port : 0 takes any that is free.

    Raises
    ------
    IpsysError
        For a port that is taken or not allowed, or a host that is not of this machine.
    """
    token = None if host is None else secrets.token_urlsafe(12)
    with _listen(host or _LOOPBACK, port) as listening:
        names = {socket.gethostname().lower(), f"{socket.gethostname().lower()}.local"}
        names |= {host.lower()} if host else set()
        app = Guard(build_app(scene), frozenset(names), token)
        config = uvicorn.Config(
            app, log_level="error", access_log=False, lifespan="off", ws="none", http="h11",
            loop="asyncio", server_header=False, timeout_graceful_shutdown=1,
        )  # fmt: skip
        server = uvicorn.Server(config)
        thread = Thread(target=server.run, kwargs={"sockets": [listening]}, name="page", daemon=True)
        thread.start()
        while thread.is_alive() and not server.started:
            thread.join(_STEP_S)
        try:
            yield Served(_url(host, listening.getsockname()[1], token), thread)
        finally:
            server.should_exit = True
            thread.join()


def check_free(host: str | None, port: int) -> None:
    """See that a page can be served there.

    Raises
    ------
    IpsysError
        As :func:`serving`.
    """
    _listen(host or _LOOPBACK, port).close()


def _listen(host: str, port: int) -> socket.socket:
    try:
        family, *_, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        return socket.create_server(address[:2], family=family)
    except socket.gaierror as error:
        raise IpsysError(f"--host {host}: is no address of this machine; 0.0.0.0 is all of them") from error
    except OverflowError as error:
        raise IpsysError(f"--port {port}: give one of 1024 to 65535") from error
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise IpsysError(f"--port {port}: is in use by another program; give another one") from error
        if error.errno == errno.EACCES:
            raise IpsysError(f"--port {port}: is not allowed; give one of 1024 to 65535") from error
        raise IpsysError(f"--host {host}: cannot be listened on: {error.strerror}") from error


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
    """The address of this machine in its network: the one that it would send from. Nothing is sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # RFC 5737: an address for examples
            return str(probe.getsockname()[0])
        except OSError:
            return socket.gethostname()


def qr_code(text: str) -> str:
    """A QR code in half blocks, to be shown light on dark or dark on light alike."""
    modules = cv2.QRCodeEncoder.create().encode(text) == 0
    if len(modules) % 2:
        modules = cv2.copyMakeBorder(modules.astype("uint8"), 0, 1, 0, 0, cv2.BORDER_CONSTANT, value=0) == 1
    blocks = {(False, False): "█", (True, False): "▄", (False, True): "▀", (True, True): " "}
    return "\n".join(
        "".join(blocks[bool(top), bool(low)] for top, low in zip(*rows, strict=True))
        for rows in zip(modules[::2], modules[1::2], strict=True)
    )
