"""Copy of the readable parts of a damaged log."""

import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log import records
from ipsys_log.log.byte_source import FileBytes
from ipsys_log.log.chunks import ChunkContents, parse_chunk_contents, unpack
from ipsys_log.log.codec import encode, schema_data
from ipsys_log.log.contents import Contents, Schema
from ipsys_log.log.hashing import METADATA_NAME
from ipsys_log.log.summary import add_record
from ipsys_log.log.survey import Kind, Part, Survey
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages.channels import EVENTS_TOPIC
from ipsys_log.messages.events import DAMAGED, Event
from ipsys_log.units import format_time

_BLOCK = 1 << 20
_SECTOR_BYTES = 512
_LOST = "/lost"  # the start of topics whose definition is lost


@dataclass(slots=True)
class PartCopier:
    """A copy of the readable parts of a log into a writer.

    `unchecked` counts the messages that no CRC confirms. `lost` counts the messages, by channel id and log
    time, that only the message indexes of damaged chunks name.
    """

    view: FileBytes
    survey: Survey
    writer: LogWriter
    is_new: bool = False
    unchecked: int = 0
    lost: Counter[tuple[int, int]] = field(default_factory=Counter)
    _channels: dict[int, mcap.Channel] = field(default_factory=dict)
    _schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    _unproved: list[tuple[int, str]] = field(default_factory=list)  # log time and topic

    def __post_init__(self) -> None:
        self._channels, self._schemas = self.survey.channels, self.survey.schemas
        self.lost.update(row for part in self.survey.parts for row in part.lost)

    def define_all(self) -> None:
        """Write all known definitions, with their ids."""
        for schema in self._schemas.values():
            self.writer.define(schema)
        for channel_id in self._channels:
            self._define(channel_id)

    def copy(self, parts: Sequence[Part]) -> None:
        """Copy the parts, and name the range of messages that no CRC confirms."""
        for part in parts:
            if part.kind == Kind.CHUNK and part.is_proved:
                self._mark()
            if part.kind == Kind.CHUNK:
                self._copy_chunk(part)
            elif part.kind == Kind.FRAME:
                data = self.survey.search.read_frame(part.start)[0]
                self._write_all(part, data, parse_chunk_contents(self.view, part.start, data))
            elif part.kind == Kind.RECORDS:
                self._copy_records(part)
            elif part.kind == Kind.MESSAGE:
                self._write_loose(part, part.start, part.end)
            elif part.kind == Kind.ATTACHMENT:
                data = self.view.read(part.start, part.end - part.start)[:-4]
                crc = zlib.crc32(data[records.HEADER.size :])
                self._copy_index(Opcode.ATTACHMENT, part.start, part.end, [data, crc.to_bytes(4, "little")])
        self._mark()

    def _copy_records(self, part: Part) -> None:
        for record in records.walk(self.view, part.start, part.end):
            stop = record.offset + record.length
            if record.opcode == Opcode.MESSAGE:
                self._write_loose(part, record.offset, stop)
            elif record.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
                blocks = (
                    self.view.read(start, min(_BLOCK, stop - start))
                    for start in range(record.offset, stop, _BLOCK)
                )
                self._copy_index(record.opcode, record.offset, stop, blocks)

    def _copy_index(self, opcode: int, start: int, stop: int, data: Iterable[bytes]) -> None:
        """Copy an attachment, or metadata of other programs: ours are hashes of the old log."""
        contents = Contents()
        try:
            add_record(
                self.view, contents, ChunkContents(), {}, records.RecordAt(opcode, start, stop - start)
            )
        except LogError:  # its name is damaged: only the old log keeps it
            return
        if contents.attachments:
            self.writer.copy_record(contents.attachments[0], data)
        elif contents.metadata[0].name != METADATA_NAME:
            self.writer.copy_record(contents.metadata[0], data)

    def _copy_chunk(self, part: Part) -> None:
        """Copy a chunk as it is, with new message indexes; message by message if that is not possible."""
        view = self.view
        head = records.parse_chunk_head(view, part.start)[1]
        data = unpack(view, part.start, head, is_crc_checked=False)
        inside = parse_chunk_contents(view, part.start, data)
        span = inside.span_ns
        for channel_id in inside.entries:
            self._define(channel_id)
        keeps_definitions = all(map(self.writer.defines, inside.schemas.values())) and all(
            map(self.writer.defines, inside.channels.values())
        )
        if not (part.is_proved and span and keeps_definitions and self.is_new):
            self._write_all(part, data, inside, None if head.compression else head.data_offset)
            return
        record = records.chunk_head(*span, head.uncompressed_size, head.crc, head.compression, head.data_size)
        record += view.read(head.data_offset, head.data_size)
        indexes, offsets = records.index_records(inside.entries, part.start + len(record))
        ref = records.ChunkRef(
            part.start, len(record), *span, head.compression, head.data_size, head.uncompressed_size,
            len(indexes), offsets,
        )  # fmt: skip
        rows = []
        for offset, channel_id in inside.in_order():
            _, length, _, _, time_ns, published_ns = records.MESSAGE.unpack_from(data, offset)
            payload = memoryview(data)[offset + records.MESSAGE.size : offset + records.HEADER.size + length]
            topic = self.writer.use(channel_id)
            rows.append((topic, time_ns, published_ns, len(payload), zlib.crc32(payload)))
            self._note(channel_id, time_ns)
        counts = {key: len(entries) for key, entries in inside.entries.items()}
        self.writer.copy_chunk(ref, record + indexes, zlib.crc32(record + indexes), counts, rows)

    def _write_all(self, part: Part, data: bytes, inside: ChunkContents, at: int | None = None) -> None:
        """Write the messages of a chunk, whose uncompressed data begin at the offset `at` in the file."""
        if at is None and self._is_lost(part, part.start, part.end):
            return
        for offset, channel_id in inside.in_order():
            stop = offset + records.HEADER.size + records.HEADER.unpack_from(data, offset)[1]
            span = None if at is None else (at + offset, at + stop)
            self._write(part, data[offset:stop], span, self._topic_in(part, inside, channel_id))

    def _write_loose(self, part: Part, start: int, stop: int) -> None:
        self._write(part, self.view.read(start, stop - start), (start, stop))

    def _write(
        self, part: Part, record: bytes, span: tuple[int, int] | None, topic: str | None = None
    ) -> None:
        """Write the message of a Message record, which lies in the bytes `span` of the file."""
        _, _, channel_id, _, time_ns, published_ns = records.MESSAGE.unpack_from(record)
        if span and self._is_lost(part, *span):
            return
        if topic is None:
            self._define(channel_id)
            topic = self.writer.use(channel_id)
        self.writer.write(topic, time_ns, published_ns, record[records.MESSAGE.size :])
        self._note(channel_id, time_ns)
        if not part.is_proved:
            self.unchecked += 1
            self._unproved.append((time_ns, topic))

    def _is_lost(self, part: Part, start: int, stop: int) -> bool:
        """Return whether a sector of these bytes of the file never reached the disk, and so has only zeros.

        This is so only in a log without an end.
        """
        is_doubtful = not part.is_proved or (part.kind == Kind.RECORDS and part.start >= self.survey.end)
        if self.survey.finished or not is_doubtful:
            return False
        first, last = start - start % _SECTOR_BYTES, min(stop - stop % -_SECTOR_BYTES, self.view.size)
        data = self.view.read(first, last - first)
        sectors = (data[at : at + _SECTOR_BYTES] for at in range(0, len(data), _SECTOR_BYTES))
        return not all(map(any, sectors))

    def _note(self, channel_id: int, time_ns: int) -> None:
        if self.lost and (channel_id, time_ns) in self.lost:
            self.lost[channel_id, time_ns] -= 1

    def _topic_in(self, part: Part, inside: ChunkContents, channel_id: int) -> str | None:
        """Return the topic of a channel that a chunk defines in another way than the log, else None."""
        channel = inside.channels.get(channel_id)
        if channel is None or self.writer.defines(channel):
            return None
        schema = inside.schemas.get(channel.schema_id) or self._schemas.get(channel.schema_id)
        try:
            self.writer.adopt_channel(channel, schema)
        except LogError:  # the log has this topic with another schema
            channel = replace(channel, topic=f"{_LOST}/{part.start}{channel.topic}")
            self.writer.adopt_channel(channel, schema)
        return channel.topic

    def _define(self, channel_id: int) -> None:
        """Write the definition of a channel; if it is lost, one with the topic ``/lost/<id>``."""
        if self.writer.has_channel(channel_id):
            return
        lost = mcap.Channel(channel_id, f"{_LOST}/{channel_id}", "", {}, 0)
        channel = self._channels.get(channel_id, lost)
        schema = self._schemas.get(channel.schema_id) or self._schema_of_topic(channel.topic)
        channel = replace(channel, schema_id=schema.id if schema else 0)
        if schema is not None and not self.writer.defines(schema):
            self.writer.define(schema)
        try:
            self.writer.define(channel)
        except LogError:  # the log has this topic with another schema
            self.writer.define(replace(channel, topic=f"{_LOST}/{channel_id}{channel.topic}"))

    def _schema_of_topic(self, topic: str) -> mcap.Schema | None:
        """Return the schema of another channel with the same topic."""
        schemas = (self._schemas.get(c.schema_id) for c in self._channels.values() if c.topic == topic)
        return next(filter(None, schemas), None)

    def _mark(self) -> None:
        """Write an event with the range of the last messages that no CRC confirms."""
        rows, self._unproved = self._unproved, []
        if not rows or not self.is_new:
            return
        start_ns, end_ns = min(rows)[0], max(rows)[0]
        topics = ", ".join(sorted({topic for _, topic in rows}))
        text = (
            f"{len(rows)} messages from {format_time(start_ns)} to {format_time(end_ns)} UTC are from a "
            f"damaged part of the log, and no CRC confirms them: {topics}"
        )
        name = f"ipsys.v1.{Event.__name__}"
        with suppress(LogError):  # a log of another program may have another channel of this name
            self.writer.add_channel(EVENTS_TOPIC, Schema(name, "protobuf", schema_data(name)))
            event = Event(end_ns, DAMAGED, text, start=start_ns, end=end_ns)
            self.writer.write(EVENTS_TOPIC, end_ns, end_ns, encode(event))
