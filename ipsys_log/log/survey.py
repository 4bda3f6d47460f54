"""Check of every record of a log, and the readable parts of a damaged log."""

import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.byte_source import BoundError, LogBytes, reason_of
from ipsys_log.log.chunks import ChunkContents, parse_chunk_contents, unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.record_search import IN_DATA, PRIVATE, RecordSearch, index_rows
from ipsys_log.log.records import (
    DATA_END,
    HEADER,
    MAGIC,
    MESSAGE,
    RecordAt,
    attachment_crcs,
    crc_of,
    parse_chunk_head,
    parse_exact,
    walk,
)
from ipsys_log.log.summary import Summary, add_record, count_all

_LAG = 1 << 20  # bytes: the CRC of the data section is computed in pieces of this size
_LONGEST_HEADER = 1 << 20  # bytes


@dataclass(frozen=True, slots=True)
class Watch:
    """Functions that a survey calls while it reads a log.

    `progress` gets the number of bytes that are checked. `message` gets the topic, the log time and the
    publish time in ns of each whole message, in the order of the file.
    """

    progress: Callable[[int], None] = lambda checked: None
    message: Callable[[str, int, int], None] = lambda topic, log_time_ns, publish_time_ns: None


class Kind(Enum):
    """The content of a part of a data section."""

    RECORDS = auto()  # whole records outside of chunks
    CHUNK = auto()  # a chunk, without its message indexes
    FRAME = auto()  # the compressed records of a chunk without its head
    MESSAGE = auto()  # a message with a wrong length: the next record gives the right one
    ATTACHMENT = auto()  # an attachment with a wrong CRC
    DAMAGE = auto()  # nothing that can be read


@dataclass(slots=True)
class Part:
    """The bytes of the file from `start` to `end`.

    `is_proved` says that no CRC contradicts the messages. `lost` has the channel id and the log time of each
    message in the message indexes after damage.
    """

    kind: Kind
    start: int
    end: int
    is_proved: bool = False
    lost: list[tuple[int, int]] = field(default_factory=list)


# The trust in a definition: in a summary without CRC, in records without CRC, in a summary with a right CRC,
# and in a chunk with a right CRC, unless it may be a stray copy of a sector of another log.
_UNCHECKED_SUMMARY, _UNCHECKED, _SUMMARY, _CHUNK = range(4)


