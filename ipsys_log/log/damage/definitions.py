"""Schemas and channels of a data section, in file order, with substitutes for lost definitions."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import ChunkContents
from ipsys_log.log.contents import Contents
from ipsys_log.log.damage.regions import DamagedRange
from ipsys_log.log.records import MESSAGE, RecordAt, parse_exact, to_bytes, walk
from ipsys_log.log.summary import Summary

_MOST_MISREAD = 100
_MOST_FREE_RANGES = 50  # ranges that are tried
_LARGEST = 1 << 28  # bytes: limit of the memory for one definition


def placeholder(channel_id: int) -> mcap.Channel:
    """Return a substitute for a lost channel; its record is not longer than any record that it replaces."""
    return mcap.Channel(channel_id, f"/lost/{channel_id}", "", {}, 0)


@dataclass(slots=True)
class Definitions:
    """The definitions up to the current offset, by id.

    `known` holds definitions of the summary or of damaged chunks; they replace missing definitions of the
    data section. If the CRC of the summary is right, a record that contradicts it is damaged.
    `free_ranges` are the damaged ranges so far: lost definitions are written there.
    """

    summary: Summary | None
    free_ranges: list[DamagedRange]
    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    known: ChunkContents = field(default_factory=ChunkContents)
    _schema_at: dict[int, int] = field(default_factory=dict)  # offset of the definition of each schema
    _sure: Contents | None = None
    _checked: set[tuple[bool, int]] = field(default_factory=set)  # schemas and channels with a valid CRC
    _places: dict[tuple[bool, int], RecordAt] = field(default_factory=dict)  # definitions in no chunk
    _full: int = 0  # number of the first rooms that are full
    _misread: list[mcap.Channel] = field(default_factory=list)
    _unused: dict[int, RecordAt] = field(default_factory=dict)  # records of channels without messages so far
    _doubtful: set[tuple[bool, int]] = field(default_factory=set)  # schemas and channels read after damage
    _strange: set[int] = field(default_factory=set)  # offsets of chunks that contradict other definitions
    _lost: set[int] = field(default_factory=set)  # channels of messages for which no room was left

    def __post_init__(self) -> None:
        if self.summary is not None:
            contents, statistics, checked = self.summary
            self.known = ChunkContents(dict(contents.schemas), dict(contents.channels))
            counts = (len(contents.schemas), len(contents.channels))
            if checked and statistics and counts == (statistics.schema_count, statistics.channel_count):
                self._sure = contents

    def add_record(self, view: LogBytes, record_at: RecordAt, *, doubtful: bool = False) -> None:
        """Add a Schema or Channel record outside of chunks; `doubtful` says that damage is near.

        Raises
        ------
        LogError
            The record cannot be parsed, or contradicts the summary or an earlier record.
        """
        if record_at.length > _LARGEST:
            raise view.fault(record_at.offset, f"a definition claims {record_at.length} bytes")
        record = parse_exact(view, record_at, view.read(record_at.offset, record_at.length))
        if isinstance(record, mcap.Schema):
            if record.id == 0 or self._contradicts(record):
                raise view.fault(record_at.offset, f"the definition of schema {record.id} is damaged")
            self.schemas[record.id] = record
            self._schema_at.setdefault(record.id, record_at.offset)
            self._places[True, record.id] = record_at
            self._note_doubt((True, record.id), doubtful=doubtful)
            return
        assert isinstance(record, mcap.Channel)
        channel = record
        if self._contradicts(channel):
            if len(self._misread) < _MOST_MISREAD:
                self._misread.append(channel)
            raise view.fault(record_at.offset, f"the definition of channel {channel.id} is damaged")
        if not self._has_schema(channel):
            raise view.fault(record_at.offset, f"channel {channel.id} has a schema that is not in the log")
        if channel.id not in self.channels:
            self._unused[channel.id] = record_at
            self._places[False, channel.id] = record_at
        self._note_doubt((False, channel.id), doubtful=doubtful)
        self.channels[channel.id] = channel

    def _note_doubt(self, key: tuple[bool, int], *, doubtful: bool) -> None:
        if doubtful:
            self._doubtful.add(key)
        else:
            self._doubtful.discard(key)

    def take_chunk(
        self,
        view: LogBytes,
        offset: int,
        inside: ChunkContents,
        *,
        checked: bool,
        doubtful: bool = False,
        alone: bool = False,
    ) -> None:
        """Add the definitions of a chunk, and check that all its messages have a channel.

        A chunk that is `checked` by its CRC takes precedence over definitions outside of chunks. Near damage
        (`doubtful`) the chunk may be a piece of another log. Then it must agree with the definitions before
        the damage that have messages. If damage also follows the chunk (`alone`), it must agree with all
        definitions before the damage.

        Raises
        ------
        LogError
            A definition is lost and cannot be restored.
        """
        records: list[mcap.Schema | mcap.Channel] = [*inside.schemas.values(), *inside.channels.values()]
        for record in records:
            if self._contradicts(record, checked=checked, doubtful=doubtful, alone=alone):
                self._strange.add(offset)
                raise view.fault(offset, "a definition in the chunk contradicts another one")
        for channel in inside.channels.values():
            if channel.schema_id not in inside.schemas and not self._has_schema(channel):
                raise view.fault(offset, f"channel {channel.id} has a schema that is not in the log")
        for channel_id in inside.entries:
            self._unused.pop(channel_id, None)
        for channel_id in inside.entries.keys() - inside.channels.keys():
            self.ensure_channel(view, offset, channel_id)
        if checked:
            self._confirm(records)
        for key, schema in inside.schemas.items():
            self.schemas.setdefault(key, schema)
            self._schema_at.setdefault(key, offset)
        self.channels |= {key: value for key, value in inside.channels.items() if key not in self.channels}

    def ensure_channel(self, view: LogBytes, offset: int, channel_id: int) -> None:
        """Ensure that the channel of a message at `offset` is defined, if necessary by a placeholder.

        Raises
        ------
        LogError
            No range before `offset` has room for the definition.
        BoundError
            The log has more channels than its file size allows.
        """
        self._unused.pop(channel_id, None)
        if channel_id in self.channels:
            return
        known = self.known.channels.get(channel_id) or self._by_one_bit(view, offset, channel_id)
        channel = known or placeholder(channel_id)
        if not self._restore(channel):
            self._lost.add(channel_id)
            view.check_number(len(self.channels) + len(self._lost), "channels")
            raise view.fault(offset, f"a message is of channel {channel_id}, whose definition is lost")
        self.channels[channel_id] = channel

    def topic(self, channel_id: int) -> str:
        """Return the topic of a channel, or its id if the topic is not known."""
        channel = self.channels.get(channel_id) or self.known.channels.get(channel_id)
        return channel.topic if channel else f"channel {channel_id}"

    def missing(self, channel_ids: set[int], defined: ChunkContents) -> Iterator[mcap.McapRecord]:
        """Yield the records that must come before messages of these channels; `defined` may have them."""
        schemas, channels = defined.schemas | self.known.schemas, defined.channels | self.known.channels
        for channel_id in sorted(channel_ids - self.channels.keys()):
            channel = channels.get(channel_id) or placeholder(channel_id)
            if channel.schema_id and channel.schema_id not in self.schemas:
                schema = schemas.get(channel.schema_id) or _empty_schema(channel.schema_id)
                self.schemas[schema.id] = schema
                yield schema
            self.channels[channel_id] = channel
            yield channel

    def complete(self) -> None:
        """Add the definitions of the summary that no message needs."""
        for channel in self._sure.channels.values() if self._sure else ():
            self.channels.setdefault(channel.id, channel)
        for schema in self._sure.schemas.values() if self._sure else ():
            self.schemas.setdefault(schema.id, schema)

    def _confirm(self, records: Sequence[mcap.Schema | mcap.Channel]) -> None:
        """Replace definitions without CRC by definitions with a valid CRC; blank the replaced records."""
        for record in records:
            key = (isinstance(record, mcap.Schema), record.id)
            defined: dict[int, Any] = self.schemas if key[0] else self.channels
            if key not in self._checked and defined.get(record.id, record) != record:
                self._blank(defined, key)
                users = [c.id for c in self.channels.values() if key[0] and c.schema_id == record.id]
                for channel_id in users:
                    self._blank(self.channels, (False, channel_id))
            self._checked.add(key)

    def _blank(self, mine: dict[int, Any], key: tuple[bool, int]) -> None:
        del mine[key[1]]
        record_at = self._places.pop(key, None)
        if record_at is not None:
            self.free_ranges.append(DamagedRange(record_at.offset, record_at.length))

    def is_foreign(self, offset: int, inside: ChunkContents) -> bool:
        """Return whether a chunk with a valid CRC defines an id of this log differently."""
        if offset in self._strange:
            return True
        records: list[mcap.Schema | mcap.Channel] = [*inside.schemas.values(), *inside.channels.values()]
        return any(self._contradicts(record, checked=True) for record in records)

    def _contradicts(
        self,
        record: mcap.Schema | mcap.Channel,
        *,
        checked: bool = False,
        doubtful: bool = False,
        alone: bool = False,
    ) -> bool:
        """Return whether other definitions contradict a record.

        Only `checked` definitions count against a `checked` record. See `take_chunk` for records near damage.
        """
        schema = isinstance(record, mcap.Schema)
        defined: Mapping[int, mcap.Schema | mcap.Channel] = self.schemas if schema else self.channels
        key = (schema, record.id)
        is_sure = not checked or key in self._checked
        is_sure |= doubtful and key not in self._doubtful and (alone or self._is_used(key))
        if is_sure and record.id in defined and defined[record.id] != record:
            return True
        if self._sure is None:
            return False
        sure: Mapping[int, mcap.Schema | mcap.Channel] = self._sure.schemas if schema else self._sure.channels
        return sure.get(record.id) != record

    def _is_used(self, key: tuple[bool, int]) -> bool:
        """Return whether a message needs this schema or channel."""
        is_schema, record_id = key
        used = self.channels.keys() - self._unused.keys()
        if is_schema:
            return any(self.channels[channel_id].schema_id == record_id for channel_id in used)
        return record_id in used

    def _has_schema(self, channel: mcap.Channel) -> bool:
        """Return whether the schema of a channel is defined before it, or can be restored."""
        key = channel.schema_id
        if key == 0 or key in self.schemas:
            return True
        known = self.known.schemas.get(key)
        schema = known or _empty_schema(key)
        room = self._room_for(to_bytes(schema), 0)
        if room is None:  # both are restored later, in a range with room for both
            self.known.channels.setdefault(channel.id, channel if known else replace(channel, schema_id=0))
            return False
        self.schemas[key] = schema
        self._schema_at[key] = room.offset
        return True

    def _restore(self, channel: mcap.Channel) -> bool:
        """Write a channel into a damaged range: after its schema, or together with it."""
        key, data = channel.schema_id, to_bytes(channel)
        if key == 0:
            return self._room_for(data, 0) is not None
        if key in self.schemas and self._room_for(data, self._schema_at.get(key, 0)) is not None:
            return True
        schema = self.schemas.get(key) or self.known.schemas.get(key) or _empty_schema(key)
        room = self._room_for(to_bytes(schema) + data, 0)
        if room is not None:
            self.schemas[key] = schema
            self._schema_at[key] = min(room.offset, self._schema_at.get(key, room.offset))
        return room is not None

    def _room_for(self, data: bytes, start: int) -> DamagedRange | None:
        """Put records into the first range from `start` on that has room for them."""
        while self._full < len(self.free_ranges) - 1 and self.free_ranges[self._full].is_full:
            self._full += 1
        rooms = islice(self.free_ranges, self._full, self._full + _MOST_FREE_RANGES)
        return next((room for room in rooms if room.offset >= start and room.define(data)), None)

    def _by_one_bit(self, view: LogBytes, offset: int, channel_id: int) -> mcap.Channel | None:
        """Return the channel without messages whose id differs from `channel_id` in one bit.

        If this channel has messages after the message at `offset`, the id in that message is wrong.
        """
        records = [record for record in self._misread if (record.id ^ channel_id).bit_count() == 1]
        if not self.free_ranges:  # its record looks whole, but its channel has no messages
            near = [key for key in self._unused if (key ^ channel_id).bit_count() == 1]
            unused = [key for key in near if not _has_message(view, offset, key)]
            records = [self.channels[key] for key in unused]
            if len(records) == 1:
                record_at = self._unused.pop(unused[0])
                self.free_ranges.append(DamagedRange(record_at.offset, record_at.length))
                del self.channels[unused[0]]
        return replace(records[0], id=channel_id) if len(records) == 1 else None


def _has_message(view: LogBytes, start: int, channel_id: int) -> bool:
    """Return whether a message of a channel lies outside of chunks, from `start` up to the next damage."""
    with suppress(LogError):
        for record_at in walk(view, start, view.size):
            is_message = record_at.opcode == Opcode.MESSAGE and record_at.length >= MESSAGE.size
            if is_message and MESSAGE.unpack(view.read(record_at.offset, MESSAGE.size))[2] == channel_id:
                return True
    return False


def _empty_schema(schema_id: int) -> mcap.Schema:
    return mcap.Schema(schema_id, b"", "", "")
