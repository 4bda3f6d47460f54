"""MCAP records: bounded parsing of untrusted bytes, and bytes of new records.

The layouts follow the MCAP specification, https://mcap.dev/spec. The record classes come from ``mcap``.
"""

import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from io import BytesIO
from typing import NamedTuple, Self, TypeVar

from mcap import records as mcap
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from ipsys_log.log.byte_source import LogBytes

MAGIC = b"\x89MCAP0\r\n"
HEADER = struct.Struct("<BQ")  # opcode, length of the rest
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
DATA_END = struct.Struct("<BQI")
FOOTER = struct.Struct("<BQQQI")
ENTRY = struct.Struct("<QQ")  # in a message index: log time in ns, offset in the chunk
INDEX_HEAD = struct.Struct("<BQHI")  # opcode, length, channel, bytes of entries
HEAD_SIZE = HEADER.size
MESSAGE_HEAD_SIZE = MESSAGE.size  # bytes from a message's opcode to its payload
CHUNK_HEAD_SIZE = 49  # bytes from a chunk's opcode to its data, without the name of the compression
_CHUNK = struct.Struct("<QQQI")  # start, end, uncompressed size, CRC
_CHUNK_INDEX = struct.Struct("<QQQQI")  # start, end, offset, length, bytes of the map that follows
_PACKED = struct.Struct("<QQQQQQQI")  # the numbers of a ChunkRef, bytes of the map that follows
_CHANNEL_OFFSET = struct.Struct("<HQ")
_WALK_BLOCK = 4096
_LONGEST_NAME = 64
_LONGEST_ATTACHMENT_HEAD = 1 << 16  # bytes
_CRC_BLOCK = 1 << 20  # bytes

R = TypeVar("R")


class RecordAt(NamedTuple):
    """The position of a record: the `offset` of its opcode, and its `length` with the head of 9 bytes."""

    opcode: int
    offset: int
    length: int


class ChunkRef(NamedTuple):
    """The contents of a ChunkIndex record. `index_offsets` maps channel ids to their MessageIndex records."""

    offset: int
    length: int
    start_ns: int
    end_ns: int
    compression: str
    compressed_size: int
    uncompressed_size: int
    index_length: int
    index_offsets: dict[int, int]

    @property
    def end(self) -> int:
        """The offset of the first byte after the message indexes of the chunk."""
        return self.offset + self.length + self.index_length

    def pack(self) -> bytes:
        """Return these contents in a tenth of the memory; :meth:`unpack` reads them."""
        name, offsets = self.compression.encode(), self.index_offsets
        place = self.start_ns, self.end_ns, self.offset, self.length
        sizes = self.compressed_size, self.uncompressed_size, self.index_length
        pairs = b"".join(_CHANNEL_OFFSET.pack(*pair) for pair in offsets.items())
        return _PACKED.pack(*place, *sizes, len(pairs)) + pairs + name

    @classmethod
    def unpack(cls, data: bytes) -> Self:
        start, end, offset, length, compressed, uncompressed, index_length, size = _PACKED.unpack_from(data)
        pairs, name = data[_PACKED.size : _PACKED.size + size], data[_PACKED.size + size :]
        offsets = dict(_CHANNEL_OFFSET.iter_unpack(pairs))
        sizes = compressed, uncompressed, index_length
        return cls(offset, length, start, end, name.decode(), *sizes, offsets)

    def as_record(self) -> mcap.ChunkIndex:
        return mcap.ChunkIndex(
            chunk_length=self.length,
            chunk_start_offset=self.offset,
            compression=self.compression,
            compressed_size=self.compressed_size,
            message_end_time=self.end_ns,
            message_index_length=self.index_length,
            message_index_offsets=self.index_offsets,
            message_start_time=self.start_ns,
            uncompressed_size=self.uncompressed_size,
        )


class ChunkHead(NamedTuple):
    """The fields before the data of a chunk; the data begin at `data_offset` in the file."""

    start_ns: int
    end_ns: int
    uncompressed_size: int
    crc: int
    compression: str
    data_offset: int
    data_size: int


