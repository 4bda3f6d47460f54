"""Ports for servers that need a number before they start.

The kernel gives the ports of its own range to any program that asks for port 0 or opens a connection. A free
port of that range may be taken before its server starts. The ports of this module are outside of that range,
and no two tests of this machine get the same one.
"""

import fcntl
import os
import socket
import tempfile
from pathlib import Path

_KERNEL_RANGE = Path("/proc/sys/net/ipv4/ip_local_port_range")
_FIRST, _COUNT = 10_000, 10_000


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """Return a free port of this machine that no other call returns before thousands of calls later."""
    path = Path(tempfile.gettempdir(), f"ipsys_test_port_{os.getuid()}")
    with path.open("a+") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        last = int(file.read() or 0)
        port = next(port for port in _ports_after(last) if _is_free(port, kind))
        file.truncate(0)
        file.write(str(port))
    return port


def _ports_after(last: int) -> list[int]:
    """Return all ports in turn, beginning with the one after the last."""
    low, high = _kernel_range()
    ports = [port for port in range(_FIRST, _FIRST + _COUNT) if not low <= port <= high]
    return [*(port for port in ports if port > last), *(port for port in ports if port <= last)]


def _kernel_range() -> tuple[int, int]:
    if not _KERNEL_RANGE.exists():
        return 32_768, 65_535
    low, high = _KERNEL_RANGE.read_text().split()
    return int(low), int(high)


def _is_free(port: int, kind: socket.SocketKind) -> bool:
    with socket.socket(type=kind) as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True
