"""Columns of messages with a list of items, such as the tracks of an instant: arrays instead of objects.

The messages of one writer have few shapes: the bytes that announce fields (tags and lengths) are equal. All
messages of one shape are read together, as the columns of one array of bytes.

References
----------
https://protobuf.dev/programming-guides/encoding
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import PartCounter
from ipsys_log.log.codec import proto_class

Bytes = NDArray[np.uint8]

_VARINT, _FIXED64, _LENGTH = 0, 1, 2
_MOST_SHAPES = 64  # for messages of one length; the other messages are read one by one


@dataclass(frozen=True, slots=True, eq=False)
class Column:
    """The values of a field, (n,), or (n, k) for a list of k numbers; and the mask of missing values, (n,).

    Texts are objects, a list of texts is a tuple. A missing number is 0, a missing text "".
    """

    values: NDArray[Any]
    missing: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """The items of messages: the number of the message of each item, (n,) ascending, and its fields."""

    message: NDArray[np.int64]
    fields: dict[str, Column]


def read_columns(
    schema: str, messages: Sequence[bytes], fields: Sequence[str], parts: PartCounter | None = None
) -> Columns:
    """Read fields of the items in messages.

    Parameters
    ----------
    schema : name of a schema with one repeated field of messages, such as ``ipsys.v1.Tracks``.
    messages : encoded.
    fields : names of fields of an item: numbers, texts, and lists of these.
    parts : counts the items, and the texts in their lists.

    Raises
    ------
    LogError
        A message is not valid, or the messages have more parts than ``parts`` allows.
    """
    kind = _kind_of(schema)
    lengths = np.fromiter(map(len, messages), np.int64, len(messages))
    pieces: list[_Piece] = []
    for length in np.unique(lengths):
        numbers = np.flatnonzero(lengths == length)
        data = np.frombuffer(b"".join(messages[n] for n in numbers.tolist()), np.uint8).reshape(
            len(numbers), length
        )
        for _ in range(_MOST_SHAPES):
            if not len(numbers):
                break
            shape = _shape_of(messages[int(numbers[0])], kind, fields)
            if shape is None:
                break
            fits = shape.fits(data)
            if parts is not None:
                parts.take(shape.parts(kind) * int(fits.sum()))
            pieces += shape.read(data[fits], numbers[fits], kind, fields)
            numbers, data = numbers[~fits], data[~fits]
        pieces += _one_by_one(schema, messages, numbers, kind, fields, parts)
    return _joined(pieces, kind, fields)


class _Kind(NamedTuple):
    """A message with items: the number of their field, and the fields of an item by number."""

    items: str
    number: int
    by_number: dict[int, FieldDescriptor]
    by_name: dict[str, FieldDescriptor]


@cache
def _kind_of(schema: str) -> _Kind:
    descriptor: Any = proto_class(schema).DESCRIPTOR
    (items,) = (entry for entry in descriptor.fields if _is_list(entry) and entry.message_type is not None)
    of_item = items.message_type.fields
    return _Kind(items.name, items.number, {f.number: f for f in of_item}, {f.name: f for f in of_item})


def _is_list(described: FieldDescriptor) -> bool:
    # Older versions of protobuf have only the label; newer versions warn of its use.
    repeated = getattr(described, "is_repeated", None)
    return bool(
        getattr(described, "label", 0) == FieldDescriptor.LABEL_REPEATED if repeated is None else repeated
    )


def _is_list_of_texts(described: FieldDescriptor) -> bool:
    return described.type == FieldDescriptor.TYPE_STRING and _is_list(described)


class _Value(NamedTuple):
    """A value in a message: item, field, offset of its bytes, their number, and how they are stored."""

    item: int
    field: str
    offset: int
    length: int
    wire: int


@dataclass(slots=True)
class _Shape:
    """The common part of messages of one shape: equal bytes, the lengths of their numbers, the values."""

    items: int = 0
    values: list[_Value] = field(default_factory=list)
    equal: list[int] = field(default_factory=list)
    varints: list[int] = field(default_factory=list)
    first: bytes = b""

    def fits(self, data: Bytes) -> NDArray[np.bool_]:
        """Return a mask of the messages that have the shape of the first one, (n,)."""
        first = np.frombuffer(self.first, np.uint8)
        equal, varints = np.array(self.equal, np.int64), np.array(self.varints, np.int64)
        same = (data[:, equal] == first[equal]).all(axis=1)
        # The highest bit of a byte tells whether the number continues.
        lengths = ((data[:, varints] ^ first[varints]) & 0x80 == 0).all(axis=1)
        return np.asarray(same & lengths, dtype=np.bool_)

    def parts(self, kind: _Kind) -> int:
        """Return the number of items of a message, and of texts in their lists."""
        return self.items + sum(_is_list_of_texts(kind.by_name[value.field]) for value in self.values)

    def read(
        self, data: Bytes, numbers: NDArray[np.int64], kind: _Kind, fields: Sequence[str]
    ) -> "list[_Piece]":
        """Return the items of messages that fit, one piece for the n-th item of all messages."""
        pieces = []
        for item in range(self.items):
            columns: dict[str, list[NDArray[Any]]] = {}
            for value in self.values:
                if value.item == item:
                    part = data[:, value.offset : value.offset + value.length]
                    columns.setdefault(value.field, []).append(
                        _decoded(part, value.wire, kind.by_name[value.field])
                    )
            pieces.append(
                _Piece(
                    numbers, item, {name: _column(kind.by_name[name], columns.get(name)) for name in fields}
                )
            )
        return pieces


class _Piece(NamedTuple):
    """Items at the same index of some messages; by field the values, None if missing."""

    numbers: NDArray[np.int64]
    item: int
    columns: dict[str, NDArray[Any] | None]


def _shape_of(data: bytes, kind: _Kind, fields: Sequence[str]) -> _Shape | None:
    """Return the shape of a message; None for a message that is not read by shape."""
    shape = _Shape(first=data)
    try:
        for number, wire, offset, end in _tokens(data, 0, len(data), shape):
            if number != kind.number or wire != _LENGTH:
                continue
            for inner, kind_of_bytes, start, stop in _tokens(data, offset, end, shape):
                described = kind.by_number.get(inner)
                if described is not None and described.name in fields:
                    shape.values.append(
                        _Value(shape.items, described.name, start, stop - start, kind_of_bytes)
                    )
            shape.items += 1
    except (IndexError, ValueError):
        return None
    return shape


def _tokens(data: bytes, at: int, end: int, shape: _Shape) -> Iterator[tuple[int, int, int, int]]:
    """Yield the fields of a message: number, wire type, start and end of the bytes."""
    while at < end:
        tag, after = _varint(data, at)
        shape.equal += range(at, after)
        number, wire = tag >> 3, tag & 7
        if wire == _VARINT:
            _, stop = _varint(data, after)
            shape.varints += range(after, stop)
            start = after
        elif wire == _FIXED64:
            start, stop = after, after + 8
        elif wire == _LENGTH:
            length, start = _varint(data, after)
            shape.equal += range(after, start)
            stop = start + length
        else:
            raise ValueError(f"wire type {wire}")
        if stop > end:
            raise ValueError("a field reaches beyond its message")
        yield number, wire, start, stop
        at = stop


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Read a number in bytes of seven bits, lowest first; return it and the offset behind it."""
    value = shift = 0
    while True:
        byte = data[at]
        value |= (byte & 0x7F) << shift
        at, shift = at + 1, shift + 7
        if byte < 0x80:
            return value, at
        if shift > 63:
            raise ValueError("a number is too long")


