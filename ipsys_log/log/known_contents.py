"""Known contents of logs: a table of contents is parsed once, until another process changes the file.

Each command imports this module before it knows whether it will open a log, so the reader of the summary is
imported later.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ipsys_log.log.byte_source import LogBytes, file_identity
from ipsys_log.log.location import LogUrl
from ipsys_log.log.remote_bytes import RemoteBytes, RemoteRanges

if TYPE_CHECKING:
    from ipsys_log.log.contents import Contents


@dataclass(slots=True)
class _Reading:
    """The tables of contents by identity, and the cached ranges of URLs, of one reading."""

    contents: dict[object, tuple[object, Contents]] = field(default_factory=dict)
    ranges: dict[LogUrl, RemoteRanges] = field(default_factory=dict)


# None outside of :func:`one_reading`.
_reading: ContextVar[_Reading | None] = ContextVar("one_reading", default=None)


@contextmanager
def one_reading() -> Iterator[None]:
    """Parse the summary of each log once within this block, and again only after a change of its file.

    Inode, size and change time show a change. An append checks for a change under the lock. The version of a
    log at a URL is that of its first opening: a later request of another version fails.
    """
    token = _reading.set(_reading.get() or _Reading())
    try:
        yield
    finally:
        _reading.reset(token)


def open_remote(url: LogUrl) -> RemoteBytes:
    """Open a log at a URL; within one reading, all readers share its cache."""
    reading = _reading.get()
    if reading is None:
        return RemoteBytes.open(url)
    if url not in reading.ranges:
        reading.ranges[url] = RemoteBytes.open(url).ranges
    return RemoteBytes(url, reading.ranges[url])


def contents_of(view: LogBytes) -> Contents:
    """Return the table of contents of an open log, which the caller may change."""
    from ipsys_log.log.summary import load_contents

    reading = _reading.get()
    if reading is None or view.is_interrupted:  # with a tail in a journal, the file is not the whole log
        return load_contents(view)
    log, content = view.identity()
    known = reading.contents.get(log)
    if known is not None and known[0] == content:
        return known[1].copy()
    contents = load_contents(view)
    _note((log, content), contents)
    return contents


def note_contents(fd: int, contents: Contents) -> None:
    """Note the table of contents of a log that this process has just written."""
    if _reading.get() is not None:
        _note(file_identity(fd), contents)


def _note(identity: tuple[object, object], contents: Contents) -> None:
    reading = _reading.get()
    if reading is None:
        return
    log, content = identity
    reading.contents.pop(log, None)
    if not contents.unchunked and not contents.cut_short:
        reading.contents[log] = content, contents.copy()
