"""Payloads to bytes and back, by the fields of the schemas.

Every payload of :mod:`ipsys_log.messages` mirrors one protobuf schema: its own from the descriptor
set that ships with the package, or a well-known one of Foxglove. The mapping is worked out once
per type from the type hints; nothing is written down twice. Numbers are stored as they are
(doubles), so that a payload read back equals the payload written, bit for bit.
"""

from __future__ import annotations

import json
import types
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from google.protobuf.message import DecodeError
from google.protobuf.message import Message as Proto
from google.protobuf.timestamp_pb2 import Timestamp

from ipsys_log import messages
from ipsys_log.errors import LogError

__all__ = ["PAYLOADS", "decode", "encode", "schema_data", "schema_name"]

NS = 1_000_000_000

# The payloads that have a channel of their own, by the name of their schema.
PAYLOADS: dict[str, type] = {
    **{
        f"foxglove.{payload.__name__}": payload
        for payload in (
            messages.CameraCalibration,
            messages.CompressedImage,
            messages.FrameTransforms,
            messages.ImageAnnotations,
            messages.RawImage,
        )
    },
    **{
        f"ipsys.v1.{payload.__name__}": payload
        for payload in (
            messages.CameraPoints,
            messages.Evaluation,
            messages.Event,
            messages.Markers,
            messages.Measurement,
            messages.Model,
            messages.Positions,
            messages.Rig,
            messages.Run,
            messages.Tracks,
        )
    },
}
_NAMES = {payload: name for name, payload in PAYLOADS.items()}

Fill = Callable[[Any, Any], None]
Read = Callable[[Any], Any]


def schema_name(payload: type) -> str:
    """Name of the schema that a type of payload is written with, such as ``ipsys.v1.Markers``."""
    return _NAMES[payload]


def encode(payload: Any) -> bytes:
    """Serialise a payload; equal payloads give equal bytes.

    Examples
    --------
    >>> from ipsys_log.messages import CameraPoint, CameraPoints
    >>> data = encode(CameraPoints(1_500_000_000, (CameraPoint(7, 0.1, 0.2, 2.1),)))
    >>> decode("ipsys.v1.CameraPoints", data).points[0].z_m
    2.1
    """
    proto = _proto_class(schema_name(type(payload)))()
    _fill(type(payload), proto, payload)
    return proto.SerializeToString(deterministic=True)


def decode(name: str, data: bytes, encoding: str = "protobuf") -> Any:
    """The payload in ``data``, which the schema called ``name`` was written with.

    Parameters
    ----------
    name : of the schema.
    data : the message.
    encoding : ``protobuf``, or ``json`` in the logs of others.

    Raises
    ------
    LogError
        Where the schema or encoding is not known here, or the bytes are not a message of it.
    """
    payload = PAYLOADS.get(name)
    if payload is None:
        raise LogError(f"its schema {name!r} is none that ipsys reads")
    try:
        return _read(payload, _parse(_proto_class(name), data, encoding))
    except (DecodeError, json_format.ParseError, ValueError, TypeError, RecursionError) as error:
        raise LogError(f"a message is not a valid {name}: {error}") from error


def _parse(proto_class: type[Proto], data: bytes, encoding: str) -> Proto:
    if encoding == "protobuf":
        return proto_class.FromString(data)
    if encoding == "json":
        return json_format.ParseDict(
            _plain_times(json.loads(data)), proto_class(), ignore_unknown_fields=True
        )
    raise LogError(f"messages encoded as {encoding!r} are not read, only protobuf and json")


def _plain_times(value: Any) -> Any:
    """Foxglove's JSON has times as {sec, nsec}, protobuf's has them as text."""
    if isinstance(value, list):
        return [_plain_times(item) for item in value]
    if not isinstance(value, dict):
        return value
    if value.keys() == {"sec", "nsec"}:
        return Timestamp(seconds=value["sec"], nanos=value["nsec"]).ToJsonString()
    return {key: _plain_times(item) for key, item in value.items()}


@cache
def schema_data(name: str) -> bytes:
    """The ``FileDescriptorSet`` of a schema with all that it imports, as MCAP wants it."""
    found = descriptor_pb2.FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in file.dependencies:
            add(dependency)
        file.CopyToProto(found.file.add())

    add(_proto_class(name).DESCRIPTOR.file)
    return found.SerializeToString(deterministic=True)


