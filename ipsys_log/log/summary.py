"""The table of contents of a log file, from its summary if it is complete, else from its records."""

import struct
import zlib
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.byte_source import BoundError, LogBytes
from ipsys_log.log.chunks import ChunkContents, check_definition, parse_chunk_contents, unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.records import (
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    ChunkRef,
    RecordAt,
    parse,
    parse_chunk_head,
    parse_chunk_index,
    to_bytes,
    walk,
)
from ipsys_log.plain_text import shell_words

# The record before a temporary tail: a private type, with the offset of the end of the old data.
TEMPORARY_TAIL_MARK = struct.Struct("<BQ8sQ")
_LARGEST_GAP = 1 << 20  # bytes: the definitions between two chunks
_MARK_TYPE, _MARK_NAME = 0x80 | Opcode.DATA_END, b"standing"


def temporary_tail_bytes(contents: Contents, offset: int) -> bytes:
    """Return the temporary tail of a log at `offset`, for the time while new data are written before it."""
    length = TEMPORARY_TAIL_MARK.size - HEADER.size
    mark = TEMPORARY_TAIL_MARK.pack(_MARK_TYPE, length, _MARK_NAME, contents.data_end)
    return mark + tail_bytes(contents, offset + len(mark))


def temporary_tail_data_end(view: LogBytes, offset: int) -> int | None:
    """Return the end of the data if the DataEnd record at `offset` belongs to a temporary tail, else None."""
    if offset < len(MAGIC) + TEMPORARY_TAIL_MARK.size:
        return None
    mark = TEMPORARY_TAIL_MARK.unpack(view.read(offset - TEMPORARY_TAIL_MARK.size, TEMPORARY_TAIL_MARK.size))
    expected = (_MARK_TYPE, TEMPORARY_TAIL_MARK.size - HEADER.size, _MARK_NAME)
    return mark[3] if mark[:3] == expected and len(MAGIC) <= mark[3] < offset else None


def tail_bytes(contents: Contents, offset: int | None = None) -> bytes:
    """Return the tail of a log: DataEnd, summary and footer, at ``contents.data_end`` or another `offset`."""
    start = (contents.data_end if offset is None else offset) + DATA_END.size
    summary, offsets = b"", b""
    for opcode, records in _groups(contents):
        group = to_bytes(*records)
        if group:
            offsets += to_bytes(mcap.SummaryOffset(opcode, start + len(summary), len(group)))
            summary += group
    footer = FOOTER.pack(Opcode.FOOTER, 20, start, start + len(summary), 0)[:-4]
    crc = zlib.crc32(summary + offsets + footer)
    data_end = DATA_END.pack(Opcode.DATA_END, 4, contents.data_crc)
    return b"".join((data_end, summary, offsets, footer, crc.to_bytes(4, "little"), MAGIC))


def _groups(contents: Contents) -> list[tuple[Opcode, list[mcap.McapRecord]]]:
    return [
        (Opcode.SCHEMA, list(contents.schemas.values())),
        (Opcode.CHANNEL, list(contents.channels.values())),
        (Opcode.STATISTICS, [_statistics(contents)]),
        (Opcode.CHUNK_INDEX, [chunk.as_record() for chunk in contents.chunks]),
        (Opcode.ATTACHMENT_INDEX, list(contents.attachments)),
        (Opcode.METADATA_INDEX, list(contents.metadata)),
    ]


def _statistics(contents: Contents) -> mcap.Statistics:
    return mcap.Statistics(
        attachment_count=contents.attachment_count,
        channel_count=len(contents.channels),
        channel_message_counts=contents.counts,
        chunk_count=len(contents.chunks),
        message_count=sum(contents.counts.values()),
        message_end_time=contents.end_ns or 0,
        message_start_time=contents.start_ns or 0,
        metadata_count=contents.metadata_count,
        schema_count=len(contents.schemas),
    )


class NoFooterError(LogError):
    """A log without an end: its writer is still running, or was killed."""


