"""Check of every record of a log, finished or not."""

from collections import ChainMap

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.bounds import BoundError
from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import ChunkContents, inner_records, parse_chunk_contents, unpack
from ipsys_log.log.damage.definitions import Definitions
from ipsys_log.log.damage.findings import (
    COUNTED,
    UNCHUNKED,
    IndexGroup,
    Survey,
    Watch,
    add_damage,
    close_indexes,
    skip_damage,
)
from ipsys_log.log.damage.regions import DamagedRange
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
    parse_chunk_head,
    parse_exact,
    parse_message_index,
    to_bytes,
    walk,
)
from ipsys_log.log.scan import add_record, count_all
from ipsys_log.log.summary import Summary

HEADER_RECORD = to_bytes(mcap.Header("", "ipsys 1"))
_LAG = 1 << 20  # bytes
_LONGEST_HEADER = 1 << 20  # bytes


def survey(
    view: LogBytes,
    known: Summary | None = None,
    salvage: Salvage | None = None,
    *,
    doubtful: bool = False,
    watch: Watch | None = None,
) -> Survey:
    """Check the data section record by record, without trusting lengths or raising errors for damage.

    A log that exceeds the limits is refused with a `BoundError`: it may be undamaged, so it is not repaired.

    The file is read once. `known` is the summary, if there is one: it may have definitions that the data
    section lacks. Without `salvage`, damaged chunks are skipped. With `doubtful`, unconfirmed lengths are
    checked closely. `watch` follows the reading.
    """
    damaged: list[DamagedRange] = []
    definitions = Definitions(known, damaged)
    channels = ChainMap[int, mcap.Channel](definitions.channels, definitions.known.channels)
    resync = Resync(view, channels, _is_chunked(known), _span_ns(known))
    findings = Survey(view, resync, definitions, salvage, watch or Watch(), damaged=damaged)
    findings.doubtful_to = view.size if doubtful else 0
    position = _take_start(findings)
    while position < view.size and not findings.finished:
        position = _take_records(findings, position)
    if findings.indexed is not None:
        close_indexes(findings, findings.end)
    _advance_crc(findings, findings.end)
    damaged.sort(key=lambda damaged_range: damaged_range.offset)
    if findings.finished:
        _, _, stored = DATA_END.unpack(view.read(findings.end, DATA_END.size))
        findings.crc_is_right = stored in (0, findings.crc)
        findings.has_crc = stored != 0
    findings.unchunked.schemas, findings.unchunked.channels = definitions.schemas, definitions.channels
    count_all(findings.contents, findings.unchunked, findings.counts)
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


def _take_start(findings: Survey) -> int:
    """Check the magic bytes and the Header record; return the offset of the records after them."""
    view, start = findings.view, len(MAGIC)
    header_end, reason = _behind_header(findings)
    if view.read(0, min(start, view.size)) != MAGIC:
        follower = start if header_end > start else findings.resync.find(start)
        if follower is None:
            return view.size
        findings.indexed = IndexGroup(follower) if follower > start else None
        head = MAGIC + (HEADER_RECORD if follower >= start + len(HEADER_RECORD) else b"")
        add_damage(findings, DamagedRange(0, follower, head), "it does not begin as an MCAP file")
        return max(follower, header_end)
    findings.end = header_end or start
    if header_end:
        return header_end
    follower = findings.resync.find(start)
    if follower is None:
        return start
    head = HEADER_RECORD if follower >= start + len(HEADER_RECORD) else b""
    return add_damage(findings, DamagedRange(start, follower - start, head), reason)


def _behind_header(findings: Survey) -> tuple[int, str]:
    """Return the end of the Header record (its offset if it is missing), or 0 and the fault if damaged."""
    view, start = findings.view, len(MAGIC)
    try:
        record_at = next(walk(view, start, view.size), None)
        if record_at is None or record_at.opcode != Opcode.HEADER:
            return start, ""
        if record_at.length > _LONGEST_HEADER:
            raise view.fault(start, f"the HEADER record claims {record_at.length} bytes")
        parse_exact(view, record_at, view.read(start, record_at.length))
        _check_length(findings, record_at)
    except UnreadError:
        raise
    except LogError as error:
        return 0, _reason(error)
    return record_at.offset + record_at.length, ""


def _take_records(findings: Survey, position: int) -> int:
    """Check the records from `position` up to the next damage; return the offset after it."""
    view = findings.view
    record_at = RecordAt(0, position, 0)
    try:
        for record_at in walk(view, position, view.size):
            _take(findings, record_at)
            if findings.finished:
                return view.size
            findings.end = position = record_at.offset + record_at.length
            if position - findings.crc_at > _LAG:
                findings.watch.progress(position)
                _advance_crc(findings, position if findings.indexed is None else findings.indexed.start)
    except (BoundError, UnreadError):
        raise
    except LogError as error:
        return skip_damage(
            findings, position, record_at if record_at.offset == position else None, _reason(error)
        )
    return view.size