@dataclass(slots=True)
class Survey:
    """A check of the data section that trusts no length, and raises no error for damage.

    A log that exceeds the limits is refused with a `BoundError`: it may be undamaged, so it is not repaired.

    Attributes
    ----------
    known : the summary of the log, if it is readable. It may have definitions that the data section lacks.
    faults : the offset and the text of each fault.
    contents, hashes : of the log before the first fault.
    schemas, channels : all known definitions by id, also those from the summary and from damaged parts.
    unindexed : the last chunk, if its message indexes are missing at the end of the log.
    finished : True if DataEnd lies at `data_end`.
    log_end : the end of the log; later bytes are not a part of it.
    crc : of the data section before `end`.
    """

    view: LogBytes
    known: Summary | None = None
    watch: Watch = field(default_factory=Watch)
    parts: list[Part] = field(default_factory=list)
    faults: list[tuple[int, str]] = field(default_factory=list)
    contents: Contents = field(default_factory=Contents)
    hashes: dict[str, ChannelHash] = field(default_factory=dict)
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    unindexed: ChunkContents | None = None
    finished: bool = False
    data_end: int = 0
    log_end: int = 0
    crc: int = 0
    search: RecordSearch = field(init=False)
    _trust: dict[tuple[bool, int], int] = field(default_factory=dict)  # by kind (a schema?) and id
    # The schemas and channels that the data section has defined so far.
    _declared: tuple[set[int], set[int]] = field(default_factory=lambda: ({0}, set()))
    _unchunked: ChunkContents = field(default_factory=ChunkContents)
    _counts: dict[int, dict[int, int]] = field(default_factory=dict)
    _crc_end: int = 0
    _in_damage: bool = False  # damage is before the next record, and no whole chunk is between them
    _has_chunks: bool = False

    def __post_init__(self) -> None:
        self.search = RecordSearch(self.view, self.channels)
        self.data_end = self.log_end = self.view.size
        if self.known is not None:
            contents, statistics, is_checked = self.known
            self._has_chunks = bool(contents.chunks)
            trust = _SUMMARY if is_checked else _UNCHECKED_SUMMARY
            for schema in contents.schemas.values():
                self._set_definition(schema, trust)
            for channel in contents.channels.values():
                self._set_definition(channel, trust)
            if is_checked and statistics and statistics.message_count:
                self._cover(statistics.message_start_time, statistics.message_end_time)
        self._read()

    @property
    def end(self) -> int:
        """The end of the beginning of the data section that has no fault."""
        return self.faults[0][0] if self.faults else self.data_end

    def topic(self, channel_id: int) -> str:
        """Return the topic of a channel, or one with its id if its definition is lost."""
        channel = self.channels.get(channel_id)
        return channel.topic if channel else f"/lost/{channel_id}"

    def _read(self) -> None:
        position = self._take_start()
        while position < self.view.size and not self.finished:
            try:
                position = self._take(position)
            except (BoundError, UnreadError):
                raise
            except LogError as error:
                position = self._skip(position, reason_of(error))
        self._advance_crc(self.end)
        if not self._has_chunks:  # else messages after damage may be pieces of a chunk with another CRC
            for part in self.parts:
                part.is_proved |= part.kind == Kind.RECORDS
        count_all(self.contents, self._unchunked, self._counts)

    def _take_start(self) -> int:
        """Check the magic bytes and the Header record; return the offset of the records after them."""
        view, start = self.view, len(MAGIC)
        try:
            if view.read(0, min(start, view.size)) != MAGIC:
                raise view.fault(0, "it does not begin as an MCAP file")
            record = next(walk(view, start, view.size), None)
            if record is None or record.opcode != Opcode.HEADER:
                return start
            if record.length > _LONGEST_HEADER:
                raise view.fault(start, f"the HEADER record claims {record.length} bytes")
            parse_exact(view, record, view.read(start, record.length))
            if self.search.inner_record(record) is not None:
                raise view.fault(start, "the Header record holds other records")
        except UnreadError:
            raise
        except LogError as error:
            return self._skip(0, reason_of(error))
        return record.offset + record.length

    def _take(self, position: int) -> int:
        """Check the bytes at `position` and add them; return their end."""
        view = self.view
        if position == self.search.frame_at:
            return self._take_frame(position)
        record = next(walk(view, position, view.size))
        if record.opcode == Opcode.CHUNK:
            return self._take_chunk(record)
        if record.opcode == Opcode.MESSAGE_INDEX:
            return self._take_stray_index(record)
        if record.opcode == Opcode.DATA_END and record.length == DATA_END.size:
            return self._take_data_end(position)
        if record.opcode not in IN_DATA and record.opcode < PRIVATE:
            raise view.fault(position, f"a record of type {record.opcode} is not allowed there")
        return self._take_loose(record)

    def _take_data_end(self, position: int) -> int:
        self._advance_crc(position)
        stop = position + DATA_END.size
        stored = DATA_END.unpack(self.view.read(position, DATA_END.size))[2]
        is_right = stored == self.crc and not self.faults
        log_end = self.search.end_of_log(stop)
        if log_end is None and not (stored and is_right) and self.search.find(position + 1) is not None:
            raise self.view.fault(position, "records follow after a DataEnd record")
        self.finished, self.data_end, self.unindexed = True, position, None
        self.log_end = self.log_end if log_end is None else log_end
        if stored and not is_right and not self.faults:
            text = "the CRC of the data section is wrong; the position of the damage is unknown"
            self.faults.append((position, text))
        return self.view.size

    def _take_loose(self, record: RecordAt) -> int:
        """Check and add a record outside of chunks; return its end."""
        view, stop = self.view, record.offset + record.length
        if record.opcode == Opcode.MESSAGE and record.length < MESSAGE.size:
            raise view.fault(record.offset, "a Message record is too short")
        definition = self.search.parse_definition(record)
        inner = self.search.inner_record(record)
        if inner is not None:
            text = f"a record claims {record.length} bytes, which hold other records"
            is_message = record.opcode == Opcode.MESSAGE and inner - record.offset >= MESSAGE.size
            if not is_message or record.offset == self.search.damage_end:
                raise view.fault(record.offset, text)
            self.faults.append((record.offset, text))
            self.parts.append(Part(Kind.MESSAGE, record.offset, inner))
            return inner
        if definition is not None:
            self._define(record.offset, definition, _UNCHECKED)
        elif record.opcode == Opcode.MESSAGE:
            _, _, channel, _, time_ns, published_ns = MESSAGE.unpack(view.read(record.offset, MESSAGE.size))
            self._check_channels(record.offset, {channel})
            self._cover(time_ns, time_ns)
            self.watch.message(self.topic(channel), time_ns, published_ns)
        elif record.opcode == Opcode.ATTACHMENT:
            stored, crc = attachment_crcs(view, record)
            if stored not in (0, crc):
                self.faults.append((record.offset, "the CRC of an attachment is wrong"))
                self.parts.append(Part(Kind.ATTACHMENT, record.offset, stop))
                return stop
        self.unindexed = None
        if not self.faults:
            add_record(view, self.contents, self._unchunked, self._counts, record)
        self._add_records(record.offset, stop)
        self._advance_crc(stop, _LAG)
        return stop

    def _add_records(self, start: int, stop: int) -> None:
        last = self.parts[-1] if self.parts else None
        is_next = (
            last and last.kind == Kind.RECORDS and (last.end, last.is_proved) == (start, not self._in_damage)
        )
        if last and is_next and self.end != start:
            last.end = stop
        else:
            self.parts.append(Part(Kind.RECORDS, start, stop, not self._in_damage))

    def _take_chunk(self, record: RecordAt) -> int:
        """Check and add a chunk with its message indexes; return their end."""
        view, stop = self.view, record.offset + record.length
        head = parse_chunk_head(view, record.offset)[1]
        data = unpack(view, record.offset, head, is_crc_checked=False)
        inside = parse_chunk_contents(view, record.offset, data)
        is_right = inside.is_exact and head.crc in (0, zlib.crc32(data))
        if not (head.compression or (head.crc and is_right)) and inside.entries:
            offset = inside.in_order()[-1][0]
            length = HEADER.size + HEADER.unpack_from(data, offset)[1]
            last = RecordAt(Opcode.MESSAGE, head.data_offset + offset, length)
            if self.search.inner_record(last) is not None:
                raise view.fault(record.offset, "the last message in a chunk holds other records")
        if not is_right:
            text = "the CRC of the chunk is wrong" if inside.is_exact else "the chunk has a wrong definition"
            self.faults.append((record.offset, text))
        is_mine = not self._in_damage or self.search.leads_to(record.offset, view.size)
        trust = _UNCHECKED if inside.is_exact else _UNCHECKED_SUMMARY
        self._add_inside(record.offset, inside, _CHUNK if head.crc and is_right and is_mine else trust)
        self.parts.append(Part(Kind.CHUNK, record.offset, stop, is_right))
        self._has_chunks, self._in_damage = True, self._in_damage and not is_right
        end, offsets, is_complete = self.search.read_indexes(inside.entries, stop)
        self.unindexed = None if is_complete or not is_right else inside
        if not self.faults:
            add_record(view, self.contents, self._unchunked, self._counts, record)
            self._counts[record.offset] = {key: len(rows) for key, rows in inside.entries.items()}
            start_ns, end_ns = inside.span_ns or (head.start_ns, head.end_ns)
            self.contents.chunks[-1] = self.contents.chunks[-1]._replace(
                start_ns=start_ns, end_ns=end_ns,  # those in its head may be wrong
                index_length=end - stop if is_complete else 0, index_offsets=offsets if is_complete else {},
            )  # fmt: skip
            self._continue_hashes(inside, data)
        if not is_complete and end > stop:
            self.faults.append((stop, "the message indexes of a chunk are not complete"))
            self._in_damage = True
        self._advance_crc(stop if self.unindexed else end, _LAG)
        return end

    def _take_stray_index(self, record: RecordAt) -> int:
        """Use a message index after damage: it names the messages that were there."""
        channel, rows = index_rows(self.view, record)
        if not self.parts or not self.faults or self.search.inner_record(record) is not None:
            raise self.view.fault(record.offset, "a MessageIndex record follows no chunk")
        self.parts[-1].lost += [(channel, time_ns) for time_ns, _ in rows]
        self._has_chunks = True
        return record.offset + record.length

    def _take_frame(self, offset: int) -> int:
        """Add the compressed records of a chunk without its head; return their end."""
        data, end, is_whole = self.search.read_frame(offset)
        is_proved = is_whole and self.search.frame_crc(offset) in (0, zlib.crc32(data))
        inside = parse_chunk_contents(self.view, offset, data)
        self._add_inside(offset, inside, _CHUNK if is_proved else _UNCHECKED)
        self._has_chunks = True
        self.parts.append(Part(Kind.FRAME, offset, end, is_proved))
        return end if is_whole else self._add_damage(end, end)

    def _add_inside(self, offset: int, inside: ChunkContents, trust: int) -> None:
        """Add the definitions of a chunk, and check that its messages have channels."""
        definitions: list[mcap.Schema | mcap.Channel] = [*inside.schemas.values(), *inside.channels.values()]
        for definition in definitions:
            self._define(offset, definition, trust)
        self._check_channels(offset, inside.entries.keys())
        if inside.span_ns is not None:
            self._cover(*inside.span_ns)

    def _define(self, offset: int, record: mcap.Schema | mcap.Channel, trust: int) -> None:
        """Add a definition in the data section; it must agree with others of its id."""
        is_schema = isinstance(record, mcap.Schema)
        known: dict[int, Any] = self.schemas if is_schema else self.channels
        if known.get(record.id, record) != record:
            text = f"{'schema' if is_schema else 'channel'} {record.id} is defined in two ways"
            self.faults.append((offset, text))
        elif isinstance(record, mcap.Channel) and record.schema_id not in self._declared[0]:
            self.faults.append((offset, f"channel {record.id} has a schema that is not in the log"))
        else:
            self._declared[not is_schema].add(record.id)
        self._set_definition(record, trust)
        if not self.faults:
            mine: dict[int, Any] = self._unchunked.schemas if is_schema else self._unchunked.channels
            mine.setdefault(record.id, record)

    def _set_definition(self, record: mcap.Schema | mcap.Channel, trust: int) -> None:
        """Note a definition: the most trusted one of an id counts, and the first of equal trust."""
        is_schema = isinstance(record, mcap.Schema)
        known: dict[int, Any] = self.schemas if is_schema else self.channels
        if trust > self._trust.get((is_schema, record.id), -1):
            self._trust[is_schema, record.id] = trust
            known[record.id] = record
            self.view.check_number(len(known), "schemas" if is_schema else "channels")

    def _check_channels(self, offset: int, channels: Collection[int]) -> None:
        for channel in set(channels) - self._declared[1]:
            self.faults.append((offset, f"a message is of channel {channel}, whose definition is lost"))
            self._declared[1].add(channel)
        self.view.check_number(len(self._declared[1]), "channels")

    def _cover(self, start_ns: int, end_ns: int) -> None:
        first, last = self.search.span_ns or (start_ns, end_ns)
        self.search.span_ns = min(first, start_ns), max(last, end_ns)

    def _continue_hashes(self, inside: ChunkContents, data: bytes) -> None:
        for offset, key in inside.in_order():
            topic = self.topic(key)
            _, length, _, _, time_ns, published_ns = MESSAGE.unpack_from(data, offset)
            payload = data[offset + MESSAGE.size : offset + HEADER.size + length]
            self.hashes.setdefault(topic, ChannelHash()).add(time_ns, published_ns, payload)
            self.watch.message(topic, time_ns, published_ns)

    def _advance_crc(self, position: int, lag: int = 0) -> None:
        """Continue the CRC of the data section up to `position`, or up to the first fault."""
        if position - self._crc_end > lag:
            stop = min(position, self.end)
            self.crc = crc_of(self.view, stop - self._crc_end, self._crc_end, self.crc)
            self._crc_end = stop
            self.watch.progress(position)

    def _skip(self, position: int, reason: str) -> int:
        """Note damage at `position`; return the offset of the next bytes that prove themselves."""
        self.faults.append((position, reason))
        self._has_chunks |= self.view.read(position, 1) == bytes([Opcode.CHUNK])
        return self._add_damage(position, position + 1)

    def _add_damage(self, start: int, search_from: int) -> int:
        follower = self.search.find(search_from)
        end = self.view.size if follower is None else follower
        if end > start:
            self.parts.append(Part(Kind.DAMAGE, start, end))
        self.search.damage_end, self._in_damage = end, True
        return end
