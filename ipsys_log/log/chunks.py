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
from ipsys_log.log.bounds import LARGEST_CHUNK, LARGEST_DEFINITION, chunk_excess
from ipsys_log.log.byte_source import View
from ipsys_log.log.records import HEADER, MESSAGE, ChunkHead, RecordAt, parse

__all__ = ["Inside", "check_compression", "check_definition", "inner_records", "look_inside", "unpack"]


class _PerThread(threading.local):
    """To make one takes longer than a small chunk does; two threads must not share one."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_DECOMPRESSORS = _PerThread()
_PIECE = 4 << 20  # bytes decompressed at once if the size of the result is not known
_DEFINITIONS = (Opcode.SCHEMA, Opcode.CHANNEL)
_FAULTS = (zstandard.ZstdError, RuntimeError, EOFError, ValueError)


def check_compression(view: View, compression: str) -> None:
    """Refuse a compression that is not in the MCAP specification."""
    if compression not in ("", "zstd", "lz4"):
        raise LogError(
            f"{view.path} has chunks compressed with {compression!r}, which is not known here. "
            "Rewrite it with: mcap compress --compression zstd"
        )


def unpack(view: View, offset: int, head: ChunkHead) -> bytes:
    """Return the records of the chunk at `offset`, decompressed; size and CRC are checked.

    Raises
    ------
    BoundError
        The chunk really holds more than the limit. A chunk that only claims so is damaged.
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
    if head.crc and zlib.crc32(data) != head.crc:
        raise view.fault(offset, "the CRC of the chunk is wrong")
    return data


def _decompress(view: View, offset: int, head: ChunkHead, data: bytes, excess: str) -> bytes:
    size = head.uncompressed_size
    # The library believes the frame's own size before max_output_size, and allocates it.
    frame_size = zstandard.frame_content_size(data) if head.compression == "zstd" else -1
    if frame_size not in (-1, size):
        raise ValueError("the frame claims another size than the chunk")
    # A size above the limit is damage, unless the frame states it too or so many bytes decompress.
    proof = min(size, LARGEST_CHUNK + 1) if excess and frame_size == -1 else 0
    held = sum(map(len, _pieces(head.compression, data, proof)))
    beyond = view.allowance.unpack(offset, held if excess else size)
    if beyond or (excess and held == proof):
        raise view.refusal(excess or beyond)
    if excess:
        raise ValueError(f"it claims {size} bytes and holds {held}")
    if head.compression == "zstd":
        return _DECOMPRESSORS.zstd.decompress(data, max_output_size=max(size, 1))
    unpacked = BytesIO()  # grows in place, and gives its bytes without a copy
    unpacked.writelines(_pieces("lz4", data, size + 1))
    return unpacked.getvalue()


def _pieces(compression: str, data: bytes, most: int) -> Iterator[bytes]:
    """Decompress up to `most` bytes, a piece at a time."""
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
            raise ValueError("the frame has no end")  # other readers refuse it
        data = b""
        most -= len(piece)
        yield piece


def inner_records(view: View, offset: int, data: bytes) -> Iterator[RecordAt]:
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
class Inside:
    """Everything that a chunk (or a data section without chunks) defines and holds."""

    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(self, view: View, at: RecordAt, where: int, body: bytes) -> None:
        """Add one record of type Schema, Channel or Message; others are ignored."""
        if at.opcode == Opcode.MESSAGE:
            if len(body) < MESSAGE.size - HEADER.size:
                raise view.fault(where, "a Message record is too short")
            channel, time = int.from_bytes(body[:2], "little"), int.from_bytes(body[6:14], "little")
            self.entries.setdefault(channel, []).append((time, at.offset))
        elif at.opcode == Opcode.SCHEMA and int.from_bytes(body[:2], "little") not in self.schemas:
            schema = parse(mcap.Schema.read, view, RecordAt(at.opcode, where, at.length), body)
            self.schemas[schema.id] = schema
            view.check_number(len(self.schemas), "schemas")
        elif at.opcode == Opcode.CHANNEL and int.from_bytes(body[:2], "little") not in self.channels:
            channel_ = parse(mcap.Channel.read, view, RecordAt(at.opcode, where, at.length), body)
            self.channels[channel_.id] = channel_
            view.check_number(len(self.channels), "channels")


def check_definition(view: View, at: RecordAt) -> None:
    """Refuse a record that is too large to be read as a whole."""
    if at.length > LARGEST_DEFINITION:
        raise view.refusal(f"one of its definitions has {at.length} bytes, more than {LARGEST_DEFINITION}")


def look_inside(view: View, offset: int, data: bytes) -> Inside:
    """Return definitions and message entries of the decompressed chunk `data` at `offset`."""
    inside, number = Inside(), 0
    left = view.allowance.records_left(offset)
    for number, at in enumerate(inner_records(view, offset, data), 1):
        if number > left:
            raise view.refusal(f"its chunks hold more than {view.allowance.most_records} records")
        if at.opcode in _DEFINITIONS:
            check_definition(view, at)
        head = MESSAGE.size if at.opcode == Opcode.MESSAGE else at.length
        inside.add(view, at, offset, data[at.offset + HEADER.size : at.offset + min(head, at.length)])
    view.allowance.count_records(offset, number)
    return inside
