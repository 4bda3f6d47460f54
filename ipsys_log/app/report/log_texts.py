"""Messages, channel sizes and latencies of a log, as text and as plain data.

Long parts and bytes of a message are given by their size.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from ipsys_log.app.report.json_format import FORMAT, plain
from ipsys_log.app.report.rows import Rows, ms, percent
from ipsys_log.errors import LogError
from ipsys_log.log.channel_sizes import ChannelSize
from ipsys_log.log.contents import RawMessage, StoredChannel
from ipsys_log.messages import Message
from ipsys_log.plain_text import plain_text
from ipsys_log.statistics.latency import Percentiles
from ipsys_log.units import format_bytes, format_time

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
        "format": FORMAT,
        "topic": raw.topic,
        "log_time_ns": raw.log_time_ns,
        "publish_time_ns": message.publish_time_ns if isinstance(message, Message) else raw.publish_time_ns,
        "schema": channel.schema.name if channel.schema is not None else None,
        "data": _data(raw, message, channel),
        "error": None if is_read or channel.message_encoding == "json" else str(message),
    }
    return json.dumps({key: value for key, value in row.items() if value is not None}, allow_nan=False)


def sizes_json(path: str, file_bytes: int, sizes: Sequence[ChannelSize]) -> dict[str, Any]:
    """Return the sizes of a log as plain data, in bytes; ``share`` is of the file."""
    stored_bytes = sum(size.stored_bytes for size in sizes)
    return {
        "path": path,
        "bytes": file_bytes,
        "channels": [{**asdict(size), "share": size.stored_bytes / file_bytes} for size in sizes],
        "other_bytes": file_bytes - stored_bytes,
    }


def sizes_table(sizes: dict[str, Any]) -> Rows:
    """Return the sizes of :func:`sizes_json` as a table, in 80 columns if the topics are short enough."""
    cells = [
        [
            row["topic"], str(row["messages"]), format_bytes(row["payload_bytes"]),
            format_bytes(row["stored_bytes"]), percent(row["share"], 1),
        ]
        for row in sizes["channels"]
    ]  # fmt: skip
    other, share = format_bytes(sizes["other_bytes"]), sizes["other_bytes"] / sizes["bytes"]
    cells.append(["(definitions, indexes)", "", "", other, percent(share, 1)])
    columns = ("topic", ">messages", ">payload", ">in the file", ">share")
    return Rows(f"{sizes['path']}, {format_bytes(sizes['bytes'])}", columns, cells)


def _data(raw: RawMessage, message: Message | LogError, channel: StoredChannel) -> dict[str, Any]:
    """Return the content of a message as plain data; its size if it cannot be decoded."""
    if isinstance(message, Message):
        content: dict[str, Any] = plain(message.payload)
        return content
    if channel.message_encoding == "json":
        try:
            read = json.loads(raw.data)
        except (ValueError, RecursionError):
            return {"bytes": len(raw.data)}
        return plain(read) if isinstance(read, dict) else {"value": plain(read)}
    return {"bytes": len(raw.data)}


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


def latency_table(steps: Mapping[str, Percentiles]) -> Rows:
    """Return a table of the durations of the steps, in ms."""
    columns = ("step", ">median", ">90 %", ">99 %", ">longest")
    cells = [[step, *map(ms, asdict(percentiles).values())] for step, percentiles in steps.items()]
    note = "total: from the arrival of a frame to its position"
    return Rows("Duration of each step in ms", columns, cells, note)
