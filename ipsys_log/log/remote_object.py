"""Objects in stores and on servers: repeated requests, failures in one line, byte ranges of one version.

A request that fails for a reason that may pass is repeated.

Each request asks for the version that was opened: by its ETag where the protocol can do this (S3, HTTP), else
by a look at size and time after the request.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, TypeVar

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogState, LogUrl
from ipsys_log.plain_text import plain_text
from ipsys_log.units import NS_PER_S

_PAUSES_S = (0.1, 0.4, 1.6, 4.0)
_SELF_REPEATING = ("s3", "s3a", "gs", "gcs")  # their file systems repeat a request some times themselves
_LONGEST_REASON = 200
# HTTP status codes of requests that may succeed when they are repeated.
_PASSING_STATUS = (408, 425, 429)
_CHANGED_STATUS = 412
_DENIED_STATUS = (401, 403)
# Errors that a repetition does not change. A file system may raise any other error for a lost connection.
_FINAL = (
    *(PermissionError, IsADirectoryError, NotADirectoryError, NotImplementedError, ImportError, LookupError),
    ValueError,
)
_NO_CREDENTIALS = "NoCredentialsError"  # of botocore, which is imported only for its URLs
_BUGS = (TypeError, AttributeError, NameError, AssertionError)
# The fields of an entry of fsspec that tell a version; each file system has some of them.
_VERSION_FIELDS = (
    *("ETag", "etag", "generation", "Last-Modified", "LastModified", "last_modified", "mtime"),
    *("modified", "created", "md5Hash", "content_md5"),
)
# The package of a protocol, for the advice; other protocols get the advice of fsspec.
_PACKAGES = {
    **dict.fromkeys(("s3", "s3a"), "s3fs"),
    **dict.fromkeys(("gs", "gcs"), "gcsfs"),
    **dict.fromkeys(("az", "abfs", "abfss", "adl"), "adlfs"),
    **dict.fromkeys(("ssh", "sftp"), "paramiko"),
    **dict.fromkeys(("http", "https"), "aiohttp"),
}

T = TypeVar("T")


class ChangedError(Exception):
    """An object that is not the one that was opened."""


class NoRangesError(ValueError):
    """A server that sends whole objects only."""


def open_filesystem(url: LogUrl) -> tuple[Any, str]:
    """Return the file system of fsspec for a URL, and the path in it; there is no request.

    Raises
    ------
    UnreadError
        The protocol is not known, or its package is missing.
    """
    check_installed(f"{url}: a log at a URL needs", "fsspec")
    from fsspec.core import url_to_fs
    from fsspec.registry import known_implementations

    known = known_implementations.get(url.scheme, {})
    try:
        filesystem, path = url_to_fs(url.url, use_listings_cache=False)
    except ImportError:
        reason = plain_text(str(known.get("err", "its package is missing")), longest=_LONGEST_REASON)
        package = _PACKAGES.get(url.scheme)
        advice = f"pip install {package}" if package else reason
        raise UnreadError(f"{url}: logs at {url.scheme}:// need another package: {advice}") from None
    except ValueError as error:
        if not known:
            raise UnreadError(
                f"{url}: the protocol {url.scheme}:// is not known; use a path, or a URL such as "
                "s3://bucket/log.mcap or https://host/log.mcap"
            ) from None
        raise UnreadError(f"{url} cannot be opened: {_reason(url, error)}") from None
    return filesystem, url.key or path


def version_of(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the fields of an entry of fsspec that identify the content of its object."""
    fields = [f"{name}={entry[name]}" for name in _VERSION_FIELDS if entry.get(name)]
    return (f"size={entry.get('size')}", *fields)


def changed_ns_of(entry: Mapping[str, Any]) -> int | None:
    """Return the time of the last change; file systems give it as a time, as seconds, or not at all."""
    for name in ("LastModified", "last_modified", "mtime", "modified", "updated"):
        value = entry.get(name)
        if isinstance(value, datetime):
            return int(value.timestamp() * NS_PER_S)
        if isinstance(value, int | float):
            return int(value * NS_PER_S)
    return None


def repeat_request(url: LogUrl, ask: Callable[[], T]) -> T:
    """Return the answer to a request; repeat it some times if its failure may pass."""
    pauses_s = _pauses_s(url)
    for pause_s in (*pauses_s, None):
        try:
            return ask()
        except (LogError, *_BUGS):
            raise
        except Exception as error:  # each file system of fsspec has errors of its own
            if pause_s is None or not _may_pass(error):
                raise failure_of(url, error) from error
        time.sleep(pause_s)
    raise AssertionError("the last attempt returns or raises")


def _pauses_s(url: LogUrl) -> tuple[float, ...]:
    return _PAUSES_S[:1] if url.scheme in _SELF_REPEATING else _PAUSES_S


def _status_of(error: BaseException) -> int | None:
    """Return the HTTP status of an error, or of its cause; None without one."""
    for one in (error, error.__cause__):
        status = getattr(one, "status", None)
        if isinstance(status, int):
            return status
        response = getattr(one, "response", None)
        if isinstance(response, dict):
            code = response.get("ResponseMetadata", {}).get("HTTPStatusCode")
            return code if isinstance(code, int) else None
    return None


def _is_changed(error: BaseException) -> bool:
    expired = type(error).__name__ == "FileExpired"  # s3fs, which is imported only for its URLs
    return expired or isinstance(error, ChangedError) or _status_of(error) == _CHANGED_STATUS


def _may_pass(error: BaseException) -> bool:
    if _is_changed(error):
        return False
    status = _status_of(error)
    if status is not None:
        return status >= 500 or status in _PASSING_STATUS
    if isinstance(error, FileNotFoundError):
        return error.__cause__ is not None  # HTTP: a HEAD request that was not answered
    return not isinstance(error, _FINAL) and type(error).__name__ != _NO_CREDENTIALS


def failure_of(url: LogUrl, error: BaseException) -> UnreadError:
    """Return the error for a request that has failed: one line with the cause and the next step."""
    if _is_changed(error):
        return UnreadError(f"{url} changed while it was read: run the command again")
    if isinstance(error, NoRangesError):
        return UnreadError(f"{url}: the server ignores byte ranges: download the log, and read the file")
    status = _status_of(error)
    if status in _DENIED_STATUS or isinstance(error, PermissionError):
        return UnreadError(
            f"{url} cannot be read: the store denies access; check the credentials of {url.scheme}://"
        )
    if status == 404 or (isinstance(error, FileNotFoundError) and not _may_pass(error)):
        return UnreadError(f"{url} does not exist")
    if type(error).__name__ == _NO_CREDENTIALS:
        return UnreadError(f"{url} cannot be read: there are no credentials for {url.scheme}://; give some")
    tried = f" after {len(_pauses_s(url)) + 1} attempts" if _may_pass(error) else ""
    cause = error.__cause__ if isinstance(error, FileNotFoundError) and error.__cause__ else error
    return UnreadError(
        f"{url} cannot be read{tried}: {_reason(url, cause)}; check the address and the connection"
    )


def _reason(url: LogUrl, error: BaseException) -> str:
    """Return the text of an error on one line, without the secrets of the URL."""
    text = " ".join((str(error) or type(error).__name__).split()).replace(url.url, str(url))
    query = url.url.partition("?")[2]
    return plain_text(text.replace(query, "...") if query else text, longest=_LONGEST_REASON)


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
    """Look up an object: one request for its size and version."""
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
    """Return the state of one object, in one request."""
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
