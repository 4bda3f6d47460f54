"""Recovery of plausible messages from a chunk that is cut off or damaged."""

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import IO, NamedTuple

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunk_builder import IMAGES, ChunkBuilder
from ipsys_log.log.chunks import ChunkContents, parse_chunk_contents, unpack
from ipsys_log.log.damage.definitions import Definitions, placeholder
from ipsys_log.log.damage.regions import DamagedRange
from ipsys_log.log.damage.resync import PRIVATE
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import HEADER, MESSAGE, ChunkRef, RecordAt, parse_chunk_head
from ipsys_log.units import format_time

_SECTOR = 512
_MOST = 256 << 20  # bytes: limit for one chunk
_READ = 1 << 20
_PIECE = 256  # compressed bytes at a time: the output of the pieces before an error is kept
_BLOCK = 128 << 10  # the largest block of a zstd frame: damage spoils all of it
_LARGEST_RATIO = 200  # no recorded data compress better
_MOST_OF_LITTLE = 16 << 20  # bytes of output: the ratio counts only above this
_LARGEST_WINDOW = 128 << 20
_HEAD = struct.Struct("<BQQQQII")  # opcode, length, start, end, size, CRC, length of the compression's name
_SIZE = struct.Struct("<Q")

Buffer = bytes | bytearray
Rows = Mapping[int, list[tuple[int, int]]]  # by channel id: log time in ns, offset in the chunk


class _Records(NamedTuple):
    """The records of a damaged chunk, as far as they can be decoded.

    `checked` says that all records are present with a valid CRC, `is_wrong` that all are present with a
    wrong CRC. `ends_early` says that the rest is missing, or cannot be decoded. `size` is the stated size
    of the chunk in bytes.
    """

    data: Buffer
    checked: bool
    is_wrong: bool
    ends_early: bool
    compressed: bool
    data_offset: int
    size: int
    span: str

    def spoiled(self, offset: int) -> int:
        """Return the start of the block or sector that holds the implausible bytes at `offset`."""
        if self.compressed:
            return offset - offset % _BLOCK
        return max(0, offset - (self.data_offset + offset) % _SECTOR)


class Saved(NamedTuple):
    """The messages saved from one range: the channel id and the offset in the chunk of each message.

    `torn` has the channel id and log time of an incomplete message. `counted` says that the range has no
    other messages. `share` is the saved fraction of the range.
    """

    messages: frozenset[tuple[int, int]] = frozenset()
    torn: tuple[tuple[int, int], ...] = ()
    counted: bool = False
    note: str = ""
    share: float = 0.0


@dataclass(slots=True)
class Salvage:
    """Messages saved into new chunks, which are kept in `spool` until they are written to the log.

    `inside` has the definitions of the damaged chunks. `unchecked` counts messages whose CRC cannot be
    checked.
    """

    spool: IO[bytes]
    chunks: list[ChunkRef] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    inside: ChunkContents = field(default_factory=ChunkContents)
    unchecked: int = 0
    size: int = 0
    _builder: ChunkBuilder = field(default_factory=lambda: ChunkBuilder(IMAGES, compress=False))

    def save(
        self,
        view: LogBytes,
        damaged_range: DamagedRange,
        rows: Rows,
        definitions: Definitions,
        hashes: dict[str, ChannelHash],
        *,
        in_order: bool,
    ) -> Saved:
        """Save the plausible messages of the chunk that begins with `damaged_range`, if there is a chunk.

        A chunk that is cut off ends with its last whole message. A sector that never reached the disk reads
        as zeros: all data from this sector on are rejected. If a record is not plausible, its whole sector
        is rejected. If the CRC is wrong and all records are plausible, the damaged record is unknown. Then
        no message is saved.

        Parameters
        ----------
        rows
            The entries of the chunk's message indexes; a message must agree with them.
        in_order
            The saved messages keep their position, after all others.
        """
        records = _records_of(view, damaged_range)
        if records is None:
            return Saved()
        channels = definitions.channels | definitions.known.channels
        messages, inside, torn, complete = _plausible_records(view, records, rows, channels)
        if records.checked and definitions.is_foreign(damaged_range.offset, inside):
            return Saved(note=f"the chunk at byte {damaged_range.offset} belongs to another log")
        for key, value in inside.schemas.items():
            self.inside.schemas.setdefault(key, value)
            definitions.known.schemas.setdefault(key, value)
        for key, channel in inside.channels.items():
            self.inside.channels.setdefault(key, channel)
            definitions.known.channels.setdefault(key, channel)
        topics = {key: channel.topic for key, channel in (inside.channels | channels).items()}
        for channel_id, start, stop in messages:
            self._add(records.data, channel_id, start, stop, topics, hashes, in_order=in_order)
        if not records.checked:
            self.unchecked += len(messages)
        note = _note(damaged_range, records, len(messages), complete=complete)
        saved = frozenset((channel_id, start) for channel_id, start, _ in messages)
        size = sum(stop - start for _, start, stop in messages)
        part = (
            size / max(records.size, size, 1) if records.compressed else min(1.0, size / damaged_range.length)
        )
        return Saved(saved, torn, complete or bool(rows), note, 1.0 if complete else part)

    def finish(self) -> None:
        """Write the last chunk into the spool."""
        chunk = self._builder.build(0)
        if chunk is None:
            return
        ref, data, _ = chunk
        offsets = {channel: offset + self.size for channel, offset in ref.index_offsets.items()}
        self.chunks.append(ref._replace(offset=self.size, index_offsets=offsets))
        for channel, number in self._builder.counts.items():
            self.counts[channel] = self.counts.get(channel, 0) + number
        self.spool.write(data)
        self.size += len(data)
        self._builder.clear()

    def _add(
        self,
        data: Buffer,
        channel_id: int,
        start: int,
        stop: int,
        topics: Mapping[int, str],
        hashes: dict[str, ChannelHash],
        *,
        in_order: bool,
    ) -> None:
        _, _, _, sequence, time_ns, published_ns = MESSAGE.unpack_from(data, start)
        payload = bytes(data[start + MESSAGE.size : stop])
        crc = zlib.crc32(payload)
        if self._builder.is_full(time_ns):
            self.finish()
        self._builder.add(channel_id, sequence, time_ns, published_ns, payload, crc)
        topic = topics.get(channel_id) or placeholder(channel_id).topic
        state = hashes.setdefault(topic, ChannelHash())
        state.add_row(time_ns, published_ns, len(payload), crc)
        state.valid &= in_order