class Summary(NamedTuple):
    """The summary of a log. `checked` says that its CRC is right (a summary may have no CRC)."""

    contents: Contents
    statistics: mcap.Statistics | None
    checked: bool


def read_intact_summary(view: LogBytes) -> Summary | None:
    """Read only the summary; None if the log has none, or if its end is missing or damaged.

    Raises
    ------
    BoundError
        The log exceeds the limits of its file size.
    """
    try:
        return read_summary(view)
    except (BoundError, UnreadError):
        raise
    except LogError:
        return None


def read_summary(view: LogBytes) -> Summary | None:
    """Read only the summary; None if the log has none."""
    footer_at, summary_start, checked = _footer(view)
    if not summary_start:
        return None
    contents, statistics = _from_summary(view, summary_start, footer_at)
    return Summary(contents, statistics, checked)


def load_contents(view: LogBytes) -> Contents:
    """Read the table of contents of a finished log.

    Raises
    ------
    LogError
        The file is empty, no MCAP file, or damaged; a `NoFooterError` if its end is missing.
    """
    _check_start(view)
    footer_at, summary_start, _ = _footer(view)
    contents, complete = (None, False)
    if summary_start:
        contents, statistics = _from_summary(view, summary_start, footer_at)
        complete = statistics is not None and _is_complete(contents, statistics)
    end = summary_start or footer_at
    data_end = end - DATA_END.size
    opcode, length, crc = DATA_END.unpack(view.read(data_end, DATA_END.size)) if data_end >= 8 else (0, 0, 0)
    if (opcode, length) != (Opcode.DATA_END, 4):
        raise view.fault(max(data_end, 0), "there is no DataEnd record before the summary")
    old_data_end = temporary_tail_data_end(view, data_end)
    if old_data_end is not None:
        data_end = old_data_end
    if contents is None or not complete or not _gaps_hold_no_messages(view, contents, data_end):
        contents = scan(view, data_end)
    view.check_number(len(contents.channels), "channels")
    view.check_number(len(contents.schemas), "schemas")
    contents.data_end, contents.data_crc, contents.cut_short = data_end, crc, old_data_end is not None
    return contents


def _check_start(view: LogBytes) -> None:
    start = view.read(0, min(len(MAGIC), view.size))
    if not start:
        raise LogError(f"{view.path} is empty: it has no messages")
    if not MAGIC.startswith(start):
        raise LogError(
            f"{view.path} is not an MCAP file (it starts with {start!r}): give a log, with a name that "
            "ends in .mcap"
        )


def _footer(view: LogBytes) -> tuple[int, int, bool]:
    """Return the offsets of the footer and the summary (0: none), and whether a CRC confirms both."""
    path = view.path
    footer_at = view.size - len(MAGIC) - FOOTER.size
    tail = view.read(footer_at, view.size - footer_at) if footer_at >= len(MAGIC) else b""
    if not tail.endswith(MAGIC) or FOOTER.unpack_from(tail)[:2] != (Opcode.FOOTER, 20):
        # A file is repaired in place; an object at a URL cannot be.
        is_file = isinstance(path, Path)
        steps = (
            f"Run: ipsys repair {shell_words(path)}" if is_file else "Download the log, and repair the file"
        )
        raise NoFooterError(
            f"{path} has no end: its recorder was killed, or the file was cut off. Its messages can be "
            f"saved. {steps}"
        )
    _, _, summary_start, _, crc = FOOTER.unpack_from(tail)
    if summary_start and not len(MAGIC) < summary_start <= footer_at:
        raise view.fault(footer_at, f"the footer says that the summary starts at byte {summary_start}")
    if summary_start and crc:
        summary = view.read(summary_start, footer_at - summary_start + FOOTER.size - 4)
        if zlib.crc32(summary) != crc:
            raise view.fault(summary_start, "the CRC of the summary is wrong")
    return footer_at, summary_start, bool(summary_start and crc)


