"""Foxglove stream: a WebSocket server that shows the messages of a recording or a replay in Foxglove.

The server of ``foxglove-sdk`` accepts every Origin and Host. In front of it, a check could not prevent that a
page in a browser reaches its port. So this server speaks the protocol itself and checks each connection.
"""

import asyncio
import hmac
import http
import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import parse_qs, urlsplit

from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.typing import Subprotocol

from ipsys_log.log.codec import PAYLOADS, encode
from ipsys_log.messages import CameraCalibration, Message, Rig, SkippedVideo, Tracks
from ipsys_log.messages.channels import IMAGES
from ipsys_log.sinks.sink import DropReport
from ipsys_log.sinks.streams import foxglove_messages
from ipsys_log.sinks.streams.addresses import LOOPBACK, is_loopback, is_own_host, listen
from ipsys_log.sinks.streams.poses import NewSession, StreamContext

_BACKLOG = 16
_MOST_CLIENTS = 32
# Connections without a complete request: a recorder needs the other file descriptors. The oldest one has its
# transport, because the loop accepts at most _BACKLOG connections in a turn.
_MOST_WAITING = 64
_LARGEST_MESSAGE = 1 << 16  # bytes, of a client
_MOST_REFUSALS = 10  # events; others could fill the log
_MOST_CHANNELS = 1000
_STATUS_S = 1.0
# The app in a browser, and the desktop app; a page of a file has the origin "null" in a browser.
_ORIGINS = frozenset({"https://app.foxglove.dev", "https://app.foxglove.com", "file://"})
# A later subscriber gets the last message of these types.
_LATCHED = (Rig, CameraCalibration)
# The server prints nothing, because the recorder uses the terminal.
_LOGGER = logging.Logger("foxglove")
_LOGGER.addHandler(logging.NullHandler())
# Above the first limit of bytes that wait, images are dropped; above the second, all messages.
_MOST_WITH_IMAGES_BYTES, _MOST_WAITING_BYTES = 2 << 20, 4 << 20


