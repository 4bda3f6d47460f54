"""Contents of a chunk: decompression within limits, and its records."""

import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO

import lz4.frame
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import LARGEST_CHUNK, LARGEST_DEFINITION, BoundError, LogBytes, chunk_excess
from ipsys_log.log.records import HEADER, MESSAGE, ChunkHead, RecordAt, parse, parse_chunk_head, to_bytes


class _PerThread(threading.local):
    """A decompressor for each thread: two threads must not share a decompressor.

    To create a decompressor takes longer than to decompress a small chunk.
    """

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()
        # glibc returns freed memory to the system, and asks for it again with the next chunk, unless a larger
        # block was freed before. The new pages of a chunk take three times as long as its decompression.
        bytes(_FREED_BLOCK)


_FREED_BLOCK = 16 << 20  # bytes; then glibc keeps up to 32 MiB
_DECOMPRESSORS = _PerThread()
_PIECE = 4 << 20  # bytes: decompressed at once if the size of the result is not known
_LARGEST_UNPACKED = 64 << 20  # bytes
_CHECKED_AT_ONCE = 256 << 10  # bytes, which stay in the cache of the processor
_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_FAULTS = (zstandard.ZstdError, RuntimeError, EOFError, ValueError)


def check_compression(view: LogBytes, compression: str) -> None:
    """Refuse a compression that is not in the MCAP specification."""
    if compression not in ("", "zstd", "lz4"):
        raise LogError(
            f"{view.path} has chunks compressed with {compression!r}, which ipsys does not know. "
            "Rewrite it with: mcap compress --compression zstd"
        )


def unpack(view: LogBytes, offset: int, head: ChunkHead, is_crc_checked: bool = True) -> bytes:
    """Return the records of the chunk at `offset`, decompressed; size and CRC are checked.

    Without `is_crc_checked`, the caller checks the CRC.

    Raises
    ------
    BoundError
        The chunk really holds more than the limit. If only its stated size is too large, it is damaged.
    LogError
        The chunk is damaged.
    """
    check_compression(view, head.compression)
    if not head.compression and head.data_size != head.uncompressed_size:
        raise view.fault(
            offset, f"the chunk holds {head.data_size} bytes and claims {head.uncompressed_size}"
        )
    excess = chunk_excess(head.data_size, head.uncompressed_size)
    if excess and not head.compression:
        raise view.refusal(excess)
    data = view.read(head.data_offset, head.data_size)
    try:
        if head.compression:
            data = _decompress(view, offset, head, data, excess)
    except _FAULTS as error:
        raise view.fault(offset, f"the chunk cannot be decompressed ({error})") from None
    if len(data) != head.uncompressed_size:
        raise view.fault(offset, f"the chunk holds {len(data)} bytes and claims {head.uncompressed_size}")
    if is_crc_checked and head.crc and zlib.crc32(data) != head.crc:
        raise view.fault(offset, "the CRC of the chunk is wrong")
    return data


def has_wrong_crc(view: LogBytes, offset: int) -> bool:
    """Return whether the records of the chunk at `offset` contradict its CRC.

    False if the chunk has no CRC. A large compressed chunk is not checked: it would need much memory.
    """
    head = parse_chunk_head(view, offset)[1]
    if not head.crc or (head.compression and head.uncompressed_size > _LARGEST_UNPACKED):
        return False
    if head.compression:
        try:
            return zlib.crc32(unpack(view, offset, head, is_crc_checked=False)) != head.crc
        except BoundError:
            return False
    crc, end = 0, head.data_offset + head.data_size
    for start in range(head.data_offset, end, _CHECKED_AT_ONCE):
        crc = zlib.crc32(view.read(start, min(_CHECKED_AT_ONCE, end - start)), crc)
    return crc != head.crc


def _decompress(view: LogBytes, offset: int, head: ChunkHead, data: bytes, excess: str) -> bytes:
    size = head.uncompressed_size
    # The library uses the size in the frame instead of max_output_size, and allocates so much memory.
    frame_size = zstandard.frame_content_size(data) if head.compression == "zstd" else -1
    if frame_size not in (-1, size):
        raise ValueError("the frame claims another size than the chunk")
    # A size above the limit is damage, unless the frame states the same size, or the data unpack to more
    # than the limit.
    proof = min(size, LARGEST_CHUNK + 1) if excess and frame_size == -1 else 0
    unpacked_size = sum(map(len, _pieces(head.compression, data, proof)))
    limit_excess = view.read_limits.unpack(offset, unpacked_size if excess else size)
    if limit_excess or (excess and unpacked_size == proof):
        raise view.refusal(excess or limit_excess)
    if excess:
        raise ValueError(f"it claims {size} bytes and holds {unpacked_size}")
    if head.compression == "zstd":
        return _DECOMPRESSORS.zstd.decompress(data, max_output_size=max(size, 1))
    unpacked = BytesIO()  # grows in place, and returns its bytes without a copy
    unpacked.writelines(_pieces("lz4", data, size + 1))
    return unpacked.getvalue()


