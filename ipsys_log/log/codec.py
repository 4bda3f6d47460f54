"""Conversion of payloads to bytes and back, field by field, from the type hints and the schemas.

Every payload of :mod:`ipsys_log.messages` mirrors one protobuf schema. The schema comes from the
descriptor set of this package, or is a well-known schema of Foxglove. The mapping is derived once per
type from the type hints, so no field is defined twice. Numbers are stored without rounding (doubles).
So a payload that is read back equals the written payload, bit for bit.
"""

import json
import types
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.resources import files
from math import prod
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto
from google.protobuf.timestamp_pb2 import Timestamp

from ipsys_log import messages
from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import PartCounter
from ipsys_log.log.ros2 import ROS2_PAYLOADS, read_ros2
from ipsys_log.messages.channels import CHANNELS

NS = 1_000_000_000
_LATEST_NS = 1 << 63

Fill = Callable[[Any, Any], None]
Read = Callable[[Any, PartCounter], Any]


def fill_proto(payload_type: type, proto: Any, payload: Any) -> None:
    """Write the fields of a payload into a protobuf message of its schema."""
    for name, fill, _ in fields_of(payload_type):
        value = getattr(payload, name)
        if value is not None:
            fill(proto, value)


def read_proto(payload_type: type, proto: Any, items: PartCounter) -> Any:
    """Decode the payload in a protobuf message; its parts are counted in `items`."""
    return payload_type(*(read(proto, items) for _, _, read in fields_of(payload_type)))


@cache
def fields_of(payload_type: type) -> tuple[tuple[str, Fill, Read], ...]:
    """Return for each field of a payload: its name, its fill function and its read function."""
    hints = get_type_hints(payload_type, include_extras=True)
    return tuple((f.name, *_converters(f.name, hints[f.name])) for f in fields(payload_type))


def _converters(name: str, hint: Any) -> tuple[Fill, Read]:
    """Return the functions that write a field into a protobuf message and read it back."""
    if get_origin(hint) in (Union, types.UnionType):
        inner = next(h for h in get_args(hint) if h is not type(None))
        fill, read = _converters(name, inner)
        if get_origin(inner) is Annotated and isinstance(inner.__metadata__[0], tuple):
            return fill, lambda proto, items: read(proto, items) if getattr(proto, name) else None
        return fill, lambda proto, items: read(proto, items) if proto.HasField(name) else None
    if get_origin(hint) is Annotated:
        mark = hint.__metadata__[0]
        return _array(name, mark) if isinstance(mark, tuple) else _time(name)
    if get_origin(hint) is tuple:
        return _repeated(name, get_args(hint)[0])
    if get_origin(hint) is dict:
        return _map(name)
    return _nested(name, hint) if is_dataclass(hint) else _scalar(name)


def _map(name: str) -> tuple[Fill, Read]:
    def read(proto: Any, items: PartCounter) -> dict[Any, Any]:
        pairs = getattr(proto, name)
        items.take(len(pairs))
        return dict(sorted(pairs.items()))

    return lambda proto, value: getattr(proto, name).update(value), read


def _nested(name: str, payload_type: Any) -> tuple[Fill, Read]:
    def fill(proto: Any, value: Any) -> None:
        getattr(proto, name).SetInParent()
        fill_proto(payload_type, getattr(proto, name), value)

    return fill, lambda proto, items: read_proto(payload_type, getattr(proto, name), items)


def _scalar(name: str) -> tuple[Fill, Read]:
    return lambda proto, value: setattr(proto, name, value), lambda proto, _: getattr(proto, name)


def _array(name: str, shape: tuple[int, ...]) -> tuple[Fill, Read]:
    size = None if -1 in shape else prod(shape)

    def fill(proto: Any, value: Any) -> None:
        getattr(proto, name).extend(np.asarray(value, dtype=np.float64).reshape(-1).tolist())

    def read(proto: Any, _: PartCounter) -> Any:
        # A list of numbers is faster to read than the protobuf container.
        array = np.array(getattr(proto, name)[:], dtype=np.float64)
        if size is not None and array.size != size:
            raise ValueError(f"{name} has {array.size} numbers instead of {size}")
        array = array.reshape(shape)
        array.flags.writeable = False
        return array

    return fill, read


