"""A client of the Foxglove stream: its subscriptions, and the messages that wait for it."""

from __future__ import annotations

from websockets.asyncio.server import ServerConnection, broadcast

from ipsys_log.sinks.sink import DropReport
from ipsys_log.sinks.streams.foxglove_messages import Subscriptions, pack_message

# Above the first limit of bytes that wait, images are dropped; above the second, all messages.
_MOST_WITH_IMAGES, _MOST_WAITING = 2 << 20, 4 << 20


class Client:
    """A client, used in the thread of the server only. A slow client loses messages, images first.

    Parameters
    ----------
    drops : counts the messages that clients lose.
    """

    def __init__(self, connection: ServerConnection, drops: DropReport) -> None:
        self.subscriptions = Subscriptions()
        self._connection, self._drops = connection, drops

    def put_message(self, channel: int, time_ns: int, data: bytes, is_image: bool) -> None:
        """Send a message of a channel if the client has subscribed to it."""
        number = self.subscriptions.number_of(channel)
        if number is not None:
            self.put(pack_message(number, time_ns, data), is_image)

    def put(self, data: str | bytes, is_image: bool = False) -> None:
        """Send data, or drop it if too much waits; this never blocks."""
        waiting = self._connection.transport.get_write_buffer_size()
        if waiting > (_MOST_WITH_IMAGES if is_image else _MOST_WAITING):
            self._drops.add("a client is too slow")
            return
        # A coroutine would send in the next turn of the loop, which has to wait for the GIL again.
        broadcast([self._connection], data)
