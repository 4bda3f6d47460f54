"""A relay of datagrams that loses some and delays the others: a program of its own, with a seed.

    python -m ipsys_log.live_runs.robot_runs.relay --port 9921 --to 9871 --loss 0.05 --delay-s 0.1 --lockstep

The relay listens on loopback, and sends to another port of loopback. With ``--lockstep`` its clock is that of
the ticks, which the simulator sends to the same port; the relay answers with the number of datagrams that it
has sent on. With ``--ros2`` it does the same with the poses of ROS 2: see ``ros2_relay.py``.
"""

import argparse
import json
import select
import socket
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ipsys_log.capture.frames import Clock
from ipsys_log.capture.simulation.settings import Purpose, random_stream
from ipsys_log.units import NS_PER_S

_LOOPBACK = "127.0.0.1"
_TURN_S = 0.005
_LONGEST_BYTES = 2048
Send = Callable[[bytes], object]


class Relay:
    """The queue of delayed datagrams; it draws for each datagram whether it is lost.

    Examples
    --------
    >>> relay = Relay(loss=0.0, delay_ns=100, seed=0)
    >>> relay.put(b"a", 1000)
    >>> relay.take(1099), relay.take(1100)
    ([], [b'a'])
    """

    def __init__(self, loss: float, delay_ns: int, seed: int) -> None:
        self.arrived = self.forwarded = 0
        self._loss, self._delay_ns = loss, delay_ns
        self._rng = random_stream(seed, Purpose.RELAY)
        self._waiting: deque[tuple[int, bytes]] = deque()

    def put(self, datagram: bytes, now_ns: int) -> None:
        """Take a datagram that arrives now."""
        self.arrived += 1
        if self._rng.random() >= self._loss:
            self._waiting.append((now_ns + self._delay_ns, datagram))

    def take(self, now_ns: int) -> list[bytes]:
        """Return the datagrams that are due."""
        due = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            due.append(self._waiting.popleft()[1])
        self.forwarded += len(due)
        return due


def _tick_of(datagram: bytes) -> dict[str, Any] | None:
    """Return the fields of a tick of the simulator; None for any other datagram."""
    try:
        fields = json.loads(datagram)
        return fields if "relay_tick" in fields else None
    except (RecursionError, TypeError, ValueError):
        return None


def _serve(sock: socket.socket, relay: Relay, send: Send) -> None:
    """Forward datagrams by the real clock, until the process is ended."""
    clock = Clock()
    while True:
        if select.select([sock], [], [], _TURN_S)[0]:
            relay.put(sock.recv(_LONGEST_BYTES), clock.now_ns())
        for datagram in relay.take(clock.now_ns()):
            send(datagram)


def _serve_lockstep(sock: socket.socket, relay: Relay, send: Send) -> None:
    """Forward datagrams by the clock of the ticks, until the process is ended."""
    early: list[bytes] = []
    tick: dict[str, Any] | None = None
    while True:
        datagram, sender = sock.recvfrom(_LONGEST_BYTES)
        if (fields := _tick_of(datagram)) is None:
            early.append(datagram)
        else:
            tick, simulator = fields, sender
        if tick is None or relay.arrived + len(early) < tick["positions"]:
            continue
        for waiting in early:
            relay.put(waiting, tick["time_ns"])
        early.clear()
        for due in relay.take(tick["time_ns"]):
            send(due)
        answer = {"relay_tick": tick["relay_tick"], "forwarded": relay.forwarded}
        sock.sendto(json.dumps(answer).encode(), simulator)
        tick = None


@contextmanager
def _open_output(sock: socket.socket, options: argparse.Namespace) -> Iterator[Send]:
    """Open the way to the robot. With ROS 2, its messages come in through ``sock``, too."""
    if options.ros2 is None:
        yield lambda datagram: sock.sendto(datagram, (_LOOPBACK, options.to))
        return
    from ipsys_log.live_runs.robot_runs.ros2_relay import open_ros2

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as inward:
        inward.connect(sock.getsockname())
        with open_ros2(options.robot, options.ros2, options.to, inward.send) as send:
            yield send


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--to", type=int, required=True)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--delay-s", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--lockstep", action="store_true")
    parser.add_argument("--ros2", type=int, help="the port of the router that sends the poses of --robot")
    parser.add_argument("--robot")
    options = parser.parse_args()
    relay = Relay(options.loss, round(options.delay_s * NS_PER_S), options.seed)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind((_LOOPBACK, options.port))
        with _open_output(sock, options) as send:
            print("ready", flush=True)  # noqa: T201
            serve = _serve_lockstep if options.lockstep else _serve
            serve(sock, relay, send)


if __name__ == "__main__":
    main()
