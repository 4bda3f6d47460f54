"""Messages of several logs in one new log, in log order and in constant memory."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

from ipsys_log.errors import LogError
from ipsys_log.log.contents import RawMessage
from ipsys_log.log.reader import LogReader
from ipsys_log.log.shifted_times import shift_time, shift_times
from ipsys_log.log.writer import LogWriter


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
        """Yield the messages of some topics as they are in the new log, in log order; None means all.

        Raises
        ------
        LogError
            A message is damaged, or its times cannot be shifted.
        """
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
