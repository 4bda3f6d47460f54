"""The exclusive lock of a log: whoever writes holds it. Readers never wait for it."""

import fcntl
import os
from pathlib import Path

from ipsys_log.errors import LogError
from ipsys_log.log.journal import journal_path
from ipsys_log.log.storage import Storage
from ipsys_log.log.view import open_for_reading

__all__ = ["check_free", "is_being_written", "open_locked"]


def open_locked(storage: Storage, path: Path, flags: int) -> int:
    """Open `path` and take the exclusive lock at once.

    Raises
    ------
    LogError
        The file cannot be opened, or another process is writing it.
    """
    try:
        fd = storage.open(path, flags)
    except FileExistsError:
        raise LogError(f"{path} exists already and is never overwritten: choose another name") from None
    except FileNotFoundError:
        raise LogError(f"{path} does not exist, or its folder does not") from None
    except OSError as error:
        raise LogError(f"{path} cannot be opened for writing: {error.strerror}") from None
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        same = os.path.samestat(os.fstat(fd), path.stat())
    except OSError:
        same = False
    if not same:
        storage.close(fd)
        raise LogError(f"{path}: another process is writing it: wait until it has finished")
    return fd


def is_being_written(path: Path) -> bool:
    """Whether another process holds the lock. Asked of logs without an end only: nobody can append to
    these, so the instant for which this takes the lock itself is in nobody's way."""
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
    """Refuse a path for a new log if something lies there, or a journal of a log that is gone."""
    try:
        exists, orphan = path.exists(), journal_path(path).exists()
    except OSError as error:
        raise LogError(f"{path} cannot be opened for writing: {error.strerror}") from None
    if exists:
        raise LogError(f"{path} exists already and is never overwritten: choose another name")
    if orphan:
        raise LogError(
            f"{journal_path(path)} belongs to a log that is gone: move that log back, or delete it"
        )
