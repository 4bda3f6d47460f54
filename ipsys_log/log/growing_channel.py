"""The messages of one topic in a log that this process is still writing."""

import os
from pathlib import Path
from typing import Any

from mcap import records as mcap
from mcap.opcode import Opcode

from ipsys_log.log.byte_source import FileBytes, open_for_reading
from ipsys_log.log.chunks import unpack
from ipsys_log.log.codec import decode
from ipsys_log.log.records import ENTRY, HEADER, INDEX_HEAD, MAGIC, MESSAGE, RecordAt, parse, parse_chunk_head


class GrowingChannel:
    """The messages of one topic, by their number in the order of the file; the file may grow meanwhile.

    Only complete chunks with their message indexes are read.

    Parameters
    ----------
    path : a log of :class:`~ipsys_log.log.writer.LogWriter`. An existing file is opened at once, because
        another program can rename it later.
    """

    def __init__(self, path: Path, topic: str) -> None:
        self._path, self._topic = path, topic
        self._view: FileBytes | None = None
        self._next = len(MAGIC)
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, str] = {}
        self._chunk = 0
        # For each message, the offset of its chunk in the file, its own in the chunk, and its schema.
        self._places: list[tuple[int, int, str]] = []
        if path.exists():
            self._open()

    def close(self) -> None:
        """Release the file; a second call does nothing."""
        if self._view is not None:
            self._view.close()

    def read(self, number: int) -> Any:
        """Return the payload of a message; None if the file does not hold it yet."""
        if number >= len(self._places):
            self._extend()
        if number >= len(self._places):
            return None
        chunk, offset, schema = self._places[number]
        view = self._open()
        head = parse_chunk_head(view, chunk)[1]
        if head.compression:
            data = unpack(view, chunk, head)
            length = HEADER.unpack_from(data, offset)[1]
            return decode(schema, data[offset + MESSAGE.size : offset + HEADER.size + length])
        # Chunks of images are not compressed: the other images of the chunk need not be read.
        start = head.data_offset + offset
        length = HEADER.unpack(view.read(start, HEADER.size))[1]
        return decode(schema, view.read(start + MESSAGE.size, HEADER.size + length - MESSAGE.size))

    def _open(self) -> FileBytes:
        if self._view is None:
            self._view = FileBytes(self._path, open_for_reading(self._path), 0, 0)
        return self._view

    def _extend(self) -> None:
        """Add the records that the file has got since the last call."""
        view = self._open()
        view.size = view.tail_offset = os.fstat(view.fd).st_size
        while self._next + HEADER.size <= view.size:
            opcode, length = HEADER.unpack(view.read(self._next, HEADER.size))
            record = RecordAt(opcode, self._next, HEADER.size + length)
            if opcode in (0, Opcode.DATA_END) or self._next + record.length > view.size:
                return
            self._add(view, record)
            self._next += record.length

    def _add(self, view: FileBytes, record: RecordAt) -> None:
        if record.opcode == Opcode.CHUNK:
            self._chunk = record.offset
        elif record.opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE_INDEX):
            body = view.read(record.offset + HEADER.size, record.length - HEADER.size)
            if record.opcode == Opcode.SCHEMA:
                schema = parse(mcap.Schema.read, view, record, body)
                self._schemas[schema.id] = schema.name
            elif record.opcode == Opcode.CHANNEL:
                channel = parse(mcap.Channel.read, view, record, body)
                if channel.topic == self._topic:
                    self._channels[channel.id] = self._schemas[channel.schema_id]
            else:
                self._add_index(view.read(record.offset, record.length))

    def _add_index(self, data: bytes) -> None:
        _, _, channel, _ = INDEX_HEAD.unpack_from(data)
        if channel in self._channels:
            rows = sorted(ENTRY.iter_unpack(data[INDEX_HEAD.size :]))
            self._places += [(self._chunk, offset, self._channels[channel]) for _, offset in rows]
