"""Foxglove stream: the client of Foxglove gets the messages; foreign pages and clients get nothing."""

import base64
import json
import os
import shutil
import socket
import struct
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import foxglove
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin, Subprotocol

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CompressedImage, Event, Message
from ipsys_log.sinks.sink import DropReport
from ipsys_log.sinks.streams import StreamSettings
from ipsys_log.sinks.streams import foxglove as foxglove_stream
from ipsys_log.sinks.streams.foxglove import FoxgloveStream
from ipsys_log.sinks.streams.foxglove_messages import SUBPROTOCOLS, Subscriptions
from ipsys_log.sinks.streams.poses import NewSession, StreamContext
from ipsys_log.statistics.latency import PositionState
from tests.node_packages import install
from tests.sinks.open_sockets import exposed, open_sockets
from tests.sinks.streaming import RIG, START_NS, STEP_NS, TOPIC, judged, send_all, tracks
from tests.waiting import wait_until

SECRET = "the-secret"
_LIMIT_S = 240.0


@contextmanager
def streaming(**options: Any) -> Iterator[tuple[FoxgloveStream, list[tuple[str, str]]]]:
    events: list[tuple[str, str]] = []
    warn = lambda kind, text: events.append((kind, text))  # noqa: E731
    images, topics = options.pop("with_images", False), options.pop("topics", [TOPIC])
    settings = StreamSettings(host=options.pop("host", None), secret=SECRET, images=images)
    stream = FoxgloveStream(0, StreamContext(settings, topics, lambda: START_NS, warn, 7, **options))
    with closing(stream):
        yield stream, events


def opened(stream: FoxgloveStream, token: str = SECRET, **options: Any) -> ClientConnection:
    address = f"ws://127.0.0.1:{stream.port}/?token={token}"
    options.setdefault("subprotocols", [Subprotocol(SUBPROTOCOLS[0])])
    client: ClientConnection = connect(address, compression=None, open_timeout=_LIMIT_S, **options)
    return client


def subscribed(client: ClientConnection, *channels: int) -> dict[str, Any]:
    """Subscribe to channels by their numbers; return what the server told before."""
    info = json.loads(client.recv(_LIMIT_S))
    assert json.loads(client.recv(_LIMIT_S))["op"] == "advertise"
    rows = [{"id": 100 + number, "channelId": number} for number in channels]
    client.send(json.dumps({"op": "subscribe", "subscriptions": rows}))
    return dict(info)


def wait_for_subscription(stream: FoxgloveStream) -> None:
    """Wait until a client has subscribed to channel 1."""
    wait_until(
        lambda: any(one.subscriptions.number_of(1) is not None for one in stream._clients),
        "a client has subscribed to channel 1",
    )


def decode(channel: Any, data: bytes) -> Any:
    """Decode a message with the schema that the server announced."""
    files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"]))
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"])).FromString(data)


@pytest.fixture(scope="session")
def node_home() -> Path:
    if shutil.which("node") is None:
        pytest.skip("node is not installed")
    return install("node_foxglove", "@foxglove/ws-protocol@0.8.0", "ws@8")


