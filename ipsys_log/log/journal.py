"""Safe changes of a log: its tail is replaced whole or not at all, under the exclusive lock of a writer.

Two copies protect the old log during the replacement:

- A *temporary* tail: a copy of the old summary after the new end of the file. Other programs read a log from
  its end, without the journal. They find the old log by this copy until the file is truncated to its new
  size.
- The journal ``<path>.journal``: the old tail. The old log is valid while the journal is whole and the file
  does not have its new size. Readers take the tail from the journal, and the next holder of the exclusive
  lock restores the tail. A torn journal means that the file itself was not changed yet.

``docs/decisions/append-order.md`` has the order of writes, and the reasons.
"""

import fcntl
import logging
import os
import stat
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import FileBytes, open_for_reading
from ipsys_log.log.location import describe_broken_link
from ipsys_log.log.records import MAGIC


class Storage:
    """The operations that change files; only tests replace them. Reads call ``os.pread`` directly."""

    __slots__ = ()

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

    def link(self, path: Path, second: Path) -> None:
        second.hardlink_to(path)

    def unlink(self, path: Path) -> None:
        path.unlink()

    def fsync_directory(self, directory: Path) -> None:
        fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


DISK = Storage()


def write_all(storage: Storage, fd: int, data: bytes | memoryview, offset: int) -> None:
    """Write all of `data`; one system call may write less (a signal, 2 GiB, a nearly full disk)."""
    rest = memoryview(data)
    while rest:
        written = storage.pwrite(fd, rest, offset)
        rest, offset = rest[written:], offset + written


_MAGIC = b"\x89IPSYSJ2"
# Magic; sizes of the file: old, new, temporary; tail offset; bytes before the tail: count, CRC; tail length.
_HEAD = struct.Struct("<8sQQQQIIQ")
# The first format has no third size: the old log is valid until the journal is removed.
_EARLIER_MAGIC = b"\x89IPSYSJ1"
_EARLIER_HEAD = struct.Struct("<8sQQQIIQ")
_CRC = struct.Struct("<I")
_BEFORE = 4096
_BLOCK = 1 << 20

_logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Journal:
    """A whole journal of a file that is not completely replaced."""

    old_size: int
    tail_offset: int
    tail_base: int


def journal_path(path: Path) -> Path:
    """Return the path of the journal of a log: beside the log file, even if `path` is a link to it."""
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
    """Return the CRC-32 of a byte range; None if the file ends before the range."""
    crc = 0
    for data in _blocks(fd, offset, length):
        crc, length = zlib.crc32(data, crc), length - len(data)
    return crc if length == 0 else None


def read_journal(fd: int, journal_fd: int) -> Journal | None:
    """Return the journal in `journal_fd` if it makes the old log in `fd` valid.

    Return None if the journal is torn or belongs to another file, or if the new log is complete.
    """
    start = os.pread(journal_fd, _HEAD.size, 0)
    earlier = start.startswith(_EARLIER_MAGIC)
    head = _EARLIER_HEAD if earlier else _HEAD
    if len(start) < head.size:
        return None
    magic, old_size, *sizes, tail_offset, bytes_before, before_crc, tail_length = head.unpack_from(start)
    body = head.size + tail_length
    whole = (
        magic in (_MAGIC, _EARLIER_MAGIC)
        and tail_offset + tail_length == old_size
        and bytes_before == min(_BEFORE, tail_offset)
        and os.fstat(journal_fd).st_size == body + _CRC.size
        and os.pread(journal_fd, _CRC.size, body) == _CRC.pack(_crc(journal_fd, 0, body) or 0)
        and _crc(fd, tail_offset - bytes_before, bytes_before) == before_crc
        and not _is_continued(fd, (old_size, *sizes))
    )
    # The file gets its new size last, after all other data are on the disk.
    complete = not earlier and os.fstat(fd).st_size == sizes[0]
    return Journal(old_size, tail_offset, head.size) if whole and not complete else None


def _is_continued(fd: int, sizes: tuple[int, ...]) -> bool:
    """Return whether the file is a finished log of another size.

    Such a log was repaired and extended under another name.
    """
    size = os.fstat(fd).st_size
    return size not in sizes and os.pread(fd, len(MAGIC), max(0, size - len(MAGIC))) == MAGIC


def attach_journal(view: FileBytes) -> bool:
    """Make `view` show the old log if there is a whole journal beside it; return whether there is one.

    The function takes no lock and changes no file.
    """
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


def replace_tail(
    storage: Storage,
    path: Path,
    fd: int,
    offset: int,
    pieces: Sequence[bytes],
    make_temporary_tail: Callable[[int], bytes] = lambda at: b"\0",
) -> None:
    """Replace all bytes from `offset` on by `pieces`, crash-safe. The caller holds the exclusive lock.

    Parameters
    ----------
    make_temporary_tail : returns a copy of the old tail for an offset after the old and the new end.
        Other programs need this copy to find the old log during the replacement.

    Raises
    ------
    OSError
        A write failed before the new tail is on the disk. `roll_back` then decides which log is valid.
    """
    new_size = offset + sum(map(len, pieces))
    beyond = max(os.fstat(fd).st_size, new_size)
    temporary_tail = make_temporary_tail(beyond)
    _write_journal(storage, path, fd, offset, (new_size, beyond + len(temporary_tail)))
    write_all(storage, fd, temporary_tail, beyond)
    storage.fsync(fd)
    for piece in pieces:
        write_all(storage, fd, piece, offset)
        offset += len(piece)
    storage.fsync(fd)
    storage.truncate(fd, new_size)
    storage.fsync(fd)
    try:
        _drop(storage, path)
    except OSError as error:  # from here on the new log is valid, with or without a journal
        _logger.warning(
            "%s: the messages are in the log, but %s cannot be removed (%s)",
            path, journal_path(path).name, error.strerror,
        )  # fmt: skip


