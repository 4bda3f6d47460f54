"""Known contents of logs: a table of contents is parsed once, until another process changes the file."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import NamedTuple

from ipsys_log.log.byte_source import LogBytes
from ipsys_log.log.contents import Contents
from ipsys_log.log.summary import load_contents

__all__ = ["contents_of", "note_contents", "one_reading"]


class _Known(NamedTuple):
    """A table of contents, with the size in bytes and the change time in ns of its file."""

    size: int
    changed_ns: int
    contents: Contents


# By device and inode; None outside of :func:`one_reading`.
_known: ContextVar[dict[tuple[int, int], _Known] | None] = ContextVar("known_contents", default=None)


@contextmanager
def one_reading() -> Iterator[None]:
    """Parse the summary of each log once within this block, and again only after a change of its file.

    Inode, size and change time show a change. An append checks for a change under the lock.
    """
    outer = _known.get()
    token = _known.set({} if outer is None else outer)
    try:
        yield
    finally:
        _known.reset(token)


def contents_of(view: LogBytes) -> Contents:
    """Return the table of contents of an open log, which the caller may change.

    Raises
    ------
    LogError
        As :func:`~ipsys_log.log.summary.load_contents`.
    """
    known = _known.get()
    if known is None or view.tail_fd >= 0:  # with a tail in a journal, the file is not the whole log
        return load_contents(view)
    status = os.fstat(view.fd)
    last = known.get((status.st_dev, status.st_ino))
    if last is not None and (last.size, last.changed_ns) == (view.size, status.st_mtime_ns):
        return last.contents.copy()
    contents = load_contents(view)
    _note(status, contents)
    return contents


def note_contents(fd: int, contents: Contents) -> None:
    """Note the table of contents of a log that this process has just written."""
    if _known.get() is not None:
        _note(os.fstat(fd), contents)


def _note(status: os.stat_result, contents: Contents) -> None:
    known = _known.get()
    if known is None:
        return
    key = status.st_dev, status.st_ino
    known.pop(key, None)
    if not contents.unchunked and not contents.cut_short:
        known[key] = _Known(status.st_size, status.st_mtime_ns, contents.copy())
