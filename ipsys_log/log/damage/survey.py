"""Check of every record of a log, finished or not."""

from collections import ChainMap

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.bounds import BoundError
from ipsys_log.log.byte_source import View
from ipsys_log.log.chunks import Inside, inner_records, look_inside, unpack
from ipsys_log.log.damage.definitions import Definitions
from ipsys_log.log.damage.findings import (
    COUNTED,
    LOOSE,
    Indexed,
    Survey,
    add_damage,
    close_indexes,
    pass_over,
)
from ipsys_log.log.damage.regions import Stretch
from ipsys_log.log.damage.resync import PRIVATE, Resync, attachment_crc, check_exact, crc_of, is_index
from ipsys_log.log.damage.salvage import Salvage, up_to_first_hole
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.records import (
    DATA_END,
    ENTRY,
    HEADER,
    MAGIC,
    MESSAGE,
    RecordAt,
    as_bytes,
    exact,
    parse_chunk_head,
    parse_message_index,
    walk,
)
from ipsys_log.log.scan import add_record, count_all
from ipsys_log.log.summary import Summary

__all__ = ["HEADER_RECORD", "survey"]

HEADER_RECORD = as_bytes(mcap.Header("", "ipsys 1"))
_LAG = 1 << 20  # bytes
_LONGEST_HEADER = 1 << 20  # bytes


def survey(
    view: View, known: Summary | None = None, saved: Salvage | None = None, *, doubtful: bool = False
) -> Survey:
    """Check the data section record by record, without trusting lengths or raising errors for damage.

    A log that exceeds the limits is refused with a `BoundError`: it may be undamaged, so it is not repaired.

    The file is read once. `known` is the summary, if there is one: it may have definitions that the data
    section lacks. Without `saved`, damaged chunks are skipped. With `doubtful`, unconfirmed lengths are
    checked closely.
    """
    damaged: list[Stretch] = []
    definitions = Definitions(known, damaged)
    channels = ChainMap[int, mcap.Channel](definitions.channels, definitions.known.channels)
    resync = Resync(view, channels, _is_chunked(known), _span_ns(known))
    findings = Survey(view, resync, definitions, saved, damaged=damaged)
    findings.doubtful_to = view.size if doubtful else 0
    position = _take_start(findings)
    while position < view.size and not findings.finished:
        position = _take_records(findings, position)
    if findings.indexed is not None:
        close_indexes(findings, findings.end)
    _advance_crc(findings, findings.end)
    damaged.sort(key=lambda stretch: stretch.offset)
    if findings.finished:
        _, _, stored = DATA_END.unpack(view.read(findings.end, DATA_END.size))
        findings.crc_is_right = stored in (0, findings.crc)
        findings.has_crc = stored != 0
    findings.loose.schemas, findings.loose.channels = definitions.schemas, definitions.channels
    count_all(findings.contents, findings.loose, findings.counts)
    return findings


def _is_chunked(known: Summary | None) -> bool | None:
    """Return whether the messages lie in chunks according to the summary; None if it has no such data."""
    if known is not None and known.contents.chunks:
        return True
    if known is not None and known.checked and known.statistics is not None:
        return known.statistics.chunk_count > 0
    return None


def _span_ns(known: Summary | None) -> tuple[int, int] | None:
    """Return the log times of the first and the last message, if the summary has them and is right."""
    if known is None or not known.checked or known.statistics is None or not known.statistics.message_count:
        return None
    return known.statistics.message_start_time, known.statistics.message_end_time


def _take_start(found: Survey) -> int:
    """Check the magic bytes and the Header record; return the offset of the records after them."""
    view, start = found.view, len(MAGIC)
    header_end, reason = _behind_header(found)
    if view.read(0, min(start, view.size)) != MAGIC:
        follower = start if header_end > start else found.resync.find(start)
        if follower is None:
            return view.size
        found.indexed = Indexed(follower) if follower > start else None
        head = MAGIC + (HEADER_RECORD if follower >= start + len(HEADER_RECORD) else b"")
        add_damage(found, Stretch(0, follower, head), "it does not begin as an MCAP file")
        return max(follower, header_end)
    found.end = header_end or start
    if header_end:
        return header_end
    follower = found.resync.find(start)
    if follower is None:
        return start
    head = HEADER_RECORD if follower >= start + len(HEADER_RECORD) else b""
    return add_damage(found, Stretch(start, follower - start, head), reason)


def _behind_header(found: Survey) -> tuple[int, str]:
    """Return the end of the Header record (its offset if it is missing), or 0 and the fault if damaged."""
    view, start = found.view, len(MAGIC)
    try:
        record_at = next(walk(view, start, view.size), None)
        if record_at is None or record_at.opcode != Opcode.HEADER:
            return start, ""
        if record_at.length > _LONGEST_HEADER:
            raise view.fault(start, f"the HEADER record claims {record_at.length} bytes")
        exact(view, record_at, view.read(start, record_at.length))
        _check_length(found, record_at)
    except LogError as error:
        return 0, _reason(error)
    return record_at.offset + record_at.length, ""


