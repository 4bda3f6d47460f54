"""Reads of a log by position; in a file, an unfinished append takes the old tail from its journal."""

import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.log.bounds import BoundError, ReadLimits
from ipsys_log.log.location import LogLocation
from ipsys_log.plain_text import shell_words

_MOST_PER_CALL = 1 << 30


class LogBytes(Protocol):
    """The bytes of a log at the time when it was opened, in a file or in a store.

    Attributes
    ----------
    size, bytes_read : bytes of the log, and bytes that its readers have asked for.
    is_interrupted : True if an append was interrupted, so that these are the bytes before it.
    """

    bytes_read: int
    read_limits: ReadLimits

    @property
    def path(self) -> LogLocation: ...
    @property
    def size(self) -> int: ...
    @property
    def is_interrupted(self) -> bool: ...
    def identity(self) -> tuple[object, object]:
        """Return what identifies the log, and what changes with its content."""
        ...

    def read(self, offset: int, length: int) -> bytes:
        """Read exactly `length` bytes at `offset`; check the length before the allocation."""
        ...

    def plan(self, name: str, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce ranges (start, end) that are going to be read, instead of those of the same name."""
        ...

    def prefetch(self, offset: int, length: int) -> None:
        """Begin to read bytes that are going to be read, without waiting for them."""
        ...

    def fault(self, offset: int, reason: str) -> LogError: ...
    def refusal(self, reason: str) -> BoundError: ...
    def check_number(self, number: int, item_name: str) -> None: ...
    def close(self) -> None: ...


@dataclass(slots=True)
class FileBytes:
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
        """Return the identity of the file, and its size and change time."""
        return file_identity(self.fd)

    def plan(self, name: str, ranges: Iterable[tuple[int, int]]) -> None:
        """Do nothing: the operating system reads ahead."""

    def prefetch(self, offset: int, length: int) -> None:
        """Ask the operating system to read bytes from the disk in advance, without waiting for them."""
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
        """Return the error for damage at `offset`."""
        return LogError(
            f"{self.path} is damaged at byte {offset}: {reason}. Run: ipsys repair {shell_words(self.path)}"
        )

    def refusal(self, reason: str) -> BoundError:
        """Return the error for a log that exceeds the limits. Such a log may be undamaged."""
        return BoundError(
            f"{self.path} is refused: {reason}. If it is a true recording, unpack it first: "
            f"mcap decompress {self.path} -o unpacked.mcap"
        )

    def check_number(self, number: int, item_name: str) -> None:
        """Refuse a log with more channels, runs or similar items than its file size allows."""
        if number > self.read_limits.max_channels:
            raise self.refusal(f"it has {number} {item_name}, more than {self.read_limits.max_channels}")

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
