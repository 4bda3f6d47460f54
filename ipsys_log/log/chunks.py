"""What is inside a chunk: decompression within bounds, and its records."""

import threading
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field

import lz4.frame
import zstandard
from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.records import HEADER, MESSAGE, ChunkHead, RecordAt, parse
from ipsys_log.log.view import View

__all__ = ["LARGEST_CHUNK", "Inside", "check_compression", "inner_records", "look_inside", "unpack"]


class _PerThread(threading.local):
    """To make one takes longer than a small chunk does; two threads must not share one."""

    def __init__(self) -> None:
        self.zstd = zstandard.ZstdDecompressor()


_DECOMPRESSORS = _PerThread()
LARGEST_CHUNK = 1 << 30  # bytes, uncompressed: what one chunk may make us allocate


def check_compression(view: View, compression: str) -> None:
    """Refuse a compression that is not in the MCAP specification."""
    if compression not in ("", "zstd", "lz4"):
        raise LogError(
            f"{view.path} has chunks compressed with {compression!r}, which is not known here. "
            "Rewrite it with: mcap compress --compression zstd"
        )


def unpack(view: View, offset: int, head: ChunkHead) -> bytes:
    """The records of the chunk at `offset`, decompressed; size and CRC are checked."""
    check_compression(view, head.compression)
    if head.uncompressed_size > LARGEST_CHUNK:
        raise view.fault(offset, f"the chunk claims {head.uncompressed_size} bytes, more than one may hold")
    data = view.read(head.data_offset, head.data_size)
    try:
        if head.compression == "zstd":
            data = _unpack_zstd(data, head.uncompressed_size)
        elif head.compression == "lz4":
            data = _unpack_lz4(data, head.uncompressed_size)
    except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:
        raise view.fault(offset, f"the chunk cannot be decompressed ({error})") from None
    if len(data) != head.uncompressed_size:
        raise view.fault(offset, f"the chunk holds {len(data)} bytes and claims {head.uncompressed_size}")
    if head.crc and zlib.crc32(data) != head.crc:
        raise view.fault(offset, "the CRC of the chunk is wrong")
    return data


def _unpack_lz4(data: bytes, size: int) -> bytes:
    decompressor = lz4.frame.LZ4FrameDecompressor()
    records: bytes = decompressor.decompress(data, size + 1)
    if len(records) == size and not decompressor.eof:  # other readers refuse it
        raise ValueError("the frame has no end")
    return records


def _unpack_zstd(data: bytes, size: int) -> bytes:
    # The library believes the frame's own size before max_output_size, and allocates it.
    if zstandard.frame_content_size(data) not in (-1, size):
        raise ValueError("the frame claims another size than the chunk")
    return _DECOMPRESSORS.zstd.decompress(data, max_output_size=max(size, 1))


def inner_records(view: View, offset: int, data: bytes) -> Iterator[RecordAt]:
    """The records inside the chunk at `offset`; their offsets count from the chunk's first record."""
    position = 0
    while position < len(data):
        if position + HEADER.size > len(data):
            raise view.fault(offset, "the last record in the chunk is cut off")
        opcode, length = HEADER.unpack_from(data, position)
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
        """Take in one record of type Schema, Channel or Message; others are ignored."""
        if at.opcode == Opcode.MESSAGE:
            if len(body) < MESSAGE.size - HEADER.size:
                raise view.fault(where, "a Message record is too short")
            channel, time = int.from_bytes(body[:2], "little"), int.from_bytes(body[6:14], "little")
            self.entries.setdefault(channel, []).append((time, at.offset))
        elif at.opcode == Opcode.SCHEMA:
            schema = parse(mcap.Schema.read, view, RecordAt(at.opcode, where, at.length), body)
            self.schemas.setdefault(schema.id, schema)
        elif at.opcode == Opcode.CHANNEL:
            channel_ = parse(mcap.Channel.read, view, RecordAt(at.opcode, where, at.length), body)
            self.channels.setdefault(channel_.id, channel_)


def look_inside(view: View, offset: int, data: bytes) -> Inside:
    """Definitions and message entries of the decompressed chunk `data`, which lies at `offset`."""
    inside = Inside()
    for at in inner_records(view, offset, data):
        head = MESSAGE.size if at.opcode == Opcode.MESSAGE else at.length
        inside.add(view, at, offset, data[at.offset + HEADER.size : at.offset + min(head, at.length)])
    return inside
