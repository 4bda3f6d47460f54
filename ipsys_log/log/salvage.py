"""Complete messages in a chunk that was being written when its writer died."""

import struct
import zlib
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from ipsys_log.log.bounds import LARGEST_CHUNK
from ipsys_log.log.chunking import ChunkBuilder, Limits
from ipsys_log.log.chunks import look_inside
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import HEADER, MESSAGE
from ipsys_log.log.survey import Survey
from ipsys_log.log.view import View
from ipsys_log.units import format_time

__all__ = ["Salvage", "salvage"]

_SECTOR = 512
_FIXED = struct.Struct("<BQQQQII")  # opcode, length, start, end, size, CRC, length of the compression's name
_NO_LIMITS = Limits(LARGEST_CHUNK, 1 << 63)


@dataclass(slots=True)
class Salvage:
    """Messages saved into a new `chunk`; those known to be lost go to the survey."""

    chunk: ChunkBuilder = field(default_factory=lambda: ChunkBuilder(_NO_LIMITS, compress=False))
    definitions: list[bytes] = field(default_factory=list)
    bytes_kept: int = 0


def salvage(view: View, start: int, found: Survey) -> Salvage:
    """Read what can be read of an uncompressed chunk that begins at `start` and is cut off.

    Its CRC cannot be checked, because the rest is missing. A sector that never reached the disk reads as
    zeros, so nothing is believed from the first such sector on.
    """
    saved = Salvage()
    data = view.read(start, min(view.size - start, LARGEST_CHUNK))
    if len(data) < _FIXED.size + 8:
        return saved
    opcode, length, start_ns, end_ns, _, _, name_length = _FIXED.unpack_from(data)
    (claimed,) = struct.unpack_from("<Q", data, _FIXED.size)
    whole = length + HEADER.size <= view.size - start
    if opcode == Opcode.CHUNK and name_length and not whole:
        found.faults.append(
            f"messages of {format_time(start_ns)} to {format_time(end_ns)} UTC, compressed and cut off"
        )
    if opcode != Opcode.CHUNK or name_length or whole or claimed != length - _FIXED.size + 1:
        return saved
    end = _first_hole(data, start)
    position = _FIXED.size + 8
    while position + MESSAGE.size <= len(data):
        position = _save_one(view, data, position, end, found, saved)
    return saved


def _save_one(view: View, data: bytes, position: int, end: int, found: Survey, saved: Salvage) -> int:
    """Save or count the record at `position`; returns where the next one begins."""
    if position + MESSAGE.size > end:
        return len(data)
    opcode, length, channel, sequence, time, published = MESSAGE.unpack_from(data, position)
    stop: int = position + HEADER.size + length
    known = found.contents.channels.get(channel)
    if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and stop <= end:
        _define(view, data[position:stop], found)
        saved.definitions.append(data[position:stop])
    elif opcode != Opcode.MESSAGE or known is None or length < MESSAGE.size - HEADER.size:
        return len(data)
    elif stop > end:
        found.lost.note(known.topic, time)
        return len(data)
    else:
        payload = data[position + MESSAGE.size : stop]
        crc = zlib.crc32(payload)
        saved.chunk.add(channel, sequence, time, published, payload, crc)
        state = found.hashes.setdefault(known.topic, ChannelHash())
        state.add_row(time, published, len(payload), crc)
    saved.bytes_kept += stop - position
    return stop


def _define(view: View, record: bytes, found: Survey) -> None:
    inside = look_inside(view, 0, record)
    found.contents.schemas = inside.schemas | found.contents.schemas
    found.contents.channels = inside.channels | found.contents.channels


def _first_hole(data: bytes, start: int) -> int:
    """Where the first sector of zeros begins, in bytes from the start of `data`."""
    zeros = bytes(_SECTOR)
    position = data.find(zeros)
    while position >= 0:
        sector = position + -(start + position) % _SECTOR
        if data[sector : sector + _SECTOR] == zeros:
            return sector
        position = data.find(zeros, sector + 1)
    return len(data)
