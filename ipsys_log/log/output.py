"""The output of a writer: chunks with their message indexes, and a growing file or memory for their bytes."""

import logging
import os
import zlib
from array import array
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import zstandard
from mcap.opcode import Opcode

from ipsys_log.errors import LogError, WriteError, disk_advice
from ipsys_log.log import records
from ipsys_log.log.hashing import WORTH_COMBINING, Buffer, combine, extend
from ipsys_log.log.journal import Storage, replace_tail, roll_back, write_all
from ipsys_log.plain_text import shell_words

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
    _end: int = records.CHUNK_HEAD_SIZE
    _crc: int = 0
    _crc_end: int = records.CHUNK_HEAD_SIZE
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
        entries.append(position - records.CHUNK_HEAD_SIZE)
        start = position + records.MESSAGE_HEAD_SIZE
        end = start + len(data)
        if end > len(self._record):
            self._make_room(end)
        length = end - position - records.HEAD_SIZE
        records.MESSAGE.pack_into(
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
            self._end - records.CHUNK_HEAD_SIZE >= self.limits.size
            or now_ns - self._start_ns >= self.limits.span_ns
            or self._end_ns - now_ns >= self.limits.span_ns
        )

    @property
    def counts(self) -> dict[int, int]:
        """The number of messages by channel id."""
        return {channel: len(entries) // 2 for channel, entries in self._entries.items()}

    def build(self, offset: int) -> tuple[records.ChunkRef, Buffer, int] | None:
        """Return the chunk for `offset` with its message indexes, and the CRC-32 of these bytes.

        Return None if the chunk holds no message. The bytes are valid until the next message is added. Call
        `clear` after writing them.
        """
        if not self._entries:
            return None
        data: Buffer = self._record[records.CHUNK_HEAD_SIZE : self._end]
        size = len(data)
        crc = data_crc = zlib.crc32(self._record[self._crc_end : self._end], self._crc)
        # A larger chunk holds one huge message. Readers refuse chunks that unpack to far more than the file
        # size, so it is not compressed.
        compress = self.compress and size <= 2 * self.limits.size
        name = "zstd" if compress else ""
        if compress:
            data = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(data)
            data_crc = zlib.crc32(data)
        head = records.chunk_head(self._start_ns, self._end_ns, size, crc, name, len(data))
        length = len(head) + len(data)
        indexes, offsets = self._indexes(offset + length)
        ref = records.ChunkRef(
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
            parts += (records.INDEX_HEAD.pack(Opcode.MESSAGE_INDEX, 6 + len(rows), channel, len(rows)), rows)
            offsets[channel], offset = offset, offset + records.INDEX_HEAD.size + len(rows)
        return b"".join(parts), offsets

    def _make_room(self, end: int) -> None:
        larger = memoryview(bytearray(max(end, 2 * len(self._record))))
        larger[: self._end] = self._record[: self._end]
        self._record = larger

    def clear(self) -> None:
        """Begin the next chunk."""
        self._end = self._crc_end = records.CHUNK_HEAD_SIZE
        self._crc, self._entries = 0, {}


_logger = logging.getLogger(__name__)


class Output(Protocol):
    """The end of the data section. `crc` is None if the log keeps no CRC.

    Callers give the CRC-32 of large data to `emit`, so that it is not computed twice.
    """

    @property
    def fd(self) -> int: ...
    @property
    def offset(self) -> int: ...
    @property
    def crc(self) -> int | None: ...
    def emit(self, data: Buffer, crc: int | None = None) -> None: ...
    def finish(self, tail: bytes) -> None: ...
    def abandon(self) -> None: ...
    def close(self) -> None: ...


@dataclass(slots=True)
class NewFile:
    """A new file. Each piece of data goes to the operating system at once.

    With a `target`, the complete file is renamed to `target`, and an abandoned file is removed. Only with
    `overwrite`, the rename replaces an existing file.
    """

    storage: Storage
    path: Path
    fd: int
    target: Path | None = None
    overwrite: bool = False
    offset: int = 0
    crc: int | None = 0
    _failed: bool = False

    def emit(self, data: Buffer, crc: int | None = None) -> None:
        try:
            write_all(self.storage, self.fd, data, self.offset)
        except OSError as error:
            self._failed = True
            advice = f"to save the written part: ipsys repair {shell_words(self.path)}"
            outcome = advice if self.target is None else f"nothing was written: {disk_advice(error)}"
            raise cannot_write(self.target or self.path, error, outcome) from None
        self.offset += len(data)
        self.crc = _extend(self.crc or 0, data, crc)

    def finish(self, tail: bytes) -> None:
        try:
            if self._failed:  # a torn piece may reach beyond the tail
                self.storage.truncate(self.fd, self.offset)
            self.emit(tail)
            self.storage.fsync(self.fd)
            if self.target is not None:
                if self.target.exists() and not self.overwrite:
                    raise LogError(
                        f"another program has created {self.target} in the meantime: choose another name"
                    )
                self.storage.rename(self.path, self.target)
                self.path, self.target = self.target, None
            self.storage.fsync_directory(self.path.parent)
        except OSError as error:
            outcome = (
                "nothing was written"
                if self.target is not None
                else "the log is complete, but perhaps not on the disk yet"
            )
            raise cannot_write(self.target or self.path, error, f"{outcome}: {disk_advice(error)}") from None

    def sync(self) -> None:
        """Wait until the written bytes are on the disk. Any thread may call this during a write."""
        self.storage.fsync(self.fd)

    def abandon(self) -> None:
        if self.target is not None:
            with suppress(OSError):
                self.storage.unlink(self.path)

    def close(self) -> None:
        self.storage.close(self.fd)


@dataclass(slots=True)
class PendingAppend:
    """An append. The file does not change before `finish`. With `is_forced`, it gets at least a new tail."""

    storage: Storage
    path: Path
    fd: int
    size: int
    start: int
    offset: int
    crc: int | None
    make_temporary_tail: Callable[[int], bytes]
    is_forced: bool = False
    _pieces: list[bytes] = field(default_factory=list)

    def emit(self, data: Buffer, crc: int | None = None) -> None:
        self._pieces.append(bytes(data))  # the memory of a chunk is used again
        self.offset += len(data)
        self.crc = None if self.crc is None else _extend(self.crc, data, crc)

    def finish(self, tail: bytes) -> None:
        if not self._pieces and not self.is_forced:
            return
        self._check_unchanged()
        try:
            pieces = (*self._pieces, tail)
            replace_tail(self.storage, self.path, self.fd, self.start, pieces, self.make_temporary_tail)
        except OSError as error:
            self._settle(error, tail)
        except BaseException:  # an interrupt: keep the old log, or the new log if it is complete
            with suppress(OSError):
                roll_back(self.storage, self.path, self.fd)
            raise

    def _check_unchanged(self) -> None:
        """Check that the path still leads to the opened file: programs without locks can replace or cut it.

        Raises
        ------
        LogError
            The messages would be lost with the old file, or would damage another one.
        """
        status = os.fstat(self.fd)
        try:
            is_same = os.path.samestat(status, self.path.stat())
        except OSError:
            is_same = False
        if not is_same or status.st_size != self.size:
            raise LogError(
                f"{self.path}: another program has replaced or changed the log in the meantime, so nothing "
                "was written to it; run the command again"
            )

    def _settle(self, error: OSError, tail: bytes) -> None:
        """Roll back after a disk fault if possible, and report which log is valid.

        Raises
        ------
        WriteError
            The new log is not valid.
        """
        with suppress(OSError):  # after a failure the next writer rolls back
            roll_back(self.storage, self.path, self.fd)
        size = os.fstat(self.fd).st_size
        if size == self.offset + len(tail) and os.pread(self.fd, len(tail), self.offset) == tail:
            # The file gets its size last: all bytes are written, but the disk did not confirm the sync.
            _logger.warning(
                "%s: the messages are in the log, but the disk did not confirm it (%s): copy it elsewhere",
                self.path, error.strerror,
            )  # fmt: skip
            return
        if size == self.size:
            outcome = f"nothing of this result was written, and the log is whole: {disk_advice(error)}"
        else:
            outcome = (
                f"no recorded data are lost, and ipsys can read the old log with {self.path.name}.journal "
                f"beside it; {disk_advice(error)}, and run: ipsys repair {shell_words(self.path)}"
            )
        raise cannot_write(self.path, error, outcome) from None

    def abandon(self) -> None:
        self._pieces.clear()

    def close(self) -> None:
        self.storage.close(self.fd)


def _extend(so_far: int, data: Buffer, crc: int | None) -> int:
    return zlib.crc32(data, so_far) if crc is None else extend(so_far, data, crc)


def cannot_write(path: Path, error: OSError, consequence: str) -> WriteError:
    """Return the error for a failed write; `consequence` describes the consequence."""
    text = f"{path} cannot be written ({error.strerror or os.strerror(error.errno or 0)}): {consequence}"
    return WriteError(text, error)
