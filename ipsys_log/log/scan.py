"""The table of contents of a log without a complete summary, from its records alone."""

import struct

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.log.byte_source import View
from ipsys_log.log.chunks import Inside, check_definition, look_inside, unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.records import HEADER, MAGIC, MESSAGE, ChunkRef, RecordAt, parse, parse_chunk_head, walk

__all__ = ["add_record", "count_all", "scan"]


def scan(view: View, data_end: int) -> Contents:
    """Read the heads of all records in the data section, and the contents of chunks if necessary."""
    contents, loose = Contents(), Inside()
    counts: dict[int, dict[int, int]] = {}  # per chunk offset, from its MessageIndex records
    for record_at in walk(view, len(MAGIC), data_end):
        add_record(view, contents, loose, counts, record_at)
    inside = [chunk for chunk in contents.chunks if not counts[chunk.offset]]
    known = contents.channels.keys() | loose.channels.keys()
    if any(not (channels.keys() <= known) for channels in counts.values()):
        inside = contents.chunks
    for chunk in inside:
        chunk_inside = look_inside(
            view, chunk.offset, unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
        )
        contents.schemas = chunk_inside.schemas | contents.schemas
        contents.channels = chunk_inside.channels | contents.channels
        counts[chunk.offset] = {key: len(rows) for key, rows in chunk_inside.entries.items()}
    count_all(contents, loose, counts)
    return contents


def add_record(
    view: View, contents: Contents, loose: Inside, counts: dict[int, dict[int, int]], at: RecordAt
) -> None:
    """Add one record of the data section to `contents`."""
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
    check_definition(view, at)
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
    """Add an attachment or a metadata record to the indexes; read only the head of an attachment."""
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
    """Fill in definitions, counts and the time range after all records were added."""
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
