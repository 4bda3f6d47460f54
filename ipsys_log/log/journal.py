"""Replacing the tail of a file so that a crash at any instant leaves the old file or the new one.

The journal ``<path>.journal`` holds the old tail. While it exists and is whole, the old log counts:
readers take the tail from it, and whoever next holds the exclusive lock puts the tail back. A torn
journal means that the file itself was not touched yet.
"""

import os
import stat
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from ipsys_log.log.records import MAGIC
from ipsys_log.log.storage import Storage, write_all
from ipsys_log.log.view import View

__all__ = ["Journal", "attach_journal", "journal_path", "read_journal", "replace_tail", "roll_back"]

_MAGIC = b"\x89IPSYSJ1"
# Magic, old size, new size, tail offset, bytes before the tail: count, CRC; tail length.
_HEAD = struct.Struct("<8sQQQIIQ")
_CRC = struct.Struct("<I")
_BEFORE = 4096
_BLOCK = 1 << 20


@dataclass(frozen=True, slots=True)
class Journal:
    """A whole journal that belongs to its file."""

    old_size: int
    tail_offset: int

    @property
    def tail_base(self) -> int:
        return _HEAD.size


def journal_path(path: Path) -> Path:
    """Where the journal of the log at `path` lies while its tail is replaced: beside the file itself, by
    whichever link it is opened."""
    real = Path(os.path.realpath(path))
    return real.with_name(real.name + ".journal")


def _blocks(fd: int, offset: int, length: int) -> Iterator[bytes]:
    while length > 0:
        data = os.pread(fd, min(length, _BLOCK), offset)
        if not data:
            return
        yield data
        offset, length = offset + len(data), length - len(data)


def _crc(fd: int, offset: int, length: int) -> int | None:
    """CRC-32 of a stretch, None if the file ends before it does."""
    crc = 0
    for data in _blocks(fd, offset, length):
        crc, length = zlib.crc32(data, crc), length - len(data)
    return crc if length == 0 else None


def read_journal(fd: int, journal_fd: int) -> Journal | None:
    """The journal in `journal_fd` if it is whole and belongs to the file in `fd`, else None."""
    head = os.pread(journal_fd, _HEAD.size, 0)
    if len(head) != _HEAD.size:
        return None
    magic, old_size, new_size, tail_offset, before, before_crc, tail_length = _HEAD.unpack(head)
    body = _HEAD.size + tail_length
    whole = (
        magic == _MAGIC
        and tail_offset + tail_length == old_size
        and before == min(_BEFORE, tail_offset)
        and os.fstat(journal_fd).st_size == body + _CRC.size
        and os.pread(journal_fd, _CRC.size, body) == _CRC.pack(_crc(journal_fd, 0, body) or 0)
        and _crc(fd, tail_offset - before, before) == before_crc
        and not _went_on(fd, (old_size, new_size))
    )
    return Journal(old_size, tail_offset) if whole else None


def _went_on(fd: int, sizes: tuple[int, int]) -> bool:
    """Whether the file is a finished log of neither size: repaired and extended under another name."""
    size = os.fstat(fd).st_size
    return size not in sizes and os.pread(fd, len(MAGIC), max(0, size - len(MAGIC))) == MAGIC


def attach_journal(view: View) -> bool:
    """Let `view` show the old log if a whole journal lies beside it. Takes no lock, changes nothing."""
    try:
        journal_fd = os.open(journal_path(view.path), os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError:
        return False
    if not stat.S_ISREG(os.fstat(journal_fd).st_mode):
        os.close(journal_fd)
        return False
    journal = read_journal(view.fd, journal_fd)
    if journal is None:
        os.close(journal_fd)
        return False
    view.size, view.tail_offset = journal.old_size, journal.tail_offset
    view.tail_fd, view.tail_base = journal_fd, journal.tail_base
    return True


def replace_tail(storage: Storage, path: Path, fd: int, offset: int, pieces: Sequence[bytes]) -> None:
    """Replace everything from `offset` on by `pieces`, crash-safe. The caller holds the exclusive lock.

    The file is cut before it is overwritten: otherwise the old footer would survive a crash and point
    into new bytes.
    """
    _write_journal(storage, path, fd, offset, offset + sum(map(len, pieces)))
    storage.truncate(fd, offset)
    for piece in pieces:
        write_all(storage, fd, piece, offset)
        offset += len(piece)
    storage.fsync(fd)
    _drop(storage, path)


def roll_back(storage: Storage, path: Path, fd: int) -> bool:
    """Undo an append that was cut short; the caller holds the exclusive lock. True if there was one."""
    journal_file = journal_path(path)
    try:
        journal_fd = os.open(journal_file, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        journal = read_journal(fd, journal_fd)
        if journal is not None:
            _put_back(storage, fd, journal_fd, journal)
    finally:
        os.close(journal_fd)
    _drop(storage, path)
    return journal is not None


def _put_back(storage: Storage, fd: int, journal_fd: int, journal: Journal) -> None:
    offset = journal.tail_offset
    storage.truncate(fd, offset)
    for data in _blocks(journal_fd, journal.tail_base, journal.old_size - offset):
        write_all(storage, fd, data, offset)
        offset += len(data)
    storage.fsync(fd)


def _write_journal(storage: Storage, path: Path, fd: int, offset: int, new_size: int) -> None:
    size = os.fstat(fd).st_size
    before = min(_BEFORE, offset)
    before_crc = _crc(fd, offset - before, before) or 0
    head = _HEAD.pack(_MAGIC, size, new_size, offset, before, before_crc, size - offset)
    journal_fd = storage.open(journal_path(path), os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    try:
        at, crc = 0, 0
        for data in chain((head,), _blocks(fd, offset, size - offset)):
            write_all(storage, journal_fd, data, at)
            at, crc = at + len(data), zlib.crc32(data, crc)
        write_all(storage, journal_fd, _CRC.pack(crc), at)
        storage.fsync(journal_fd)
    finally:
        storage.close(journal_fd)
    storage.fsync_directory(journal_path(path).parent)


def _drop(storage: Storage, path: Path) -> None:
    storage.unlink(journal_path(path))
    storage.fsync_directory(journal_path(path).parent)
