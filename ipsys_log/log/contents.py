"""The table of contents of a log: from its summary where that is complete, else from its records."""

import struct
import zlib
from dataclasses import dataclass, field
from itertools import pairwise

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.errors import LogError
from ipsys_log.log.chunks import Inside, look_inside, unpack
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
    walk,
)
from ipsys_log.log.view import View

__all__ = ["Contents", "add_record", "count_all", "load_contents"]

_LARGEST_RECORD = 1 << 30  # a definition or an index: what one record may make us allocate


@dataclass(slots=True)
class Contents:
    """Schemas and channels by id, chunks, and the counts that go into the Statistics record.

    `loose` holds the messages that lie in no chunk: per channel id (log time in ns, file offset).
    `data_end` is the offset of the DataEnd record, `data_crc` its CRC (0: not computed).
    """

    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    chunks: list[ChunkRef] = field(default_factory=list)
    attachments: list[mcap.AttachmentIndex] = field(default_factory=list)
    metadata: list[mcap.MetadataIndex] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    attachment_count: int = 0
    metadata_count: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    loose: dict[int, list[tuple[int, int]]] = field(default_factory=dict)
    data_end: int = 0
    data_crc: int = 0

    def count(self, channel_id: int, messages: int) -> None:
        """Add `messages` to the count of a channel."""
        self.counts[channel_id] = self.counts.get(channel_id, 0) + messages

    def cover(self, start_ns: int, end_ns: int) -> None:
        """Stretch the time range of the log over `start_ns` to `end_ns`."""
        self.start_ns = start_ns if self.start_ns is None else min(self.start_ns, start_ns)
        self.end_ns = end_ns if self.end_ns is None else max(self.end_ns, end_ns)


def load_contents(view: View) -> Contents:
    """The table of contents of a finished log.

    Raises
    ------
    LogError
        The file is empty, not an MCAP, has no footer, or is damaged.
    """
    footer_at, summary_start = _footer(view)
    contents, complete = (None, False)
    if summary_start:
        contents, complete = _from_summary(view, summary_start, footer_at)
    end = summary_start or footer_at
    data_end = end - DATA_END.size
    opcode, length, crc = DATA_END.unpack(view.read(data_end, DATA_END.size)) if data_end > 8 else (0, 0, 0)
    if (opcode, length) != (Opcode.DATA_END, 4):
        raise view.fault(max(data_end, 0), "there is no DataEnd record before the summary")
    if contents is None or not complete or not _gaps_hold_no_messages(view, contents, data_end):
        contents = _from_records(view, data_end)
    contents.data_end, contents.data_crc = data_end, crc
    return contents


def _footer(view: View) -> tuple[int, int]:
    """Offset of the Footer record, and of the summary (0: none)."""
    path = view.path
    start = view.read(0, min(8, view.size))
    if not start:
        raise LogError(f"{path} is empty: nothing was ever written to it")
    if not MAGIC.startswith(start):
        raise LogError(f"{path} is not an MCAP file (it starts with {start!r}): give a log ending in .mcap")
    at = view.size - len(MAGIC) - FOOTER.size
    tail = view.read(at, view.size - at) if at >= len(MAGIC) else b""
    if not tail.endswith(MAGIC) or FOOTER.unpack_from(tail)[:2] != (Opcode.FOOTER, 20):
        raise LogError(
            f"{path} has no footer: it is still being written, its writer was killed, or the file is "
            f"truncated. Run: ipsys repair {path}"
        )
    _, _, summary_start, _, crc = FOOTER.unpack_from(tail)
    if summary_start and not len(MAGIC) < summary_start <= at:
        raise view.fault(at, f"the footer says that the summary starts at byte {summary_start}")
    if summary_start and crc:
        summary = view.read(summary_start, at - summary_start + FOOTER.size - 4)
        if zlib.crc32(summary) != crc:
            raise view.fault(summary_start, "the CRC of the summary is wrong")
    return at, summary_start


def _from_summary(view: View, start: int, end: int) -> tuple[Contents, bool]:
    """What the summary says, and whether that is all."""
    contents = Contents()
    statistics: mcap.Statistics | None = None
    data = view.read(start, end - start)
    for at in walk(view, start, end):
        body = data[at.offset - start + HEADER.size : at.offset - start + at.length]
        if at.opcode == Opcode.STATISTICS:
            statistics = parse(mcap.Statistics.read, view, at, body)
        elif at.opcode == Opcode.CHUNK_INDEX:
            contents.chunks.append(parse_chunk_index(view, at, body))
        elif at.opcode == Opcode.ATTACHMENT_INDEX:
            contents.attachments.append(parse(mcap.AttachmentIndex.read, view, at, body))
        elif at.opcode == Opcode.METADATA_INDEX:
            contents.metadata.append(parse(mcap.MetadataIndex.read, view, at, body))
        elif at.opcode == Opcode.SCHEMA:
            schema = parse(mcap.Schema.read, view, at, body)
            contents.schemas.setdefault(schema.id, schema)
        elif at.opcode == Opcode.CHANNEL:
            channel = parse(mcap.Channel.read, view, at, body)
            contents.channels.setdefault(channel.id, channel)
    if statistics is None:
        return contents, False
    contents.counts = dict(statistics.channel_message_counts)
    contents.attachment_count = statistics.attachment_count
    contents.metadata_count = statistics.metadata_count
    if statistics.message_count:
        contents.cover(statistics.message_start_time, statistics.message_end_time)
    return contents, _is_complete(contents, statistics)


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