@pytest.mark.slow
@pytest.mark.parametrize("subprotocol", SUBPROTOCOLS)
def test_client_of_foxglove_gets_poses(node_home: Path, subprotocol: str) -> None:
    script = str(Path(__file__).with_name("foxglove_client.mjs"))
    with streaming(is_replayed=True) as (stream, _):
        address = stream.describe().split()[-1]
        command = ["node", script, str(node_home), address, subprotocol, "4", "https://app.foxglove.dev"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as client:
            wait_until(lambda: stream.client_count, "a client is connected")
            wait_for_subscription(stream)
            send_all(stream, [tracks(n) for n in range(1, 5)])
            text, _ = client.communicate(timeout=_LIMIT_S)
    rows = [json.loads(line) for line in text.splitlines()]
    (info,) = [row["info"] for row in rows if "info" in row]
    assert (info["sessionId"], info["capabilities"]) == ("7", ["time"])
    (channel,) = [row["channel"] for row in rows if "channel" in row]
    assert (channel["topic"], channel["schemaName"]) == (TOPIC, "ipsys.v1.Tracks")
    messages = [row["message"] for row in rows if "message" in row]
    assert [int(message["time"]) for message in messages] == [START_NS + n * STEP_NS for n in range(1, 5)]
    last = decode(channel, base64.b64decode(messages[-1]["data"]))
    assert [(row.robot, row.x_m) for row in last.tracks] == [("ada", 1.04), ("bob", 3.0)]
    assert [int(row["time"]) for row in rows if "time" in row][-1] == START_NS + 4 * STEP_NS


def test_messages_have_the_form_of_the_sdk() -> None:
    """The server of foxglove-sdk sends the same fields for a channel of the same schema."""
    with streaming() as (stream, _):
        send_all(stream, [tracks(0)])
        with opened(stream) as client:
            ours = [json.loads(client.recv(_LIMIT_S)) for _ in range(2)]
            client.send('{"op":"subscribe","subscriptions":[{"id":9,"channelId":1}]}')
            wait_for_subscription(stream)
            send_all(stream, [tracks(1)])
            data = client.recv(_LIMIT_S)
    theirs = messages_of_sdk(data[13:])
    assert ours[0].keys() <= theirs[0].keys()
    assert ours[1]["channels"][0].keys() <= theirs[1]["channels"][0].keys()
    assert isinstance(data, bytes)
    assert (data[:13], data[13:]) == (struct.pack("<BIQ", 1, 9, START_NS + STEP_NS), theirs[2][13:])
    assert theirs[2][:5] == data[:5]


def messages_of_sdk(payload: Any) -> list[Any]:
    """Return the first messages of a server of foxglove-sdk, and a message with a payload."""
    context = foxglove.Context()
    server = foxglove.start_server(host="127.0.0.1", port=0, context=context)
    try:
        schema = foxglove.Schema(name="ipsys.v1.Tracks", encoding="protobuf", data=b"")
        channel = foxglove.Channel(TOPIC, schema=schema, message_encoding="protobuf", context=context)
        address = f"ws://127.0.0.1:{server.port}"
        with connect(address, subprotocols=[Subprotocol(SUBPROTOCOLS[0])], compression=None) as client:
            rows: list[Any] = [json.loads(client.recv(_LIMIT_S)) for _ in range(2)]
            number = rows[1]["channels"][0]["id"]
            row = {"op": "subscribe", "subscriptions": [{"id": 9, "channelId": number}]}
            client.send(json.dumps(row))
            wait_until(channel.has_sinks, "the client of the SDK has subscribed")
            channel.log(payload, log_time=1)
            return [*rows, client.recv(_LIMIT_S)]
    finally:
        server.stop()


def test_later_client_gets_the_rig_and_images_only_if_asked() -> None:
    rig = Message("/rig", START_NS, START_NS, RIG)
    image = Message("/cameras/red/image", START_NS, START_NS, CompressedImage(START_NS, "red", b"x", "jpeg"))
    with streaming() as (stream, _):
        assert not isinstance(image.payload, stream.payloads)
        send_all(stream, [rig])
        with opened(stream) as client:
            subscribed(client, 2)
            data = client.recv(_LIMIT_S)
            assert (data[:5], isinstance(data, bytes) and b"lab" in data) == (
                struct.pack("<BI", 1, 102),
                True,
            )
    with streaming(with_images=True) as (stream, _):
        assert isinstance(image.payload, stream.payloads)


def test_status_is_shown_while_positions_are_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foxglove_stream, "_STATUS_S", 0.01)
    positions = judged("late")
    with streaming(positions=positions) as (stream, _), opened(stream) as client:
        wait_until(lambda: stream._status, "the server knows the state")
        with opened(stream) as later:
            subscribed(later)
            shown = json.loads(later.recv(_LIMIT_S))
        assert (shown["op"], shown["level"]) == ("status", 1)
        assert shown["message"] == "positions are late: 0.4 s. The cause. The remedy"
        positions.state = PositionState("live", 0.1)
        subscribed(client)
        last = json.loads(client.recv(_LIMIT_S))
        while last["op"] == "status":
            last = json.loads(client.recv(_LIMIT_S))
        assert last == {"op": "removeStatus", "statusIds": [shown["id"]]}


