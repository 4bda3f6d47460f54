"""A disk that takes no more while a log is written to it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ipsys_log.errors import LogError, WriteError, is_full
from ipsys_log.log.reader import LogReader
from ipsys_log.units import NS_PER_S, format_bytes

__all__ = ["disk_fault", "reserve", "reserved_bytes", "what_failed", "what_fitted"]

# Set aside on the disk, so that a log can be finished when the disk is full: what waits is written and looked
# at, and the table of contents, which has some MB after some hours, is written twice. On a small disk half.
_RESERVE_BYTES = 64 << 20


def reserved_bytes(free_bytes: int) -> int:
    """Return the part of the free bytes on a disk that is reserved for the end of a log."""
    return min(_RESERVE_BYTES, free_bytes // 2)


@contextmanager
def reserve(path: Path) -> Iterator[Callable[[], None]]:
    """Reserve disk space in an unnamed file; call the yielded function to release it."""
    with ExitStack() as held:
        with suppress(OSError):  # a file system that cannot, or a disk that is full already
            if hasattr(os, "O_TMPFILE"):
                fd = os.open(path.parent, os.O_TMPFILE | os.O_RDWR)
                held.callback(os.close, fd)
                os.posix_fallocate(fd, 0, reserved_bytes(shutil.disk_usage(path.parent).free))
        yield held.close


def what_fitted(path: Path, error: WriteError) -> str:
    """Describe a log that ended because the disk was full or failed."""
    try:
        with LogReader(path) as log:
            count, seconds = log.message_count, ((log.end_ns or 0) - (log.start_ns or 0)) / NS_PER_S
    except LogError:
        return str(error)
    what = "the disk is full" if is_full(error.cause) else disk_fault(error.cause)
    then = "Free some space, or record to another disk" if is_full(error.cause) else "Record to another disk"
    size = format_bytes(path.stat().st_size)
    return (
        f"{path}: {what}; recording has stopped, and the log is complete up to then: "
        f"{count} messages, {seconds:.1f} s, {size}. {then}"
    )


def what_failed(path: Path, fault: OSError) -> str:
    """Describe what to do with a log that may be incomplete on a failed disk."""
    return (
        f"{path}: {disk_fault(fault)} during the recording; messages may be lost. To check the log: "
        f"ipsys repair {path}. Record to another disk"
    )


def disk_fault(fault: OSError) -> str:
    """Describe a fault of the disk."""
    return f"the disk has failed ({fault.strerror})"