def _take(findings: Survey, record: RecordAt) -> None:
    """Check one record and add it."""
    view = findings.view
    if record.opcode == Opcode.MESSAGE_INDEX:
        _take_index(findings, record)
        return
    indexed = findings.indexed
    is_among = indexed is not None and indexed.inside is not None and not indexed.is_complete
    if record.opcode == Opcode.MESSAGE and is_among and findings.resync.chunked:
        raise view.fault(record.offset, "a message is among the message indexes of a chunk")
    if indexed is not None:
        close_indexes(findings, record.offset)
    if record.opcode == Opcode.DATA_END and record.length == DATA_END.size:
        _advance_crc(findings, record.offset)
        if not findings.resync.is_end(record.offset, findings.crc):
            raise view.fault(record.offset, "records follow after a DataEnd record")
        findings.finished, findings.end = True, record.offset
    elif record.opcode == Opcode.CHUNK:
        _take_chunk(findings, record)
    elif record.opcode in UNCHUNKED:
        _take_unchunked(findings, record)
    elif record.opcode < PRIVATE:
        raise view.fault(record.offset, f"a record of type {record.opcode} is not allowed there")
    else:
        _check_length(findings, record)


def _check_length(findings: Survey, record: RecordAt) -> None:
    """Refuse a record whose wrong length includes whole records, or ends before a whole record.

    If a record follows, the length is right. If no record follows, the damage may also be after this record.
    """
    view, stop = findings.view, record.offset + record.length
    follows = stop == view.size
    if stop + HEADER.size <= view.size:
        opcode, length = HEADER.unpack(view.read(stop, HEADER.size))
        known = opcode in UNCHUNKED or opcode in COUNTED or opcode == Opcode.CHUNK or opcode >= PRIVATE
        follows = known and length <= view.size - stop - HEADER.size and record.offset >= findings.doubtful_to
        follows = follows or findings.resync.is_chunk_head(stop)  # perhaps a chunk that is cut off
    if not follows:
        inner = findings.resync.find(record.offset)
        if inner is not None and inner != stop and inner < stop + HEADER.size:
            findings.wrong_length = record.offset
            if record.opcode == Opcode.MESSAGE and record.length >= MESSAGE.size and stop < inner:
                findings.displaced.append(
                    record
                )  # it may be whole: the gap between them is too small to skip
            raise view.fault(
                record.offset, f"a record claims {record.length} bytes, which hold other records"
            )


def _take_unchunked(findings: Survey, record: RecordAt) -> None:
    """Add a record outside of chunks."""
    view = findings.view
    _check_length(findings, record)
    if record.opcode == Opcode.METADATA:
        check_exact(view, record)
    elif record.opcode == Opcode.ATTACHMENT:
        stored, crc = attachment_crc(view, record)
        if stored != crc:
            raise view.fault(record.offset, "the CRC of an attachment is wrong")
    elif record.opcode == Opcode.MESSAGE and record.length >= MESSAGE.size:
        _, _, channel, _, time_ns, published_ns = MESSAGE.unpack(view.read(record.offset, MESSAGE.size))
        if (
            _has_lost_chunk_heads(findings)
            and up_to_first_hole(view, record.offset, record.length) < record.length
        ):
            raise view.fault(record.offset, "a message holds a sector of zeros")
        if record.offset < findings.doubtful_to and findings.resync.chunked:
            raise view.fault(record.offset, "a message outside of chunks follows damage in a log with chunks")
        if record.offset < findings.doubtful_to and not findings.resync.fits(channel, time_ns):
            raise view.fault(record.offset, "a message after damage has an unknown channel and another time")
        try:
            findings.definitions.ensure_channel(view, record.offset, channel)
        except LogError:
            if findings.resync.chunked:
                findings.lost.add(findings.definitions.topic(channel), time_ns)
            else:
                findings.displaced.append(record)
            raise
        findings.watch.message(findings.definitions.topic(channel), time_ns, published_ns)
        findings.resync.times_ns.append(time_ns)
        if findings.resync.chunked and record.offset >= findings.doubtful_to:
            findings.resync.chunked = None  # the log has messages in chunks and outside of chunks
    elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        findings.definitions.add_record(view, record, doubtful=record.offset < findings.doubtful_to)
        return
    add_record(view, findings.contents, findings.unchunked, findings.counts, record)


def _has_lost_chunk_heads(findings: Survey) -> bool:
    """Return whether messages outside of chunks may be from a chunk with a lost head.

    This is unknown if both ends of the log are lost.
    """
    begins_late = bool(findings.damaged) and findings.damaged[0].offset == 0
    return begins_late and findings.definitions.summary is None


