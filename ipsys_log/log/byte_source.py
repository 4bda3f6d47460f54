"""Reads of a log by position, within limits in proportion to the size of its file.

A compressor stores 1 GB of zeros in 33 kB, and half a million empty messages in about 1 kB. Recorded
logs stay far below every limit. Each byte of their file unpacks to 2 to 4 bytes, and a message takes
170 bytes or more.

In a file, an unfinished append takes the old tail from its journal.
"""

import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import shell_words
from ipsys_log.units import format_bytes

_MIB = 1 << 20
LARGEST_CHUNK = 256 * _MIB  # bytes, uncompressed
LARGEST_MESSAGE = LARGEST_CHUNK - 8 * _MIB  # bytes: the rest of the chunk is for earlier messages
LARGEST_DEFINITION = 4 * _MIB  # bytes of a schema, a channel or a metadata record
_ANY_RATIO = 16 * _MIB  # bytes: a chunk up to this size may have any compression ratio
_HIGHEST_RATIO = 200
_UNPACKED = 128 * _MIB  # bytes: the limit for all chunks of a small file together
_RECORDS = 20_000
_BYTES_PER_RECORD = 8
_CHANNELS = 1_000
_BYTES_PER_CHANNEL = 1_000
_ITEMS = 50_000
_BYTES_PER_ITEM = 4


class BoundError(LogError):
    """A log that needs more time or memory than the limit for its file size."""


def chunk_excess(packed: int, unpacked: int) -> str:
    """Return the reason to refuse a chunk of `packed` bytes that unpacks to `unpacked` bytes, else "".

    Examples
    --------
    >>> chunk_excess(33_000, 1 << 30)
    'a chunk of 33.0 kB claims to hold 1.1 GB, more than 268.4 MB'
    >>> chunk_excess(33_000, 3 << 20)
    ''
    """
    claim = f"a chunk of {format_bytes(packed)} claims to hold {format_bytes(unpacked)}, more than"
    if unpacked > LARGEST_CHUNK:
        return f"{claim} {format_bytes(LARGEST_CHUNK)}"
    if unpacked > _ANY_RATIO and unpacked > _HIGHEST_RATIO * packed:
        return f"{claim} {_HIGHEST_RATIO} times its size"
    return ""


@dataclass(slots=True)
class ReadLimits:
    """The limits of the work for a file of `size` bytes. Each chunk counts once, even if it is read again."""

    size: int
    _unpacked: dict[int, int] = field(default_factory=dict)
    _records: dict[int, int] = field(default_factory=dict)
    _total_unpacked: int = 0
    _total_records: int = 0

    @property
    def max_unpacked(self) -> int:
        """The limit for all compressed chunks together, in bytes after decompression."""
        return _UNPACKED + _HIGHEST_RATIO * max(0, self.size - _MIB)

    @property
    def max_records(self) -> int:
        """The limit for the number of records in chunks without a message index."""
        return _RECORDS + self.size // _BYTES_PER_RECORD

    @property
    def max_channels(self) -> int:
        """The limit for the number of channels; also for the number of schemas, and of runs."""
        return _CHANNELS + self.size // _BYTES_PER_CHANNEL

    @property
    def max_payload(self) -> int:
        """The limit for one message in a compressed chunk, in bytes."""
        return _ANY_RATIO + 4 * self.size

    @property
    def max_structured(self) -> int:
        """The limit for one message that is not an image, in bytes.

        The parts of such a message take many times its size in memory.
        """
        return 2 * _MIB + self.size

    @property
    def max_items(self) -> int:
        """The limit for the message parts in one read of the log, such as the markers of a frame."""
        return _ITEMS + self.size // _BYTES_PER_ITEM

    def unpack(self, offset: int, size: int) -> str:
        """Count `size` bytes unpacked from the chunk at `offset`.

        Return an error text if the file exceeds its limit, else "".
        """
        self._total_unpacked += size - self._unpacked.get(offset, 0)
        self._unpacked[offset] = size
        if self._total_unpacked <= self.max_unpacked:
            return ""
        return f"its chunks hold more than {format_bytes(self.max_unpacked)}"

    def records_left(self, offset: int) -> int:
        """Return the number of records that the chunk at `offset` may hold."""
        return self.max_records - self._total_records + self._records.get(offset, 0)

    def count_records(self, offset: int, number: int) -> None:
        """Count the records of the chunk at `offset`."""
        self._total_records += number - self._records.get(offset, 0)
        self._records[offset] = number


@dataclass(slots=True)
class PartCounter:
    """A counter of the message parts that are still allowed, such as the markers of a frame."""

    left: int

    def take(self, number: int) -> None:
        """Count `number` parts."""
        self.left -= number
        if self.left < 0:
            raise BoundError("the messages have more parts than a log of this size may hold")


_MOST_PER_CALL = 1 << 30


