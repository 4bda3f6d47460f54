"""Ten clients of four streams during a recording: faulty ones change nothing for the others and the log."""

from __future__ import annotations

import json
import socket
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from math import inf
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from ipsys_log.capture.lab import first_messages
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import FRAME_SKIPPED, Tracks
from ipsys_log.messages.channels import EVENTS, TRACKS
from ipsys_log.sinks.streams import STALE_S, StreamSettings
from ipsys_log.sinks.streams.foxglove import FoxgloveStream
from ipsys_log.sinks.streams.opening import open_streams
from ipsys_log.sinks.streams.poses import StreamContext, first_session
from ipsys_log.units import NS_PER_S
from tests.live_recordings import RATE_HZ, lenses, sent
from tests.playing import SteppedClock, cameras, playing
from tests.ports import free_port
from tests.sinks.streaming import in_order
from tests.sinks.test_vrpn_stream import Reader
from tests.sinks.zenoh_listener import ZenohListener
from tests.waiting import wait_until

_LIMIT_S = 240.0
_TOPIC = TRACKS.topic_of("poly")


class Clients:
    """The clients, each in a thread; ``counts`` has the positions that each has received."""

    def __init__(self, vrpn: int, ros2: int, foxglove: str) -> None:
        self.counts: Counter[str] = Counter()
        self.udp = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
        for sock in self.udp:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
            sock.bind(("127.0.0.1", 0))
        self._vrpn, self._ros2, self._foxglove = vrpn, ros2, foxglove
        self._stack = ExitStack()

    def connect(self) -> None:
        """Connect, as soon as the servers listen."""
        for number, sock in enumerate(self.udp):
            self._start(lambda sock=sock, name=f"udp {number}": self._count_datagrams(sock, name))
        reader = Reader(self._opened())
        reader.greet()
        self._start(lambda: self._count_reports(reader))
        stalled = self._opened()
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.sendall(b"vrpn: ver. 07.38  0".ljust(24, b"\0"))
        self._start(self._send_garbage)
        self.ros2 = self._stack.enter_context(closing(ZenohListener(self._ros2, "/marker_7/pose", "/tf")))
        self._vanishing = ZenohListener(self._ros2, "/tf")
        self._start(self._vanish)
        for name in ("foxglove", "foxglove 2"):
            self._start(lambda name=name: self._count_frames(name))

    def close(self) -> None:
        with self._stack:
            for sock in self.udp:
                sock.close()

    def _opened(self) -> socket.socket:
        return self._stack.enter_context(socket.create_connection(("127.0.0.1", self._vrpn), _LIMIT_S))

    def _start(self, job: Any) -> None:
        threading.Thread(target=job, daemon=True).start()

    def _count_datagrams(self, sock: socket.socket, name: str) -> None:
        while True:
            try:
                assert json.loads(sock.recv(4096))["ipsys"] == 1
            except OSError:
                return
            self.counts[name] += 1

    def _count_reports(self, reader: Reader) -> None:
        try:
            for report in reader.reports():
                self.counts["vrpn"] += "Pos_Quat" in report.type
        except (OSError, EOFError):
            return

    def _send_garbage(self) -> None:
        for _ in range(20):
            # The server may end the connection before it has read everything.
            with suppress(OSError), self._opened() as sock:
                sock.sendall(bytes(range(256)) * 8)
                sock.recv(4096)

    def _vanish(self) -> None:
        self._vanishing.messages("/tf", 3)
        self._vanishing.close()

    def _count_frames(self, name: str) -> None:
        options: Any = {"subprotocols": [Subprotocol("foxglove.sdk.v1")], "compression": None}
        with connect(self._foxglove, **options) as client:
            while True:
                try:
                    data = client.recv()
                except ConnectionClosed:
                    return
                if isinstance(data, bytes):
                    self.counts[name] += 1
                elif json.loads(data)["op"] == "advertise":
                    rows = [row for row in json.loads(data)["channels"] if row["topic"] == _TOPIC]
                    wanted = [{"id": 1, "channelId": row["id"]} for row in rows]
                    client.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


@contextmanager
def recording(lab: Path, calibration: Path, target: Path) -> Iterator[tuple[Clients, list[str]]]:
    """Record all frames of a log with ten clients; the block runs after the recording."""
    frames, events = sent(lab), []
    clock = SteppedClock(list(frames), RATE_HZ)
    with Session([lab]) as session:
        (rig,) = session.payloads(["/rig"])
    vrpn, ros2, foxglove = (free_port() for _ in range(3))
    clients = Clients(vrpn, ros2, f"ws://127.0.0.1:{foxglove}/?token=secret")
    udp = tuple(f"127.0.0.1:{sock.getsockname()[1]}" for sock in clients.udp)
    settings = StreamSettings(udp=udp, vrpn=vrpn, ros2=ros2, foxglove=foxglove, secret="secret")
    attached = LiveCameras(cameras(*frames), playing(frames, inf, before=clock.before), clock)

    def warn(kind: str, text: str) -> None:
        events.append(f"{kind}: {text}")

    first = first_messages(rig, lenses(lab), attached.now_ns)
    robots = {f"marker_{number}": None for number in range(10)}
    number = first_session(clock.now_ns())
    context = StreamContext(settings, {_TOPIC}, clock.now_ns, warn, number, robots)
    with open_streams(context) as streams, closing(clients):
        clients.connect()
        (server,) = [stream for stream in streams if isinstance(stream, FoxgloveStream)]
        wait_until(
            lambda: sum(one.subscriptions.number_of(1) == 1 for one in server._clients) == 2,
            "two clients of Foxglove have subscribed",
        )
        with attached:
            request = Request(model_from=calibration)
            pipeline.live(attached, first, target, request, sinks=[clock.watch, *streams])
        yield clients, events


@pytest.mark.slow
def test_faulty_clients_change_nothing_for_the_others(
    lab_log: Path, calibration: Path, tmp_path: Path
) -> None:
    target = tmp_path / "live.mcap"
    with recording(lab_log, calibration, target) as (clients, events):
        with Session([target]) as session:
            recorded: list[Tracks] = session.payloads([_TOPIC])
            counted = {name: session.count(topic) for name, topic in session.images.items()}
            skipped = [row for row in session.payloads(session.topics(EVENTS)) if row.kind == FRAME_SKIPPED]
        poses = in_order(recorded)
        # A prediction that is too old is withheld.
        recent = [row for row in poses if (row.coasting_ns or 0) < STALE_S * NS_PER_S]
        good = [row for row in recent if row.inside is not False and row.heading_rad is not None]
        expected = {**{f"udp {n}": len(poses) for n in range(3)}, "vrpn": len(good)}
        expected |= {"foxglove": len(recorded), "foxglove 2": len(recorded)}
        wait_until(
            lambda: sum(clients.counts.values()) >= sum(expected.values()),
            f"the clients have {expected} messages",
            lambda: clients.counts,
        )
        assert dict(clients.counts) == expected
        wait_until(
            lambda: sum(len(m.transforms) for m in clients.ros2.messages("/tf")) == len(good) > 0,
            f"the node of ROS 2 has {len(good)} transforms",
        )
    assert counted == {name: len(rows) for name, rows in sent(lab_log).items()}
    assert skipped == []
    assert not [text for text in events if text.startswith("sink_")], events
