"""Lists of the objects in stores and on servers that match a pattern, in pages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from ipsys_log.errors import UnreadError
from ipsys_log.log.location import LogState, LogUrl
from ipsys_log.log.remote_requests import changed_ns_of, open_filesystem, repeat_request, version_of

_FLAT = ("s3", "s3a", "gs", "gcs")  # stores without folders, whose file systems list by a prefix


def list_objects(pattern: LogUrl) -> list[LogUrl]:
    """Return the objects that match a pattern, by name.

    Raises
    ------
    LogError
        Nothing matches, or the store cannot be listed.
    """
    return list(_list_entries(pattern))


def list_states(pattern: LogUrl) -> dict[LogUrl, LogState | None]:
    """Return the objects that match a pattern, by name, with their states; None if the list has no sizes.

    Raises
    ------
    LogError
        As :func:`list_objects`.
    """
    return {url: _state(entry) for url, entry in _list_entries(pattern).items()}


def _list_entries(pattern: LogUrl) -> dict[LogUrl, Mapping[str, Any]]:
    filesystem, path = open_filesystem(pattern)
    find = _find_flat if pattern.scheme in _FLAT else _find_by_folder
    matches = repeat_request(pattern, lambda: find(filesystem, path))
    if not matches:
        raise UnreadError(f"{pattern}: no object matches; check the pattern and the permission to list")
    return {LogUrl(pattern.url, name): entry for name, entry in sorted(matches.items())}


def _find_by_folder(filesystem: Any, path: str) -> dict[str, Mapping[str, Any]]:
    return _as_entries(filesystem.glob(path, detail=True))


def _find_flat(filesystem: Any, path: str) -> dict[str, Mapping[str, Any]]:
    """List all objects that begin as the pattern does, page by page, and select those that match.

    A glob of fsspec would list each folder of such a store, with three requests for each of them.
    """
    from fsspec.utils import glob_translate

    folder, _, start = re.split(r"[*?\[]", path, maxsplit=1)[0].rpartition("/")
    matches = re.compile(glob_translate(path)).fullmatch
    entries = _as_entries(filesystem.find(folder, prefix=start, detail=True))
    return {name: entry for name, entry in entries.items() if matches(name)}


def _as_entries(found: Mapping[Any, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {str(name): entry for name, entry in found.items() if entry.get("type") != "directory"}


def _state(entry: Mapping[str, Any]) -> LogState | None:
    size = entry.get("size")
    if size is None:
        return None
    return LogState(int(size), changed_ns_of(entry), "; ".join(version_of(entry)))