def _gaps_hold_no_messages(view: View, contents: Contents, data_end: int) -> bool:
    """True if all messages lie in the indexed chunks: what lies between them is small, and walked."""
    extents = sorted((chunk.offset, chunk.end) for chunk in contents.chunks)
    edges = [(0, len(MAGIC)), *extents, (data_end, data_end)]
    for (_, start), (end, _) in pairwise(edges):
        if start > end:
            raise view.fault(end, "two chunks overlap, or one reaches into the summary")
        for at in walk(view, start, end):
            if at.opcode in (Opcode.MESSAGE, Opcode.CHUNK):
                return False
    return True


def _from_records(view: View, data_end: int) -> Contents:
    """The same from the data section alone: heads of records, and the inside of chunks where needed."""
    contents, loose = Contents(), Inside()
    counts: dict[int, dict[int, int]] = {}  # per chunk offset, from its MessageIndex records
    for at in walk(view, len(MAGIC), data_end):
        add_record(view, contents, loose, counts, at)
    inside = [chunk for chunk in contents.chunks if not counts[chunk.offset]]
    known = contents.channels.keys() | loose.channels.keys()
    if any(not (channels.keys() <= known) for channels in counts.values()):
        inside = contents.chunks
    for chunk in inside:
        found = look_inside(
            view, chunk.offset, unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
        )
        contents.schemas = found.schemas | contents.schemas
        contents.channels = found.channels | contents.channels
        counts[chunk.offset] = {key: len(rows) for key, rows in found.entries.items()}
    count_all(contents, loose, counts)
    return contents


def add_record(
    view: View, contents: Contents, loose: Inside, counts: dict[int, dict[int, int]], at: RecordAt
) -> None:
    """Take one record of the data section into `contents`."""
    if at.opcode == Opcode.CHUNK:
        _, head = parse_chunk_head(view, at.offset)
        start, end, size = head.start_ns, head.end_ns, head.uncompressed_size
        contents.chunks.append(
            ChunkRef(at.offset, at.length, start, end, head.compression, head.data_size, size, 0, {})
        )
        counts[at.offset] = {}
    elif at.opcode == Opcode.MESSAGE_INDEX:
        _add_message_index(view, contents, counts, at)
    elif at.opcode == Opcode.MESSAGE:
        loose.add(view, at, at.offset, view.read(at.offset + 9, min(at.length, MESSAGE.size) - HEADER.size))
    elif at.opcode in (Opcode.ATTACHMENT, Opcode.METADATA):
        _add_index(view, contents, at)
    elif at.opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
        loose.add(view, at, at.offset, _body(view, at))


def _body(view: View, at: RecordAt) -> bytes:
    if at.length > _LARGEST_RECORD:
        raise view.fault(at.offset, f"a record of type {at.opcode} claims {at.length} bytes")
    return view.read(at.offset + HEADER.size, at.length - HEADER.size)


def _add_message_index(
    view: View, contents: Contents, counts: dict[int, dict[int, int]], at: RecordAt
) -> None:
    if not contents.chunks or contents.chunks[-1].end != at.offset or at.length < 15:
        raise view.fault(at.offset, "a MessageIndex record follows no chunk")
    chunk = contents.chunks[-1]
    channel, size = struct.unpack("<HI", view.read(at.offset + HEADER.size, 6))
    counts[chunk.offset][channel] = size // 16
    offsets = chunk.index_offsets | ({channel: at.offset} if size else {})
    contents.chunks[-1] = ChunkRef(
        chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, chunk.compression, chunk.compressed_size,
        chunk.uncompressed_size, chunk.index_length + at.length, offsets,
    )  # fmt: skip


def _add_index(view: View, contents: Contents, at: RecordAt) -> None:
    """An attachment or a metadata record into the indexes; of an attachment only the head is read."""
    if at.opcode == Opcode.METADATA:
        metadata = parse(mcap.Metadata.read, view, at, _body(view, at))
        contents.metadata.append(mcap.MetadataIndex(at.offset, at.length, metadata.name))
        contents.metadata_count += 1
        return
    head = view.read(at.offset + HEADER.size, min(at.length - HEADER.size, 1 << 16))
    try:
        log_time, create_time, name_length = struct.unpack_from("<QQI", head)
        (type_length,) = struct.unpack_from("<I", head, 20 + name_length)
        (size,) = struct.unpack_from("<Q", head, 24 + name_length + type_length)
        name = str(head[20 : 20 + name_length], "utf-8")
        media_type = str(head[24 + name_length : 24 + name_length + type_length], "utf-8")
    except (struct.error, UnicodeDecodeError) as error:
        raise view.fault(at.offset, f"the Attachment record is not valid ({error})") from None
    index = mcap.AttachmentIndex(at.offset, at.length, log_time, create_time, size, name, media_type)
    contents.attachments.append(index)
    contents.attachment_count += 1


def count_all(contents: Contents, loose: Inside, counts: dict[int, dict[int, int]]) -> None:
    contents.schemas = loose.schemas | contents.schemas
    contents.channels = loose.channels | contents.channels
    contents.loose = loose.entries
    for chunk in contents.chunks:
        for channel, number in counts[chunk.offset].items():
            contents.count(channel, number)
        if any(counts[chunk.offset].values()):
            contents.cover(chunk.start_ns, chunk.end_ns)
    for channel, rows in contents.loose.items():
        contents.count(channel, len(rows))
        contents.cover(min(rows)[0], max(rows)[0])
