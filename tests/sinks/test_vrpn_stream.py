"""VRPN server: an independent client gets the poses; wrong clients disturb neither it nor the stream."""

import json
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from math import cos, sin
from typing import Any, NamedTuple

import pytest
from scipy.spatial.transform import Rotation

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message
from ipsys_log.sinks.streams import StreamSettings
from ipsys_log.sinks.streams.poses import StreamContext
from ipsys_log.sinks.streams.vrpn import VrpnStream
from ipsys_log.units import NS_PER_S
from tests.conftest import ROOT
from tests.sinks.streaming import START_NS, STEP_NS, TILT_RAD, TOPIC, send_all, tilted_track, track, tracks
from tests.waiting import wait_until

_LIMIT_S = 240.0
COOKIE = b"vrpn: ver. 07.38  0".ljust(24, b"\0")


class Report(NamedTuple):
    """A message as a client of VRPN reads it: names instead of numbers."""

    sender: str
    type: str
    time_ns: int
    content: bytes


class Reader:
    """A client of VRPN by the description of its protocol; it shares no code with the server."""

    def __init__(self, sock: socket.socket) -> None:
        self.sock = sock
        sock.settimeout(_LIMIT_S)
        self._names: dict[tuple[int, int], str] = {}

    def greet(self, cookie: bytes = COOKIE) -> bytes:
        self.sock.sendall(cookie)
        return self._exactly(24)

    def reports(self) -> Iterator[Report]:
        while True:
            length, seconds, microseconds, sender, kind, _ = struct.unpack(">IIIiiI", self._exactly(24))
            content = self._exactly(-(-(length - 24) // 8) * 8)[: length - 24]
            if kind in (-1, -2):
                self._names[kind, sender] = content[4:-1].decode()
            else:
                names = self._names[-1, sender], self._names[-2, kind]
                yield Report(*names, seconds * NS_PER_S + microseconds * 1000, content)

    def send(self, content: bytes, kind: int, sender: int) -> None:
        padding = bytes(-len(content) % 8)
        self.sock.sendall(
            struct.pack(">IIIiiI", 24 + len(content), 0, 0, sender, kind, 0) + content + padding
        )

    def _exactly(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            more = self.sock.recv(count - len(data))
            if not more:
                raise EOFError
            data += more
        return data


class Served(NamedTuple):
    server: VrpnStream
    events: list[str]


@contextmanager
def serving(*robots: str, host: str | None = None) -> Iterator[Served]:
    events: list[str] = []
    warn = lambda kind, text: events.append(f"{kind}: {text}")  # noqa: E731
    heights_m = dict.fromkeys(robots)
    context = StreamContext(StreamSettings(host=host), {TOPIC}, lambda: START_NS, warn, 1, heights_m)
    server = VrpnStream(0, context)
    with closing(server):
        yield Served(server, events)


@contextmanager
def connected(server: VrpnStream, cookie: bytes = COOKIE) -> Iterator[Reader]:
    clients = server.client_count
    with socket.create_connection(("127.0.0.1", server.port), _LIMIT_S) as sock:
        reader = Reader(sock)
        assert reader.greet(cookie) == COOKIE
        wait_until(lambda: server.client_count > clients, "the client is connected")
        yield reader


def send(server: VrpnStream, *messages: Message) -> None:
    send_all(server, messages)


def taken(reader: Reader, count: int) -> list[Report]:
    reports = reader.reports()
    return [next(reports) for _ in range(count)]


def test_client_of_motioncapture_gets_the_poses() -> None:
    pytest.importorskip("motioncapture")
    ended = threading.Event()
    with serving("ada", "bob") as served:

        def play() -> Iterator[Message]:
            number = 0
            while not ended.wait(0.01):
                number += 1
                yield tracks(number, track("ada", 1.25, 0.5), replace(tilted_track("bob"), x_m=3.0))

        thread = threading.Thread(target=lambda: send_all(served.server, play()), daemon=True)
        thread.start()
        program = [sys.executable, "-m", "tests.sinks.vrpn_listener", f"127.0.0.1:{served.server.port}", "6"]
        try:
            done = subprocess.run(
                program, cwd=ROOT, capture_output=True, text=True, timeout=_LIMIT_S, check=False
            )
        finally:
            ended.set()
            thread.join()
    lines = [line.removeprefix("POSE ") for line in done.stdout.splitlines() if line.startswith("POSE ")]
    poses = dict(map(json.loads, lines))
    assert poses["ada"] == pytest.approx([1.25, 2.0, 0.1, 0, 0, sin(0.25), cos(0.25)], abs=1e-6)
    turn = Rotation.from_rotvec(TILT_RAD).as_quat()
    assert poses["bob"] == pytest.approx([3.0, 2.0, 0.1, *turn], abs=1e-6)
    # On a busy machine, the client may get too little time to read all messages.
    assert all("is too slow" in event for event in served.events)


def test_reports_have_capture_times_poses_and_velocities() -> None:
    with serving("ada") as served, connected(served.server) as client:
        send(served.server, *(tracks(n, track("ada", 0.02 * n, 0.04 * n)) for n in range(4)))
        reports = taken(client, 6)
    assert [report.sender for report in reports] == ["ada"] * 6
    kinds = [report.type.removeprefix("vrpn_Tracker ") for report in reports]
    assert kinds == ["Pos_Quat"] * 3 + ["Velocity", "Pos_Quat", "Velocity"]
    assert [r.time_ns for r in reports if "Pos" in r.type] == [START_NS + n * STEP_NS for n in range(4)]
    sensor, _, *pose = struct.unpack(">ii7d", reports[4].content)
    assert sensor == 0
    assert pose == pytest.approx([0.06, 2.0, 0.1, 0, 0, sin(0.06), cos(0.06)])
    _, _, *velocity = struct.unpack(">ii8d", reports[5].content)
    assert velocity == pytest.approx([0.5, 0, 0, 0, 0, sin(0.05), cos(0.05), 0.1])


def test_velocity_of_a_tilted_robot_has_its_axis() -> None:
    with serving("ada") as served, connected(served.server) as client:
        send(served.server, tracks(0, sent := tilted_track("ada")))
        *velocity, turn_s = struct.unpack(">ii8d", taken(client, 2)[1].content)[2:]
    assert velocity[:3] == pytest.approx(sent.velocity_m_s)
    assert Rotation.from_quat(velocity[3:]).as_rotvec() / turn_s == pytest.approx(sent.angular_velocity_rad_s)


def test_robot_that_is_seen_later_is_announced() -> None:
    with serving() as served, connected(served.server) as client:
        send(served.server, tracks(0))
        assert [report.sender for report in taken(client, 2)] == ["ada", "bob"]


def test_poses_that_cannot_be_marked_are_withheld() -> None:
    with serving() as served, connected(served.server) as client:
        rows = (
            track("ada", 1.0, inside=False),
            track("ada", 2.0, heading_rad=None),
            track("ada", 3.0, inside=None),
        )
        send(served.server, tracks(-30, track("ada", 0.0)), *(tracks(n, row) for n, row in enumerate(rows)))
        (report,) = taken(client, 1)
    assert struct.unpack_from(">d", report.content, 8) == (3.0,)


def test_ping_for_a_robot_is_answered() -> None:
    with serving("ada") as served, connected(served.server) as client:
        client.send(struct.pack(">i", 4) + b"eve\0", -1, 3)
        client.send(struct.pack(">i", 4) + b"ada\0", -1, 5)
        client.send(struct.pack(">i", 23) + b"vrpn_Base ping_message\0", -2, 9)
        client.send(b"", 9, 3)  # not known: no answer
        client.send(b"", 9, 5)
        (report,) = taken(client, 1)
    assert (report.sender, report.type) == ("ada", "vrpn_Base pong_message")


def ask(server: VrpnStream, text: str) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.sendto(text.encode() + b"\0", ("127.0.0.1", server.port))


def test_server_calls_back_the_sender_of_a_datagram_only() -> None:
    with serving("ada") as served, socket.create_server(("127.0.0.1", 0)) as waiting:
        waiting.settimeout(_LIMIT_S)
        ask(served.server, f"192.0.2.1 {waiting.getsockname()[1]}")  # the text names another machine
        sock, address = waiting.accept()
        with sock:
            reader = Reader(sock)
            assert (address[0], reader.greet()) == ("127.0.0.1", COOKIE)
            wait_until(lambda: served.server.client_count == 1, "the client is connected")
            send(served.server, tracks(0, track("ada", 1.0)))
            assert [report.sender for report in taken(reader, 1)] == ["ada"]


def test_only_a_few_ports_above_1023_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[tuple[str, int]] = []

    class Watched(socket.socket):
        def connect_ex(self, address: Any) -> int:
            called.append(address)
            return super().connect_ex(address)

    with serving() as served:
        waiting = [socket.create_server(("127.0.0.1", 0)) for _ in range(8)]
        monkeypatch.setattr(socket, "socket", Watched)
        for text in ("127.0.0.1 22", "127.0.0.1 1023", "127.0.0.1 70000", "127.0.0.1 -5", "x", "", "a b"):
            ask(served.server, text)
        for sock in waiting:
            for _ in range(3):  # a client repeats its request
                ask(served.server, f"127.0.0.1 {sock.getsockname()[1]}")
        wait_until(lambda: len(called) == 4, "four ports are called", lambda: called)
        time.sleep(0.3)
        assert called == [sock.getsockname() for sock in waiting[:4]]
        for sock in waiting:
            sock.close()


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"vrpn: ver. 08.00  0".ljust(24, b"\0"), "has another version of VRPN; this server has 07.38"),
        (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", "has another version of VRPN"),
        (COOKIE + b"\xff" * 64, "sends something else than VRPN"),
        (COOKIE + bytes(64), "sends something else than VRPN"),
    ],
)
def test_client_of_something_else_is_disconnected(data: bytes, text: str) -> None:
    with serving() as served:
        with socket.create_connection(("127.0.0.1", served.server.port), _LIMIT_S) as sock:
            sock.sendall(data)
            wait_until(lambda: len(served.events) == 1, "the server warns once", lambda: served.events)
            with suppress(ConnectionResetError):  # the server has not read everything
                while sock.recv(4096):
                    pass
        assert text in served.events[0]
        assert served.events[0].startswith("stream_client: VRPN port")


def test_other_clients_do_not_disturb_a_good_one() -> None:
    count = 2000
    rows = [tracks(n, track("ada", float(n))) for n in range(count)]
    with serving("ada") as served, connected(served.server) as stalled, connected(served.server) as good:
        with connected(served.server) as vanishing:
            send(served.server, rows[0])
        assert vanishing.sock.fileno() == -1
        with socket.create_connection(("127.0.0.1", served.server.port), _LIMIT_S) as garbage:
            garbage.sendall(b"\x17" * 5000)
        positions: list[float] = []

        def read() -> None:
            for report in good.reports():
                if "Pos_Quat" in report.type:
                    positions.extend(struct.unpack_from(">d", report.content, 8))
                    if len(positions) == count:
                        return

        reading = threading.Thread(target=read, daemon=True)
        reading.start()
        for number, row in enumerate(rows[1:], 2):
            send(served.server, row)
            wait_until(
                lambda number=number: len(positions) >= number - 50,  # type: ignore[misc]
                "the good client is at most 50 messages late",
            )
        reading.join(_LIMIT_S)
        assert positions == [float(n) for n in range(count)]
        assert any("is too slow" in event for event in served.events)
        # The stalled client lost messages, but the rest is complete messages.
        stalled.sock.shutdown(socket.SHUT_WR)
        kept = 0
        try:
            for report in stalled.reports():
                assert report.sender == "ada"
                kept += "Pos_Quat" in report.type
        except (EOFError, ConnectionResetError):
            pass
        assert 0 < kept < count


def test_silent_client_does_not_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ipsys_log.sinks.streams.vrpn._GREETING_NS", NS_PER_S // 10)
    with serving() as served:
        with socket.create_connection(("127.0.0.1", served.server.port), _LIMIT_S) as sock:
            sock.settimeout(_LIMIT_S)
            while sock.recv(4096):
                pass
        assert served.events == []


def test_port_in_use_is_refused() -> None:
    with (
        serving() as served,
        pytest.raises(IpsysError, match=f"port {served.server.port} is in use") as error,
    ):
        VrpnStream(served.server.port, StreamContext(StreamSettings(), (), lambda: 0, lambda *_: None, 1))
    assert "\n" not in str(error.value)


def test_foreign_host_is_refused() -> None:
    context = StreamContext(StreamSettings(host="192.0.2.77"), (), lambda: 0, lambda *_: None, 1)
    with pytest.raises(IpsysError, match=r"--host 192\.0\.2\.77: is not an address of this machine"):
        VrpnStream(0, context)
