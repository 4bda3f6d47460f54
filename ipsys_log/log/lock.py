"""The exclusive lock of a log. A writer holds the lock; readers never wait for it."""

import fcntl
import os
import tempfile
from contextlib import suppress
from pathlib import Path

from ipsys_log.errors import LogError
from ipsys_log.log.byte_source import open_for_reading
from ipsys_log.log.journal import Storage, journal_path


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


def describe_broken_link(path: Path) -> str | None:
    """Return an error text for a path that is a broken link; None for any other path.

    Such a path does not exist, but no file can be created there.
    """
    if not path.is_symlink() or path.exists():
        return None
    return f"{path} is a link to {path.readlink()}, which does not exist: remove it, or choose another name"
