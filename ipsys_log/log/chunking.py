"""Collecting messages into chunks with their message indexes."""

import struct
import zlib
from array import array
from dataclasses import dataclass, field

import zstandard
from mcap.opcode import Opcode

from ipsys_log.log.records import HEADER, INDEX_HEAD, MESSAGE, ChunkRef

__all__ = ["IMAGES", "IMAGE_SCHEMAS", "SMALL_APPENDED", "SMALL_LIVE", "ChunkBuilder", "Limits"]

_ZSTD_LEVEL = 3

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
class Limits:
    """When a chunk is full: bytes of records, or ns of log time from its first message."""

    size: int
    span_ns: int


_SECOND = 1_000_000_000
IMAGES = Limits(4 << 20, _SECOND)
SMALL_LIVE = Limits(1 << 20, _SECOND)
SMALL_APPENDED = Limits(1 << 20, 60 * _SECOND)


@dataclass(slots=True)
class ChunkBuilder:
    """One chunk being filled."""

    limits: Limits
    compress: bool
    _parts: list[bytes] = field(default_factory=list)
    _size: int = 0
    _start_ns: int = 0
    _end_ns: int = 0
    _entries: "dict[int, array[int]]" = field(default_factory=dict)

    def add(self, channel: int, sequence: int, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        """Add one message."""
        if not self._parts:
            self._start_ns = self._end_ns = log_time_ns
        self._start_ns = min(self._start_ns, log_time_ns)
        self._end_ns = max(self._end_ns, log_time_ns)
        entries = self._entries.get(channel)
        if entries is None:
            entries = self._entries[channel] = array("Q")
        entries.append(log_time_ns)
        entries.append(self._size)
        length = MESSAGE.size - HEADER.size + len(data)
        head = MESSAGE.pack(Opcode.MESSAGE, length, channel, sequence, log_time_ns, publish_time_ns)
        self._parts += (head, data)
        self._size += HEADER.size + length

    def is_full(self, now_ns: int) -> bool:
        """True if the chunk must be written before a message of `now_ns` is added."""
        return bool(self._parts) and (
            self._size >= self.limits.size
            or max(now_ns, self._end_ns) - min(now_ns, self._start_ns) >= self.limits.span_ns
        )

    @property
    def counts(self) -> dict[int, int]:
        """Messages per channel id."""
        return {channel: len(entries) // 2 for channel, entries in self._entries.items()}

    def build(self, offset: int) -> tuple[ChunkRef, bytes] | None:
        """The chunk to be written at `offset` with its message indexes, None if it holds no message.

        Call `clear` once the bytes are where they belong.
        """
        if not self._parts:
            return None
        data = b"".join(self._parts)
        crc = zlib.crc32(data)
        name = "zstd" if self.compress else ""
        if self.compress:
            data = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(data)
        fixed = struct.pack("<QQQI", self._start_ns, self._end_ns, self._size, crc)
        fixed += struct.pack("<I", len(name)) + name.encode() + struct.pack("<Q", len(data))
        length = HEADER.size + len(fixed) + len(data)
        parts = [HEADER.pack(Opcode.CHUNK, length - HEADER.size), fixed, data]
        offsets, at = {}, offset + length
        for channel, entries in self._entries.items():
            rows = entries.tobytes()  # little-endian machines only, like the rest of this floor
            parts += (INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(rows), channel, len(rows)), rows)
            offsets[channel], at = at, at + INDEX_HEAD.size + len(rows)
        ref = ChunkRef(
            offset, length, self._start_ns, self._end_ns, name, len(data), self._size,
            at - offset - length, offsets,
        )  # fmt: skip
        return ref, b"".join(parts)

    def clear(self) -> None:
        """Begin the next chunk."""
        self._parts, self._size, self._entries = [], 0, {}
