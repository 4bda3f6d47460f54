"""Copies of parts of logs: whole chunks as they are, other messages one by one, in constant memory."""

import zlib
from collections.abc import Callable, Iterator, Mapping
from itertools import zip_longest
from typing import NamedTuple

import numpy as np
from mcap import records as mcap
from mcap.opcode import Opcode
from numpy.typing import NDArray

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.chunk_messages import Entries, Rows, chunk_entries, to_rows
from ipsys_log.log.chunks import unpack
from ipsys_log.log.contents import Contents
from ipsys_log.log.hashing import METADATA_NAME, Buffer, extend
from ipsys_log.log.reader import LogReader
from ipsys_log.log.records import HEAD_SIZE, HEADER, MESSAGE, MESSAGE_HEAD_SIZE, ChunkRef, parse_chunk_head
from ipsys_log.log.writer import LogWriter

# From a topic and log times in ns, (n,), to those that are kept, (n,).
Choose = Callable[[str, NDArray[np.int64]], NDArray[np.bool_]]

_PIECE = 4 << 20  # bytes of an attachment that are copied at once


def copy_messages(
    reader: LogReader, writer: LogWriter, choose: Choose, advance: Callable[[int], None]
) -> None:
    """Copy the chosen messages of a log into a new log, in the order of the file.

    Topic, times and data of each message stay as they are. A chunk of which all messages are chosen is copied
    without decompression of its images. One chunk is in memory at a time.

    Parameters
    ----------
    choose : returns the messages to keep, by topic and log time.
    advance : called with the number of bytes of the log that are done.

    Raises
    ------
    LogError
        A chunk is damaged, or the new log has one of the topics with another schema.
    """
    view, contents = reader.view, reader.contents
    chunks = sorted(contents.chunks, key=lambda chunk: chunk.offset)
    for chunk, next_chunk in zip_longest(chunks, chunks[1:]):
        if next_chunk is not None:
            view.prefetch(next_chunk.offset, next_chunk.end - next_chunk.offset)
        _copy_chosen(reader, writer, chunk, choose)
        advance(chunk.end)
    unchunked = _kept_rows(contents, to_rows(contents.unchunked), choose)
    if unchunked:
        for key in unchunked:
            _adopt(contents, writer, key)
        _copy_rows(view, contents, unchunked, writer, lambda low, high: view.read(low, high - low))


def _copy_chosen(reader: LogReader, writer: LogWriter, chunk: ChunkRef, choose: Choose) -> None:
    """Copy the chosen messages of a chunk; errors are those of `copy_messages`."""
    view, contents = reader.view, reader.contents
    entries = chunk_entries(view, chunk, {})
    kept = _kept_rows(contents, entries, choose)
    if not kept:
        return
    ids = {key: _adopt(contents, writer, key) for key in kept}
    is_whole = all(len(kept.get(key, ())) == len(rows) for key, rows in entries.items())
    if chunk.index_length and is_whole and all(key == own for key, own in ids.items()):
        _copy_chunk(view, contents, chunk, entries, writer)
    else:
        data = unpack(view, chunk.offset, parse_chunk_head(view, chunk.offset)[1])
        _copy_rows(view, contents, kept, writer, lambda low, high: data[low:high])


def copy_records(reader: LogReader, writer: LogWriter) -> None:
    """Copy the attachments and the metadata of a log; the stored hashes of its channels are left out."""
    view, contents = reader.view, reader.contents
    for index in contents.attachments:
        _copy_record(view, writer, index, Opcode.ATTACHMENT)
    for metadata in contents.metadata:
        if metadata.name != METADATA_NAME:
            _copy_record(view, writer, metadata, Opcode.METADATA)


def _copy_record(
    view: LogBytes, writer: LogWriter, index: mcap.AttachmentIndex | mcap.MetadataIndex, opcode: Opcode
) -> None:
    head = HEADER.unpack(view.read(index.offset, HEADER.size))
    if head != (opcode, index.length - HEADER.size):
        raise view.fault(index.offset, f"the record of {index.name} is missing")
    end = index.offset + index.length
    starts = range(index.offset, end, _PIECE)
    writer.copy_record(index, (view.read(start, min(_PIECE, end - start)) for start in starts))


