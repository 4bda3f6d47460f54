"""Differences between two outputs: logs by message, JSON by key, other files by line.

Nothing here imports ``ipsys_log``. The ``mcap`` package reads the logs, and their own schemas decode them:
a fault of the code under test cannot hide itself.
"""

import hashlib
import json
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader

# places that are not topics
ORDER, SCHEMAS, BYTES, EXIT_CODE = "order", "schemas", "bytes", "exit-code"
_LONGEST_VALUE = 60


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference at a place: a topic, a JSON path, a file name, or ``order``, ``schemas``, ``bytes``."""

    place: str
    text: str
    file: str = ""

    def __str__(self) -> str:
        return ": ".join(dict.fromkeys(part for part in (self.file, self.place, self.text) if part))


@dataclass(slots=True)
class JsonDifferences:
    """The differences between two JSON values, and the paths of keys in the new one only."""

    differences: list[Difference] = field(default_factory=list)
    additions: list[str] = field(default_factory=list)


# The name, encoding and definition of a schema.
Definition = tuple[str, str, bytes]


class Entry(NamedTuple):
    """A stored message of a log."""

    topic: str
    log_time_ns: int
    publish_time_ns: int
    data: bytes


class Log(NamedTuple):
    """The messages of a log in file order, and the schema of each topic."""

    entries: list[Entry]
    schemas: dict[str, Definition]

    def by_topic(self) -> dict[str, list[Entry]]:
        topics: dict[str, list[Entry]] = {}
        for entry in self.entries:
            topics.setdefault(entry.topic, []).append(entry)
        return topics


def read_log(path: Path) -> Log:
    """Read all messages of a log.

    Raises
    ------
    McapError
        The file is no complete log.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    log = Log([], {})
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
                schema = schemas.get(record.schema_id)
                if schema is not None:
                    log.schemas[record.topic] = (schema.name, schema.encoding, schema.data)
            elif isinstance(record, Record):
                topic = channels[record.channel_id].topic
                log.entries.append(Entry(topic, record.log_time, record.publish_time, record.data))
    return log


def compare_logs(old: Path, new: Path, messages_only: bool = False) -> list[Difference]:
    """Compare two logs; the first difference is the earliest in the old log.

    Parameters
    ----------
    messages_only : compare the messages of each topic in the order of their log times, not in file order:
        with several writing threads, the order between topics and the chunks are random.
    """
    if old.read_bytes() == new.read_bytes():
        return []
    try:
        logs = read_log(old), read_log(new)
    except (McapError, struct.error) as error:
        return [Difference(BYTES, f"the bytes differ, and one of the logs cannot be read: {error!r}")]
    topics = logs[0].by_topic(), logs[1].by_topic()
    if messages_only:
        for entries in (*topics[0].values(), *topics[1].values()):
            entries.sort(key=lambda entry: entry.log_time_ns)
    found = []
    positions = {id(entry): n for log in logs for n, entry in enumerate(log.entries)}
    for topic in sorted({*topics[0], *topics[1]}):
        pair = topics[0].get(topic, []), topics[1].get(topic, [])
        if pair[0] != pair[1]:
            schemas = logs[0].schemas.get(topic), logs[1].schemas.get(topic)
            found.append(_compare_topic(topic, *pair, *schemas))
    found.sort(key=lambda one: positions[id(one[0])])
    differences = [difference for _, difference in found]
    differences += _compare_schemas(logs[0].schemas, logs[1].schemas)
    if messages_only:
        return differences
    same = {topic for topic in topics[0] if topics[0][topic] == topics[1].get(topic)}
    differences += _compare_order(logs[0].entries, logs[1].entries, same)
    return differences or [_compare_bytes(old.read_bytes(), new.read_bytes())]


