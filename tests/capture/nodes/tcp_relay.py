"""A relay of TCP connections with delays, broken connections, and partitions.

As a program, it breaks connections and passes nothing for a time, by a seeded plan::

    python -m tests.capture.nodes.tcp_relay LISTEN_HOST PORT TO_HOST SEED FAULTS
"""

from __future__ import annotations

import random
import socket
import sys
import threading
import time
from contextlib import suppress
from queue import Queue

__all__ = ["Relay"]

_BLOCK = 1 << 16
_TURN_S = 0.02
_MOST_WAITING_BLOCKS = 64
# The delays of the program from the node to the centre and back, its jitter, and its faults.
DELAYS_S, JITTER_S = (0.045, 0.005), 0.01
_BLOCKS_BETWEEN, _PARTITION_S = (60, 160), (2.0, 7.0)


class Relay:
    """A relay to a port. A context manager.

    Parameters
    ----------
    to : the port to which the relay connects.
    jitter_s : each block of bytes waits for a random time up to this, in both directions.
    seed : seed of these times.
    delays_s : each block waits for this time, too: from the node to the centre, and back.
    host, port : the address on which the relay listens; port 0 is a free one.
    to_host : the host of ``to``.

    Attributes
    ----------
    port : the port on which the relay listens.
    blocks : the number of blocks that have passed.
    """

    def __init__(
        self,
        to: int,
        jitter_s: float = 0.0,
        seed: int = 0,
        delays_s: tuple[float, float] = (0.0, 0.0),
        host: str = "127.0.0.1",
        port: int = 0,
        to_host: str = "127.0.0.1",
    ) -> None:
        self._to, self._jitter_s, self._delays_s = (to_host, to), jitter_s, delays_s
        self._rng = random.Random(seed)
        self._listener = socket.create_server((host, port))
        self.port: int = self._listener.getsockname()[1]
        self.blocks = 0
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
                far = socket.create_connection(self._to)
            except OSError:
                near.close()
                continue
            self._sockets += [near, far]
            for source, target, delay_s in ((near, far, self._delays_s[0]), (far, near, self._delays_s[1])):
                self._start_line(source, target, delay_s)

    def _start_line(self, source: socket.socket, target: socket.socket, delay_s: float) -> None:
        """Start the threads of one direction; None in the line is the end of the connection."""
        line: Queue[tuple[float, bytes] | None] = Queue(_MOST_WAITING_BLOCKS)
        rng = random.Random(self._rng.getrandbits(64))

        def take() -> None:
            with suppress(OSError):
                while block := source.recv(_BLOCK):
                    line.put((time.monotonic() + delay_s + rng.random() * self._jitter_s, block))
            line.put(None)

        for work in (take, lambda: self._pass_on(line, source, target)):
            threading.Thread(target=work, daemon=True).start()

    def _pass_on(
        self, line: Queue[tuple[float, bytes] | None], source: socket.socket, target: socket.socket
    ) -> None:
        is_open = True
        while (item := line.get()) is not None:
            due_s, block = item
            while (wait_s := due_s - time.monotonic()) > 0:
                time.sleep(wait_s)
            self._wait_for_passage()
            try:
                if is_open:
                    target.sendall(block)
                    self.blocks += 1
            except OSError:
                is_open = False
                _end(source, target)
        # The end of a connection does not pass a partition either.
        self._wait_for_passage()
        _end(source, target)

    def _wait_for_passage(self) -> None:
        """Wait until the relay passes blocks, or ends."""
        while not self._passes.wait(_TURN_S) and not self._ended.is_set():
            continue


def _end(*sides: socket.socket) -> None:
    for side in sides:
        with suppress(OSError):
            side.shutdown(socket.SHUT_RDWR)


def _disturb(relay: Relay, rng: random.Random, faults: int) -> None:
    """Break connections and partition the network in turns, each after some blocks."""
    for number in range(faults):
        until = relay.blocks + rng.randint(*_BLOCKS_BETWEEN)
        while relay.blocks < until:
            time.sleep(_TURN_S)
        duration_s = rng.uniform(*_PARTITION_S)
        relay.cut(closes=number % 2 == 0)
        time.sleep(duration_s)
        relay.mend()
        kind = "partition" if number % 2 else "broken connection"
        print(f"{kind} of {duration_s:.1f} s", flush=True)  # noqa: T201
    print("calm", flush=True)  # noqa: T201


def _main(host: str, port: str, to_host: str, seed: str, faults: str) -> None:
    with Relay(int(port), JITTER_S, int(seed), DELAYS_S, host, int(port), to_host) as relay:
        print("ready", flush=True)  # noqa: T201
        _disturb(relay, random.Random(int(seed)), int(faults))
        sys.stdin.read()  # until the test ends


if __name__ == "__main__":
    _main(*sys.argv[1:])
