"""VRPN server and its clients: a tracker per robot, as a motion-capture system has. It sends only."""

import errno
import selectors
import socket
import threading
from collections.abc import Iterator, Mapping
from contextlib import suppress

from ipsys_log.capture.frames import Clock
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Message, Tracks
from ipsys_log.sinks.sink import DropReport
from ipsys_log.sinks.streams import vrpn_messages
from ipsys_log.sinks.streams.addresses import LOOPBACK, is_loopback, refuse_bind
from ipsys_log.sinks.streams.poses import NewSession, StreamContext, StreamPose
from ipsys_log.units import NS_PER_S

_MOST_CLIENTS, _MOST_CALLBACKS = 32, 4
_MOST_ROBOTS = 256
_LONGEST_NAME = 99  # bytes; the limit of the protocol
_LOWEST_PORT = 1024
_GREETING_NS = 5 * NS_PER_S
_TURN_S = 0.25
_BACKLOG = 16
_MOST_REFUSALS = 10  # events; others could fill the log


class VrpnStream:
    """A :class:`~ipsys_log.sinks.sink.InlineSink` that is a VRPN server, on TCP and UDP.

    A client connects by TCP. Or it asks by UDP for a connection to one of its ports; the server connects only
    to the address that sent this datagram. Positions are sent by TCP. Stale positions and positions outside
    the calibrated volume are withheld, because the protocol cannot mark them.

    Parameters
    ----------
    port : the port; 0 means any free port.
    context : the inputs of all streams; its robots are announced before they are seen.

    Raises
    ------
    IpsysError
        The port is in use or not allowed, or the host is not this machine.
    """

    payloads: tuple[type, ...] = (Tracks, NewSession)

    def __init__(self, port: int, context: StreamContext) -> None:
        self._host, self._poses = context.settings.host or LOOPBACK, context.poses()
        self._warn = context.warn
        self._listening, self._asking = _listen(self._host, port)
        self.port: int = self._listening.getsockname()[1]
        self.name = f"VRPN port {self.port}"
        self.drops, self._refusals = DropReport(self.name, context.warn), 0
        self._clock = Clock()
        # The lock guards the clients and the robots; no call within it waits.
        self._lock = threading.Lock()
        self._clients: list[Client] = []
        self._robots: dict[bytes, int] = {}
        for robot in context.streamed_heights_m:
            self._sender(robot)
        self._wake, self._woken = socket.socketpair()
        self._wake.setblocking(False)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._serve, name=self.name, daemon=True)
        self._thread.start()

    def describe(self) -> str:
        """Return one line about the receivers of the positions."""
        if is_loopback(self._host):
            return f"{self.name}: only this machine"
        return f"{self.name}: every computer that reaches {self._host} can read the positions"

    @property
    def client_count(self) -> int:
        """The number of clients that receive positions."""
        return sum(client.is_greeted for client in self._clients)

    def send(self, message: Message) -> None:
        """Send the poses of a message."""
        for pose in self._poses.read(message):
            self._send(pose)

    def close(self) -> None:
        """Disconnect the clients and close the sockets."""
        self.drops.finish()
        self._ended.set()
        self._wake_thread()
        self._thread.join()
        for sock in (self._listening, self._asking, self._wake, self._woken):
            sock.close()

    def _send(self, pose: StreamPose) -> None:
        if not pose.is_sendable or not 0 <= pose.time_ns < 2**32 * NS_PER_S:
            return
        with self._lock:
            sender = self._sender(pose.track.robot)
            if sender is None:
                return
            for client in self._clients:
                if client.is_greeted and not client.send(
                    vrpn_messages.pack_pose(pose, sender, client.count(2))
                ):
                    self.drops.add(f"client {client.name} is too slow")
            waiting = any(client.has_output for client in self._clients)
        if waiting:
            self._wake_thread()

    def _sender(self, robot: str) -> int | None:
        """Return the number of a robot, and announce a new one; None if it cannot be announced."""
        name = robot.encode()
        if name not in self._robots:
            if len(self._robots) >= _MOST_ROBOTS or not 0 < len(name) <= _LONGEST_NAME:
                return None
            number = self._robots[name] = len(self._robots)
            for client in self._clients:
                if client.is_greeted:
                    client.send(vrpn_messages.describe(name, number, True, client.count(1)), always=True)
        return self._robots[name]

    def _wake_thread(self) -> None:
        with suppress(OSError):  # a full buffer wakes it, too
            self._wake.send(b"\0")

    def _serve(self) -> None:
        """Accept clients, read their greetings and pings, and send the output that waits."""
        while not self._ended.is_set():
            with selectors.DefaultSelector() as selector:
                for sock in (self._listening, self._asking, self._woken):
                    selector.register(sock, selectors.EVENT_READ)
                for client in self._clients:
                    selector.register(client.socket, client.events, client)
                ready = selector.select(_TURN_S)
            for key, events in ready:
                if key.fileobj is self._listening:
                    self._accept()
                elif key.fileobj is self._asking:
                    self._call_back()
                elif key.fileobj is self._woken:
                    self._woken.recv(4096)
                else:
                    self._handle(key.data, events)
            self._close_silent()
        for client in self._clients:
            client.close()

    def _handle(self, client: "Client", events: int) -> None:
        with self._lock:
            fault = client.handle(events, self._robots)
        if fault is not None:
            self._remove(client, fault)

    def _accept(self) -> None:
        with suppress(OSError):
            sock, address = self._listening.accept()
            self._add(sock, f"{address[0]}:{address[1]}", is_connected=True)

    def _call_back(self) -> None:
        """Connect to a client that asks for it: to the source of its datagram, whatever the text names."""
        try:
            text, (address, _) = self._asking.recvfrom(256)
            port = int(text.rstrip(b"\0").split()[1])
        except (OSError, LookupError, ValueError):
            return
        name = f"{address}:{port}"
        pending = [client for client in self._clients if not client.is_greeted]
        if not _LOWEST_PORT <= port < 2**16 or len(pending) >= _MOST_CALLBACKS:
            return
        if any(client.name == name for client in self._clients):
            return
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.setblocking(False)
        try:
            sock.bind((self._host, 0))
            is_waiting = sock.connect_ex((address, port)) in (0, errno.EINPROGRESS)
        except OSError:
            is_waiting = False
        if is_waiting:
            self._add(sock, name, is_connected=False)
        else:
            sock.close()

    def _add(self, sock: socket.socket, name: str, is_connected: bool) -> None:
        if len(self._clients) >= _MOST_CLIENTS:
            sock.close()
            self._refuse(f"client {name} is refused: there are {_MOST_CLIENTS} clients already")
            return
        client = Client(sock, name, is_connected, self._clock.now_ns() + _GREETING_NS)
        with self._lock:
            self._clients = [*self._clients, client]

    def _remove(self, client: "Client", reason: str) -> None:
        with self._lock:
            self._clients = [other for other in self._clients if other is not client]
        client.close()
        if reason:
            self._refuse(f"client {client.name} {reason}")

    def _close_silent(self) -> None:
        now_ns = self._clock.now_ns()
        for client in self._clients:
            if not client.is_greeted and now_ns > client.greeting_until_ns:
                self._remove(client, "")

    def _refuse(self, text: str) -> None:
        self._refusals += 1
        if self._refusals <= _MOST_REFUSALS:
            self._warn("stream_client", f"{self.name}: {text}")


