"""Messages, channel sizes and findings of a check of a log, as text and as plain data.

Long parts and bytes of a message are given by their size.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

from ipsys_log.app.report.json_format import FORMAT, plain
from ipsys_log.app.report.rows import Rows, counted, percent
from ipsys_log.errors import LogError
from ipsys_log.log.channel_sizes import ChannelSize
from ipsys_log.log.contents import RawMessage, StoredChannel
from ipsys_log.messages import Message
from ipsys_log.plain_text import plain_text
from ipsys_log.tools.soundness.finding import BROKEN, SOUND, UNREAD, LogCheck, LogFinding
from ipsys_log.units import format_bytes, format_time

_LONGEST_VALUE = 200
_TIME = "timestamp"  # every payload repeats its publish time
_MOST_LINES = 30


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
        "channels": [
            {
                "topic": size.topic,
                "messages": size.messages,
                "payload_bytes": size.payload_bytes,
                "stored_bytes": size.stored_bytes,
                "share": size.stored_bytes / file_bytes,
            }
            for size in sizes
        ],
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


def check_json(checks: Sequence[LogCheck]) -> dict[str, Any]:
    """Return the results as plain data; notes are included, and missing values are left out."""
    return {
        "state": LogCheck.worst(checks),
        "logs": [
            {
                "path": str(check.path),
                "state": check.state,
                "findings": [_finding_json(finding) for finding in check.findings],
            }
            for check in checks
        ],
    }


def check_lines(check: LogCheck, details: bool = False) -> Iterator[str]:
    """Yield the answer for a log, then a line for each finding; notes only with ``details``."""
    findings = check.findings if details else check.remarks
    yield f"{check.path}: {_answer(check)}"
    for finding in findings[:_MOST_LINES]:
        if finding is not _first_fault(check):
            yield f"  {_finding_line(finding)}"
        elif finding.advice:
            yield f"  {finding.advice}"
    if len(findings) > _MOST_LINES:
        yield f"  and {len(findings) - _MOST_LINES} more: --json lists all"


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


def _finding_json(finding: LogFinding) -> dict[str, Any]:
    return {key: value for key, value in asdict(finding).items() if value not in (None, "")}


def _first_fault(check: LogCheck) -> LogFinding | None:
    return next((finding for finding in check.findings if finding.level in (BROKEN, UNREAD)), None)


def _answer(check: LogCheck) -> str:
    fault = _first_fault(check)
    if fault is not None:
        return f"{check.state}: {plain_text(fault.text)}"
    number = len(check.remarks)
    return SOUND if not number else f"readable, {counted(number, 'remark')}"


def _finding_line(finding: LogFinding) -> str:
    """Return the place, the fault and the advice of a finding in one line."""
    place = [finding.topic] if finding.topic else []
    place += [f"at {format_time(finding.time_ns)}"] if finding.time_ns is not None else []
    place += [f"({finding.count} messages)"] if finding.count is not None and finding.count > 1 else []
    title = f"{' '.join(place)}: " if place else ""
    advice = f"; {finding.advice}" if finding.advice else ""
    return plain_text(f"{title}{finding.text}{advice}")
