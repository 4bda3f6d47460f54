"""Several logs as one: their conditions, their messages in one new log, and times shifted without a loss."""

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2
from google.protobuf.message import DecodeError

from ipsys_log.errors import LogError
from ipsys_log.log.codec import NS, PAYLOADS, payload_type, proto_class
from ipsys_log.log.contents import RawMessage, StoredChannel, run_of_topic
from ipsys_log.log.location import LogLocation
from ipsys_log.log.reader import LogReader
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import Measurement, Run


def check_overlaps(readers: Sequence[LogReader], image_topics: Collection[str]) -> None:
    """Refuse logs that have images of the same camera, or results of the same run, at the same time.

    Sessions one after the other may have runs of the same name: such a run is read as one.
    """
    first: dict[str, LogReader] = {}
    for reader in readers:
        for topic in reader.channels:
            other = first.setdefault(topic, reader)
            if other is reader or topic.endswith("/record"):
                continue
            if topic in image_topics and _overlap(reader, other, topic):
                raise LogError(
                    f"two cameras have the same name: {topic} is in {other.path} and, at the same time, "
                    f"in {reader.path}; leave one of them out"
                )
            if run_of_topic(topic) is not None and _overlap(reader, other, topic):
                raise LogError(
                    f"{topic} is in {other.path} and, at the same time, in {reader.path}; leave one of "
                    "them out"
                )


def _overlap(one: LogReader, other: LogReader, topic: str) -> bool:
    first, second = one.first_time(topic), other.first_time(topic)
    if first is None or second is None:
        return False
    return first <= (other.last_time(topic) or 0) and second <= (one.last_time(topic) or 0)


def check_same_parameters(logs: Iterable[tuple[LogLocation, Iterable[Run]]]) -> None:
    """Refuse logs in which a stage made a run of the same name in different ways.

    ``logs`` has the path of each log, and the records of its runs.
    """
    known: dict[tuple[str, str], tuple[LogLocation, Mapping[str, str]]] = {}
    for path, runs in logs:
        for run in runs:
            other, parameters = known.setdefault((run.run, run.stage), (path, run.parameters))
            if other != path and parameters != run.parameters:
                raise LogError(
                    f"run {run.run} has other parameters of {run.stage} in {other} than in {path}; leave one "
                    "of them out, or compute the run again with --run and another name"
                )


def find_new_ids(logs: Iterable[Iterable[Measurement]]) -> list[dict[str, str]]:
    """Return new ids for ids that an earlier log has too: for each log, the new id by the old id.

    Parameters
    ----------
    logs : the measurements of each log; the earliest log first.

    Examples
    --------
    >>> find_new_ids([[Measurement(0, "p001")], [Measurement(9, "p001"), Measurement(9, "p002")]])
    [{}, {'p001': 'p001_2'}]
    """
    taken: set[str] = set()
    renamings = []
    for number, measurements in enumerate(logs, 1):
        ids = list(dict.fromkeys(measurement.id for measurement in measurements))
        new: dict[str, str] = {}
        for name in ids:
            if name in taken:
                new[name] = f"{name}_{number}"
        taken.update(new.get(name, name) for name in ids)
        renamings.append(new)
    return renamings


def rename_ids(measurement: Measurement, ids: Mapping[str, str]) -> Measurement:
    """Return a measurement, a withdrawal, or a re-admission, with the new ids of its log."""

    def new_id(name: str | None) -> str | None:
        return None if name is None else ids.get(name, name)

    return replace(
        measurement,
        id=ids.get(measurement.id, measurement.id),
        withdraws=new_id(measurement.withdraws),
        readmits=new_id(measurement.readmits),
    )


@dataclass(frozen=True, slots=True, eq=False)
class MergeSource:
    """A log that is merged.

    Attributes
    ----------
    reader : the open log.
    offset_ns : is added to all its times.
    topics : the topics that come with this log.
    replaced : by topic, the data of all its messages in the new log, if they are not those of this log.
    metadata : are added to the metadata of its channels in the new log.
    """

    reader: LogReader
    offset_ns: int
    topics: Collection[str]
    replaced: Mapping[str, bytes] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """Yield the messages of some topics as they are in the new log, in log order; None means all."""
        wanted = [topic for topic in self.topics if topics is None or topic in topics]
        schemas = {topic: self.reader.channels[topic].schema for topic in wanted}
        names = {topic: schema.name if schema else "" for topic, schema in schemas.items()}
        for topic, log_ns, publish_ns, data in self.reader.messages(wanted, is_checked=True):
            try:
                yield RawMessage(
                    topic,
                    shift_time(log_ns, self.offset_ns),
                    shift_time(publish_ns, self.offset_ns),
                    shift_times(names[topic], self.replaced.get(topic, data), self.offset_ns),
                )
            except LogError as error:
                raise LogError(f"{self.reader.path}: {topic} at {log_ns} ns: {error}") from error

    def adopt(self, writer: LogWriter, topic: str) -> None:
        """Continue the channel of a topic in the new log; the newest schema of the topic counts."""
        contents = self.reader.contents
        channel = max(
            (one for one in contents.channels.values() if one.topic == topic), key=lambda one: one.id
        )
        named = replace(channel, metadata={**channel.metadata, **self.metadata})
        writer.adopt_channel(named, contents.schemas.get(channel.schema_id))


def merged(
    sources: Sequence[MergeSource], topics: Collection[str] | None = None
) -> Iterator[tuple[int, RawMessage]]:
    """Yield the messages of some topics of the new log, in log order, each with the number of its log.

    At equal times, messages of an earlier log come first.
    """
    streams = [_numbered(number, source.messages(topics)) for number, source in enumerate(sources)]
    return heapq.merge(*streams, key=lambda row: row[1].log_time_ns)


def _numbered(number: int, messages: Iterator[RawMessage]) -> Iterator[tuple[int, RawMessage]]:
    for message in messages:
        yield number, message


def merge_messages(sources: Sequence[MergeSource], writer: LogWriter, advance: Callable[[int], None]) -> None:
    """Write the messages of several logs into a new log, in log order; a chunk of each log is in memory.

    Parameters
    ----------
    advance : called with the number of messages that are written.

    Raises
    ------
    LogError
        A log is damaged, two logs have one topic with different schemas, or a time cannot be shifted.
    """
    owners: dict[str, int] = {}  # by topic, the log whose channel the writer continues
    for done, (number, message) in enumerate(merged(sources)):
        if owners.get(message.topic) != number:
            sources[number].adopt(writer, message.topic)
            owners[message.topic] = number
        writer.write(*message)
        advance(done)


_TIMESTAMP = "google.protobuf.Timestamp"


def check_shift(channel: StoredChannel) -> None:
    """Refuse a channel with times that cannot be shifted."""
    is_known = channel.schema is not None and payload_type(channel.schema.name) is not None
    if is_known and channel.message_encoding != "protobuf":
        raise LogError(
            f"the times in the messages of {channel.topic} cannot be shifted, because their encoding is "
            f"{channel.message_encoding}; merge it as the first log"
        )


def shift_time(time_ns: int, offset_ns: int) -> int:
    """Return a shifted time in ns; 0 means that a time is missing, and stays 0."""
    if time_ns == 0:
        return 0
    shifted_ns = time_ns + offset_ns
    if not 0 < shifted_ns < 1 << 64:
        raise LogError(f"a time of {time_ns} ns cannot be shifted by {offset_ns} ns; give another offset")
    return shifted_ns


def shift_times(name: str, data: bytes, offset_ns: int) -> bytes:
    """Return a message with all its times shifted; a message of an unknown schema stays the same.

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
