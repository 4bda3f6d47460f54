"""Messages of the Foxglove WebSocket protocol: what a server tells its clients, and subscriptions of clients.

Reference: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

import base64
import json
import struct
from dataclasses import dataclass
from functools import cache
from typing import Any

from ipsys_log.log.codec import schema_data, schema_name

# The name that the server prefers comes first.
SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")
_MESSAGE, _TIME = 1, 2
_MOST_SUBSCRIPTIONS = 1000
_LARGEST_ID = 2**32


@dataclass(frozen=True, slots=True)
class Advertised:
    """A channel that clients may subscribe to: its number, its topic and the type of its payloads."""

    number: int
    topic: str
    payload: type


def write_server_info(name: str, session: int, has_time: bool) -> str:
    """Return the first message to a client; with ``has_time``, the server also sends the time of a replay."""
    capabilities = ["time"] if has_time else []
    return json.dumps(
        {
            "op": "serverInfo",
            "name": name,
            "capabilities": capabilities,
            "metadata": {},
            "sessionId": str(session),
        }
    )


def write_advertise(channels: list[Advertised]) -> str:
    """Return the message that announces channels, with their schemas."""
    return json.dumps({"op": "advertise", "channels": [_describe(channel) for channel in channels]})


def _describe(channel: Advertised) -> dict[str, Any]:
    name = schema_name(channel.payload)
    return {
        "id": channel.number,
        "topic": channel.topic,
        "encoding": "protobuf",
        "schemaName": name,
        "schema": _schema(name),
        "schemaEncoding": "protobuf",
    }


@cache
def _schema(name: str) -> str:
    return base64.b64encode(schema_data(name)).decode()


def pack_message(subscription: int, time_ns: int, data: bytes) -> bytes:
    """Return a message of a channel, for the subscription of a client."""
    return struct.pack("<BIQ", _MESSAGE, subscription, time_ns) + data


def pack_time(time_ns: int) -> bytes:
    """Return the time of a replay; it may be earlier than the one before."""
    return struct.pack("<BQ", _TIME, time_ns)


def write_status(text: str) -> str:
    """Return the message that shows a warning in place of the one before; an empty text removes it."""
    if not text:
        return json.dumps({"op": "removeStatus", "statusIds": ["positions"]})
    return json.dumps({"op": "status", "level": 1, "message": text, "id": "positions"})


class Subscriptions:
    """The subscriptions of a client: the number that it gave to each channel."""

    def __init__(self) -> None:
        self._numbers: dict[int, int] = {}

    def number_of(self, channel: int) -> int | None:
        """Return the number of the subscription to a channel; None if there is none."""
        return self._numbers.get(channel)

    def read(self, text: str) -> list[int]:
        """Read a message of the client; return the channels with new subscriptions.

        Messages other than those about subscriptions change nothing: no client can publish or control.

        Raises
        ------
        ValueError
            The message has another form, or there are too many subscriptions.
        """
        try:
            message = json.loads(text)
            if message["op"] == "unsubscribe":
                ended = set(message["subscriptionIds"])
                kept = {channel: number for channel, number in self._numbers.items() if number not in ended}
                self._numbers = kept
            if message["op"] != "subscribe":
                return []
            rows = [(int(row["channelId"]), int(row["id"])) for row in message["subscriptions"]]
        except (LookupError, TypeError, RecursionError, OverflowError) as error:
            raise ValueError("a message has another form") from error
        if len(self._numbers) + len(rows) > _MOST_SUBSCRIPTIONS:
            raise ValueError(f"there are more than {_MOST_SUBSCRIPTIONS} subscriptions")
        if not all(0 <= number < _LARGEST_ID for row in rows for number in row):
            raise ValueError("a number is not in the range of the protocol")
        self._numbers.update(rows)
        return [channel for channel, _ in rows]