def _take_records(found: Survey, position: int) -> int:
    """Check the records from `position` up to the next damage; return the offset after it."""
    view = found.view
    record_at = RecordAt(0, position, 0)
    try:
        for record_at in walk(view, position, view.size):
            _take(found, record_at)
            if found.finished:
                return view.size
            found.end = position = record_at.offset + record_at.length
            if position - found.crc_at > _LAG:
                _advance_crc(found, position if found.indexed is None else found.indexed.start)
    except BoundError:
        raise
    except LogError as error:
        return pass_over(found, position, record_at if record_at.offset == position else None, _reason(error))
    return view.size


def _take(found: Survey, at: RecordAt) -> None:
    """Check one record and add it."""
    view = found.view
    if at.opcode == Opcode.MESSAGE_INDEX:
        _take_index(found, at)
        return
    indexed = found.indexed
    is_among = indexed is not None and indexed.inside is not None and not indexed.is_complete
    if at.opcode == Opcode.MESSAGE and is_among and found.resync.chunked:
        raise view.fault(at.offset, "a message lies among the message indexes of a chunk")
    if indexed is not None:
        close_indexes(found, at.offset)
    if at.opcode == Opcode.DATA_END and at.length == DATA_END.size:
        _advance_crc(found, at.offset)
        if not found.resync.is_end(at.offset, found.crc):
            raise view.fault(at.offset, "records follow after a DataEnd record")
        found.finished, found.end = True, at.offset
    elif at.opcode == Opcode.CHUNK:
        _take_chunk(found, at)
    elif at.opcode in LOOSE:
        _take_loose(found, at)
    elif at.opcode < PRIVATE:
        raise view.fault(at.offset, f"a record of type {at.opcode} has no place there")
    else:
        _check_length(found, at)


def _check_length(found: Survey, at: RecordAt) -> None:
    """Refuse a record whose wrong length includes whole records, or ends before a whole record.

    If a record follows, the length is right. If no record follows, the damage may also be after this record.
    """
    view, stop = found.view, at.offset + at.length
    follows = stop == view.size
    if stop + HEADER.size <= view.size:
        opcode, length = HEADER.unpack(view.read(stop, HEADER.size))
        known = opcode in LOOSE or opcode in COUNTED or opcode == Opcode.CHUNK or opcode >= PRIVATE
        follows = known and length <= view.size - stop - HEADER.size and at.offset >= found.doubtful_to
        follows = follows or found.resync.is_chunk_head(stop)  # perhaps a chunk that is cut off
    if not follows:
        inner = found.resync.find(at.offset)
        if inner is not None and inner != stop and inner < stop + HEADER.size:
            found.wrong_length = at.offset
            if at.opcode == Opcode.MESSAGE and at.length >= MESSAGE.size and stop < inner:
                found.homeless.append(at)  # it may be whole: the gap between them is too small to skip
            raise view.fault(at.offset, f"a record claims {at.length} bytes, which hold other records")


def _take_loose(found: Survey, at: RecordAt) -> None:
    """Add a record outside of chunks."""
    view = found.view
    _check_length(found, at)
    if at.opcode == Opcode.METADATA:
        check_exact(view, at)
    elif at.opcode == Opcode.ATTACHMENT:
        stored, crc = attachment_crc(view, at)
        if stored != crc:
            raise view.fault(at.offset, "the CRC of an attachment is wrong")
    elif at.opcode == Opcode.MESSAGE and at.length >= MESSAGE.size:
        _, _, channel, _, time_ns, _ = MESSAGE.unpack(view.read(at.offset, MESSAGE.size))
        if _has_lost_chunk_heads(found) and up_to_first_hole(view, at.offset, at.length) < at.length:
            raise view.fault(at.offset, "a message holds a sector of zeros")
        if at.offset < found.doubtful_to and found.resync.chunked:
            raise view.fault(at.offset, "a message outside of chunks follows damage in a log with chunks")
        if at.offset < found.doubtful_to and not found.resync.fits(channel, time_ns):
            raise view.fault(at.offset, "a message after damage has an unknown channel and another time")
        try:
            found.definitions.need(view, at.offset, channel)
        except LogError:
            if found.resync.chunked:
                found.lost.note(found.definitions.topic(channel), time_ns)
            else:
                found.homeless.append(at)
            raise
        found.resync.times_ns.append(time_ns)
        if found.resync.chunked and at.offset >= found.doubtful_to:
            found.resync.chunked = None  # the log has messages in chunks and outside of chunks
    elif at.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        found.definitions.take(view, at, doubtful=at.offset < found.doubtful_to)
        return
    add_record(view, found.contents, found.loose, found.counts, at)


def _has_lost_chunk_heads(found: Survey) -> bool:
    """Return whether messages outside of chunks may be from a chunk with a lost head.

    This is unknown if both ends of the log are lost.
    """
    begins_late = bool(found.damaged) and found.damaged[0].offset == 0
    return begins_late and found.definitions.summary is None


