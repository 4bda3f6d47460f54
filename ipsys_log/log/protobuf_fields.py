"""Conversion of payloads to protobuf messages and back, field by field, from the type hints."""

from __future__ import annotations

import types
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from math import prod
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np

from ipsys_log.log.bounds import PartCounter

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