def _take_chunk(findings: Survey, record: RecordAt) -> None:
    view = findings.view
    if findings.resync.chunked is False:
        raise view.fault(record.offset, "a chunk is in a log that has its messages outside of chunks")
    head = parse_chunk_head(view, record.offset)[1]
    data = unpack(view, record.offset, head)
    inside = parse_chunk_contents(view, record.offset, data)
    if head.crc == 0:
        _check_definitions(view, record.offset, data)
        if findings.has_crcs:
            _check_without_crc(findings, record)
    findings.has_crcs |= head.crc != 0
    stop, is_doubtful = record.offset + record.length, record.offset < findings.doubtful_to
    is_alone = is_doubtful and stop < view.size and not findings.resync.starts_records(stop)
    findings.definitions.take_chunk(
        view, record.offset, inside, checked=head.crc != 0, doubtful=is_doubtful, alone=is_alone
    )
    add_record(view, findings.contents, findings.unchunked, findings.counts, record)
    times = [time for rows in inside.entries.values() for time, _ in rows]
    if times:  # the times in its head may be wrong, and readers use them
        span = (min(times), max(times))
        if span != (head.start_ns, head.end_ns):
            findings.wrong_heads.append((record.offset + HEADER.size, ENTRY.pack(*span)))
        chunk = findings.contents.chunks[-1]
        findings.contents.chunks[-1] = chunk._replace(start_ns=span[0], end_ns=span[1])
    findings.counts[record.offset] = {key: len(rows) for key, rows in inside.entries.items()}
    _continue_hashes(findings, inside, data)
    if not findings.resync.times_ns:  # else the log has messages in chunks and outside of chunks
        findings.resync.chunked = True
    findings.indexed = IndexGroup(stop, inside)


def _check_without_crc(findings: Survey, record: RecordAt) -> None:
    """Refuse a chunk without CRC among chunks with CRC, if it may belong to another log."""
    if findings.resync.holds_chunk(record):
        findings.wrong_length = record.offset
        raise findings.view.fault(record.offset, "a chunk without CRC holds another chunk")
    if record.offset < findings.doubtful_to:
        raise findings.view.fault(
            record.offset, "a chunk without CRC follows damage in a log whose chunks have CRCs"
        )


def _check_definitions(view: LogBytes, offset: int, data: bytes) -> None:
    """Refuse a chunk without CRC whose definitions have wrong lengths."""
    for record_at in inner_records(view, offset, data):
        if record_at.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            record = data[record_at.offset : record_at.offset + record_at.length]
            if (
                len(to_bytes(parse_exact(view, RecordAt(record_at.opcode, offset, record_at.length), record)))
                != record_at.length
            ):
                raise view.fault(offset, "a definition in the chunk claims less than it holds")


def _continue_hashes(findings: Survey, inside: ChunkContents, data: bytes) -> None:
    rows = sorted((offset, key) for key, entries in inside.entries.items() for _, offset in entries)
    for offset, key in rows:
        topic = findings.definitions.channels[key].topic
        _, length, _, _, time, published = MESSAGE.unpack_from(data, offset)
        payload = data[offset + MESSAGE.size : offset + HEADER.size + length]
        findings.hashes.setdefault(topic, ChannelHash()).add(time, published, payload)
        findings.watch.message(topic, time, published)


def _take_index(findings: Survey, record: RecordAt) -> None:
    """Add a MessageIndex record to the chunk, or to the damaged range, before it."""
    indexed = findings.indexed
    if findings.resync.chunked is False:
        raise findings.view.fault(record.offset, "a MessageIndex record is in a log without chunks")
    if indexed is None:
        channel, rows = _index_rows(findings.view, record)
        for time_ns, _ in rows:
            findings.lost.add(findings.definitions.topic(channel), time_ns)
        add_damage(
            findings, DamagedRange(record.offset, record.length), "a MessageIndex record follows no chunk"
        )
        return
    if not is_index(findings.view, record):
        raise findings.view.fault(record.offset, "a MessageIndex record has another length than its entries")
    _check_length(findings, record)
    try:
        channel, rows = _index_rows(findings.view, record)
        if indexed.inside is not None:
            fits = sorted(rows) == sorted(indexed.inside.entries.get(channel, []))
            indexed.sound &= fits and channel in findings.definitions.channels
        indexed.sound &= channel not in indexed.rows
        indexed.rows[channel] = rows
        if rows:
            indexed.offsets[channel] = record.offset
    except UnreadError:
        raise
    except LogError as error:
        indexed.sound = False
        findings.faults.append(_reason(error))
    if indexed.damaged_range is not None:
        indexed.damaged_range.length += record.length
        findings.damaged[-1].length += record.length


def _index_rows(view: LogBytes, record: RecordAt) -> tuple[int, list[tuple[int, int]]]:
    """Return the channel of a MessageIndex record, and the log times and offsets of its messages."""
    body = view.read(record.offset, record.length)
    channel = int.from_bytes(body[HEADER.size : HEADER.size + 2], "little")
    return channel, list(ENTRY.iter_unpack(parse_message_index(view, body, 0, channel, record.offset)))


def _advance_crc(findings: Survey, position: int) -> None:
    findings.crc = crc_of(findings.view, position - findings.crc_at, findings.crc_at, findings.crc)
    findings.crc_at = position


def _reason(error: LogError) -> str:
    return str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0]