def _time(name: str) -> tuple[Fill, Read]:
    def fill(proto: Any, value: int) -> None:
        stamp = getattr(proto, name)
        stamp.seconds, stamp.nanos = divmod(value, NS)
        stamp.SetInParent()

    def read(proto: Any, _: PartCounter) -> int:
        stamp = getattr(proto, name)
        time_ns = int(stamp.seconds * NS + stamp.nanos)
        if not -_LATEST_NS <= time_ns < _LATEST_NS:
            raise ValueError(f"{name} is {stamp.seconds} s, later than the year 2262")
        return time_ns

    return fill, read


def _repeated(name: str, item: Any) -> tuple[Fill, Read]:
    def numbers(proto: Any, items: PartCounter) -> tuple[Any, ...]:
        values = getattr(proto, name)
        items.take(len(values))
        return tuple(values)

    if not is_dataclass(item):
        return lambda proto, value: getattr(proto, name).extend(value), numbers
    nested: Any = item

    def fill(proto: Any, value: Any) -> None:
        for element in value:
            fill_proto(nested, getattr(proto, name).add(), element)

    def read(proto: Any, items: PartCounter) -> tuple[Any, ...]:
        values = getattr(proto, name)
        items.take(len(values))
        return tuple(read_proto(nested, element, items) for element in values)

    return fill, read


_OF_FOXGLOVE = (
    *(messages.CameraCalibration, messages.CompressedImage, messages.CompressedVideo, messages.RawImage),
    *(messages.FrameTransforms, messages.ImageAnnotations),
)


def schema_name(payload: type) -> str:
    """Return the name of the schema for a type of payload, such as ``ipsys.v1.Markers``."""
    return f"{'foxglove' if payload in _OF_FOXGLOVE else 'ipsys.v1'}.{payload.__name__}"


_STORED = {payload for channel in CHANNELS for payload in channel.payloads} - {messages.SkippedVideo}
# The payloads of the channels, by the name of their schema.
PAYLOADS: dict[str, type] = {schema_name(kind): kind for kind in sorted(_STORED, key=schema_name)}
_LONG = 32 << 10  # bytes
_ITEMS_OF_ONE = 1 << 20


def payload_type(name: str) -> type | None:
    """Return the type of payload for messages of a schema, from any program; None if there is no type."""
    return PAYLOADS.get(name) or ROS2_PAYLOADS.get(name)


def encode(payload: Any) -> bytes:
    """Serialise a payload; equal payloads give equal bytes.

    Examples
    --------
    >>> from ipsys_log.messages import CameraPoint, CameraPoints
    >>> data = encode(CameraPoints(1_500_000_000, (CameraPoint(7, 0.1, 0.2, 2.1),)))
    >>> decode("ipsys.v1.CameraPoints", data).points[0].z_m
    2.1
    """
    kind: type = type(payload)
    if kind is messages.Encoded:
        return payload.data  # type: ignore[no-any-return]
    for name in _bytes_fields(kind):
        if len(getattr(payload, name)) >= _LONG:
            return _encode_around(payload, name)
    proto = proto_class(schema_name(kind))()
    fill_proto(kind, proto, payload)
    return proto.SerializeToString(deterministic=True)


def _encode_around(payload: Any, long: str) -> bytes:
    """Serialise a payload with one long field of bytes; return the same bytes as protobuf.

    The long field is joined between the fields with lower numbers and the fields with higher numbers. A
    message contains a field of bytes without change. Protobuf would copy an image three times.
    """
    kind: type = type(payload)
    message_class = proto_class(schema_name(kind))
    numbers = {field.name: field.number for field in message_class.DESCRIPTOR.fields}
    lower, higher = message_class(), message_class()
    for name, fill, _ in fields_of(kind):
        value = getattr(payload, name)
        if name != long and value is not None:
            fill(lower if numbers[name] < numbers[long] else higher, value)
    data = getattr(payload, long)
    head = _varint(numbers[long] << 3 | 2) + _varint(len(data))  # 2: the length comes before the data
    return b"".join(
        (
            lower.SerializeToString(deterministic=True),
            head,
            data,
            higher.SerializeToString(deterministic=True),
        )
    )