class FoxgloveStream:
    """A :class:`~ipsys_log.sinks.sink.InlineSink` that sends messages to Foxglove. It carries out no command.

    A connection needs the secret in its address, a Host of this machine, and the Origin of Foxglove or none.

    Parameters
    ----------
    port : the port; 0 means any free port.
    context : the inputs of all streams. Its topics are announced before the first message. Clients get the
        times of a recording as the time of the server, and a status if live positions are late or stale.

    Raises
    ------
    IpsysError
        The port is in use or not allowed, or the host is not this machine.
    """

    def __init__(self, port: int, context: StreamContext) -> None:
        settings, with_images, warn = context.settings, context.settings.images, context.warn
        self._positions, self._status = context.positions, ""
        images = (*IMAGES.payloads, SkippedVideo)
        shown = {payload for payload in PAYLOADS.values() if with_images or payload not in images}
        self.payloads: tuple[type, ...] = (*shown, NewSession, *(images if with_images else ()))
        self._host, self._secret = settings.host or LOOPBACK, settings.secret
        self._session, self._warn = context.session, warn
        self._is_replayed, self._time_ns = context.is_replayed, -1
        self._listening = listen(self._host, port, "--foxglove", _BACKLOG)
        self.port: int = self._listening.getsockname()[1]
        self.name = f"Foxglove port {self.port}"
        self.drops, self._refusals = DropReport(self.name, warn), 0
        self._channels: dict[str, foxglove_messages.Advertised] = {}
        self._latched: dict[str, tuple[int, bytes]] = {}
        # Replaced as a whole: other threads iterate over it.
        self._clients: frozenset[Client] = frozenset()
        self._waiting: list[ServerConnection] = []  # the oldest first
        for topic in context.topics:
            self._advertise(topic, Tracks)
        self._loop = asyncio.new_event_loop()
        self._ended = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()

    def describe(self) -> str:
        """Return one line about the receivers of the messages, with the address to open in Foxglove."""
        is_own = is_loopback(self._host)
        who = (
            "only this machine" if is_own else f"every computer that reaches {self._host} and has the secret"
        )
        name = f"[{self._host}]" if ":" in self._host else self._host
        return f"Foxglove: {who}; open ws://{name}:{self.port}/?token={self._secret}"

    @property
    def client_count(self) -> int:
        """The number of clients."""
        return len(self._clients)

    def send(self, message: Message) -> None:
        """Send a message to the clients that have subscribed to its topic."""
        payload, time_ns = message.payload, message.publish_time_ns
        channel = self._channels.get(message.topic)
        if isinstance(payload, NewSession):
            self._call(self._begin, payload.number, time_ns)
        elif channel is None or isinstance(payload, _LATCHED) or self._is_wanted(channel):
            self._call(self._send, message.topic, type(payload), time_ns, encode(payload))
        elif self._is_replayed:
            self._call(self._send_time, time_ns)

    def _is_wanted(self, channel: foxglove_messages.Advertised) -> bool:
        """Return whether a client has subscribed to a channel; any thread may call this."""
        return any(client.subscriptions.number_of(channel.number) is not None for client in self._clients)

    def close(self) -> None:
        """Disconnect the clients and close the socket."""
        self.drops.finish()
        self._call(self._ended.set)
        self._thread.join()
        self._listening.close()

    def _call(self, function: Callable[..., object], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(function, *arguments)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            runner.run(self._serve())

    async def _serve(self) -> None:
        self._listening.setblocking(False)
        async with serve(
            self._handle,
            sock=self._listening,
            backlog=_BACKLOG,
            process_request=self._check,
            create_connection=self._connect,  # type: ignore[arg-type]  # only called, never subclassed
            subprotocols=[Subprotocol(name) for name in foxglove_messages.SUBPROTOCOLS],
            max_size=_LARGEST_MESSAGE,
            compression=None,
            server_header=None,
            close_timeout=1,
            logger=_LOGGER,
        ) as server:
            while not self._ended.is_set():
                self._send_status()
                with suppress(TimeoutError):
                    await asyncio.wait_for(self._ended.wait(), _STATUS_S)
            # A stalled client would delay the end.
            for connection in server.connections:
                connection.transport.abort()

    def _connect(self, *arguments: Any, **options: Any) -> ServerConnection:
        """Return a new connection, and close the oldest one of too many that have sent no request."""
        connection = ServerConnection(*arguments, **options)
        self._waiting = [other for other in self._waiting if not _is_closed(other)]
        if len(self._waiting) >= _MOST_WAITING:
            self._waiting.pop(0).transport.abort()
        self._waiting.append(connection)
        return connection

    def _check(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse a connection before the handshake, unless it comes from a client with the secret."""
        address = connection.remote_address
        name = f"{address[0]}:{address[1]}"
        headers = request.headers
        if not any(is_own_host(host, ("localhost",)) for host in headers.get_all("Host")):
            return self._refuse(connection, name, "names another host")
        origins = headers.get_all("Origin")
        if any(origin not in _ORIGINS for origin in origins):
            return self._refuse(connection, name, "comes from a page that is not Foxglove")
        token = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        if not hmac.compare_digest(token.encode(), self._secret.encode()):
            return self._refuse(
                connection, name, "has not the secret; use the full address that ipsys printed"
            )
        offered = ",".join(headers.get_all("Sec-WebSocket-Protocol")).replace(" ", "").split(",")
        if not set(foxglove_messages.SUBPROTOCOLS) & set(offered):
            return self._refuse(
                connection,
                name,
                f"does not speak {foxglove_messages.SUBPROTOCOLS[0]}; use a newer version of Foxglove",
            )
        if len(self._clients) >= _MOST_CLIENTS:
            return self._refuse(connection, name, f"is too much: there are {_MOST_CLIENTS} clients already")
        return None

    def _refuse(self, connection: ServerConnection, client: str, reason: str) -> Response:
        self._refusals += 1
        if self._refusals <= _MOST_REFUSALS:
            self._warn("stream_client", f"{self.name}: client {client} is refused: it {reason}")
        return connection.respond(http.HTTPStatus.FORBIDDEN, f"refused: the connection {reason}\n")

    async def _handle(self, connection: ServerConnection) -> None:
        self._waiting = [other for other in self._waiting if other is not connection]
        client = Client(connection, self.drops)
        client.put(foxglove_messages.write_server_info("ipsys", self._session, self._is_replayed))
        client.put(foxglove_messages.write_advertise(list(self._channels.values())))
        if self._status:
            client.put(foxglove_messages.write_status(self._status))
        self._clients |= {client}
        try:
            async for text in connection:
                self._subscribe(client, text)
        except (ConnectionClosed, ValueError, OSError):
            pass  # a client that vanishes, or sends something else
        finally:
            self._clients -= {client}

    def _subscribe(self, client: "Client", text: str | bytes) -> None:
        """Read a message of a client; a new subscriber gets the last message of latched types."""
        if isinstance(text, bytes):
            raise ValueError("a client cannot publish")
        topics = {channel.number: channel.topic for channel in self._channels.values()}
        for number in client.subscriptions.read(text):
            if number in topics and topics[number] in self._latched:
                client.put_message(number, *self._latched[topics[number]], is_image=False)

    def _send(self, topic: str, payload: type, time_ns: int, data: bytes) -> None:
        channel = self._channels.get(topic) or self._advertise(topic, payload)
        if channel is None:
            return
        self._send_time(time_ns)
        if payload in _LATCHED:
            self._latched[topic] = time_ns, data
        for client in self._clients:
            client.put_message(channel.number, time_ns, data, payload in IMAGES.payloads)

    def _advertise(self, topic: str, payload: type) -> foxglove_messages.Advertised | None:
        if len(self._channels) >= _MOST_CHANNELS:
            return None
        channel = self._channels[topic] = foxglove_messages.Advertised(
            len(self._channels) + 1, topic, payload
        )
        for client in self._clients:
            client.put(foxglove_messages.write_advertise([channel]))
        return channel

    def _begin(self, session: int, time_ns: int) -> None:
        """Begin a session: a time that goes back makes Foxglove forget earlier messages."""
        self._session = session
        self._send_time(time_ns)

    def _send_status(self) -> None:
        """Send the state of the positions if it has changed and is a fault, or was one."""
        state = None if self._positions is None else self._positions.state
        text = (
            "" if state is None or (state.state == "live" and not state.remedy) else f"positions are {state}"
        )
        if text != self._status:
            self._status = text
            for client in self._clients:
                client.put(foxglove_messages.write_status(text))

    def _send_time(self, time_ns: int) -> None:
        if self._is_replayed and time_ns != self._time_ns:
            self._time_ns = time_ns
            for client in self._clients:
                client.put(foxglove_messages.pack_time(time_ns))


class Client:
    """A client, used in the thread of the server only. A slow client loses messages, images first.

    ``drops`` counts the messages that clients lose.
    """

    def __init__(self, connection: ServerConnection, drops: DropReport) -> None:
        self.subscriptions = foxglove_messages.Subscriptions()
        self._connection, self.drops = connection, drops

    def put_message(self, channel: int, time_ns: int, data: bytes, is_image: bool) -> None:
        """Send a message of a channel if the client has subscribed to it."""
        number = self.subscriptions.number_of(channel)
        if number is not None:
            self.put(foxglove_messages.pack_message(number, time_ns, data), is_image)

    def put(self, data: str | bytes, is_image: bool = False) -> None:
        """Send data, or drop it if too much waits; this never blocks."""
        waiting = self._connection.transport.get_write_buffer_size()
        if waiting > (_MOST_WITH_IMAGES_BYTES if is_image else _MOST_WAITING_BYTES):
            self.drops.add("a client is too slow")
            return
        # A coroutine would send in the next turn of the loop, which has to wait for the GIL again.
        broadcast([self._connection], data)


def _is_closed(connection: ServerConnection) -> bool:
    # A connection gets its transport in the next turn of the loop.
    return hasattr(connection, "transport") and connection.transport.is_closing()


def open_all(context: StreamContext) -> Iterator[FoxgloveStream]:
    """Yield the server, if there is one."""
    if context.settings.foxglove is not None:
        yield FoxgloveStream(context.settings.foxglove, context)