class LogBytes:
    """The bytes of a log at the time when it was opened, in a file or in a store.

    Attributes
    ----------
    size, bytes_read : bytes of the log, and bytes that its readers have asked for.
    is_interrupted : True if an append was interrupted, so that these are the bytes before it. A store
        replaces an object as a whole.
    """

    __slots__ = ()
    path: LogLocation
    size: int
    bytes_read: int
    read_limits: ReadLimits

    @property
    def is_interrupted(self) -> bool:
        return False

    def identity(self) -> tuple[object, object]:
        """Return what identifies the log, and what changes with its content."""
        raise NotImplementedError

    def read(self, offset: int, length: int) -> bytes:
        """Read exactly `length` bytes at `offset`; check the length before the allocation."""
        raise NotImplementedError

    def plan(self, name: str, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce ranges (start, end) that are going to be read, instead of those of the same name.

        A store needs this; in a file, the operating system reads ahead.
        """

    def prefetch(self, offset: int, length: int) -> None:
        """Begin to read bytes of a file that are going to be read, without waiting for them."""

    def fault(self, offset: int, reason: str) -> LogError:
        """Return the error for damage at `offset`."""
        raise NotImplementedError

    def refusal(self, reason: str) -> BoundError:
        """Return the error for a log that exceeds the limits. Such a log may be undamaged."""
        raise NotImplementedError

    def check_number(self, number: int, item_name: str) -> None:
        """Refuse a log with more channels, runs or similar items than its size allows."""
        if number > self.read_limits.max_channels:
            raise self.refusal(f"it has {number} {item_name}, more than {self.read_limits.max_channels}")

    def close(self) -> None:
        """Release the file."""


@dataclass(slots=True)
class FileBytes(LogBytes):
    """The bytes of a log file at the time when it was opened.

    Bytes from `tail_offset` on come from `tail_fd` (a journal). In the journal they begin at `tail_base`.
    The class uses ``pread`` and not ``mmap``: if a mapped file shrinks, the operating system
    kills the process.
    """

    path: Path
    fd: int
    size: int
    tail_offset: int
    tail_fd: int = -1
    tail_base: int = 0
    bytes_read: int = 0
    read_limits: ReadLimits = field(init=False)

    def __post_init__(self) -> None:
        self.read_limits = ReadLimits(self.size)

    def read(self, offset: int, length: int) -> bytes:
        """Read exactly `length` bytes at `offset`; check the length against the file before allocation."""
        if self.fd < 0:
            raise ValueError(f"{self.path}: read after close")
        end = offset + length
        if offset < 0 or length < 0 or end > self.size:
            raise self.fault(offset, f"a record reaches {end - self.size} bytes beyond the end of the file")
        self.bytes_read += length
        if end <= self.tail_offset:
            data = self._read_once(self.fd, length, offset) if 0 < length < _MOST_PER_CALL else b""
            return data if len(data) == length else self._pread(self.fd, offset, length)
        return self._joined(offset, length)

    @property
    def is_interrupted(self) -> bool:
        """True if the old tail comes from a journal."""
        return self.tail_fd >= 0

    def identity(self) -> tuple[object, object]:
        return file_identity(self.fd)

    def prefetch(self, offset: int, length: int) -> None:
        if hasattr(os, "posix_fadvise"):  # macOS lacks it
            with suppress(OSError):
                os.posix_fadvise(self.fd, offset, length, os.POSIX_FADV_WILLNEED)

    def _joined(self, offset: int, length: int) -> bytes:
        head = max(0, min(length, self.tail_offset - offset))
        parts = [self._pread(self.fd, offset, head)] if head else []
        if head < length:
            tail_position = self.tail_base + offset + head - self.tail_offset
            parts.append(self._pread(self.tail_fd, tail_position, length - head))
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def fault(self, offset: int, reason: str) -> LogError:
        return LogError(
            f"{self.path} is damaged at byte {offset}: {reason}. Run: ipsys repair {shell_words(self.path)}"
        )

    def refusal(self, reason: str) -> BoundError:
        return BoundError(
            f"{self.path} is refused: {reason}. If it is a true recording, unpack it first: "
            f"mcap decompress {self.path} -o unpacked.mcap"
        )

    def close(self) -> None:
        for fd in (self.fd, self.tail_fd):
            if fd >= 0:
                os.close(fd)
        self.fd = self.tail_fd = -1

    def _read_once(self, fd: int, length: int, offset: int) -> bytes:
        """Read at most `length` bytes; an error of the disk names the file. It is no damage of the log."""
        try:
            return os.pread(fd, length, offset)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self.path)) from None

    def _pread(self, fd: int, offset: int, length: int) -> bytes:
        data = self._read_once(fd, min(length, _MOST_PER_CALL), offset)
        if len(data) == length:
            return data
        parts = [data]
        length_read = len(data)
        while data and length_read < length:
            data = self._read_once(fd, min(length - length_read, _MOST_PER_CALL), offset + length_read)
            parts.append(data)
            length_read += len(data)
        if length_read < length:
            raise self.fault(offset + length_read, "the file became shorter while it was read")
        return b"".join(parts)


def reason_of(error: LogError) -> str:
    """Return the reason of a `fault`, without the path and the advice."""
    return str(error).split(" is damaged ", 1)[-1].split(". Run:", 1)[0]


def file_identity(fd: int) -> tuple[object, object]:
    """Return device and inode of an open file, and its size in bytes and change time in ns."""
    status = os.fstat(fd)
    return (status.st_dev, status.st_ino), (status.st_size, status.st_mtime_ns)


def open_for_reading(path: Path) -> int:
    """Open a file for reading; return its file descriptor, or raise a one-line `UnreadError`."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError:
        raise UnreadError(f"{path} does not exist") from None
    except OSError as error:
        raise UnreadError(f"{path} cannot be opened: {error.strerror}") from None
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise UnreadError(f"{path} cannot be read as a log: it is not a file")
    return fd