def _varint(number: int) -> bytes:
    """Encode a number in bytes of seven bits, lowest first; all but the last have the highest bit set."""
    parts = []
    while number > 127:
        parts.append(number & 127 | 128)
        number >>= 7
    return bytes((*parts, number))


@cache
def _bytes_fields(kind: type) -> tuple[str, ...]:
    return tuple(name for name, hint in get_type_hints(kind).items() if hint is bytes)


def decode(
    name: str,
    data: bytes,
    encoding: str = "protobuf",
    definition: bytes = b"",
    items: PartCounter | None = None,
) -> Any:
    """Decode the payload in ``data``, a message of the schema ``name``.

    Parameters
    ----------
    name : the name of the schema.
    data : the message.
    encoding : ``protobuf``. Logs of other programs also have ``json``, and ``cdr`` of ROS 2.
    definition : the definition of the schema in the log; ``cdr`` cannot be read without it.
    items : the number of message parts that may still be read; a million by default.

    Raises
    ------
    BoundError
        The message has more parts than `items` allows.
    LogError
        The schema or encoding is not known here, or the bytes are not a valid message of the schema.
    """
    items = items or PartCounter(_ITEMS_OF_ONE)
    if name in ROS2_PAYLOADS:
        if encoding != "cdr":
            raise LogError(f"messages of ROS 2 encoded as {encoding!r} cannot be read, only cdr")
        return read_ros2(name, data, definition, items)
    payload = PAYLOADS.get(name)
    if payload is None:
        raise LogError(f"its schema {name!r} is not supported")
    try:
        return read_proto(payload, _parse(proto_class(name), data, encoding, items), items)
    except (DecodeError, json_format.ParseError, ValueError, TypeError, RecursionError) as error:
        raise LogError(f"a message is not a valid {name}: {error}") from error


def _parse(message_class: type[Proto], data: bytes, encoding: str, items: PartCounter) -> Proto:
    if encoding == "protobuf":
        return message_class.FromString(data)
    if encoding == "json":
        items.take(sum(map(data.count, (b",", b"{", b"["))))
        return json_format.ParseDict(_read_json(data), message_class(), ignore_unknown_fields=True)
    raise LogError(f"messages encoded as {encoding!r} cannot be read, only protobuf and json")


def _read_json(data: bytes) -> Any:
    """Parse a JSON object; all its texts must be valid UTF-8."""
    value = json.loads(data)
    if not isinstance(value, dict):
        raise ValueError("it is not an object")
    if b"\\ud" in data.lower():  # half of a surrogate pair; the reader of protobuf fails on it
        json.dumps(value, ensure_ascii=False).encode()
    return _plain_times(value)


def _plain_times(value: Any) -> Any:
    """Convert the times {sec, nsec} in the JSON of Foxglove into text, the form in the JSON of protobuf."""
    if isinstance(value, list):
        return [_plain_times(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"sec", "nsec"}:
        return Timestamp(seconds=value["sec"], nanos=value["nsec"]).ToJsonString()
    return {key: _plain_times(item) for key, item in value.items()}


@cache
def schema_data(name: str) -> bytes:
    """Return the ``FileDescriptorSet`` of a schema with all its imports, the form that MCAP needs."""
    descriptors = descriptor_pb2.FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in file.dependencies:
            add(dependency)
        file.CopyToProto(descriptors.file.add())

    add(proto_class(name).DESCRIPTOR.file)
    return descriptors.SerializeToString(deterministic=True)


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    data = files("ipsys_log").joinpath("schemas.binpb").read_bytes()
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(data).file:
        pool.Add(file)
    return pool


@cache
def proto_class(name: str) -> type[Proto]:
    """Return the class of protobuf for a schema."""
    package, _, message = name.rpartition(".")
    if package == "foxglove":
        module = import_module(f"foxglove_schemas_protobuf.{message}_pb2")
        return getattr(module, message)  # type: ignore[no-any-return]
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(name))