def _note(damaged_range: DamagedRange, records: _Records, count: int, *, complete: bool) -> str:
    chunk_text = f"the chunk at byte {damaged_range.offset} ({records.span})"
    if records.checked:
        return (
            f"all {count} messages of {chunk_text} were copied: the chunk has a valid CRC, but "
            "cannot stay in place"
        )
    if count:
        count_text = "all" if complete else "the first"
        return f"{count_text} {count} messages of {chunk_text} were saved; their CRC cannot be checked"
    if records.ends_early or not records.data:
        return f"{chunk_text} has no readable message"
    return f"{chunk_text}: one of its messages is damaged, but it is unknown which, so none was saved"


def _records_of(view: LogBytes, damaged_range: DamagedRange) -> _Records | None:
    """Decode a chunk as far as possible; return None if there is no chunk."""
    head = view.read(damaged_range.offset, min(_HEAD.size + 4 + _SIZE.size, damaged_range.length))
    if len(head) < _HEAD.size + _SIZE.size:
        return None
    opcode, length, start_ns, end_ns, size, crc, name_length = _HEAD.unpack_from(head)
    name = head[_HEAD.size : _HEAD.size + min(name_length, 4)]
    if opcode != Opcode.CHUNK or name_length > 4 or name not in (b"", b"zstd", b"lz4"):
        return None
    if len(head) < _HEAD.size + name_length + _SIZE.size:
        return None
    (packed,) = _SIZE.unpack_from(head, _HEAD.size + name_length)
    data_offset = damaged_range.offset + _HEAD.size + name_length + _SIZE.size
    if length + HEADER.size != data_offset - damaged_range.offset + packed:
        return None
    span = f"{format_time(start_ns)} to {format_time(end_ns)} UTC"
    if data_offset + packed <= damaged_range.end:
        try:
            data: Buffer = unpack(view, damaged_range.offset, parse_chunk_head(view, damaged_range.offset)[1])
        except LogError:
            pass
        else:
            return _Records(data, crc != 0, False, False, bool(name), data_offset, size, span)
    readable = up_to_first_hole(view, data_offset, min(packed, damaged_range.end - data_offset))
    data, ends_early = _decode(view, name, data_offset, readable)
    ends_early |= readable < packed
    is_right = zlib.crc32(data) == crc
    checked = not ends_early and crc != 0 and is_right
    is_wrong = not ends_early and crc != 0 and not is_right
    return _Records(data, checked, is_wrong, ends_early, bool(name), data_offset, size, span)


def _decode(view: LogBytes, name: bytes, offset: int, length: int) -> tuple[Buffer, bool]:
    """Decode compressed bytes up to their end, an error, or the size limit.

    Return the data, and whether an error or the limit stopped the decoder.
    """
    if not name:
        return view.read(offset, min(length, _MOST)), length > _MOST
    decompress = _decompressor(name)
    data, read = bytearray(), 0
    try:
        for piece in _pieces(view, offset, length):
            data += decompress(piece)
            read += len(piece)
            if len(data) > min(_MOST, max(_MOST_OF_LITTLE, _LARGEST_RATIO * read)):
                return data, True
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
        return data, True
    return data, False


