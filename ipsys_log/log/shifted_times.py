"""Shift of all times within a message, without a loss: the opposite shift gives the same bytes again."""

from __future__ import annotations

from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2
from google.protobuf.message import DecodeError

from ipsys_log.errors import LogError
from ipsys_log.log.codec import PAYLOADS, payload_type, proto_class
from ipsys_log.log.contents import StoredChannel
from ipsys_log.log.protobuf_fields import NS

_TIMESTAMP = "google.protobuf.Timestamp"


def has_times(channel: StoredChannel) -> bool:
    """Return whether this version knows the times within the messages of a channel."""
    return channel.schema is not None and payload_type(channel.schema.name) is not None


def check_shift(channel: StoredChannel) -> None:
    """Refuse a channel with times that cannot be shifted.

    Raises
    ------
    LogError
        The channel has known messages in another encoding than protobuf.
    """
    if has_times(channel) and channel.message_encoding != "protobuf":
        raise LogError(
            f"the times in the messages of {channel.topic} cannot be shifted, because their encoding is "
            f"{channel.message_encoding}; merge it as the first log"
        )


def shift_time(time_ns: int, offset_ns: int) -> int:
    """Return a shifted time in ns; 0 means that a time is missing, and stays 0.

    Raises
    ------
    LogError
        The shifted time is before 1970 or after 2554, or is 0.
    """
    if time_ns == 0:
        return 0
    shifted_ns = time_ns + offset_ns
    if not 0 < shifted_ns < 1 << 64:
        raise LogError(f"a time of {time_ns} ns cannot be shifted by {offset_ns} ns; give another offset")
    return shifted_ns


def shift_times(name: str, data: bytes, offset_ns: int) -> bytes:
    """Return a message with all its times shifted; a message of an unknown schema stays the same.

    Parameters
    ----------
    name : the name of its schema.
    data : the message, encoded with protobuf.

    Raises
    ------
    LogError
        The message is not valid, or a time cannot be shifted.

    Examples
    --------
    >>> from ipsys_log.log.codec import decode, encode
    >>> from ipsys_log.messages import Event
    >>> shifted = shift_times("ipsys.v1.Event", encode(Event(1_000, "gap", "")), 500)
    >>> decode("ipsys.v1.Event", shifted).timestamp
    1500
    """
    if offset_ns == 0 or name not in PAYLOADS:
        return data
    try:
        proto = proto_class(name).FromString(data)
    except DecodeError as error:
        raise LogError(f"a message is not a valid {name}: {error}") from None
    _shift(proto, proto.DESCRIPTOR, offset_ns)
    return proto.SerializeToString(deterministic=True)


def _shift(proto: Any, kind: Any, offset_ns: int) -> None:
    for name, is_repeated, child in _fields_with_times(kind):
        if not is_repeated and not proto.HasField(name):
            continue
        for part in getattr(proto, name) if is_repeated else (getattr(proto, name),):
            if child.full_name != _TIMESTAMP:
                _shift(part, child, offset_ns)
            elif part.seconds or part.nanos:
                time_ns = shift_time(part.seconds * NS + part.nanos, offset_ns)
                part.seconds, part.nanos = divmod(time_ns, NS)


@cache
def _fields_with_times(kind: Any) -> tuple[tuple[str, bool, Any], ...]:
    """Return the fields of a message type that are times, or have times inside: name, repeated, and type."""
    definition = descriptor_pb2.DescriptorProto()
    kind.CopyToProto(definition)
    repeated = {field.name for field in definition.field if field.label == field.LABEL_REPEATED}
    return tuple(
        (field.name, field.name in repeated, field.message_type)
        for field in kind.fields
        if field.message_type is not None
        and not field.message_type.GetOptions().map_entry
        and (field.message_type.full_name == _TIMESTAMP or _fields_with_times(field.message_type))
    )