def _kept_rows(contents: Contents, entries: Entries, choose: Choose) -> dict[int, Rows]:
    """Return the rows of chosen messages by channel id; no channel has an empty array."""
    kept = {}
    for key, rows in entries.items():
        if key in contents.channels:  # readers leave out a message without a channel, too
            chosen = rows[choose(contents.channels[key].topic, rows[:, 0].astype(np.int64))]
            if len(chosen):
                kept[key] = chosen
    return kept


def _adopt(contents: Contents, writer: LogWriter, key: int) -> int:
    channel = contents.channels[key]
    return writer.adopt_channel(channel, contents.schemas.get(channel.schema_id))


def _copy_rows(
    view: LogBytes,
    contents: Contents,
    kept: Mapping[int, Rows],
    writer: LogWriter,
    read: Callable[[int, int], Buffer],
) -> None:
    """Write messages one by one; ``read`` returns the bytes between two offsets."""
    topics = [contents.channels[key].topic for key in kept]
    for message in _messages(view, kept, read):
        topic = contents.channels[message.channel].topic
        if topics.count(topic) > 1:  # its channels differ in the version of their schema
            _adopt(contents, writer, message.channel)
        data = bytes(read(message.start, message.end))
        writer.write(topic, message.log_time_ns, message.publish_time_ns, data)


class _Message(NamedTuple):
    """A message record: its channel id, its times in ns, and the offsets of its data."""

    channel: int
    log_time_ns: int
    publish_time_ns: int
    start: int
    end: int


def _messages(view: LogBytes, entries: Entries, read: Callable[[int, int], Buffer]) -> Iterator[_Message]:
    """Yield the messages of message indexes in the order of the file."""
    rows = np.concatenate([*entries.values()])
    for time_ns, offset in rows[np.argsort(rows[:, 1], kind="stable")].tolist():
        start = offset + MESSAGE_HEAD_SIZE
        head = read(offset, start)
        if len(head) < MESSAGE_HEAD_SIZE:
            raise view.fault(offset, "a message reaches beyond the end of its chunk")
        opcode, length, key, _, log_ns, publish_ns = MESSAGE.unpack(head)
        if opcode != Opcode.MESSAGE or key not in entries or log_ns != time_ns:
            raise view.fault(offset, "a message index points to no message of its time")
        yield _Message(key, log_ns, publish_ns, start, offset + HEAD_SIZE + length)


def _copy_chunk(
    view: LogBytes, contents: Contents, chunk: ChunkRef, entries: Entries, writer: LogWriter
) -> None:
    """Copy a chunk as it is. One pass computes the CRCs of its messages, its records and all its bytes."""
    head = parse_chunk_head(view, chunk.offset)[1]
    whole = view.read(chunk.offset, chunk.length + chunk.index_length)
    data = memoryview(unpack(view, chunk.offset, head, is_crc_checked=False))
    rows, crc, position = [], 0, 0
    for message in _messages(view, entries, lambda low, high: data[low:high]):
        payload = data[message.start : message.end]
        own_crc = zlib.crc32(payload)
        crc = extend(zlib.crc32(data[position : message.start], crc), payload, own_crc)
        position = message.end
        topic = contents.channels[message.channel].topic
        rows.append((topic, message.log_time_ns, message.publish_time_ns, len(payload), own_crc))
    crc = zlib.crc32(data[position:], crc)
    if head.crc and crc != head.crc:
        raise view.fault(chunk.offset, "the CRC of the chunk is wrong")
    start = head.data_offset - chunk.offset
    stored = memoryview(whole)[start : start + head.data_size]
    stored_crc = zlib.crc32(stored) if head.compression else crc
    indexes = memoryview(whole)[start + head.data_size :]
    whole_crc = zlib.crc32(indexes, extend(zlib.crc32(whole[:start]), stored, stored_crc))
    counts = {key: len(rows_of_one) for key, rows_of_one in entries.items()}
    writer.copy_chunk(chunk, whole, whole_crc, counts, rows)
