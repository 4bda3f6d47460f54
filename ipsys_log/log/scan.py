"""The table of contents of a log without a complete summary, from its records alone."""

import struct

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunks import ChunkContents, check_definition, parse_chunk_contents, unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.records import HEADER, MAGIC, MESSAGE, ChunkRef, RecordAt, parse, parse_chunk_head, walk


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