def _decompressor(name: bytes) -> Callable[[bytes], bytes]:
    if name == b"zstd":
        return zstandard.ZstdDecompressor(max_window_size=_LARGEST_WINDOW).decompressobj().decompress
    decompress: Callable[[bytes], bytes] = lz4.frame.LZ4FrameDecompressor().decompress
    return decompress


def _pieces(view: LogBytes, offset: int, length: int) -> Iterator[bytes]:
    for position in range(offset, offset + length, _READ):
        block = view.read(position, min(_READ, offset + length - position))
        for start in range(0, len(block), _PIECE):
            yield block[start : start + _PIECE]


def up_to_first_hole(view: LogBytes, offset: int, length: int) -> int:
    """Return the number of bytes before the first sector of zeros."""
    zeros = bytes(_SECTOR)
    sector = offset + -offset % _SECTOR
    for start in range(sector, offset + length, _READ):
        block = view.read(start, min(_READ, offset + length - start))
        position = block.find(zeros)
        while position >= 0:
            hole = position + -position % _SECTOR
            if block[hole : hole + _SECTOR] == zeros:
                return start + hole - offset
            position = block.find(zeros, hole + 1)
    return length


class _PlausibleRecords(NamedTuple):
    """The plausible messages (channel id, start, stop) and definitions, and an incomplete message."""

    messages: list[tuple[int, int, int]]
    inside: ChunkContents
    torn: tuple[tuple[int, int], ...] = ()
    is_all: bool = False


def _plausible_records(
    view: LogBytes, records: _Records, rows: Rows, channels: Mapping[int, object]
) -> _PlausibleRecords:
    data = records.data
    named = {(channel, time_ns, offset) for channel, entries in rows.items() for time_ns, offset in entries}
    inside, starts = ChunkContents(), list[RecordAt]()
    position, is_plausible = 0, True
    while is_plausible and position + HEADER.size <= len(data):
        record_at = RecordAt(*_head(data, position))
        is_plausible = _is_plausible(view, data, record_at, inside)
        if is_plausible and record_at.opcode == Opcode.MESSAGE and position + MESSAGE.size <= len(data):
            _, _, channel, _, time_ns, _ = MESSAGE.unpack_from(data, position)
            is_plausible = channel in channels or channel in inside.channels or records.checked
            is_plausible &= channel not in rows or (channel, time_ns, position) in named
        if not is_plausible or position + record_at.length > len(data):
            break
        starts.append(record_at)
        position += record_at.length
    return _up_to(records, inside, starts, position, is_plausible=is_plausible)


def _head(data: Buffer, position: int) -> tuple[int, int, int]:
    opcode, length = HEADER.unpack_from(data, position)
    return opcode, position, HEADER.size + length


def _is_plausible(view: LogBytes, data: Buffer, record: RecordAt, inside: ChunkContents) -> bool:
    """Return whether the record may lie in a chunk; add its definitions to `inside`."""
    if record.opcode == Opcode.MESSAGE:
        return MESSAGE.size <= record.length <= _MOST
    if record.opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
        return record.opcode >= PRIVATE
    if record.offset + record.length <= len(data):
        try:
            record_inside = parse_chunk_contents(
                view, 0, bytes(data[record.offset : record.offset + record.length])
            )
        except LogError:
            return False
        inside.schemas |= record_inside.schemas
        inside.channels |= record_inside.channels
    return True


def _up_to(
    records: _Records, inside: ChunkContents, starts: list[RecordAt], position: int, *, is_plausible: bool
) -> _PlausibleRecords:
    """Select the plausible records; `position` is their end."""
    data = records.data
    whole = position == len(data)
    if not is_plausible or (not whole and not records.ends_early):
        sound = records.spoiled(position)
    else:
        sound = len(data) if records.ends_early or not records.is_wrong else 0
    messages = [
        (
            MESSAGE.unpack_from(data, record_at.offset)[2],
            record_at.offset,
            record_at.offset + record_at.length,
        )
        for record_at in starts
        if record_at.opcode == Opcode.MESSAGE and record_at.offset + record_at.length <= sound
    ]
    torn: tuple[tuple[int, int], ...] = ()
    if sound == len(data) and position + MESSAGE.size <= sound and data[position] == Opcode.MESSAGE:
        _, _, channel, _, time_ns, _ = MESSAGE.unpack_from(data, position)
        torn = ((channel, time_ns),)
    is_all = whole and sound == len(data) and not records.ends_early
    return _PlausibleRecords(messages, inside if sound else ChunkContents(), torn, is_all)