def test_session_of_a_replay_begins_at_its_time() -> None:
    begin = Message("", START_NS - 5, START_NS - 5, NewSession(8))
    with streaming(is_replayed=True) as (stream, _), opened(stream) as client:
        subscribed(client)
        wait_until(lambda: stream.client_count, "a client is connected")
        send_all(stream, [tracks(0), begin])
        times = [client.recv(_LIMIT_S) for _ in range(2)]
    assert times == [struct.pack("<BQ", 2, START_NS), struct.pack("<BQ", 2, START_NS - 5)]


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "foreign page": ({"origin": Origin("https://evil.example")}, "is not Foxglove"),
    "page of a file": ({"origin": Origin("null")}, "is not Foxglove"),
    "page of this machine": ({"origin": Origin("http://localhost:8000")}, "is not Foxglove"),
    "wrong secret": ({"token": "the-secret2"}, "has not the secret"),
    "no secret": ({"token": ""}, "has not the secret"),
    "foreign host": ({"host": "evil.example"}, "names another host"),
    "other version": ({"subprotocols": ["foxglove.websocket.v0"]}, "does not speak foxglove.sdk.v1; use a"),
    "no protocol": ({"subprotocols": None}, "does not speak foxglove.sdk.v1"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_foreign_connection_is_refused(case: str) -> None:
    options, reason = REFUSED[case]
    with streaming() as (stream, events):
        if "host" in options:
            status = raw_status(stream.port, str(options["host"]))
        else:
            with pytest.raises(InvalidStatus) as error:
                opened(stream, **options)
            status = error.value.response.status_code
        assert stream.client_count == 0
    assert status == 403
    ((kind, text),) = events
    assert (kind, reason in text) == ("stream_client", True)


def raw_status(port: int, host: str) -> int:
    lines = [f"GET /?token={SECRET} HTTP/1.1", f"Host: {host}", "Upgrade: websocket", "Connection: Upgrade"]
    lines += [f"Sec-WebSocket-Protocol: {SUBPROTOCOLS[0]}"]
    lines += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version: 13"]
    with socket.create_connection(("127.0.0.1", port), _LIMIT_S) as sock:
        sock.sendall(("\r\n".join([*lines, "", ""])).encode())
        return int(sock.recv(4096).split()[1])


def test_connections_of_foxglove_and_of_programs_are_accepted() -> None:
    with streaming() as (stream, events):
        for origin in (None, Origin("https://app.foxglove.dev"), Origin("file://")):
            with opened(stream, origin=origin) as client:
                assert json.loads(client.recv(_LIMIT_S))["op"] == "serverInfo"
        assert raw_status(stream.port, "localhost:8765") == 101
    assert events == []


def test_client_that_publishes_or_sends_garbage_is_disconnected() -> None:
    with streaming() as (stream, _):
        send_all(stream, [tracks(0)])
        for data in (
            b"\x01",
            "{",
            "[]",
            '{"op":"subscribe"}',
            "[" * 5000,
            '{"op":"subscribe","subscriptions":7}',
        ):
            with opened(stream) as client:
                client.send(data)
                wait_until(partial(ended, client), f"the connection ends after {data!r}")
        with opened(stream) as client:
            subscribed(client, 1)
            client.send('{"op":"setParameters","parameters":[]}')
            client.send('{"op":"advertise","channels":[{"id":1,"topic":"/cmd"}]}')
            wait_for_subscription(stream)
            send_all(stream, [tracks(1)])
            assert isinstance(client.recv(_LIMIT_S), bytes)


def test_silent_connections_leave_descriptors_to_the_recorder() -> None:
    with streaming() as (stream, events), ExitStack() as stack:
        client = stack.enter_context(opened(stream))
        assert json.loads(client.recv(_LIMIT_S))["op"] == "serverInfo"
        silent = [
            stack.enter_context(socket.create_connection(("127.0.0.1", stream.port), timeout=_LIMIT_S))
            for _ in range(foxglove_stream._MOST_WAITING + 5)
        ]
        for connection in silent[:5]:  # the oldest ones
            with suppress(ConnectionResetError):
                assert connection.recv(1) == b""
        # Clients are not disconnected, and another one can connect.
        assert json.loads(client.recv(_LIMIT_S))["op"] == "advertise"
        with opened(stream) as later:
            assert json.loads(later.recv(_LIMIT_S))["op"] == "serverInfo"
    assert events == []


def ended(client: ClientConnection) -> bool:
    try:
        client.recv(0.1)
    except TimeoutError:
        return False
    except Exception:  # any end of the connection
        return True
    return False


@given(st.text(max_size=20))
def test_any_text_of_a_client_is_read_or_refused(text: str) -> None:
    subscriptions = Subscriptions()
    with suppress(ValueError):
        assert subscriptions.read(text) == []


def test_ended_subscription_gets_no_message() -> None:
    subscriptions = Subscriptions()
    assert subscriptions.read('{"op":"subscribe","subscriptions":[{"id":3,"channelId":1}]}') == [1]
    assert subscriptions.number_of(1) == 3
    assert subscriptions.read('{"op":"unsubscribe","subscriptionIds":[3]}') == []
    assert subscriptions.number_of(1) is None


def test_only_this_machine_can_connect_to_foxglove_without_a_host() -> None:
    before = set(exposed(os.getpid()))
    with streaming() as (stream, _):
        assert ("tcp", "127.0.0.1", stream.port) in open_sockets(os.getpid())
        assert set(exposed(os.getpid())) == before
        assert stream.describe() == (
            f"Foxglove: only this machine; open ws://127.0.0.1:{stream.port}/?token={SECRET}"
        )
    with streaming(host="0.0.0.0") as (stream, _):
        assert ("tcp", "0.0.0.0", stream.port) in exposed(os.getpid())
        assert "every computer that reaches 0.0.0.0 and has the secret" in stream.describe()


def test_stalled_client_loses_messages_and_others_do_not() -> None:
    """The stalled client reads nothing; its socket and its queue fill up."""
    long = Message("/events", START_NS, START_NS, Event(START_NS, "camera_lost", "x" * (1 << 19)))
    with ExitStack() as stack:
        stream, events = stack.enter_context(streaming())
        # At its end, a stalled client waits for an answer that it cannot read.
        stalled = stack.enter_context(opened(stream, close_timeout=0.1))
        good = stack.enter_context(opened(stream))
        send_all(stream, [long])  # announces its topic
        stalled.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        for client in (stalled, good):
            client.recv(_LIMIT_S)
            client.recv(_LIMIT_S)
            client.send('{"op":"subscribe","subscriptions":[{"id":1,"channelId":2}]}')
        wait_until(
            lambda: all(one.subscriptions.number_of(2) for one in stream._clients),
            "both clients have subscribed",
        )
        received = 0
        while not events:
            send_all(stream, [long])
            received += isinstance(good.recv(_LIMIT_S), bytes)
            assert received < 100
    assert events[0][0] == "sink_dropped"
    assert "1 message dropped (a client is too slow)" in events[0][1]


def test_slow_client_loses_images_before_other_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    sent: list[str | bytes] = []
    monkeypatch.setattr(foxglove_stream, "broadcast", lambda connections, data: sent.append(data))
    events: list[str] = []
    transport = SimpleNamespace(get_write_buffer_size=lambda: 3 << 20)
    connection: Any = SimpleNamespace(transport=transport)
    client = foxglove_stream.Client(
        connection, DropReport("Foxglove", lambda kind, text: events.append(text))
    )
    client.put(b"image", is_image=True)
    client.put(b"tracks")
    assert sent == [b"tracks"]
    assert events == ["Foxglove: 1 message dropped (a client is too slow)"]


def test_port_in_use_is_named() -> None:
    with streaming() as (stream, _), pytest.raises(IpsysError) as error:
        FoxgloveStream(stream.port, StreamContext(StreamSettings(), (), lambda: 0, lambda *_: None, 1))
    assert f"--foxglove: port {stream.port} is in use, perhaps by another ipsys" in str(error.value)