def roll_back(storage: Storage, path: Path, fd: int) -> bool:
    """Undo an interrupted append; the caller holds the exclusive lock.

    Returns
    -------
    True if an append was undone. If only the removal of the journal is missing, the append is completed
    instead.

    Raises
    ------
    OSError
        A write failed; the journal stays, and the old log remains valid.
    """
    journal_file = journal_path(path)
    try:
        journal_fd = os.open(journal_file, os.O_RDONLY | os.O_CLOEXEC)
    except FileNotFoundError:
        return False
    try:
        journal = read_journal(fd, journal_fd)
        if journal is not None:
            _restore(storage, fd, journal_fd, journal)
    finally:
        os.close(journal_fd)
    storage.fsync(fd)
    _drop(storage, path)
    return journal is not None


def _restore(storage: Storage, fd: int, journal_fd: int, journal: Journal) -> None:
    """Write the old tail while the temporary tail still follows it. Truncate the file after that."""
    offset = journal.tail_offset
    for data in _blocks(journal_fd, journal.tail_base, journal.old_size - offset):
        write_all(storage, fd, data, offset)
        offset += len(data)
    storage.fsync(fd)
    storage.truncate(fd, journal.old_size)


def _write_journal(storage: Storage, path: Path, fd: int, offset: int, sizes: tuple[int, int]) -> None:
    size = os.fstat(fd).st_size
    bytes_before = min(_BEFORE, offset)
    before_crc = _crc(fd, offset - bytes_before, bytes_before) or 0
    head = _HEAD.pack(_MAGIC, size, *sizes, offset, bytes_before, before_crc, size - offset)
    journal_fd = storage.open(journal_path(path), os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    try:
        position, crc = 0, 0
        for data in chain((head,), _blocks(fd, offset, size - offset)):
            write_all(storage, journal_fd, data, position)
            position, crc = position + len(data), zlib.crc32(data, crc)
        write_all(storage, journal_fd, _CRC.pack(crc), position)
        storage.fsync(journal_fd)
    finally:
        storage.close(journal_fd)
    storage.fsync_directory(journal_path(path).parent)


def _drop(storage: Storage, path: Path) -> None:
    storage.unlink(journal_path(path))
    storage.fsync_directory(journal_path(path).parent)


def open_locked(storage: Storage, path: Path, flags: int) -> int:
    """Open `path` and take the exclusive lock at once.

    Raises
    ------
    LogError
        The file cannot be opened, another process is writing it, or its file system has no locks. A file that
        this call created is removed.
    """
    try:
        fd = storage.open(path, flags)
    except FileExistsError:
        raise LogError(_why_taken(path)) from None
    except FileNotFoundError:
        raise LogError(f"{path} does not exist, or its folder does not") from None
    except OSError as error:
        raise LogError(f"{path} cannot be opened for writing: {error.strerror}") from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        same = os.path.samestat(os.fstat(fd), path.stat())
    except (BlockingIOError, FileNotFoundError):
        same = False
    except OSError as error:
        if flags & os.O_CREAT and os.fstat(fd).st_size == 0:
            with suppress(OSError):
                storage.unlink(path)
        storage.close(fd)
        raise LogError(_without_locks(path, error)) from None
    if not same:
        storage.close(fd)
        raise LogError(f"{path}: another process is writing it: wait until it has finished")
    return fd


def _without_locks(path: Path, error: OSError) -> str:
    return (
        f"{path}: its file system has no locks ({error.strerror}), so two programs could write a log at the "
        "same time: write to a local disk, or mount this one with locks (NFS: start rpc.statd, or mount it "
        "with nolock if only this machine writes there)"
    )


def check_locks(folder: Path) -> None:
    """Check that files in a folder can be locked, before any work is done.

    Raises
    ------
    LogError
        The files cannot be locked. A folder that is not writable is not checked.
    """
    with suppress(OSError), tempfile.TemporaryFile(dir=folder) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise LogError(_without_locks(folder, error)) from None


def is_being_written(path: Path) -> bool:
    """Return whether another process holds the lock.

    The check takes the lock for an instant. A writer that starts in this instant fails. So call the function
    only for logs with a journal, and for logs without an end, to which no program can append.
    """
    fd = open_for_reading(path)
    try:
        fcntl.flock(fd, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:  # a file system without locks
        return False
    finally:
        os.close(fd)
    return False


def check_free(path: Path) -> None:
    """Refuse a path for a new log if a file exists there, or a journal of a deleted log."""
    try:
        taken, orphan = os.path.lexists(path), journal_path(path).exists()
    except OSError as error:
        raise LogError(f"{path} cannot be opened for writing: {error.strerror}") from None
    if taken:
        raise LogError(_why_taken(path))
    if orphan:
        raise LogError(
            f"{journal_path(path)} belongs to a log that does not exist: move the log back, or delete "
            "this file"
        )


def _why_taken(path: Path) -> str:
    return (
        describe_broken_link(path) or f"{path} exists already and is never overwritten: choose another name"
    )
