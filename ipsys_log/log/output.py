"""Where a writer's bytes go: into a file that grows, or into memory until an append is complete."""

import os
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ipsys_log.errors import LogError, WriteError
from ipsys_log.log.crc import Buffer, extend
from ipsys_log.log.journal import replace_tail, roll_back
from ipsys_log.log.storage import Storage, write_all

__all__ = ["Growing", "Output", "Pending"]


class Output(Protocol):
    """The end of the data section. `crc` is None where the log does not keep one.

    `emit` is told the CRC-32 of large data, so that it is not worked out twice.
    """

    @property
    def offset(self) -> int: ...
    @property
    def crc(self) -> int | None: ...
    def emit(self, data: Buffer, crc: int | None = None) -> None: ...
    def finish(self, tail: bytes) -> None: ...
    def abandon(self) -> None: ...
    def close(self) -> None: ...


@dataclass(slots=True)
class Growing:
    """A new file. Each piece is handed to the operating system at once.

    With a `target` the file is renamed to it when it is complete, and removed when it is abandoned.
    """

    storage: Storage
    path: Path
    fd: int
    target: Path | None = None
    offset: int = 0
    crc: int | None = 0
    _failed: bool = False

    def emit(self, data: Buffer, crc: int | None = None) -> None:
        try:
            write_all(self.storage, self.fd, data, self.offset)
        except OSError as error:
            self._failed = True
            kept = f"what it holds so far can be saved with: ipsys repair {self.path}"
            then = kept if self.target is None else "nothing was written, free some space and try again"
            raise _cannot_write(self.target or self.path, error, then) from None
        self.offset += len(data)
        self.crc = _extend(self.crc or 0, data, crc)

    def finish(self, tail: bytes) -> None:
        if self._failed:  # a torn piece may reach beyond the tail
            self.storage.truncate(self.fd, self.offset)
        self.emit(tail)
        self.storage.fsync(self.fd)
        if self.target is not None:
            if self.target.exists():
                raise LogError(f"{self.target} appeared while it was written: choose another name")
            self.storage.rename(self.path, self.target)
            self.target = None
        self.storage.fsync_directory(self.path.parent)

    def abandon(self) -> None:
        if self.target is not None:
            self.storage.unlink(self.path)

    def close(self) -> None:
        self.storage.close(self.fd)


@dataclass(slots=True)
class Pending:
    """An append: nothing touches the file until `finish`."""

    storage: Storage
    path: Path
    fd: int
    start: int
    offset: int
    crc: int | None
    _pieces: list[bytes] = field(default_factory=list)

    def emit(self, data: Buffer, crc: int | None = None) -> None:
        self._pieces.append(bytes(data))  # a chunk's memory is used again
        self.offset += len(data)
        self.crc = None if self.crc is None else _extend(self.crc, data, crc)

    def finish(self, tail: bytes) -> None:
        if not self._pieces:
            return
        try:
            replace_tail(self.storage, self.path, self.fd, self.start, (*self._pieces, tail))
        except OSError as error:
            with suppress(OSError):  # else whoever next writes does it
                roll_back(self.storage, self.path, self.fd)
            then = "the log stays as it was: free some space and try again"
            raise _cannot_write(self.path, error, then) from None

    def abandon(self) -> None:
        self._pieces.clear()

    def close(self) -> None:
        self.storage.close(self.fd)


def _extend(so_far: int, data: Buffer, crc: int | None) -> int:
    return zlib.crc32(data, so_far) if crc is None else extend(so_far, data, crc)


def _cannot_write(path: Path, error: OSError, then: str) -> WriteError:
    return WriteError(f"{path} cannot be written ({error.strerror or os.strerror(error.errno or 0)}): {then}")