def _pieces(compression: str, data: bytes, most: int) -> Iterator[bytes]:
    """Yield up to `most` decompressed bytes, piece by piece."""
    if compression == "zstd":
        with _DECOMPRESSORS.zstd.stream_reader(data) as reader:
            while most > 0 and (piece := reader.read(min(most, _PIECE))):
                most -= len(piece)
                yield piece
        return
    decompressor = lz4.frame.LZ4FrameDecompressor()
    while most > 0 and not decompressor.eof:
        piece = decompressor.decompress(data, min(most, _PIECE))
        if not piece and decompressor.needs_input:
            raise ValueError("the frame has no end")  # other readers refuse such a frame
        data = b""
        most -= len(piece)
        yield piece


def inner_records(view: LogBytes, offset: int, data: bytes) -> Iterator[RecordAt]:
    """Yield the records inside the chunk at `offset`; their offsets count from the chunk's first record."""
    position = 0
    while position < len(data):
        if position + HEADER.size > len(data):
            raise view.fault(offset, "the last record in the chunk is cut off")
        opcode, length = HEADER.unpack_from(data, position)
        if opcode == 0:
            raise view.fault(offset, "a record is missing in the chunk")
        if length > len(data) - position - HEADER.size:
            raise view.fault(offset, "a record in the chunk reaches beyond its end")
        yield RecordAt(opcode, position, HEADER.size + length)
        position += HEADER.size + length


@dataclass(slots=True)
class ChunkContents:
    """The definitions and message entries of a chunk, or of a data section without chunks.

    `is_exact` is False if a schema has the id 0, or if a definition claims lengths that it does not have:
    other readers refuse it.
    """

    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    is_exact: bool = True

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The first and the last log time; None without messages."""
        times = [time_ns for rows in self.entries.values() for time_ns, _ in rows]
        return (min(times), max(times)) if times else None

    def in_order(self) -> list[tuple[int, int]]:
        """Return the offset and the channel id of each message, in the order of the file."""
        return sorted((offset, key) for key, rows in self.entries.items() for _, offset in rows)

    def add(self, view: LogBytes, record: RecordAt, offset: int, body: bytes) -> None:
        """Add one record of type Schema, Channel or Message; ignore other types."""
        if record.opcode == Opcode.MESSAGE:
            if len(body) < MESSAGE.size - HEADER.size:
                raise view.fault(offset, "a Message record is too short")
            channel, time = int.from_bytes(body[:2], "little"), int.from_bytes(body[6:14], "little")
            self.entries.setdefault(channel, []).append((time, record.offset))
        elif record.opcode == Opcode.SCHEMA and int.from_bytes(body[:2], "little") not in self.schemas:
            schema = parse(mcap.Schema.read, view, RecordAt(record.opcode, offset, record.length), body)
            if schema.id:
                self.schemas[schema.id] = schema
            self.is_exact &= schema.id > 0 and body.startswith(to_bytes(schema)[HEADER.size :])
            view.check_number(len(self.schemas), "schemas")
        elif record.opcode == Opcode.CHANNEL and int.from_bytes(body[:2], "little") not in self.channels:
            channel_ = parse(mcap.Channel.read, view, RecordAt(record.opcode, offset, record.length), body)
            self.channels[channel_.id] = channel_
            self.is_exact &= body.startswith(to_bytes(channel_)[HEADER.size :])
            view.check_number(len(self.channels), "channels")


def check_definition(view: LogBytes, record: RecordAt) -> None:
    """Refuse a record that is too large to be read as a whole."""
    if record.length > LARGEST_DEFINITION:
        raise view.refusal(
            f"one of its definitions has {record.length} bytes, more than {LARGEST_DEFINITION}"
        )


def parse_chunk_contents(view: LogBytes, offset: int, data: bytes) -> ChunkContents:
    """Return the definitions and message entries of the decompressed chunk `data` at `offset`."""
    inside, number = ChunkContents(), 0
    left = view.read_limits.records_left(offset)
    for number, record in enumerate(inner_records(view, offset, data), 1):
        if number > left:
            raise view.refusal(f"its chunks hold more than {view.read_limits.max_records} records")
        if record.opcode in _DEFINITIONS:
            check_definition(view, record)
        head = MESSAGE.size if record.opcode == Opcode.MESSAGE else record.length
        inside.add(
            view, record, offset, data[record.offset + HEADER.size : record.offset + min(head, record.length)]
        )
    view.read_limits.count_records(offset, number)
    return inside
