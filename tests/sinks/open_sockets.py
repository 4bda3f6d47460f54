"""The local addresses of the sockets of a process, from /proc: those that other computers could reach."""

import ipaddress
import re
import struct
from collections.abc import Iterator
from pathlib import Path


def open_sockets(pid: int) -> list[tuple[str, str, int]]:
    """Return protocol, local address and port of each bound socket of a process."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            inodes.update(re.findall(r"socket:\[(\d+)\]", str(link.readlink())))
        except FileNotFoundError:  # closed in the meantime
            continue
    return [
        (protocol, address, port)
        for protocol in ("tcp", "tcp6", "udp", "udp6")
        for inode, address, port in _rows(Path(f"/proc/{pid}/net/{protocol}"))
        if inode in inodes and port
    ]


def exposed(pid: int) -> list[tuple[str, str, int]]:
    """Return the sockets of a process that are bound to more than loopback."""
    return [row for row in open_sockets(pid) if not ipaddress.ip_address(row[1]).is_loopback]


def _rows(path: Path) -> Iterator[tuple[str, str, int]]:
    for line in path.read_text().splitlines()[1:]:
        fields = line.split()
        address, port = fields[1].split(":")
        words = [int(address[n : n + 8], 16) for n in range(0, len(address), 8)]
        packed = struct.pack(f"={len(words)}I", *words)
        yield fields[9], str(ipaddress.ip_address(packed)), int(port, 16)
