"""Messages of a log as lines of text and as JSON; long parts and bytes are given by their size."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from math import isfinite
from typing import Any

import numpy as np

from ipsys_log.errors import LogError
from ipsys_log.log.contents import RawMessage, StoredChannel
from ipsys_log.messages import Message
from ipsys_log.plain_text import plain_text
from ipsys_log.units import format_time

_LONGEST_VALUE = 200
_TIME = "timestamp"  # every payload repeats its publish time


def message_line(raw: RawMessage, message: Message | LogError, channel: StoredChannel) -> str:
    """Return time (UTC), topic, schema and short content of a message in one line."""
    name = channel.schema.name if channel.schema is not None else "no schema"
    content = _data(raw, message, channel)
    parts = [_short(key, value) for key, value in content.items() if key != _TIME]
    return plain_text(" ".join((format_time(raw.log_time_ns), raw.topic, f"[{name}]", *parts)))


def message_json(raw: RawMessage, message: Message | LogError, channel: StoredChannel) -> str:
    """Return a message as one line of JSON; times are in ns, and a missing value is absent or null."""
    is_read = not isinstance(message, LogError)
    row = {
        "topic": raw.topic,
        "log_time_ns": raw.log_time_ns,
        "publish_time_ns": message.publish_time_ns if isinstance(message, Message) else raw.publish_time_ns,
        "schema": channel.schema.name if channel.schema is not None else None,
        "data": _data(raw, message, channel),
        "error": None if is_read or channel.message_encoding == "json" else str(message),
    }
    return json.dumps({key: value for key, value in row.items() if value is not None}, allow_nan=False)


def _data(raw: RawMessage, message: Message | LogError, channel: StoredChannel) -> dict[str, Any]:
    """Return the content of a message as plain data; its size if it cannot be decoded."""
    if isinstance(message, Message):
        content: dict[str, Any] = _plain(message.payload)
        return content
    if channel.message_encoding == "json":
        try:
            read = json.loads(raw.data)
        except (ValueError, RecursionError):
            return {"bytes": len(raw.data)}
        return _plain(read) if isinstance(read, dict) else {"value": _plain(read)}
    return {"bytes": len(raw.data)}


def _plain(value: Any) -> Any:
    """Return a payload as plain data, without missing fields; bytes become their number."""
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): _plain(part) for key, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    if isinstance(value, bytes | bytearray | memoryview):
        return {"bytes": len(value)}
    is_number = not isinstance(value, float) or isfinite(value)
    return value if is_number else None


def _short(key: str, value: Any) -> str:
    """Return a field in one short text: a list as its length, bytes as their number."""
    if isinstance(value, list):
        return f"{key}[{len(value)}]"
    if isinstance(value, dict):
        if value.keys() == {"bytes"}:
            return f"{key}={value['bytes']} bytes"
        return f"{key}{{{len(value)}}}"
    if key == "bytes":
        return f"{value} bytes"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return f"{key}={text[:_LONGEST_VALUE]}"
