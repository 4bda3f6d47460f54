"""A client of the Foxglove stream: its subscriptions, and the messages that wait for it."""

from __future__ import annotations

import asyncio
from collections import deque
from contextlib import suppress

from websockets.asyncio.server import ServerConnection
from websockets.exceptions import ConnectionClosed

from ipsys_log.sinks.sink import DropReport
from ipsys_log.sinks.streams.foxglove_messages import Subscriptions, pack_message

__all__ = ["Client"]

_MOST_WAITING, _MOST_IMAGES = 500, 6
_MOST_BYTES = 16 << 20


class Client:
    """A client, used in the thread of the server only. A slow client loses messages, images first.

    Parameters
    ----------
    drops : counts the messages that clients lose.
    """

    def __init__(self, connection: ServerConnection, drops: DropReport) -> None:
        self.subscriptions = Subscriptions()
        self._connection, self._drops = connection, drops
        self._waiting: deque[tuple[str | bytes, bool]] = deque()
        self._images = self._bytes = 0
        self._changed = asyncio.Event()

    def put_message(self, channel: int, time_ns: int, data: bytes, is_image: bool) -> None:
        """Send a message of a channel if the client has subscribed to it."""
        number = self.subscriptions.number_of(channel)
        if number is not None:
            self.put(pack_message(number, time_ns, data), is_image)

    def put(self, data: str | bytes, is_image: bool = False) -> None:
        """Enqueue data, or drop it if too much waits; this never blocks."""
        is_full = len(self._waiting) >= _MOST_WAITING or self._bytes > _MOST_BYTES
        if is_full or (is_image and self._images >= _MOST_IMAGES):
            self._drops.add("a client is too slow")
            return
        self._waiting.append((data, is_image))
        self._images += is_image
        self._bytes += len(data)
        self._changed.set()

    async def send(self) -> None:
        """Send what waits, until the connection ends."""
        with suppress(ConnectionClosed, OSError):
            while True:
                await self._changed.wait()
                self._changed.clear()
                while self._waiting:
                    data, is_image = self._waiting.popleft()
                    self._images -= is_image
                    self._bytes -= len(data)
                    await self._connection.send(data)
