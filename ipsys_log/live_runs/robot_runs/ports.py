"""The ports of a robot run: all are on loopback, and free before the run."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass

from ipsys_log.errors import IpsysError

_LOOPBACK = "127.0.0.1"
# Attempts to find any free port.
_ATTEMPTS = 100


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of a robot run.

    Attributes
    ----------
    wheels : the simulated wheels; 0: they bind any free port themselves.
    server : the server of VRPN or ROS 2; None with UDP.
    positions : by number of the robot, the port that its program gets.
    relays : by number of the robot, the port of its relay; empty without relays.
    """

    wheels: int
    server: int | None
    positions: tuple[int, ...]
    relays: tuple[int, ...]


def find_ports(first: int, robots: int, has_server: bool, has_relay: bool) -> Ports:
    """Return ports that are free now.

    Parameters
    ----------
    first : the first port, the others follow; 0: any free ports.
    robots : number of robots.
    has_server : all robots connect to one server, or to their relay.
    has_relay : each robot has a relay.

    Raises
    ------
    IpsysError
        A port is in use.
    """
    own = 0 if has_server and not has_relay else robots
    count = has_server + own + (robots if has_relay else 0)
    # A port that is bound later may be taken before, so the wheels choose their own.
    wheels, *free = _bindable(first, 1 + count) if first else (0, *_bindable(0, count))
    server = free.pop(0) if has_server else None
    shared = () if server is None else (server,) * robots
    return Ports(wheels, server, tuple(free[:own]) or shared, tuple(free[own:]))


def _bindable(first: int, count: int) -> Sequence[int]:
    with ExitStack() as stack:
        return [_probe(first + number if first else 0, first, stack) for number in range(count)]


def _probe(wanted: int, first: int, stack: ExitStack) -> int:
    """Return a port that is free for UDP and TCP; it stays in use until the stack is closed."""
    for _ in range(1 if wanted else _ATTEMPTS):
        port = wanted
        with ExitStack() as probes:
            try:
                for kind in (socket.SOCK_DGRAM, socket.SOCK_STREAM):
                    probe = probes.enter_context(socket.socket(socket.AF_INET, kind))
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, kind is socket.SOCK_STREAM)
                    probe.bind((_LOOPBACK, port))
                    port = port or int(probe.getsockname()[1])
            except OSError:  # a port that is free for UDP may be in use for TCP
                continue
            stack.push(probes.pop_all())
            return port
    raise IpsysError(
        f"--port {first}: port {port} is in use, perhaps by another run; end it, or give another port"
    )
