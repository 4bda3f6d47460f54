"""The end of a log as bytes: DataEnd, summary, footer."""

import zlib

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.log.contents import Contents
from ipsys_log.log.records import DATA_END, FOOTER, MAGIC, as_bytes

__all__ = ["tail_bytes"]


def tail_bytes(contents: Contents, *, index_chunks: bool = True) -> bytes:
    """Everything from ``contents.data_end`` to the end of the file.

    With chunk indexes, other readers look for messages in chunks only: a log that also has messages in none
    is written without (`index_chunks`).
    """
    start = contents.data_end + DATA_END.size
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
