"""Every operation by which a log file changes, in one place, so that tests can record and cut them."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

__all__ = ["DISK", "Disk", "Storage", "write_all"]


class Storage(Protocol):
    """The operations that change files. Reading goes straight to ``os.pread``."""

    def open(self, path: Path, flags: int) -> int: ...
    def close(self, fd: int) -> None: ...
    def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int: ...
    def truncate(self, fd: int, size: int) -> None: ...
    def fsync(self, fd: int) -> None: ...
    def rename(self, source: Path, target: Path) -> None: ...
    def unlink(self, path: Path) -> None: ...
    def fsync_directory(self, directory: Path) -> None: ...


@dataclass(frozen=True, slots=True)
class Disk:
    """The real thing."""

    def open(self, path: Path, flags: int) -> int:
        return os.open(path, flags | os.O_CLOEXEC, 0o666)

    def close(self, fd: int) -> None:
        os.close(fd)

    def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int:
        return os.pwrite(fd, data, offset)

    def truncate(self, fd: int, size: int) -> None:
        os.ftruncate(fd, size)

    def fsync(self, fd: int) -> None:
        os.fsync(fd)

    def rename(self, source: Path, target: Path) -> None:
        source.rename(target)

    def unlink(self, path: Path) -> None:
        path.unlink()

    def fsync_directory(self, directory: Path) -> None:
        fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


DISK: Storage = Disk()


def write_all(storage: Storage, fd: int, data: bytes | memoryview, offset: int) -> None:
    """Write the whole of `data`: one system call may take less (a signal, 2 GiB, a nearly full disk)."""
    rest = memoryview(data)
    while rest:
        written = storage.pwrite(fd, rest, offset)
        rest, offset = rest[written:], offset + written
