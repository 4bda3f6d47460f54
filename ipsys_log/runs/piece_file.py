"""The bytes of a file with the result of a piece: an index in JSON, and the payloads as in a log.

Nothing in it is executed: another user may write into a shared folder. A hash shows a damaged file.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.codec import PAYLOADS, decode, encode, payload_type, schema_name
from ipsys_log.messages import Encoded, kind_of
from ipsys_log.runs.pieces import FrameResult, PieceResult, stays_encoded

_MAGIC = b"ipsys piece 1\n"
_HASH_BYTES = 16
_LENGTH = struct.Struct("<Q")
_FAULTS = (LogError, ValueError, KeyError, TypeError, IndexError, RecursionError, struct.error)


def to_bytes(result: PieceResult) -> bytes:
    """Return the result of a piece as bytes; equal results give equal bytes."""
    blobs: list[bytes] = []
    frames = [
        [frame.publish_time_ns, [_entry(payload, blobs) for payload in frame.payloads]]
        for frame in result.frames
    ]
    error = None if result.error is None else str(result.error)
    index = json.dumps({"frames": frames, "error": error}).encode()
    body = b"".join((_LENGTH.pack(len(index)), index, *blobs))
    return _MAGIC + _hash(body) + body


def from_bytes(data: bytes, interim: Sequence[type] = ()) -> PieceResult | None:
    """Return the result of a piece; None if the bytes are not complete.

    Parameters
    ----------
    interim : the types of payloads that no log has.
    """
    start = len(_MAGIC) + _HASH_BYTES
    body = data[start:]
    if data[:start] != _MAGIC + _hash(body):
        return None
    try:
        (length,) = _LENGTH.unpack_from(body)
        begin = _LENGTH.size + length
        index = json.loads(body[_LENGTH.size : begin])
        payloads = _Payloads(body[begin:], {kind.__name__: kind for kind in interim})
        frames = [
            FrameResult(int(time_ns), tuple(map(payloads.take, rows))) for time_ns, rows in index["frames"]
        ]
        error = index["error"]
    except _FAULTS:
        return None
    return PieceResult(frames, None if error is None else IpsysError(str(error)))


def _hash(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_HASH_BYTES).digest()


def _entry(payload: Any, blobs: list[bytes]) -> list[Any]:
    """Return the entry of a payload in the index: its schema and length, or its type and fields."""
    kind = kind_of(payload)
    if kind in PAYLOADS.values():
        blobs.append(encode(payload))
        return [schema_name(kind), len(blobs[-1])]
    values = {field.name: getattr(payload, field.name) for field in fields(payload)}
    return [type(payload).__name__, {name: _value(value, blobs) for name, value in values.items()}]


def _value(value: Any, blobs: list[bytes]) -> Any:
    return {"payload": _entry(value, blobs)} if type(value) in PAYLOADS.values() else value


class _Payloads:
    """The payloads of a file, taken in the order of its index."""

    def __init__(self, data: bytes, interim: Mapping[str, type]) -> None:
        self._data, self._interim, self._position = data, interim, 0

    def take(self, entry: Sequence[Any]) -> Any:
        name, rest = entry
        if isinstance(rest, int):
            end = self._position + rest
            data, self._position = self._data[self._position : end], end
            kind = payload_type(name)
            return Encoded(kind, data) if kind is not None and stays_encoded(kind) else decode(name, data)
        return self._interim[name](**{key: self._field(value) for key, value in rest.items()})

    def _field(self, value: Any) -> Any:
        if isinstance(value, dict):
            return self.take(value["payload"])
        return tuple(value) if isinstance(value, list) else value