def _compare_topic(
    topic: str,
    old: Sequence[Entry],
    new: Sequence[Entry],
    old_schema: Definition | None,
    new_schema: Definition | None,
) -> tuple[Entry, Difference]:
    """Return the first different message of a topic, and the difference."""
    if not old or not new:
        side, entries = ("new", new) if new else ("old", old)
        text = f"only in the {side} log, {_count(len(entries))}; first at {entries[0].log_time_ns}"
        return entries[0], Difference(topic, text)
    number = next((n for n, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1]), None)
    if number is None:
        longer = old if len(old) > len(new) else new
        entry = longer[min(len(old), len(new))]
        text = f"{_count(len(old))} -> {len(new)}; the first without a counterpart at {entry.log_time_ns}"
        return entry, Difference(topic, text)
    differing = sum(one != other for one, other in zip(old, new, strict=False))
    counts = f"{differing} of {_count(len(old))} differ" + (
        f" ({len(new)} in the new log)" if len(new) != len(old) else ""
    )
    before, after = old[number], new[number]
    if before.log_time_ns != after.log_time_ns:
        what = f"log time -> {after.log_time_ns}"
    elif before.publish_time_ns != after.publish_time_ns:
        what = f"publish time {before.publish_time_ns} -> {after.publish_time_ns}"
    else:
        what = _first_field_of(before.data, after.data, old_schema, new_schema)
    return before, Difference(topic, f"{counts}; first at {before.log_time_ns}: {what}")


def _first_field_of(
    old: bytes, new: bytes, old_schema: Definition | None, new_schema: Definition | None
) -> str:
    try:
        messages = decode(old, old_schema), decode(new, new_schema)
    except (DecodeError, KeyError, TypeError) as error:
        return f"{_short(old)} -> {_short(new)} (not decoded: {error!r})"
    if messages[0] is None or messages[1] is None:
        return f"{_short(old)} -> {_short(new)}"
    found = first_field(messages[0], messages[1])
    return found or "equal fields, other bytes: unknown fields, or another order of the fields"


def decode(data: bytes, schema: Definition | None) -> Message | None:
    """Decode a payload with the schema of its log; return None for encodings other than Protobuf."""
    if schema is None or schema[1] != "protobuf":
        return None
    name, _, definition = schema
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(definition).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return kind.FromString(data)


def first_field(old: Message, new: Message, prefix: str = "") -> str | None:
    """Return the first different field of two messages, with both values; None if all are equal."""
    fields = {f.name: (f.number, f.name) for message in (new, old) for f in message.DESCRIPTOR.fields}
    for _, name in sorted(fields.values()):
        sides = _value(old, name), _value(new, name)
        text = _first_difference(*sides, f"{prefix}{name}")
        if text is not None:
            return text
    return None


def _value(message: Message, name: str) -> Any:
    """Return the value of a field: None if it is absent, a list if it is repeated."""
    described = message.DESCRIPTOR.fields_by_name.get(name)
    if described is None:
        return None
    value = getattr(message, name)
    if described.message_type is not None and described.message_type.GetOptions().map_entry:
        return sorted(value.items())
    if described.is_repeated:
        return list(value)
    return value if not described.has_presence or message.HasField(name) else None


def _first_difference(old: Any, new: Any, path: str) -> str | None:
    if isinstance(old, Message) and isinstance(new, Message):
        return first_field(old, new, f"{path}.")
    if isinstance(old, (list, tuple)) and isinstance(new, (list, tuple)):
        for n, pair in enumerate(zip(old, new, strict=False)):
            text = _first_difference(*pair, f"{path}[{n}]")
            if text is not None:
                return text
        return None if len(old) == len(new) else f"{path}: {len(old)} elements -> {len(new)}"
    if isinstance(old, float) and isinstance(new, float):
        equal = struct.pack("<d", old) == struct.pack("<d", new)
    else:
        equal = type(old) is type(new) and old == new
    return None if equal else f"{path}: {_short(old)} -> {_short(new)}"


