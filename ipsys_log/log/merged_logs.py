"""Messages of several logs in one new log, in log order and in constant memory."""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import LogError
from ipsys_log.log.checked_chunk import crc_of_changed
from ipsys_log.log.contents import RawMessage
from ipsys_log.log.part import copy_chunk
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import ChunkRef
from ipsys_log.log.shifted_times import shift_time, shift_times
from ipsys_log.log.writer import LogWriter

# From the data of a message to those in the new log.
Change = Callable[[bytes], bytes]


@dataclass(frozen=True, slots=True, eq=False)
class MergeSource:
    """A log that is merged.

    Attributes
    ----------
    reader : the open log.
    offset_ns : is added to all its times.
    topics : the topics that come with this log, each with its name in the new log.
    changes : by topic here, the change of the messages whose content depends on the names in the new log.
    metadata : the metadata of its channels in the new log; empty for those of the log.
    """

    reader: LogReader
    offset_ns: int
    topics: Mapping[str, str]
    changes: Mapping[str, Change] = field(default_factory=dict)
    metadata: Mapping[str, str] = field(default_factory=dict)

    def messages(
        self, topics: Collection[str] | None = None, without: Collection[int] = ()
    ) -> Iterator[RawMessage]:
        """Yield the messages as they are in the new log, in log order.

        Parameters
        ----------
        topics : topics in the new log; None means all of this log.
        without : offsets of chunks that are left out.

        Raises
        ------
        LogError
            A message is damaged, or its times cannot be shifted.
        """
        wanted = [topic for topic, name in self.topics.items() if topics is None or name in topics]
        schemas = {topic: self.reader.channels[topic].schema for topic in wanted}
        names = {topic: schema.name if schema else "" for topic, schema in schemas.items()}
        for raw in self.reader.messages(wanted, without=without, is_checked=True):
            data, crc = raw.data, raw.crc
            try:
                if raw.topic in self.changes:
                    data = self.changes[raw.topic](data)
                data = shift_times(names[raw.topic], data, self.offset_ns)
                if crc is not None and data is not raw.data:
                    crc = crc_of_changed(raw.data, crc, data)
                yield RawMessage(
                    self.topics[raw.topic],
                    shift_time(raw.log_time_ns, self.offset_ns),
                    shift_time(raw.publish_time_ns, self.offset_ns),
                    data,
                    crc,
                )
            except LogError as error:
                raise LogError(f"{self.reader.path}: {raw.topic} at {raw.log_time_ns} ns: {error}") from error

    @property
    def span_ns(self) -> tuple[int, int]:
        """The first and the last log time in the new log, in ns."""
        return (self.reader.start_ns or 0) + self.offset_ns, (self.reader.end_ns or 0) + self.offset_ns

    def is_copied(self, topic: str) -> bool:
        """Return whether the messages of a topic stay as they are, or are left out."""
        as_it_is = self.topics.get(topic, topic) == topic and topic not in self.changes
        return as_it_is and not self.offset_ns and not self.metadata

    def adopt(self, writer: LogWriter, topic: str) -> None:
        """Continue the channel of a topic in the new log; the newest schema of the topic counts."""
        contents = self.reader.contents
        channel = max(
            (one for one in contents.channels.values() if one.topic == topic), key=lambda one: one.id
        )
        named = replace(channel, topic=self.topics[topic], metadata={**channel.metadata, **self.metadata})
        writer.adopt_channel(named, contents.schemas.get(channel.schema_id), is_distinct=True)


def merged(
    sources: Sequence[MergeSource], topics: Collection[str] | None = None
) -> Iterator[tuple[int, RawMessage]]:
    """Yield the messages of some topics of the new log, in log order, each with the number of its log.

    At equal times, messages of an earlier log come first.
    """
    return _in_log_order(sources, topics, [()] * len(sources))


def _in_log_order(
    sources: Sequence[MergeSource], topics: Collection[str] | None, without: Sequence[Collection[int]]
) -> Iterator[tuple[int, RawMessage]]:
    streams = [
        _numbered(number, source.messages(topics, left_out))
        for number, (source, left_out) in enumerate(zip(sources, without, strict=True))
    ]
    return heapq.merge(*streams, key=lambda row: row[1].log_time_ns)


def _numbered(number: int, messages: Iterator[RawMessage]) -> Iterator[tuple[int, RawMessage]]:
    for message in messages:
        yield number, message


def merge_messages(sources: Sequence[MergeSource], writer: LogWriter, advance: Callable[[int], None]) -> None:
    """Write the messages of several logs into a new log, in log order.

    A chunk is copied as it is, without decompression of its images, if its messages do not change and no
    other log has messages in its time. One chunk of each log is in memory at a time.

    Parameters
    ----------
    advance : called with the number of messages that are written.

    Raises
    ------
    LogError
        A log is damaged, two logs have one topic with different schemas, or a time cannot be shifted.
    """
    chunks = [_free_chunks(sources, number) for number in range(len(sources))]
    free = deque(
        sorted(
            ((number, chunk) for number, of_one in enumerate(chunks) for chunk in of_one),
            key=lambda row: (row[1].start_ns, row[0], row[1].offset),
        )
    )
    owners: dict[str, int] = {}  # by topic, the log whose channel the writer continues
    names = [{name: topic for topic, name in source.topics.items()} for source in sources]
    rest = _in_log_order(sources, None, [{chunk.offset for chunk in of_one} for of_one in chunks])
    for done, (number, message) in enumerate(rest):
        while free and free[0][1].start_ns <= message.log_time_ns:
            _copy_free(sources, writer, free, owners)
        if owners.get(message.topic) != number:
            sources[number].adopt(writer, names[number][message.topic])
            owners[message.topic] = number
        writer.write(*message)
        advance(done)
    while free:
        _copy_free(sources, writer, free, owners)


def _copy_free(
    sources: Sequence[MergeSource],
    writer: LogWriter,
    free: deque[tuple[int, ChunkRef]],
    owners: dict[str, int],
) -> None:
    number, chunk = free.popleft()
    source = sources[number]

    def choose(topic: str, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        return np.full(len(times_ns), topic in source.topics)

    copy_chunk(source.reader, writer, chunk, choose, is_distinct=True)
    owners.clear()  # the writer continues the channels of the chunk


def _free_chunks(sources: Sequence[MergeSource], number: int) -> list[ChunkRef]:
    """Return the chunks of a log that are copied as they are."""
    source, contents = sources[number], sources[number].reader.contents
    spans_ns = [other.span_ns for other in sources if other is not source and other.topics]
    changed = {key for key, channel in contents.channels.items() if not source.is_copied(channel.topic)}
    return [
        chunk
        for chunk in contents.chunks
        if chunk.index_offsets
        and changed.isdisjoint(chunk.index_offsets)
        and all(chunk.end_ns < start_ns or end_ns < chunk.start_ns for start_ns, end_ns in spans_ns)
    ]