def _decoded(part: Bytes, wire: int, described: FieldDescriptor) -> NDArray[Any]:
    """Return the values of one field: (n,), (n, k) for numbers in one field, or objects for texts."""
    if wire == _VARINT:
        value = np.zeros(len(part), np.uint64)
        for n in range(part.shape[1]):
            value |= (part[:, n] & np.uint8(0x7F)).astype(np.uint64) << np.uint64(7 * n)
        return value.astype(np.int64)
    if described.type == FieldDescriptor.TYPE_DOUBLE:
        values = np.ascontiguousarray(part).view("<f8")
        return values if _is_list(described) else values[:, 0]
    return _texts(part)


def _texts(part: Bytes) -> NDArray[np.object_]:
    texts = np.empty(len(part), object)
    if (part == part[:1]).all():
        texts[:] = part[0].tobytes().decode()
        return texts
    packed = np.ascontiguousarray(part)
    texts[:] = [row.tobytes().decode() for row in packed]
    return texts


def _column(described: FieldDescriptor, parts: list[NDArray[Any]] | None) -> NDArray[Any] | None:
    """Join the parts of a field: for a list the parts of all its fields, else the last part."""
    if parts is None:
        return None
    if not _is_list(described):
        return parts[-1]
    if described.type == FieldDescriptor.TYPE_DOUBLE:
        return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)
    lists = np.empty(len(parts[0]), object)
    lists[:] = list(zip(*parts, strict=True))
    return lists