def _compare_schemas(old: dict[str, Definition], new: dict[str, Definition]) -> Iterator[Difference]:
    changed = sorted({old[t][0] for t in {*old} & {*new} if old[t] != new[t]})
    if changed:
        yield Difference(SCHEMAS, f"other definitions of {', '.join(changed)}")


def _compare_order(old: Iterable[Entry], new: Iterable[Entry], topics: set[str]) -> Iterator[Difference]:
    """Compare the order between messages of topics that are equal by themselves."""
    sides = [[entry for entry in side if entry.topic in topics] for side in (old, new)]
    for before, after in zip(*sides, strict=True):
        if before != after:
            text = f"at {before.log_time_ns} {before.topic} -> at {after.log_time_ns} {after.topic}"
            yield Difference(ORDER, f"equal messages in another order; first {text}")
            return


def _compare_bytes(old: bytes, new: bytes) -> Difference:
    offset = next((n for n, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1]), None)
    at = min(len(old), len(new)) if offset is None else offset
    sizes = f"{len(old)} -> {len(new)} bytes" if len(old) != len(new) else f"{len(old)} bytes"
    text = f"equal messages; chunks, indexes or summary differ from byte {at} on ({sizes})"
    return Difference(BYTES, text)


def compare_json(old: Any, new: Any) -> JsonDifferences:
    """Compare two JSON values; a key in the new one only is an addition, not a difference.

    Examples
    --------
    >>> compare_json({"a": [1, 2.0]}, {"a": [1, 2.5], "b": 3})
    JsonDifferences(differences=[Difference(place='a.1', text='2.0 -> 2.5', file='')], additions=['b'])
    """
    found = JsonDifferences()
    _walk(old, new, "", found)
    return found


def _walk(old: Any, new: Any, path: str, found: JsonDifferences) -> None:
    if isinstance(old, dict) and isinstance(new, dict):
        found.additions += [_join(path, key) for key in new if key not in old]
        for key, value in old.items():
            if key in new:
                _walk(value, new[key], _join(path, key), found)
            else:
                found.differences.append(Difference(_join(path, key), f"{_short(value)} -> absent"))
    elif isinstance(old, list) and isinstance(new, list):
        for n, pair in enumerate(zip(old, new, strict=False)):
            _walk(*pair, _join(path, str(n)), found)
        if len(old) != len(new):
            found.differences.append(Difference(path or ".", f"{len(old)} elements -> {len(new)}"))
    elif type(old) is not type(new) or old != new:
        found.differences.append(Difference(path or ".", f"{_short(old)} -> {_short(new)}"))


def _join(path: str, key: str) -> str:
    return f"{path}.{key}" if path else key


def compare_files(old: Path, new: Path, place: str) -> list[Difference]:
    """Compare two other files by their first different line."""
    before, after = old.read_bytes(), new.read_bytes()
    if before == after:
        return []
    try:
        lines = before.decode().splitlines(), after.decode().splitlines()
    except UnicodeDecodeError:
        return [Difference(place, f"{_short(before)} -> {_short(after)}")]
    for number, (one, other) in enumerate(zip(*lines, strict=False), start=1):
        if one != other:
            return [Difference(place, f"line {number}: {_short(one)} -> {_short(other)}")]
    return [Difference(place, f"{len(lines[0])} lines -> {len(lines[1])}")]


def _count(messages: int) -> str:
    return f"{messages} message" if messages == 1 else f"{messages} messages"


def _short(value: Any) -> str:
    """Return a value as text for one line; for bytes, their number and hash."""
    if value is None:
        return "absent"
    if isinstance(value, bytes):
        return f"{len(value)} bytes {hashlib.sha256(value).hexdigest()[:12]}"
    if isinstance(value, Message):
        value = " ".join(str(value).split())
    text = json.dumps(value) if isinstance(value, (str, dict, list)) else repr(value)
    return text if len(text) <= _LONGEST_VALUE else text[: _LONGEST_VALUE - 3] + "..."
