"""A model of a disk that loses power: operations are recorded, then replayed cut at every point.

Any subset of the writes that were not synced may be lost, and only some sectors of the last of them may
have arrived. A new directory entry, a rename or an unlink may be lost until the directory is synced.
A truncation counts as a write of the file's metadata: it may be lost too, in order with later writes
of the same file or not.
"""

import os
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

from ipsys_log.log.journal import DISK, Storage

SECTOR = 512


@dataclass(frozen=True, slots=True)
class Operation:
    kind: str  # create, write, truncate, sync, rename, link, unlink, sync_directory
    file: int = 0
    name: str = ""
    target: str = ""
    data: bytes = b""
    at: int = 0


@dataclass(slots=True)
class Recorder(Storage):
    """A storage that does all operations for real and notes them."""

    operations: list[Operation] = field(default_factory=list)
    _files: dict[int, int] = field(default_factory=dict)
    _names: dict[str, int] = field(default_factory=dict)

    def know(self, path: Path) -> None:
        """Declare a file that is already safe on the disk."""
        self._names[path.name] = len(self._names) + 1

    def open(self, path: Path, flags: int) -> int:
        if not path.exists() and flags & os.O_CREAT:
            self._names[path.name] = 1 + max(self._names.values(), default=0) + len(self.operations)
            self.operations.append(Operation("create", self._names[path.name], path.name))
        elif flags & os.O_TRUNC:
            self.operations.append(Operation("truncate", self._names[path.name]))
        fd = DISK.open(path, flags)
        self._files[fd] = self._names[path.name]
        return fd

    def close(self, fd: int) -> None:
        DISK.close(fd)

    def pwrite(self, fd: int, data: bytes | memoryview, offset: int) -> int:
        self.operations.append(Operation("write", self._files[fd], data=bytes(data), at=offset))
        return DISK.pwrite(fd, data, offset)

    def truncate(self, fd: int, size: int) -> None:
        self.operations.append(Operation("truncate", self._files[fd], at=size))
        DISK.truncate(fd, size)

    def fsync(self, fd: int) -> None:
        self.operations.append(Operation("sync", self._files[fd]))
        DISK.fsync(fd)

    def rename(self, source: Path, target: Path) -> None:
        self.operations.append(Operation("rename", name=source.name, target=target.name))
        self._names[target.name] = self._names.pop(source.name)
        DISK.rename(source, target)

    def link(self, path: Path, second: Path) -> None:
        self.operations.append(Operation("link", name=path.name, target=second.name))
        self._names[second.name] = self._names[path.name]
        DISK.link(path, second)

    def unlink(self, path: Path) -> None:
        self.operations.append(Operation("unlink", name=path.name))
        self._names.pop(path.name)
        DISK.unlink(path)

    def fsync_directory(self, directory: Path) -> None:
        self.operations.append(Operation("sync_directory"))
        DISK.fsync_directory(directory)


@dataclass(slots=True)
class Disk:
    """File contents by number, and names in the directory."""

    files: dict[int, bytearray]
    names: dict[str, int]

    def apply(self, operation: Operation) -> None:
        if operation.kind == "create":
            self.files.setdefault(operation.file, bytearray())
            self.names[operation.name] = operation.file
        elif operation.kind == "write":
            self._write(self.files.setdefault(operation.file, bytearray()), operation.data, operation.at)
        elif operation.kind == "truncate":
            content = self.files.setdefault(operation.file, bytearray())
            content[:] = bytes(content[: operation.at]).ljust(operation.at, b"\0")
        elif operation.kind == "rename" and operation.name in self.names:
            self.names[operation.target] = self.names.pop(operation.name)
        elif operation.kind == "link":
            self.names[operation.target] = self.names[operation.name]
        elif operation.kind == "unlink":
            self.names.pop(operation.name, None)

    @staticmethod
    def _write(content: bytearray, data: bytes, at: int) -> None:
        if len(content) < at + len(data):
            content.extend(bytes(at + len(data) - len(content)))
        content[at : at + len(data)] = data

    def store(self, folder: Path) -> None:
        for old in folder.iterdir():
            old.unlink()
        stored: dict[int, Path] = {}
        for name, number in self.names.items():
            if number in stored:
                (folder / name).hardlink_to(stored[number])
            else:
                (folder / name).write_bytes(self.files[number])
                stored[number] = folder / name


def durable(operations: Sequence[Operation]) -> list[bool]:
    """Return for each operation whether a later sync has made it safe."""
    safe = [False] * len(operations)
    for index, operation in enumerate(operations):
        for earlier in range(index):
            kind = operations[earlier].kind
            if (
                operation.kind == "sync"
                and kind in ("write", "truncate")
                and operations[earlier].file == operation.file
            ):
                safe[earlier] = True
            if operation.kind == "sync_directory" and kind in ("create", "rename", "link", "unlink"):
                safe[earlier] = True
    return safe


def torn(operation: Operation, chance: random.Random) -> Iterator[Operation]:
    """Return some sectors of a write."""
    start = operation.at
    end = start + len(operation.data)
    edges = [start, *range(start - start % SECTOR + SECTOR, end, SECTOR), end]
    for low, high in pairwise(edges):
        if chance.random() < 0.5:
            yield Operation("write", operation.file, data=operation.data[low - start : high - start], at=low)


def crashes(
    files: dict[str, bytes], operations: Sequence[Operation], chance: random.Random, tries: int
) -> Iterator[tuple[int, Disk]]:
    """Yield states of the disk after a power loss at every point: (operations issued, disk)."""
    for cut in range(len(operations) + 1):
        issued = operations[:cut]
        safe = durable(issued)
        loose = [index for index in range(cut) if not safe[index] and "sync" not in issued[index].kind]
        last = max((i for i in loose if issued[i].kind == "write"), default=-1)
        subsets = [(set[int](), False), (set(loose), False), (set(loose), True), ({last}, True)]
        subsets += [(set(loose) - {index}, False) for index in loose[-8:]]
        subsets += [({i for i in loose if chance.random() < 0.5}, number % 2 == 0) for number in range(tries)]
        for kept, tear in subsets:
            disk = Disk(
                {place: bytearray(data) for place, data in enumerate(files.values(), 1)},
                {name: place for place, name in enumerate(files, 1)},
            )
            for index, operation in enumerate(issued):
                if safe[index] or index in kept:
                    if index == last and tear:
                        for piece in torn(operation, chance):
                            disk.apply(piece)
                    else:
                        disk.apply(operation)
            yield cut, disk
