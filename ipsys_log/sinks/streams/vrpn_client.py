"""One client of the VRPN server: its greeting, its names and pings, and the output that waits for it."""

from __future__ import annotations

import selectors
import socket
from collections.abc import Mapping

from ipsys_log.sinks.streams.vrpn_messages import (
    DISCONNECT,
    GREETING,
    GREETING_BYTES,
    PING,
    PONG,
    SENDER_DESCRIPTION,
    TYPE_DESCRIPTION,
    TYPES,
    describe,
    is_greeting,
    pack,
    take_message,
)

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
        self._input, self._output = bytearray(), bytearray(GREETING)
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
            if len(self._input) < GREETING_BYTES:
                return None
            if not is_greeting(bytes(self._input[:GREETING_BYTES])):
                return "has another version of VRPN; this server has 07.38"
            del self._input[:GREETING_BYTES]
            self._introduce(robots)
        while (message := take_message(self._input)) is not None:
            if message.type == DISCONNECT:
                return ""
            if message.type in (SENDER_DESCRIPTION, TYPE_DESCRIPTION):
                names = self._senders if message.type == SENDER_DESCRIPTION else self._types
                if len(names) < _MOST_NAMES:
                    names[message.sender] = message.name
            elif self._types.get(message.type) == TYPES[PING]:
                robot = robots.get(self._senders.get(message.sender, b""))
                if robot is not None:
                    self.send(pack(b"", PONG, robot, 0, self.count(1)))
        return None

    def _introduce(self, robots: Mapping[bytes, int]) -> None:
        """Describe the senders and types of this server."""
        self.is_greeted = True
        for name, number in robots.items():
            self.send(describe(name, number, True, self.count(1)), always=True)
        for number, name in enumerate(TYPES):
            self.send(describe(name, number, False, self.count(1)), always=True)