def _one_by_one(
    schema: str,
    messages: Sequence[bytes],
    numbers: NDArray[np.int64],
    kind: _Kind,
    fields: Sequence[str],
    parts: PartCounter | None,
) -> list[_Piece]:
    """Read messages of rare shapes with the library of protobuf."""
    pieces = []
    for number in numbers.tolist():
        try:
            items = getattr(proto_class(schema).FromString(messages[number]), kind.items)
        except DecodeError as error:
            raise LogError(f"a message is not a valid {schema}: {error}") from error
        if parts is not None:
            lists = [name for name in fields if _is_list_of_texts(kind.by_name[name])]
            parts.take(len(items) + sum(len(getattr(item, name)) for item in items for name in lists))
        for place, item in enumerate(items):
            columns = {name: _value(item, kind.by_name[name]) for name in fields}
            pieces.append(_Piece(np.array([number]), place, columns))
    return pieces


def _value(item: Any, described: FieldDescriptor) -> NDArray[Any] | None:
    value = getattr(item, described.name)
    if _is_list(described):
        if not len(value):
            return None
        if described.type == FieldDescriptor.TYPE_DOUBLE:
            return np.array([list(value)])
        texts = np.empty(1, object)
        texts[0] = tuple(value)
        return texts
    if described.has_presence and not item.HasField(described.name):
        return None
    if described.type == FieldDescriptor.TYPE_STRING:
        texts = np.empty(1, object)
        texts[0] = value
        return texts
    return np.array([value], np.float64 if described.type == FieldDescriptor.TYPE_DOUBLE else np.int64)


def _joined(pieces: Sequence[_Piece], kind: _Kind, fields: Sequence[str]) -> Columns:
    """Join pieces in the order of messages and items."""
    if not pieces:
        empty = np.empty(0, np.int64)
        return Columns(empty, {name: _filled(kind.by_name[name], [], []) for name in fields})
    message = np.concatenate([piece.numbers for piece in pieces])
    item = np.repeat([piece.item for piece in pieces], [len(piece.numbers) for piece in pieces])
    order = np.lexsort((item, message))
    sizes = [len(piece.numbers) for piece in pieces]
    columns = {}
    for name in fields:
        column = _filled(kind.by_name[name], [piece.columns[name] for piece in pieces], sizes)
        columns[name] = Column(column.values[order], column.missing[order])
    return Columns(message[order], columns)


def _filled(described: FieldDescriptor, parts: Sequence[NDArray[Any] | None], sizes: Sequence[int]) -> Column:
    """Join the parts of a column; an absent field without presence is 0 or "", not missing."""
    is_text = described.type == FieldDescriptor.TYPE_STRING
    is_list = _is_list(described)
    width = max((part.shape[1] for part in parts if part is not None and part.ndim == 2), default=0)
    shape: tuple[int, ...] = (sum(sizes), width) if is_list and not is_text else (sum(sizes),)
    kind: Any = (
        object if is_text else np.float64 if described.type == FieldDescriptor.TYPE_DOUBLE else np.int64
    )
    values = np.zeros(shape, kind)
    if is_text:
        values[:] = [() if is_list else ""] * len(values)
    missing = np.zeros(sum(sizes), np.bool_)
    start = 0
    for part, size in zip(parts, sizes, strict=True):
        if part is None:
            missing[start : start + size] = is_list or described.has_presence
        elif values.ndim == 2:
            values[start : start + size, : part.shape[1]] = part
            missing[start : start + size] = part.shape[1] < width
        else:
            values[start : start + size] = part
        start += size
    return Column(values, missing)