def _from_summary(view: LogBytes, start: int, end: int) -> tuple[Contents, mcap.Statistics | None]:
    """Parse the summary and its Statistics record. A summary without this record is not complete."""
    contents = Contents()
    statistics: mcap.Statistics | None = None
    data = view.read(start, end - start)
    for record_at in walk(view, start, end):
        body = data[record_at.offset - start + HEADER.size : record_at.offset - start + record_at.length]
        if record_at.opcode == Opcode.STATISTICS:
            statistics = parse(mcap.Statistics.read, view, record_at, body)
        elif record_at.opcode == Opcode.CHUNK_INDEX:
            contents.chunks.append(parse_chunk_index(view, record_at, body))
        elif record_at.opcode == Opcode.ATTACHMENT_INDEX:
            contents.attachments.append(parse(mcap.AttachmentIndex.read, view, record_at, body))
        elif record_at.opcode == Opcode.METADATA_INDEX:
            contents.metadata.append(parse(mcap.MetadataIndex.read, view, record_at, body))
        elif record_at.opcode == Opcode.SCHEMA:
            schema = parse(mcap.Schema.read, view, record_at, body)
            contents.schemas.setdefault(schema.id, schema)
        elif record_at.opcode == Opcode.CHANNEL:
            channel = parse(mcap.Channel.read, view, record_at, body)
            contents.channels.setdefault(channel.id, channel)
    if statistics is None:
        return contents, None
    contents.counts = dict(statistics.channel_message_counts)
    contents.attachment_count = statistics.attachment_count
    contents.metadata_count = statistics.metadata_count
    if statistics.message_count:
        contents.cover(statistics.message_start_time, statistics.message_end_time)
    return contents, statistics


def _is_complete(contents: Contents, statistics: mcap.Statistics) -> bool:
    known = contents.channels.keys()
    return (
        len(known) == statistics.channel_count
        and contents.counts.keys() <= known
        and all(c.schema_id == 0 or c.schema_id in contents.schemas for c in contents.channels.values())
        and len(contents.chunks) == statistics.chunk_count
        and all(chunk.index_offsets.keys() <= known for chunk in contents.chunks)
        and (statistics.chunk_count > 0 or statistics.message_count == 0)
        and sum(contents.counts.values()) == statistics.message_count
        and len(contents.metadata) == statistics.metadata_count
        and len(contents.attachments) == statistics.attachment_count
    )


def _gaps_hold_no_messages(view: LogBytes, contents: Contents, data_end: int) -> bool:
    """Return whether all messages lie in the indexed chunks.

    The gaps between the chunks are small, so all their records are checked.
    """
    extents = sorted((chunk.offset, chunk.end) for chunk in contents.chunks)
    edges = [(0, len(MAGIC)), *extents, (data_end, data_end)]
    gaps = [(start, end) for (_, start), (end, _) in pairwise(edges)]
    view.plan("gaps", ((start, end) for start, end in gaps if start < end <= start + _LARGEST_GAP))
    for start, end in gaps:
        if start > end:
            raise view.fault(end, "two chunks overlap, or one reaches into the summary")
        for record_at in walk(view, start, end):
            if record_at.opcode in (Opcode.MESSAGE, Opcode.CHUNK):
                return False
    return True


def scan(view: LogBytes, data_end: int) -> Contents:
    """Read the heads of all records in the data section, and the contents of chunks if necessary."""
    contents, unchunked = Contents(), ChunkContents()
    counts: dict[int, dict[int, int]] = {}  # per chunk offset, from its MessageIndex records
    for record_at in walk(view, len(MAGIC), data_end):
        add_record(view, contents, unchunked, counts, record_at)
    inside = [chunk for chunk in contents.chunks if not counts[chunk.offset]]
    known = contents.channels.keys() | unchunked.channels.keys()
    if any(not (channels.keys() <= known) for channels in counts.values()):
        inside = contents.chunks
    for chunk in inside:
        chunk_inside = parse_chunk_contents(
            view, chunk.offset, unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
        )
        contents.schemas = chunk_inside.schemas | contents.schemas
        contents.channels = chunk_inside.channels | contents.channels
        counts[chunk.offset] = {key: len(rows) for key, rows in chunk_inside.entries.items()}
    count_all(contents, unchunked, counts)
    return contents


