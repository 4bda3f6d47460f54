"""Objects in stores and on servers: exact byte ranges of one version.

Each request asks for the version that was opened: by its ETag where the protocol can do this (S3, HTTP), else
by a look at size and time after the request.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from ipsys_log.errors import UnreadError
from ipsys_log.log.location import LogState, LogUrl
from ipsys_log.log.remote_requests import (
    ChangedError,
    NoRangesError,
    changed_ns_of,
    failure_of,
    open_filesystem,
    repeat_request,
    version_of,
)

Read = Callable[[int, int], bytes]
Opened = tuple[Mapping[str, Any], Read]  # the entry of an object, and the function that reads its version


@dataclass(slots=True)
class RemoteObject:
    """One version of an object.

    Attributes
    ----------
    filesystem, path : the file system of fsspec, and the object in it.
    size : in bytes.
    version : identifies the content, as far as the store tells.
    changed_ns : the time of the last change, in ns since 1970, if the store tells it.
    requests, bytes_fetched : the number of successful requests for bytes, and of these bytes.
    """

    url: LogUrl
    filesystem: Any
    path: str
    size: int
    version: tuple[str, ...]
    read_pinned: Callable[[int, int], bytes]
    changed_ns: int | None = None
    requests: int = 0
    bytes_fetched: int = 0

    def fetch(self, start: int, end: int) -> bytes:
        """Return the bytes from `start` to before `end`, in one request.

        Raises
        ------
        LogError
            The object has changed since it was opened, or cannot be read.
        """

        def ask() -> bytes:
            data = self.read_pinned(start, end)
            if len(data) > end - start:
                raise NoRangesError
            if len(data) < end - start:
                raise ConnectionError(f"{len(data)} of {end - start} bytes arrived")
            return data

        data = repeat_request(self.url, ask)
        self.requests += 1
        self.bytes_fetched += len(data)
        return data


def open_object(url: LogUrl) -> RemoteObject:
    """Look up an object: one request for its size and version.

    Raises
    ------
    LogError
        The protocol is not known, its package is missing, or the object cannot be found.
    """
    filesystem, path = open_filesystem(url)
    open_pinned = _OPENERS.get(url.scheme, _open_and_look)
    entry, read = repeat_request(url, lambda: open_pinned(filesystem, path))
    size = entry.get("size")
    if entry.get("type") == "directory":
        raise UnreadError(f"{url} cannot be read as a log: it is a folder; to read its logs: {url}/*.mcap")
    if size is None or entry.get("partial") is False:
        raise failure_of(url, NoRangesError())
    version, changed_ns = version_of(entry), changed_ns_of(entry)
    return RemoteObject(url, filesystem, path, int(size), version, read, changed_ns)


def read_state(url: LogUrl) -> LogState:
    """Return the state of one object, in one request.

    Raises
    ------
    LogError
        As :func:`open_object`.
    """
    source = open_object(url)
    return LogState(source.size, source.changed_ns, "; ".join(source.version))


def _open_s3(filesystem: Any, path: str) -> Opened:
    """Open with If-Match: the file object of s3fs sends it, and without a cache it reads exact ranges."""
    file = filesystem.open(path, "rb", cache_type="none")
    return file.details, _reader_of(file)


def _open_http(filesystem: Any, path: str) -> Opened:
    """Open with If-Match if the server gives a strong ETag; it never compares a weak one as equal."""
    entry = filesystem.info(path)
    if not entry.get("size"):
        return entry, lambda start, end: b""
    etag = str(entry.get("ETag") or "")
    headers = {**filesystem.kwargs.get("headers", {}), "Accept-Encoding": "identity"}
    is_strong = bool(etag) and not etag.startswith("W/")
    if is_strong:
        headers["If-Match"] = etag
    file = filesystem.open(path, "rb", cache_type="none", size=entry["size"], headers=headers)

    def read(start: int, end: int) -> bytes:
        try:
            return _reader_of(file)(start, end)
        except ValueError as error:  # the whole object is coming
            raise NoRangesError from error

    return entry, read if is_strong else _looking_after(read, filesystem, path, entry)


def _open_and_look(filesystem: Any, path: str) -> Opened:
    """Open without If-Match: the protocol has none, or its file system does not send it."""
    entry = filesystem.info(path)

    def read(start: int, end: int) -> bytes:
        data: bytes = filesystem.cat_file(path, start=start, end=end)
        return data

    return entry, _looking_after(read, filesystem, path, entry)


def _reader_of(file: Any) -> Read:
    def read(start: int, end: int) -> bytes:
        file.seek(start)
        data: bytes = file.read(end - start)
        return data

    return read


def _looking_after(read: Read, filesystem: Any, path: str, entry: Mapping[str, Any]) -> Read:
    """Return a function that compares the version of the object after each request."""
    version = version_of(entry)

    def read_and_look(start: int, end: int) -> bytes:
        data = read(start, end)
        if version_of(filesystem.info(path)) != version:
            raise ChangedError
        return data

    return read_and_look


_OPENERS: dict[str, Callable[[Any, str], Opened]] = {
    **dict.fromkeys(("s3", "s3a"), _open_s3),
    **dict.fromkeys(("http", "https"), _open_http),
}
