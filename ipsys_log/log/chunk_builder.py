"""A builder that collects messages into chunks, with their message indexes."""

import zlib
from array import array
from dataclasses import dataclass, field

import zstandard
from mcap.opcode import Opcode

from ipsys_log.log.hashing import WORTH_COMBINING, Buffer, combine, extend
from ipsys_log.log.records import (
    CHUNK_HEAD_SIZE,
    HEAD_SIZE,
    INDEX_HEAD,
    MESSAGE,
    MESSAGE_HEAD_SIZE,
    ChunkRef,
    chunk_head,
)

_ZSTD_LEVEL = 3
_OPCODE = int(Opcode.MESSAGE)
_FIRST_ROOM = 64 << 10  # bytes

IMAGE_SCHEMAS = frozenset(
    {
        "foxglove.CompressedImage",
        "foxglove.CompressedVideo",
        "foxglove.RawImage",
        "sensor_msgs/CompressedImage",
        "sensor_msgs/Image",
        "sensor_msgs/msg/CompressedImage",
        "sensor_msgs/msg/Image",
    }
)


@dataclass(frozen=True, slots=True)
class ChunkLimits:
    """The limits of a full chunk: bytes of records, or ns of log time from its first message."""

    size: int
    span_ns: int


_SECOND = 1_000_000_000
IMAGES = ChunkLimits(4 << 20, _SECOND)
SMALL_LIVE = ChunkLimits(1 << 20, _SECOND)
SMALL_APPENDED = ChunkLimits(1 << 20, 60 * _SECOND)


@dataclass(slots=True)
class ChunkBuilder:
    """A chunk under construction.

    `_record` has the layout of the Chunk record in the file: room for its head, then messages up to
    `_end`. The next chunk reuses this memory, because new memory from the kernel costs more time.
    `_crc` is the CRC-32 of the messages up to `_crc_end`.
    """

    limits: ChunkLimits
    compress: bool
    _record: memoryview = field(default_factory=lambda: memoryview(bytearray(_FIRST_ROOM)))
    _end: int = CHUNK_HEAD_SIZE
    _crc: int = 0
    _crc_end: int = CHUNK_HEAD_SIZE
    _start_ns: int = 0
    _end_ns: int = 0
    _entries: "dict[int, array[int]]" = field(default_factory=dict)

    def add(
        self, channel: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes, crc: int
    ) -> None:
        """Add one message; `crc` is the CRC-32 of `data`."""
        if not self._entries:
            self._start_ns = self._end_ns = log_time_ns
        elif log_time_ns < self._start_ns:
            self._start_ns = log_time_ns
        elif log_time_ns > self._end_ns:
            self._end_ns = log_time_ns
        position = self._end
        entries = self._entries.get(channel)
        if entries is None:
            entries = self._entries[channel] = array("Q")
        entries.append(log_time_ns)
        entries.append(position - CHUNK_HEAD_SIZE)
        start = position + MESSAGE_HEAD_SIZE
        end = start + len(data)
        if end > len(self._record):
            self._make_room(end)
        length = end - position - HEAD_SIZE
        MESSAGE.pack_into(
            self._record, position, _OPCODE, length, channel, sequence, log_time_ns, publish_time_ns
        )
        self._record[start:end] = data
        self._end = end
        if len(data) >= WORTH_COMBINING:
            self._crc = combine(zlib.crc32(self._record[self._crc_end : start], self._crc), crc, len(data))
            self._crc_end = end

    def is_full(self, now_ns: int) -> bool:
        """Return whether the chunk must be written before a message with log time `now_ns` is added."""
        return bool(self._entries) and (
            self._end - CHUNK_HEAD_SIZE >= self.limits.size
            or now_ns - self._start_ns >= self.limits.span_ns
            or self._end_ns - now_ns >= self.limits.span_ns
        )

    @property
    def counts(self) -> dict[int, int]:
        """The number of messages by channel id."""
        return {channel: len(entries) // 2 for channel, entries in self._entries.items()}

    def build(self, offset: int) -> tuple[ChunkRef, Buffer, int] | None:
        """Return the chunk for `offset` with its message indexes, and the CRC-32 of these bytes.

        Return None if the chunk holds no message. The bytes are valid until the next message is added. Call
        `clear` after writing them.
        """
        if not self._entries:
            return None
        data: Buffer = self._record[CHUNK_HEAD_SIZE : self._end]
        size = len(data)
        crc = data_crc = zlib.crc32(self._record[self._crc_end : self._end], self._crc)
        # A larger chunk holds one huge message. Readers refuse chunks that unpack to far more than the file
        # size, so it is not compressed.
        compress = self.compress and size <= 2 * self.limits.size
        name = "zstd" if compress else ""
        if compress:
            data = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(data)
            data_crc = zlib.crc32(data)
        head = chunk_head(self._start_ns, self._end_ns, size, crc, name, len(data))
        length = len(head) + len(data)
        indexes, offsets = self._indexes(offset + length)
        ref = ChunkRef(
            offset, length, self._start_ns, self._end_ns, name, len(data), size, len(indexes), offsets
        )
        whole_crc = zlib.crc32(indexes, extend(zlib.crc32(head), data, data_crc))
        return ref, self._joined(head, data, indexes, compress), whole_crc

    def _joined(self, head: bytes, data: Buffer, indexes: bytes, compressed: bool) -> Buffer:
        if compressed:
            return b"".join((head, data, indexes))
        end = self._end + len(indexes)
        if end > len(self._record):
            self._make_room(end)
        self._record[: len(head)] = head
        self._record[self._end : end] = indexes
        return self._record[:end]

    def _indexes(self, offset: int) -> tuple[bytes, dict[int, int]]:
        """Return the MessageIndex records for `offset`, and the offset of each record by channel id."""
        parts: list[bytes] = []
        offsets: dict[int, int] = {}
        for channel, entries in self._entries.items():
            rows = entries.tobytes()  # little-endian machines only, like the rest of this package
            parts += (INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(rows), channel, len(rows)), rows)
            offsets[channel], offset = offset, offset + INDEX_HEAD.size + len(rows)
        return b"".join(parts), offsets

    def _make_room(self, end: int) -> None:
        larger = memoryview(bytearray(max(end, 2 * len(self._record))))
        larger[: self._end] = self._record[: self._end]
        self._record = larger

    def clear(self) -> None:
        """Begin the next chunk."""
        self._end = self._crc_end = CHUNK_HEAD_SIZE
        self._crc, self._entries = 0, {}
