"""Requests to stores and servers, with fsspec: file systems, repeated requests, and failures in one line.

A request that fails for a reason that may pass is repeated.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, TypeVar

from ipsys_log.errors import LogError, UnreadError
from ipsys_log.extras import check_installed
from ipsys_log.log.location import LogUrl
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


def check_protocol(url: LogUrl) -> None:
    """Check that the protocol of a URL is known, and its package installed; there is no request.

    Raises
    ------
    UnreadError
        The protocol is not known, or its package is missing.
    """
    open_filesystem(url)


def open_filesystem(url: LogUrl) -> tuple[Any, str]:
    """Return the file system of fsspec for a URL, and the path in it; there is no request.

    Raises
    ------
    UnreadError
        As :func:`check_protocol`.
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
    """Return the answer to a request; repeat it some times if its failure may pass.

    Raises
    ------
    LogError
        One line: the failure, and what to do.
    """
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