def add_record(
    view: LogBytes,
    contents: Contents,
    unchunked: ChunkContents,
    counts: dict[int, dict[int, int]],
    record: RecordAt,
) -> None:
    """Add one record of the data section to `contents`."""
    if record.opcode == Opcode.CHUNK:
        _, head = parse_chunk_head(view, record.offset)
        start, end, size = head.start_ns, head.end_ns, head.uncompressed_size
        contents.chunks.append(
            ChunkRef(record.offset, record.length, start, end, head.compression, head.data_size, size, 0, {})
        )
        counts[record.offset] = {}
    elif record.opcode == Opcode.MESSAGE_INDEX:
        _add_message_index(view, contents, counts, record)
    elif record.opcode == Opcode.MESSAGE:
        unchunked.add(
            view,
            record,
            record.offset,
            view.read(record.offset + 9, min(record.length, MESSAGE.size) - HEADER.size),
        )
    elif record.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
        _add_index(view, contents, record)
    elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        unchunked.add(view, record, record.offset, _body(view, record))


def _body(view: LogBytes, record: RecordAt) -> bytes:
    check_definition(view, record)
    return view.read(record.offset + HEADER.size, record.length - HEADER.size)


def _add_message_index(
    view: LogBytes, contents: Contents, counts: dict[int, dict[int, int]], record: RecordAt
) -> None:
    if not contents.chunks or contents.chunks[-1].end != record.offset or record.length < 15:
        raise view.fault(record.offset, "a MessageIndex record follows no chunk")
    chunk = contents.chunks[-1]
    channel, size = struct.unpack("<HI", view.read(record.offset + HEADER.size, 6))
    counts[chunk.offset][channel] = size // 16
    offsets = chunk.index_offsets | ({channel: record.offset} if size else {})
    contents.chunks[-1] = ChunkRef(
        chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, chunk.compression, chunk.compressed_size,
        chunk.uncompressed_size, chunk.index_length + record.length, offsets,
    )  # fmt: skip


def _add_index(view: LogBytes, contents: Contents, record: RecordAt) -> None:
    """Add an attachment or a metadata record to the indexes; read only the head of an attachment."""
    if record.opcode == Opcode.METADATA:
        metadata = parse(mcap.Metadata.read, view, record, _body(view, record))
        contents.metadata.append(mcap.MetadataIndex(record.offset, record.length, metadata.name))
        contents.metadata_count += 1
        return
    head = view.read(record.offset + HEADER.size, min(record.length - HEADER.size, 1 << 16))
    try:
        log_time, create_time, name_length = struct.unpack_from("<QQI", head)
        (type_length,) = struct.unpack_from("<I", head, 20 + name_length)
        (size,) = struct.unpack_from("<Q", head, 24 + name_length + type_length)
        name = str(head[20 : 20 + name_length], "utf-8")
        media_type = str(head[24 + name_length : 24 + name_length + type_length], "utf-8")
    except (struct.error, UnicodeDecodeError) as error:
        raise view.fault(record.offset, f"the Attachment record is not valid ({error})") from None
    index = mcap.AttachmentIndex(record.offset, record.length, log_time, create_time, size, name, media_type)
    contents.attachments.append(index)
    contents.attachment_count += 1


def count_all(contents: Contents, unchunked: ChunkContents, counts: dict[int, dict[int, int]]) -> None:
    """Fill in definitions, counts and the time range after all records were added."""
    contents.schemas = unchunked.schemas | contents.schemas
    contents.channels = unchunked.channels | contents.channels
    contents.unchunked = unchunked.entries
    for chunk in contents.chunks:
        for channel, number in counts[chunk.offset].items():
            contents.count(channel, number)
        if any(counts[chunk.offset].values()):
            contents.cover(chunk.start_ns, chunk.end_ns)
    for channel, rows in contents.unchunked.items():
        contents.count(channel, len(rows))
        contents.cover(min(rows)[0], max(rows)[0])
