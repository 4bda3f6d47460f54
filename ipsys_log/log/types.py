"""What a log is made of, as the rest of the program sees it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

__all__ = ["Channel", "RawMessage", "Schema"]


@dataclass(frozen=True, slots=True)
class Schema:
    """The type of a channel's messages.

    Parameters
    ----------
    name
        Full name of the message type, for example ``foxglove.CompressedImage``.
    encoding
        How ``data`` is written, for example ``protobuf`` (a ``FileDescriptorSet``).
    data
        The definition itself.
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """One topic of a log.

    ``schema`` is None for a channel that has none. ``message_count`` counts the whole log.
    """

    topic: str
    schema: Schema | None
    message_encoding: str
    metadata: Mapping[str, str]
    message_count: int


class RawMessage(NamedTuple):
    """One message, payload not decoded. Times are in ns.

    A tuple, because a frozen dataclass takes four times as long to make, and there are many of them.
    """

    topic: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes
