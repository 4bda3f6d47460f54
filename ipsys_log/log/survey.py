"""Checking every record of a log, finished or not: how far it is whole, and what it holds up to there."""

import zlib
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.chunks import Inside, look_inside, unpack
from ipsys_log.log.contents import Contents, add_record, count_all
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import (
    DATA_END,
    HEADER,
    MAGIC,
    MESSAGE,
    RecordAt,
    parse_chunk_head,
    parse_message_index,
    walk,
)
from ipsys_log.log.view import View

__all__ = ["Survey", "survey"]

_BLOCK = 1 << 20
_DATA_SECTION = frozenset(
    (
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    )
)
_PRIVATE = 0x80  # types from here on are skipped by every reader


@dataclass(slots=True)
class Survey:
    """What is whole: records up to `end`, except the ones in `damaged`.

    `finished` says that a DataEnd record lies at `end`. `fault` is why the survey stopped elsewhere.
    `unindexed` holds the entries of the last chunk if its message indexes are missing.
    """

    contents: Contents = field(default_factory=Contents)
    loose: Inside = field(default_factory=Inside)
    counts: dict[int, dict[int, int]] = field(default_factory=dict)
    hashes: dict[str, ChannelHash] = field(default_factory=dict)
    damaged: list[RecordAt] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    unindexed: Inside | None = None
    end: int = len(MAGIC)
    crc: int = 0
    crc_is_right: bool = True
    finished: bool = False


def survey(view: View) -> Survey:
    """Check the data section record by record; never believes a length, never raises for damage."""
    found = Survey()
    last: Inside | None = None  # the chunk whose message indexes are being read
    indexed: set[int] = set()
    try:
        for at in walk(view, len(MAGIC), view.size):
            if at.opcode == Opcode.MESSAGE_INDEX and last is not None:
                indexed.add(_check_index(view, at, last))
                add_record(view, found.contents, found.loose, found.counts, at)
                found.end = at.offset + at.length
                continue
            if last is not None and indexed and indexed != last.entries.keys():
                raise view.fault(at.offset, "message indexes are missing")
            last, indexed = _take(view, found, at), set()
            if found.finished:
                break
            found.end = at.offset + at.length
    except LogError as error:
        found.faults.append(str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0])
    if last is not None and indexed != last.entries.keys() and not found.finished:
        _forget_indexes(found, last)
    found.crc = _crc(view, found.end)
    if found.finished:
        _, _, stored = DATA_END.unpack(view.read(found.end, DATA_END.size))
        found.crc_is_right = stored in (0, found.crc)
    count_all(found.contents, found.loose, found.counts)
    return found


def _take(view: View, found: Survey, at: RecordAt) -> Inside | None:
    """Check one record and take it in; returns the inside of a chunk."""
    if at.opcode == Opcode.DATA_END and at.length == DATA_END.size:
        found.finished = True
    elif at.opcode == Opcode.CHUNK:
        return _take_chunk(view, found, at)
    elif at.opcode == Opcode.MESSAGE_INDEX and found.damaged:
        found.damaged.append(at)  # the indexes of a damaged chunk go with it
    elif at.opcode == Opcode.ATTACHMENT:
        _check_attachment(view, at)
        add_record(view, found.contents, found.loose, found.counts, at)
    elif at.opcode in _DATA_SECTION:
        add_record(view, found.contents, found.loose, found.counts, at)
    elif at.opcode < _PRIVATE and not (at.opcode == Opcode.HEADER and at.offset == len(MAGIC)):
        raise view.fault(at.offset, f"a record of type {at.opcode} has no place there")
    return None


def _take_chunk(view: View, found: Survey, at: RecordAt) -> Inside | None:
    try:
        data = unpack(view, at.offset, parse_chunk_head(view, at.offset)[1])
        inside = look_inside(view, at.offset, data)
    except LogError as error:
        if not _record_follows(view, at):
            raise
        found.faults.append(str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0])
        found.damaged.append(at)
        return None
    add_record(view, found.contents, found.loose, found.counts, at)
    found.counts[at.offset] = {key: len(rows) for key, rows in inside.entries.items()}
    found.loose.schemas = inside.schemas | found.loose.schemas
    found.loose.channels = inside.channels | found.loose.channels
    _continue_hashes(found, inside, data)
    return inside


def _record_follows(view: View, at: RecordAt) -> bool:
    """True if the length of a damaged record can be believed, because another record follows it."""
    try:
        follower = next(walk(view, at.offset + at.length, view.size), None)
    except LogError:
        return False
    return follower is not None and follower.opcode in _DATA_SECTION


def _continue_hashes(found: Survey, inside: Inside, data: bytes) -> None:
    rows = sorted((offset, key) for key, entries in inside.entries.items() for _, offset in entries)
    for offset, key in rows:
        channel = found.loose.channels.get(key)
        if channel is not None:
            _, length, _, _, time, published = MESSAGE.unpack_from(data, offset)
            payload = data[offset + MESSAGE.size : offset + HEADER.size + length]
            found.hashes.setdefault(channel.topic, ChannelHash()).add(time, published, payload)


def _check_index(view: View, at: RecordAt, inside: Inside) -> int:
    """The channel of a MessageIndex record that agrees with its chunk."""
    body = view.read(at.offset, at.length)
    channel = int.from_bytes(body[HEADER.size : HEADER.size + 2], "little")
    rows = parse_message_index(view, body, 0, channel, at.offset)
    if sorted(map(tuple, rows.tolist())) != sorted(inside.entries.get(channel, [])):
        raise view.fault(at.offset, "a MessageIndex record does not fit its chunk")
    return channel


def _check_attachment(view: View, at: RecordAt) -> None:
    stored = int.from_bytes(view.read(at.offset + at.length - 4, 4), "little") if at.length > 13 else 0
    if stored and _crc(view, at.length - HEADER.size - 4, at.offset + HEADER.size) != stored:
        raise view.fault(at.offset, "the CRC of an attachment is wrong")


def _forget_indexes(found: Survey, last: Inside) -> None:
    """Cut behind the last chunk, so that its message indexes can be written anew."""
    chunk = found.contents.chunks[-1]
    found.contents.chunks[-1] = type(chunk)(
        chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, chunk.compression, chunk.compressed_size,
        chunk.uncompressed_size, 0, {},
    )  # fmt: skip
    found.end = chunk.offset + chunk.length
    found.unindexed = last


def _crc(view: View, length: int, start: int = 0) -> int:
    crc = 0
    for offset in range(start, start + length, _BLOCK):
        crc = zlib.crc32(view.read(offset, min(_BLOCK, start + length - offset)), crc)
    return crc