def to_bytes(*records: mcap.McapRecord) -> bytes:
    """Return the records as the bytes of a file."""
    builder = RecordBuilder()  # type: ignore[no-untyped-call, unused-ignore]
    for record in records:
        record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def parse(read: Callable[[ReadDataStream], R], view: LogBytes, record: RecordAt, body: bytes) -> R:
    """Parse one record with a `read` of ``mcap``; wrong lengths in the record cannot reach beyond `body`."""
    try:
        return read(ReadDataStream(BytesIO(body)))
    except (McapError, struct.error, UnicodeDecodeError, OverflowError, MemoryError, ValueError) as error:
        raise view.fault(
            record.offset, f"the {_name(record.opcode)} record is not valid ({error!r})"
        ) from None


_READERS: dict[int, Callable[[ReadDataStream], mcap.McapRecord]] = {
    Opcode.HEADER: mcap.Header.read,
    Opcode.SCHEMA: mcap.Schema.read,
    Opcode.CHANNEL: mcap.Channel.read,
    Opcode.METADATA: mcap.Metadata.read,
    Opcode.STATISTICS: mcap.Statistics.read,
    Opcode.CHUNK_INDEX: mcap.ChunkIndex.read,
    Opcode.ATTACHMENT_INDEX: mcap.AttachmentIndex.read,
    Opcode.METADATA_INDEX: mcap.MetadataIndex.read,
    Opcode.SUMMARY_OFFSET: mcap.SummaryOffset.read,
}


def parse_exact(view: LogBytes, record_at: RecordAt, data: bytes) -> mcap.McapRecord:
    """Parse the record `data`, of any type without messages; its lengths must be right.

    Bytes after the known fields are ignored: later versions of the format may add fields.
    """
    if record_at.opcode not in _READERS:
        raise view.fault(record_at.offset, f"a record of {_name(record_at.opcode)} is not allowed there")
    record = parse(_READERS[record_at.opcode], view, record_at, data[HEADER.size :])
    if not data.startswith(to_bytes(record)[HEADER.size :], HEADER.size):
        raise view.fault(
            record_at.offset, f"the {_name(record_at.opcode)} record claims lengths that it does not have"
        )
    return record


def parse_chunk_index(view: LogBytes, record: RecordAt, body: bytes) -> ChunkRef:
    """Parse a ChunkIndex record, much faster than field by field; each chunk has such a record."""
    try:
        start, end, offset, length, map_length = _CHUNK_INDEX.unpack_from(body)
        rest = _CHUNK_INDEX.size + map_length
        offsets = dict(struct.iter_unpack("<HQ", body[_CHUNK_INDEX.size : rest]))
        index_length, name_length = struct.unpack_from("<QI", body, rest)
        name = _short_name(body[rest + 12 : rest + 12 + name_length])
        compressed, uncompressed = struct.unpack_from("<QQ", body, rest + 12 + name_length)
    except (struct.error, ValueError) as error:
        raise view.fault(record.offset, f"the ChunkIndex record is not valid ({error})") from None
    return ChunkRef(offset, length, start, end, name, compressed, uncompressed, index_length, offsets)


def parse_chunk_head(view: LogBytes, offset: int) -> tuple[RecordAt, ChunkHead]:
    """Parse the head of the Chunk record at `offset`; check it with the lengths of record and file."""
    data = view.read(offset, min(HEADER.size + _CHUNK.size + 4 + _LONGEST_NAME + 8, view.size - offset))
    try:
        opcode, length = HEADER.unpack_from(data)
        start, end, size, crc = _CHUNK.unpack_from(data, HEADER.size)
        position = HEADER.size + _CHUNK.size
        (name_length,) = struct.unpack_from("<I", data, position)
        name = _short_name(data[position + 4 : position + 4 + min(name_length, _LONGEST_NAME + 1)])
        position += 4 + name_length
        (data_size,) = struct.unpack_from("<Q", data, position)
    except (struct.error, ValueError) as error:
        raise view.fault(offset, f"the Chunk record is not valid ({error})") from None
    if opcode != Opcode.CHUNK or position + 8 + data_size != HEADER.size + length:
        raise view.fault(offset, "a Chunk record is missing")
    if offset + HEADER.size + length > view.size:
        raise view.fault(offset, "the Chunk record reaches beyond the end of the file")
    head = ChunkHead(start, end, size, crc, name, offset + position + 8, data_size)
    return RecordAt(opcode, offset, HEADER.size + length), head


