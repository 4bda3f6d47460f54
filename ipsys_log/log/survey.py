"""Checking every record of a log, finished or not: how far it is whole, and what it holds up to there."""

import re
import zlib
from contextlib import suppress
from dataclasses import dataclass, field

from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.bounds import BoundError
from ipsys_log.log.chunks import Inside, look_inside, unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import (
    DATA_END,
    ENTRY,
    HEADER,
    MAGIC,
    MESSAGE,
    RecordAt,
    parse_chunk_head,
    parse_message_index,
    walk,
)
from ipsys_log.log.scan import add_record, count_all
from ipsys_log.log.view import View

__all__ = ["Lost", "Survey", "crc_of", "survey"]

_BLOCK = 1 << 20
_HEAD_OVERLAP = 64
# A chunk by its compression, or DataEnd with the record behind it: where to go on behind damage.
_NEXT = re.compile(
    rb"\x06.{36}(?:\x00{4}|\x04\x00{3}zstd|\x03\x00{3}lz4)|\x0f\x04\x00{7}.{4}[\x02\x03\x04\x08\x0b]",
    re.DOTALL,
)
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
class Lost:
    """Messages that are known to be gone, by topic: their log times in ns."""

    times_ns: dict[str, list[int]] = field(default_factory=dict)

    def note(self, topic: str, time_ns: int) -> None:
        self.times_ns.setdefault(topic, []).append(time_ns)


@dataclass(slots=True)
class Survey:
    """What is whole: records up to `end`, except the stretches in `damaged`.

    `lost` is what lay in damaged chunks whose message indexes are whole.
    `finished` says that a DataEnd record lies at `end`. `faults` is what was found wrong. `unindexed`
    holds the entries of the last chunk if it is the last record and its message indexes are missing.
    """

    contents: Contents = field(default_factory=Contents)
    loose: Inside = field(default_factory=Inside)
    counts: dict[int, dict[int, int]] = field(default_factory=dict)
    hashes: dict[str, ChannelHash] = field(default_factory=dict)
    damaged: list[RecordAt] = field(default_factory=list)
    lost: Lost = field(default_factory=Lost)
    faults: list[str] = field(default_factory=list)
    unindexed: Inside | None = None
    end: int = len(MAGIC)
    crc: int = 0
    crc_is_right: bool = True
    finished: bool = False
    _chunk: Inside | None = None  # the chunk whose message indexes are being read
    _indexed: set[int] = field(default_factory=set)


def survey(view: View, known: Contents | None = None) -> Survey:
    """Check the data section record by record; never believes a length, never raises for damage.

    A log that asks for too much is refused with a `BoundError`: it need not be damaged, and is not repaired.

    `known` is what the summary says, if there is one: it may define what the data section does not.
    """
    found = Survey()
    if known is not None:
        found.loose.schemas, found.loose.channels = dict(known.schemas), dict(known.channels)
    position = len(MAGIC)
    while position < view.size and not found.finished:
        position = _stretch(view, found, position)
    if found._chunk is not None and found._indexed != found._chunk.entries.keys():
        _forget_indexes(found)
        chunk = found.contents.chunks[-1]
        if not found.finished and not any(bad.offset > chunk.offset for bad in found.damaged):
            found.end, found.unindexed = chunk.offset + chunk.length, found._chunk
    found.crc = crc_of(view, found.end)
    if found.finished:
        _, _, stored = DATA_END.unpack(view.read(found.end, DATA_END.size))
        found.crc_is_right = stored in (0, found.crc)
    count_all(found.contents, found.loose, found.counts)
    return found


def _stretch(view: View, found: Survey, position: int) -> int:
    """Take records from `position` on up to the next damage; returns where to go on behind it."""
    at = RecordAt(0, position, 0)
    try:
        for at in walk(view, position, view.size):
            _take(view, found, at)
            if found.finished:
                return view.size
            found.end = position = at.offset + at.length
    except BoundError:
        raise
    except LogError as error:
        found.faults.append(str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0])
    else:
        return view.size
    follower = _next_record(view, position, at.offset + at.length if at.offset == position else 0)
    if follower is None:
        return view.size
    if at.opcode == Opcode.MESSAGE_INDEX and found._chunk is None:
        _note_lost(view, found, at)
    found.damaged.append(RecordAt(Opcode.CHUNK, position, follower - position))
    return follower


