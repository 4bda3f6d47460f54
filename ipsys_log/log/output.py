"""Destinations of a writer's bytes: a growing file, or memory until an append is complete."""

import logging
import os
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from ipsys_log.errors import LogError, WriteError, disk_advice
from ipsys_log.log.hashing import Buffer, extend
from ipsys_log.log.journal import Storage, replace_tail, roll_back, write_all
from ipsys_log.plain_text import shell_words

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
