"""A disk that takes no more while a log is written to it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ipsys_log.errors import LogError, WriteError
from ipsys_log.log import LogReader
from ipsys_log.units import NS_PER_S, format_bytes

__all__ = ["reserve", "reserved_bytes", "what_fitted"]

# Set aside on the disk, so that a log can be finished when the disk is full: what waits is written and looked
# at, and the table of contents, which has some MB after some hours, is written twice. On a small disk half.
_RESERVE_BYTES = 64 << 20


def reserved_bytes(free_bytes: int) -> int:
    """Return how much of what is free on a disk is set aside for the end of a log."""
    return min(_RESERVE_BYTES, free_bytes // 2)


@contextmanager
def reserve(path: Path) -> Iterator[Callable[[], None]]:
    """Some of the disk; what is yielded gives it back. It has no name: it cannot be left behind."""
    with ExitStack() as held:
        with suppress(OSError):  # a file system that cannot, or a disk that is full already
            if hasattr(os, "O_TMPFILE"):
                fd = os.open(path.parent, os.O_TMPFILE | os.O_RDWR)
                held.callback(os.close, fd)
                os.posix_fallocate(fd, 0, reserved_bytes(shutil.disk_usage(path.parent).free))
        yield held.close


def what_fitted(path: Path, error: WriteError) -> str:
    """How far a log goes that was ended by a full disk."""
    try:
        with LogReader(path) as log:
            count, seconds = log.message_count, ((log.end_ns or 0) - (log.start_ns or 0)) / NS_PER_S
    except LogError:
        return str(error)
    size = format_bytes(path.stat().st_size)
    return (
        f"{path}: the disk takes no more; recording has stopped, and the log is complete with what fitted: "
        f"{count} messages, {seconds:.1f} s, {size}. Free some space, or record to another disk"
    )