def _listen(host: str, port: int) -> tuple[socket.socket, socket.socket]:
    """Return a listening socket of TCP, and one of UDP with the same port."""
    if not 0 <= port < 2**16:
        raise IpsysError(f"--vrpn-port {port}: is not a port; give one from {_LOWEST_PORT} to 65535")
    listening = asking = None
    try:
        listening = socket.create_server((host, port), family=socket.AF_INET, backlog=_BACKLOG)
        asking = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        asking.bind((host, listening.getsockname()[1]))
    except OSError as error:
        for sock in (listening, asking):
            if sock is not None:
                sock.close()
        raise refuse_bind(error, host, port, "--vrpn") from error
    listening.setblocking(False)
    asking.setblocking(False)
    return listening, asking


def open_all(context: StreamContext) -> Iterator[VrpnStream]:
    """Yield the server, if there is one."""
    if context.settings.vrpn is not None:
        yield VrpnStream(context.settings.vrpn, context)


# About 200 poses with velocities: a client that is so far behind loses further ones.
_MOST_OUTPUT_BYTES = 40_000
# A larger buffer of the system would fill with old poses while a client is stalled.
_SYSTEM_BYTES = 32_768
_READ_BYTES = 16_384
_MOST_NAMES = 1024


class Client:
    """The connection to a client. No method waits.

    Attributes
    ----------
    name : address and port.
    greeting_until_ns : the time until which the client must send its greeting.
    is_greeted : the greetings are exchanged: the client gets positions.
    """

    def __init__(self, sock: socket.socket, name: str, is_connected: bool, greeting_until_ns: int) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SYSTEM_BYTES)
        self.socket, self.name, self.greeting_until_ns = sock, name, greeting_until_ns
        self.is_greeted = False
        self._is_connected = is_connected
        self._input, self._output = bytearray(), bytearray(vrpn_messages.GREETING)
        self._count = 0
        # Names that the client gave to its own numbers.
        self._senders: dict[int, bytes] = {}
        self._types: dict[int, bytes] = {}

    @property
    def has_output(self) -> bool:
        """True while output waits."""
        return bool(self._output)

    @property
    def events(self) -> int:
        """The events of the socket that the client waits for."""
        writes = selectors.EVENT_WRITE if self._output or not self._is_connected else 0
        return selectors.EVENT_READ | writes

    def count(self, messages: int) -> int:
        """Count messages that are sent next; return the number of the first."""
        first = self._count
        self._count = (first + messages) % 2**31
        return first

    def send(self, data: bytes, always: bool = False) -> bool:
        """Send messages, as far as the connection takes them now; return False if they are dropped.

        With ``always``, they are not dropped for a slow client: names of robots, of which there are few.
        """
        if len(self._output) > _MOST_OUTPUT_BYTES and not always:
            return False
        self._output += data
        return self._flush()

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()

    def handle(self, events: int, robots: Mapping[bytes, int]) -> str | None:
        """Handle events of the socket; return the reason of an end of the connection, "" if it is normal."""
        if not self._is_connected:
            if self.socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                return ""
            self._is_connected = True
        if events & selectors.EVENT_WRITE and not self._flush():
            return ""
        return self._receive(robots) if events & selectors.EVENT_READ else None

    def _receive(self, robots: Mapping[bytes, int]) -> str | None:
        try:
            data = self.socket.recv(_READ_BYTES)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            return ""
        self._input += data
        try:
            return self._read(robots)
        except ValueError:
            return "sends something else than VRPN; it is disconnected"

    def _flush(self) -> bool:
        """Send output that waits; return False if the connection is broken."""
        if not self._is_connected:
            return True
        try:
            while self._output:
                del self._output[: self.socket.send(self._output)]
        except BlockingIOError:
            pass
        except OSError:
            return False
        return True

    def _read(self, robots: Mapping[bytes, int]) -> str | None:
        """Read the messages that have arrived; return the reason of an end."""
        if not self.is_greeted:
            if len(self._input) < vrpn_messages.GREETING_BYTES:
                return None
            if not vrpn_messages.is_greeting(bytes(self._input[: vrpn_messages.GREETING_BYTES])):
                return "has another version of VRPN; this server has 07.38"
            del self._input[: vrpn_messages.GREETING_BYTES]
            self._introduce(robots)
        while (message := vrpn_messages.take_message(self._input)) is not None:
            if message.type == vrpn_messages.DISCONNECT:
                return ""
            if message.type in (vrpn_messages.SENDER_DESCRIPTION, vrpn_messages.TYPE_DESCRIPTION):
                names = self._senders if message.type == vrpn_messages.SENDER_DESCRIPTION else self._types
                if len(names) < _MOST_NAMES:
                    names[message.sender] = message.name
            elif self._types.get(message.type) == vrpn_messages.TYPES[vrpn_messages.PING]:
                robot = robots.get(self._senders.get(message.sender, b""))
                if robot is not None:
                    self.send(vrpn_messages.pack(b"", vrpn_messages.PONG, robot, 0, self.count(1)))
        return None

    def _introduce(self, robots: Mapping[bytes, int]) -> None:
        """Describe the senders and types of this server."""
        self.is_greeted = True
        for name, number in robots.items():
            self.send(vrpn_messages.describe(name, number, True, self.count(1)), always=True)
        for number, name in enumerate(vrpn_messages.TYPES):
            self.send(vrpn_messages.describe(name, number, False, self.count(1)), always=True)
