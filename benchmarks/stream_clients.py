"""Clients of the streams, in a process of their own: capture time and time of arrival of each position.

    python benchmarks/stream_clients.py UDP,UDP MAVLINK VRPN ROS2 ADDRESS

The arguments are ports on loopback, and the address for Foxglove. Two clients listen on UDP, two on VRPN,
one each on MAVLink, ROS 2 and Foxglove. Another one never reads, one sends garbage, and one vanishes. The
end of standard input ends the process; it prints JSON: by stream and client, capture time and arrival in ns.
"""

from __future__ import annotations

import json
import socket
import struct
import sys
import threading
import time
from collections.abc import Callable, Iterator

import zenoh
from pymavlink.dialects.v20 import common
from websockets.sync.client import connect
from websockets.typing import Subprotocol

__all__ = ["CLIENTS"]

# The clients whose messages are counted, by stream.
CLIENTS = {"UDP": 2, "MAVLink": 1, "VRPN": 2, "ROS 2": 1, "Foxglove": 1}
_GREETING = b"vrpn: ver. 07.38  0".ljust(24, b"\0")
_HEADER = struct.Struct(">iiiiii")
_ALIGNMENT, _NS_PER_US = 8, 1000
_TURN_S = 0.05
_VANISHES_AFTER = 50
_SILENT_S = 0.2

Arrivals = list[tuple[int, int]]
_READY_S = 60.0


def _datagrams(port: int) -> Iterator[tuple[bytes, int]]:
    """Yield the datagrams that arrive at a port, and their times of arrival."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        sock.bind(("127.0.0.1", port))
        while True:
            yield sock.recv(4096), time.time_ns()


def _udp(port: int, arrivals: Arrivals) -> None:
    for data, arrived_ns in _datagrams(port):
        arrivals.append((json.loads(data)["time_ns"], arrived_ns))


def _mavlink(port: int, arrivals: Arrivals) -> None:
    parser = common.MAVLink(None)
    for data, arrived_ns in _datagrams(port):
        for message in parser.parse_buffer(data) or ():
            if message.get_type() == "ODOMETRY":
                arrivals.append((message.time_usec * _NS_PER_US, arrived_ns))


def _connected(port: int) -> socket.socket:
    end_s = time.monotonic() + _READY_S
    while True:
        try:
            return socket.create_connection(("127.0.0.1", port))
        except OSError:
            if time.monotonic() > end_s:
                raise
            time.sleep(_TURN_S)


def _vrpn(port: int, arrivals: Arrivals, most: float = float("inf")) -> None:
    """Read the poses of the VRPN server."""
    with _connected(port) as sock:
        sock.sendall(_GREETING)
        for seconds, micros, kind in _vrpn_messages(sock):
            if kind == 0:
                time_ns = (seconds * 1_000_000 + micros) * _NS_PER_US
                arrivals.append((time_ns, time.time_ns()))
            if len(arrivals) >= most:
                return


def _vrpn_messages(sock: socket.socket) -> Iterator[tuple[int, int, int]]:
    data = bytearray()
    greeted = False
    while True:
        data += sock.recv(65536)
        if not greeted and len(data) >= len(_GREETING):
            del data[: len(_GREETING)]
            greeted = True
        while greeted and len(data) >= _HEADER.size:
            length, seconds, micros, _, kind, _ = _HEADER.unpack_from(data)
            padded = length + -length % _ALIGNMENT
            if len(data) < padded:
                break
            del data[:padded]
            yield seconds, micros, kind


def _stalled(port: int) -> None:
    """Greet the VRPN server, and never read."""
    sock = _connected(port)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    sock.sendall(_GREETING)
    while True:
        time.sleep(_TURN_S)


def _garbage(vrpn: int, foxglove: int) -> None:
    """Send bytes that belong to no protocol, again and again."""
    while True:
        for port in (vrpn, foxglove):
            with _connected(port) as sock:
                try:
                    sock.sendall(bytes(range(256)) * 16)
                    time.sleep(_SILENT_S)
                except OSError:
                    continue


def _ros2(port: int, arrivals: Arrivals) -> None:
    config = zenoh.Config()
    for key, value in {
        "mode": '"client"',
        "connect/endpoints": f'["tcp/127.0.0.1:{port}"]',
        "scouting/multicast/enabled": "false",
    }.items():
        config.insert_json5(key, value)
    _connected(port).close()
    session = zenoh.open(config)

    def take(sample: zenoh.Sample) -> None:
        arrived_ns = time.time_ns()
        # CDR: 4 bytes of header, then the stamp of the message.
        seconds, rest_ns = struct.unpack_from("<iI", sample.payload.to_bytes(), 4)
        arrivals.append((seconds * 1_000_000_000 + rest_ns, arrived_ns))

    subscriber = session.declare_subscriber("0/*/pose/**", take)
    while subscriber:  # as long as the session has a name, it is open
        time.sleep(_TURN_S)


def _foxglove(address: str, arrivals: Arrivals) -> None:
    port = int(address.split(":")[2].partition("/")[0])
    _connected(port).close()
    with connect(address, subprotocols=[Subprotocol("foxglove.sdk.v1")], compression=None) as client:
        while True:
            data = client.recv()
            arrived_ns = time.time_ns()
            if isinstance(data, bytes):
                (time_ns,) = struct.unpack_from("<Q", data, 5)
                arrivals.append((time_ns, arrived_ns))
            elif json.loads(data)["op"] == "advertise":
                rows = [row for row in json.loads(data)["channels"] if row["topic"].endswith("/tracks")]
                wanted = [{"id": row["id"], "channelId": row["id"]} for row in rows]
                client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def main(udp: str, mavlink: int, vrpn: int, ros2: int, foxglove: str) -> None:
    """Run the clients until standard input ends; ``foxglove`` is an address with its secret."""
    arrivals: dict[str, list[Arrivals]] = {name: [[] for _ in range(n)] for name, n in CLIENTS.items()}
    port = int(foxglove.split(":")[2].partition("/")[0])
    jobs: list[Callable[[], None]] = [lambda: _stalled(vrpn), lambda: _garbage(vrpn, port)]
    jobs += [lambda: _vrpn(vrpn, [], _VANISHES_AFTER)]
    jobs += [
        lambda n=int(n), rows=rows: _udp(n, rows)  # type: ignore[misc]
        for n, rows in zip(udp.split(","), arrivals["UDP"], strict=True)
    ]
    jobs += [lambda rows=rows: _vrpn(vrpn, rows) for rows in arrivals["VRPN"]]  # type: ignore[misc]
    jobs += [lambda: _mavlink(mavlink, arrivals["MAVLink"][0])]
    jobs += [lambda: _ros2(ros2, arrivals["ROS 2"][0]), lambda: _foxglove(foxglove, arrivals["Foxglove"][0])]
    for job in jobs:
        threading.Thread(target=_quietly, args=(job,), daemon=True).start()
    sys.stdin.read()
    sys.stdout.write(json.dumps(arrivals))
    sys.stdout.flush()


def _quietly(job: Callable[[], None]) -> None:
    """Run a client until its server ends."""
    try:
        job()
    except (OSError, EOFError, ValueError, RuntimeError) as error:
        sys.stderr.write(f"{error}\n")


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5])