def _take_chunk(found: Survey, at: RecordAt) -> None:
    view = found.view
    if found.resync.chunked is False:
        raise view.fault(at.offset, "a chunk lies in a log that has its messages outside of chunks")
    head = parse_chunk_head(view, at.offset)[1]
    data = unpack(view, at.offset, head)
    inside = look_inside(view, at.offset, data)
    if head.crc == 0:
        _check_definitions(view, at.offset, data)
        if found.has_crcs:
            _check_without_crc(found, at)
    found.has_crcs |= head.crc != 0
    stop, is_doubtful = at.offset + at.length, at.offset < found.doubtful_to
    is_alone = is_doubtful and stop < view.size and not found.resync.leads_on(stop)
    found.definitions.take_chunk(
        view, at.offset, inside, checked=head.crc != 0, doubtful=is_doubtful, alone=is_alone
    )
    add_record(view, found.contents, found.loose, found.counts, at)
    times = [time for rows in inside.entries.values() for time, _ in rows]
    if times:  # the times in its head may be wrong, and readers use them
        span = (min(times), max(times))
        if span != (head.start_ns, head.end_ns):
            found.wrong_heads.append((at.offset + HEADER.size, ENTRY.pack(*span)))
        chunk = found.contents.chunks[-1]
        found.contents.chunks[-1] = chunk._replace(start_ns=span[0], end_ns=span[1])
    found.counts[at.offset] = {key: len(rows) for key, rows in inside.entries.items()}
    _continue_hashes(found, inside, data)
    if not found.resync.times_ns:  # else the log has messages in chunks and outside of chunks
        found.resync.chunked = True
    found.indexed = Indexed(stop, inside)


def _check_without_crc(found: Survey, at: RecordAt) -> None:
    """Refuse a chunk without CRC among chunks with CRC, if it may belong to another log."""
    if found.resync.holds_chunk(at):
        found.wrong_length = at.offset
        raise found.view.fault(at.offset, "a chunk without CRC holds another chunk")
    if at.offset < found.doubtful_to:
        raise found.view.fault(
            at.offset, "a chunk without CRC follows damage in a log whose chunks have CRCs"
        )


def _check_definitions(view: View, offset: int, data: bytes) -> None:
    """Refuse a chunk without CRC whose definitions have wrong lengths."""
    for record_at in inner_records(view, offset, data):
        if record_at.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = data[record_at.offset : record_at.offset + record_at.length]
            if (
                len(as_bytes(exact(view, RecordAt(record_at.opcode, offset, record_at.length), record)))
                != record_at.length
            ):
                raise view.fault(offset, "a definition in the chunk claims less than it holds")


def _continue_hashes(found: Survey, inside: Inside, data: bytes) -> None:
    rows = sorted((offset, key) for key, entries in inside.entries.items() for _, offset in entries)
    for offset, key in rows:
        topic = found.definitions.channels[key].topic
        _, length, _, _, time, published = MESSAGE.unpack_from(data, offset)
        payload = data[offset + MESSAGE.size : offset + HEADER.size + length]
        found.hashes.setdefault(topic, ChannelHash()).add(time, published, payload)


def _take_index(found: Survey, at: RecordAt) -> None:
    """Add a MessageIndex record to the chunk, or to the damaged stretch, before it."""
    indexed = found.indexed
    if found.resync.chunked is False:
        raise found.view.fault(at.offset, "a MessageIndex record lies in a log without chunks")
    if indexed is None:
        channel, rows = _index_rows(found.view, at)
        for time_ns, _ in rows:
            found.lost.note(found.definitions.topic(channel), time_ns)
        add_damage(found, Stretch(at.offset, at.length), "a MessageIndex record follows no chunk")
        return
    if not is_index(found.view, at):
        raise found.view.fault(at.offset, "a MessageIndex record has another length than its entries")
    _check_length(found, at)
    try:
        channel, rows = _index_rows(found.view, at)
        if indexed.inside is not None:
            fits = sorted(rows) == sorted(indexed.inside.entries.get(channel, []))
            indexed.sound &= fits and channel in found.definitions.channels
        indexed.sound &= channel not in indexed.rows
        indexed.rows[channel] = rows
        if rows:
            indexed.offsets[channel] = at.offset
    except LogError as error:
        indexed.sound = False
        found.faults.append(_reason(error))
    if indexed.stretch is not None:
        indexed.stretch.length += at.length
        found.damaged[-1].length += at.length


def _index_rows(view: View, at: RecordAt) -> tuple[int, list[tuple[int, int]]]:
    """Return the channel of a MessageIndex record, and the log times and offsets of its messages."""
    body = view.read(at.offset, at.length)
    channel = int.from_bytes(body[HEADER.size : HEADER.size + 2], "little")
    return channel, list(ENTRY.iter_unpack(parse_message_index(view, body, 0, channel, at.offset)))


def _advance_crc(found: Survey, position: int) -> None:
    found.crc = crc_of(found.view, position - found.crc_at, found.crc_at, found.crc)
    found.crc_at = position


def _reason(error: LogError) -> str:
    return str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0]