@cache
def _pool() -> descriptor_pool.DescriptorPool:
    data = files("ipsys_log").joinpath("schemas.binpb").read_bytes()
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(data).file:
        pool.Add(file)
    return pool


@cache
def _proto_class(name: str) -> type[Proto]:
    package, _, message = name.rpartition(".")
    if package == "foxglove":
        module = import_module(f"foxglove_schemas_protobuf.{message}_pb2")
        return getattr(module, message)  # type: ignore[no-any-return]
    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(name))


# --- one payload type, field by field -----------------------------------------------------------


def _fill(payload_type: type, proto: Any, payload: Any) -> None:
    for name, fill, _ in _fields(payload_type):
        value = getattr(payload, name)
        if value is not None:
            fill(proto, value)


def _read(payload_type: type, proto: Any) -> Any:
    return payload_type(*(read(proto) for _, _, read in _fields(payload_type)))


@cache
def _fields(payload_type: type) -> tuple[tuple[str, Fill, Read], ...]:
    hints = get_type_hints(payload_type, include_extras=True)
    return tuple((f.name, *_converters(f.name, hints[f.name])) for f in fields(payload_type))


def _converters(name: str, hint: Any) -> tuple[Fill, Read]:
    """How a field is put into a protobuf message, and taken out of one."""
    if get_origin(hint) in (Union, types.UnionType):
        inner = next(h for h in get_args(hint) if h is not type(None))
        fill, read = _converters(name, inner)
        if get_origin(inner) is Annotated and isinstance(inner.__metadata__[0], tuple):
            return fill, lambda proto: read(proto) if getattr(proto, name) else None
        return fill, lambda proto: read(proto) if proto.HasField(name) else None
    if get_origin(hint) is Annotated:
        mark = hint.__metadata__[0]
        return _array(name, mark) if isinstance(mark, tuple) else _time(name)
    if get_origin(hint) is tuple:
        return _repeated(name, get_args(hint)[0])
    if get_origin(hint) is dict:
        return _map(name)
    return _nested(name, hint) if is_dataclass(hint) else _scalar(name)


def _map(name: str) -> tuple[Fill, Read]:
    return (
        lambda proto, value: getattr(proto, name).update(value),
        lambda proto: dict(sorted(getattr(proto, name).items())),
    )


def _nested(name: str, payload_type: Any) -> tuple[Fill, Read]:
    def fill(proto: Any, value: Any) -> None:
        getattr(proto, name).SetInParent()
        _fill(payload_type, getattr(proto, name), value)

    return fill, lambda proto: _read(payload_type, getattr(proto, name))


def _scalar(name: str) -> tuple[Fill, Read]:
    return lambda proto, value: setattr(proto, name, value), lambda proto: getattr(proto, name)


def _array(name: str, shape: tuple[int, ...]) -> tuple[Fill, Read]:
    def fill(proto: Any, value: Any) -> None:
        getattr(proto, name).extend(np.asarray(value, dtype=np.float64).reshape(-1).tolist())

    def read(proto: Any) -> Any:
        array = np.array(getattr(proto, name), dtype=np.float64)
        if -1 not in shape and array.size != np.prod(shape):
            raise ValueError(f"{name} has {array.size} numbers instead of {np.prod(shape)}")
        array = array.reshape(shape)
        array.flags.writeable = False
        return array

    return fill, read


def _time(name: str) -> tuple[Fill, Read]:
    def fill(proto: Any, value: int) -> None:
        stamp = getattr(proto, name)
        stamp.seconds, stamp.nanos = divmod(value, NS)
        stamp.SetInParent()

    def read(proto: Any) -> int:
        stamp = getattr(proto, name)
        return int(stamp.seconds * NS + stamp.nanos)

    return fill, read


def _repeated(name: str, item: Any) -> tuple[Fill, Read]:
    if not is_dataclass(item):
        return (
            lambda proto, value: getattr(proto, name).extend(value),
            lambda proto: tuple(getattr(proto, name)),
        )
    nested: Any = item

    def fill(proto: Any, value: Any) -> None:
        for one in value:
            _fill(nested, getattr(proto, name).add(), one)

    return fill, lambda proto: tuple(_read(nested, one) for one in getattr(proto, name))