def chunk_head(start_ns: int, end_ns: int, size: int, crc: int, compression: str, data_size: int) -> bytes:
    """Return a Chunk record without its data, which have `data_size` bytes and unpack to `size` bytes."""
    name = compression.encode()
    fields = _CHUNK.pack(start_ns, end_ns, size, crc)
    fields += struct.pack("<I", len(name)) + name + struct.pack("<Q", data_size)
    return HEADER.pack(Opcode.CHUNK, len(fields) + data_size) + fields


def index_records(entries: Mapping[int, list[tuple[int, int]]], offset: int) -> tuple[bytes, dict[int, int]]:
    """Return the MessageIndex records of a chunk for `offset`, and the offset of each by channel id."""
    pieces: list[bytes] = []
    offsets: dict[int, int] = {}
    for channel, rows in entries.items():
        pieces.append(to_bytes(mcap.MessageIndex(channel, rows)))
        offsets[channel], offset = offset, offset + len(pieces[-1])
    return b"".join(pieces), offsets


def parse_message_index(view: LogBytes, data: bytes, position: int, channel_id: int, offset: int) -> bytes:
    """Return the entries of the record at `position` in `data`; each has the layout of `ENTRY`."""
    if 0 <= position <= len(data) - INDEX_HEAD.size:
        opcode, length, channel, size = INDEX_HEAD.unpack_from(data, position)
        end = position + INDEX_HEAD.size + size
        fits = end <= len(data) and size + 6 <= length and size % 16 == 0
        if fits and opcode == Opcode.MESSAGE_INDEX and channel == channel_id:
            return data[end - size : end]
    raise view.fault(offset, f"a MessageIndex record of channel {channel_id} is missing")


def attachment_crcs(view: LogBytes, record: RecordAt) -> tuple[int, int]:
    """Return the stated CRC of an attachment (0: none), and its computed CRC."""
    head = view.read(record.offset, min(record.length, _LONGEST_ATTACHMENT_HEAD))
    try:
        (name,) = struct.unpack_from("<I", head, HEADER.size + 16)
        (media_type,) = struct.unpack_from("<I", head, HEADER.size + 20 + name)
        (size,) = struct.unpack_from("<Q", head, HEADER.size + 24 + name + media_type)
    except struct.error:
        raise view.fault(record.offset, "the Attachment record is not valid") from None
    if record.length < HEADER.size + 36 + name + media_type + size:
        raise view.fault(record.offset, "the Attachment record claims lengths that it does not have")
    stored = int.from_bytes(view.read(record.offset + record.length - 4, 4), "little")
    return stored, crc_of(view, record.length - HEADER.size - 4, record.offset + HEADER.size) if stored else 0


def crc_of(view: LogBytes, length: int, start: int = 0, crc: int = 0) -> int:
    """Return the CRC-32 of a byte range of the file, continued from `crc`."""
    for offset in range(start, start + length, _CRC_BLOCK):
        crc = zlib.crc32(view.read(offset, min(_CRC_BLOCK, start + length - offset)), crc)
    return crc


def walk(view: LogBytes, start: int, end: int) -> Iterator[RecordAt]:
    """Yield the positions of the records from `start` to `end`; read only their heads."""
    block, base = b"", start
    while start < end:
        if start + HEADER.size > base + len(block) or start < base:
            base, block = start, view.read(start, min(_WALK_BLOCK, view.size - start))
        if start - base + HEADER.size > len(block):
            raise view.fault(start, "a record is cut off")
        opcode, length = HEADER.unpack_from(block, start - base)
        if opcode == 0:
            raise view.fault(start, "a record is missing")
        if length > end - start - HEADER.size:
            room = end - start - HEADER.size
            raise view.fault(
                start, f"a {_name(opcode)} record claims {length} bytes, but the file has {room}"
            )
        yield RecordAt(opcode, start, HEADER.size + length)
        start += HEADER.size + length


def _short_name(data: bytes) -> str:
    if len(data) > _LONGEST_NAME:
        raise ValueError("the name of the compression is too long")
    return str(data, "utf-8")


def _name(opcode: int) -> str:
    return Opcode(opcode).name if opcode in Opcode._value2member_map_ else f"type {opcode}"
