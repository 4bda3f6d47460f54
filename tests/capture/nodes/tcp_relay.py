"""A relay of TCP connections on loopback that can be cut: everything stops, and nobody is told."""

from __future__ import annotations

import random
import socket
import threading
import time
from contextlib import suppress

__all__ = ["Relay"]

_BLOCK = 1 << 16
_TURN_S = 0.02


class Relay:
    """A relay to a port. A context manager.

    Parameters
    ----------
    to : the port of loopback to which the relay connects.
    jitter_s : each block of bytes waits for a random time up to this, in both directions.
    seed : seed of these times.

    Attributes
    ----------
    port : the port of loopback on which the relay listens.
    """

    def __init__(self, to: int, jitter_s: float = 0.0, seed: int = 0) -> None:
        self._to, self._jitter_s, self._rng = to, jitter_s, random.Random(seed)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._passes, self._ended = threading.Event(), threading.Event()
        self._passes.set()
        self._sockets: list[socket.socket] = []
        self._thread = threading.Thread(target=self._accept, daemon=True)

    def __enter__(self) -> Relay:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._passes.set()
        self._listener.close()
        self._close_all()
        self._thread.join()

    def cut(self, closes: bool = False) -> None:
        """Pass nothing from now on; with ``closes``, end the connections, too."""
        self._passes.clear()
        if closes:
            self._close_all()

    def mend(self) -> None:
        """Pass everything again."""
        self._passes.set()

    def _close_all(self) -> None:
        for connection in self._sockets:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def _accept(self) -> None:
        self._listener.settimeout(_TURN_S)
        while not self._ended.is_set():
            try:
                near, _ = self._listener.accept()
            except TimeoutError:
                continue
            except OSError:
                return
            near.settimeout(None)
            try:
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                near.close()
                continue
            self._sockets += [near, far]
            for source, target in ((near, far), (far, near)):
                threading.Thread(target=self._pump, args=(source, target), daemon=True).start()

    def _wait_for_passage(self) -> bool:
        """Wait until the relay passes blocks; return False at its end."""
        while not self._passes.wait(_TURN_S):
            if self._ended.is_set():
                return False
        return True

    def _pump(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while block := source.recv(_BLOCK):
                if self._jitter_s:
                    time.sleep(self._rng.random() * self._jitter_s)
                if not self._wait_for_passage():
                    return
                target.sendall(block)
        # The end of a connection does not pass either.
        self._wait_for_passage()
        for side in (source, target):
            with suppress(OSError):
                side.shutdown(socket.SHUT_RDWR)