def _take(view: View, found: Survey, at: RecordAt) -> None:
    """Check one record and take it in."""
    if at.opcode == Opcode.MESSAGE_INDEX and found._chunk is not None:
        found._indexed.add(_check_index(view, at, found._chunk))
        add_record(view, found.contents, found.loose, found.counts, at)
        return
    if found._chunk is not None and found._indexed != found._chunk.entries.keys():
        _forget_indexes(found)
    found._chunk, found._indexed = None, set()
    if at.opcode == Opcode.DATA_END and at.length == DATA_END.size:
        found.finished = True
    elif at.opcode == Opcode.CHUNK:
        _take_chunk(view, found, at)
    elif at.opcode in _DATA_SECTION:
        if at.opcode == Opcode.ATTACHMENT:
            _check_attachment(view, at)
        add_record(view, found.contents, found.loose, found.counts, at)
    elif at.opcode < _PRIVATE and not (at.opcode == Opcode.HEADER and at.offset == len(MAGIC)):
        raise view.fault(at.offset, f"a record of type {at.opcode} has no place there")


def _take_chunk(view: View, found: Survey, at: RecordAt) -> None:
    data = unpack(view, at.offset, parse_chunk_head(view, at.offset)[1])
    inside = look_inside(view, at.offset, data)
    known = inside.channels.keys() | found.loose.channels.keys()
    if not inside.entries.keys() <= known:
        raise view.fault(at.offset, "the chunk holds messages of a channel whose definition is lost")
    add_record(view, found.contents, found.loose, found.counts, at)
    times = [time for rows in inside.entries.values() for time, _ in rows]
    if times:  # what its head says may be wrong, and readers go by it
        chunk = found.contents.chunks[-1]
        found.contents.chunks[-1] = chunk._replace(start_ns=min(times), end_ns=max(times))
    found.counts[at.offset] = {key: len(rows) for key, rows in inside.entries.items()}
    found.loose.schemas = inside.schemas | found.loose.schemas
    found.loose.channels = inside.channels | found.loose.channels
    _continue_hashes(found, inside, data)
    found._chunk = inside


def _note_lost(view: View, found: Survey, at: RecordAt) -> None:
    """Take in what a message index names, if it lies right behind a damaged chunk or another index."""
    before = found.damaged[-1] if found.damaged else at
    if before.offset + before.length == at.offset:
        with suppress(LogError):
            channel, rows = _index_rows(view, at)
            known = found.loose.channels.get(channel)
            for time_ns, _ in rows:
                found.lost.note(known.topic if known else f"channel {channel}", time_ns)


def _next_record(view: View, damaged: int, claimed: int) -> int | None:
    """Where the next whole record begins behind a damaged one: where that one's length says, or a chunk."""
    if claimed and _is_record(view, claimed):
        return claimed
    for base in range(damaged + HEADER.size, view.size, _BLOCK):
        block = view.read(base, min(_BLOCK + _HEAD_OVERLAP, view.size - base))
        for match in _NEXT.finditer(block):
            if _is_record(view, base + match.start()):
                return base + match.start()
    return None


def _is_record(view: View, offset: int) -> bool:
    try:
        at = next(walk(view, offset, view.size), None)
        if at is not None and at.opcode == Opcode.CHUNK:
            unpack(view, offset, parse_chunk_head(view, offset)[1])
    except BoundError:
        raise
    except LogError:
        return False
    return at is not None and (at.opcode in _DATA_SECTION or at.opcode >= _PRIVATE)


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
    channel, rows = _index_rows(view, at)
    if sorted(rows) != sorted(inside.entries.get(channel, [])):
        raise view.fault(at.offset, "a MessageIndex record does not fit its chunk")
    return channel


def _index_rows(view: View, at: RecordAt) -> tuple[int, list[tuple[int, int]]]:
    """The channel of a MessageIndex record; log times and places of its messages."""
    body = view.read(at.offset, at.length)
    channel = int.from_bytes(body[HEADER.size : HEADER.size + 2], "little")
    return channel, list(ENTRY.iter_unpack(parse_message_index(view, body, 0, channel, at.offset)))


def _check_attachment(view: View, at: RecordAt) -> None:
    stored = int.from_bytes(view.read(at.offset + at.length - 4, 4), "little") if at.length > 13 else 0
    if stored and crc_of(view, at.length - HEADER.size - 4, at.offset + HEADER.size) != stored:
        raise view.fault(at.offset, "the CRC of an attachment is wrong")


def _forget_indexes(found: Survey) -> None:
    """The last chunk has no complete set of message indexes: then it is read without them."""
    chunk = found.contents.chunks[-1]
    found.contents.chunks[-1] = type(chunk)(
        chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, chunk.compression, chunk.compressed_size,
        chunk.uncompressed_size, 0, {},
    )  # fmt: skip


def crc_of(view: View, length: int, start: int = 0) -> int:
    """CRC-32 of a stretch of the file."""
    crc = 0
    for offset in range(start, start + length, _BLOCK):
        crc = zlib.crc32(view.read(offset, min(_BLOCK, start + length - offset)), crc)
    return crc
