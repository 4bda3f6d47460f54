"""The end of a log as bytes: DataEnd, summary, footer."""

import struct
import zlib

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.log.byte_source import View
from ipsys_log.log.contents import Contents
from ipsys_log.log.records import DATA_END, FOOTER, HEADER, MAGIC, as_bytes

__all__ = ["STANDING", "standing_bytes", "standing_data_end", "tail_bytes"]

# Precedes a tail after new data: a record of a private type with the offset of the end of the old data.
STANDING = struct.Struct("<BQ8sQ")
_STANDING_TYPE, _STANDING_NAME = 0x80 | Opcode.DATA_END, b"standing"


def standing_bytes(contents: Contents, offset: int) -> bytes:
    """Return the temporary tail of a log at `offset`, for the time while new data are written before it."""
    length = STANDING.size - HEADER.size
    mark = STANDING.pack(_STANDING_TYPE, length, _STANDING_NAME, contents.data_end)
    return mark + tail_bytes(contents, offset + len(mark))


def standing_data_end(view: View, at: int) -> int | None:
    """Return the end of the data if the DataEnd record at `at` belongs to a temporary tail, else None."""
    if at < len(MAGIC) + STANDING.size:
        return None
    mark = STANDING.unpack(view.read(at - STANDING.size, STANDING.size))
    expected = (_STANDING_TYPE, STANDING.size - HEADER.size, _STANDING_NAME)
    return mark[3] if mark[:3] == expected and len(MAGIC) <= mark[3] < at else None


def tail_bytes(contents: Contents, offset: int | None = None, *, index_chunks: bool = True) -> bytes:
    """Return the tail of a log: DataEnd, summary and footer, at ``contents.data_end`` or another `offset`.

    With chunk indexes, other readers search for messages only in chunks. So a log that also has messages
    outside of chunks gets none (`index_chunks`).
    """
    start = (contents.data_end if offset is None else offset) + DATA_END.size
    summary, offsets = b"", b""
    for opcode, records in _groups(contents):
        group = as_bytes(*records)
        if group and (index_chunks or opcode != Opcode.CHUNK_INDEX):
            offsets += as_bytes(mcap.SummaryOffset(opcode, start + len(summary), len(group)))
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
