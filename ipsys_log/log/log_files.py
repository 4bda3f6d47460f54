"""The logs of a list of locations, where a folder or a pattern stands for several logs."""

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import takewhile
from pathlib import Path, PurePath, PurePosixPath
from typing import Any

from ipsys_log.errors import IpsysError, UnreadError
from ipsys_log.log import remote_object
from ipsys_log.log.location import LogLocation, LogState, LogUrl, parse_location

_ALL_BELOW = "**/*.mcap"
_FLAT = ("s3", "s3a", "gs", "gcs")  # stores without folders, whose file systems list by a prefix


def read_log_state(log: LogLocation) -> LogState:
    """Return the state of a log; of a URL, in one request.

    Raises
    ------
    LogError
        The object cannot be found.
    OSError
        The file cannot be found.
    """
    if isinstance(log, LogUrl):
        from ipsys_log.log.remote_object import read_state

        return read_state(log)
    status = log.stat()
    return LogState(status.st_size, status.st_mtime_ns)


def find_logs(texts: Iterable[str | os.PathLike[str] | LogUrl]) -> list[LogLocation]:
    """Return the locations of logs; a URL with ``*`` or ``[`` gives all objects that match, by name."""
    found: list[LogLocation] = []
    for location in map(parse_location, texts):
        if isinstance(location, LogUrl) and location.is_pattern:
            found += _list_objects(location)
        else:
            found.append(location)
    return found


def expand_folders(logs: Iterable[LogLocation]) -> list[LogLocation]:
    """Return the logs of some locations, in their order; a folder stands for all logs below it.

    A URL that ends with ``/`` is a folder. A log that is named twice, or by a link, is returned once.

    Examples
    --------
    >>> expand_folders([Path("b.mcap"), Path("a.mcap"), Path("./b.mcap")])
    [PosixPath('b.mcap'), PosixPath('a.mcap')]
    """
    return [log for log, _ in _expand(logs)]


def name_places(logs: Iterable[LogLocation]) -> dict[LogLocation, PurePath]:
    """Return the logs of some locations, each with a relative path for its results.

    It is the path below the folder or the pattern that names the log. Logs with the same path get the path
    below their common folder.

    Examples
    --------
    >>> [str(path) for path in name_places([Path("mon/lab.mcap"), Path("tue/lab.mcap")]).values()]
    ['mon/lab.mcap', 'tue/lab.mcap']
    """
    places = {log: _place(location, log) for log, location in _expand(logs)}
    same: dict[PurePath, list[LogLocation]] = {}
    for log, place in places.items():
        same.setdefault(place, []).append(log)
    for group in same.values():
        if len(group) > 1:
            places |= _below_common_folder(group)
    return places


def _place(location: LogLocation, log: LogLocation) -> PurePath:
    if isinstance(log, LogUrl):
        return log.below_pattern
    if isinstance(location, Path) and location != log:
        return log.relative_to(location)
    return PurePath(log.name)


def _below_common_folder(logs: list[LogLocation]) -> dict[LogLocation, PurePath]:
    """Return the paths of logs below their common folder; none of a log that would leave the folder."""
    parts = {log: _parts(log) for log in logs}
    levels = zip(*parts.values(), strict=False)  # of the shortest path
    common = sum(1 for _ in takewhile(lambda names: len(set(names)) == 1, levels))
    rest = {log: PurePath(*of_log[common:]) for log, of_log in parts.items()}
    return {log: path for log, path in rest.items() if not path.is_absolute() and ".." not in path.parts}


def _parts(log: LogLocation) -> tuple[str, ...]:
    if isinstance(log, LogUrl):
        return PurePosixPath(str(log).partition("://")[2]).parts
    return log.absolute().parts


def _expand(logs: Iterable[LogLocation]) -> list[tuple[LogLocation, LogLocation]]:
    """Return each log once, with the location that names it."""
    found: dict[object, tuple[LogLocation, LogLocation]] = {}
    for location in logs:
        for log in _logs_of(location):
            found.setdefault(_identity(log), (log, location))
    return list(found.values())


def _identity(log: LogLocation) -> object:
    """Return a value that is equal for all names of a log, also for hard links."""
    if isinstance(log, LogUrl):
        return log
    try:
        status = log.stat()
    except OSError:  # no such file, or a link that leads nowhere
        return log.absolute()
    return status.st_dev, status.st_ino


def logs_below(folder: Path) -> list[Path]:
    """Return all files below a folder whose name ends in ``.mcap``, sorted by path.

    A link without a file is returned, too: perhaps its disk is not mounted, and the user must know.
    """
    if not folder.is_dir():
        raise IpsysError(f"{folder}: is not a folder; name a folder with logs")
    broken_links = (path for path in folder.rglob("*.mcap") if path.is_symlink() and not path.exists())
    return sorted([*broken_links, *(path for path in folder.rglob("*.mcap") if path.is_file())])


def states_below(folder: LogLocation) -> Iterator[tuple[str, LogLocation, LogState | None]]:
    """Yield the logs below a folder, or those of a URL with a pattern: name below the folder, log and state.

    The state is None for a file that does not exist any more, and for a link without a file. The lists of an
    object store have the states, so an unchanged object needs no request of its own.
    """
    if isinstance(folder, Path):
        for path in logs_below(folder):
            yield str(path.relative_to(folder)), path, _state_of_file(path)
        return
    pattern = folder if folder.is_pattern else _all_below(folder)
    for log, state in _list_states(pattern).items():
        yield str(log.below_pattern), log, state or read_log_state(log)


def _state_of_file(path: Path) -> LogState | None:
    try:
        return read_log_state(path)
    except OSError:
        return None


def _all_below(folder: LogUrl) -> LogUrl:
    address, mark, query = folder.url.partition("?")
    return LogUrl(f"{address.rstrip('/')}/{_ALL_BELOW}{mark}{query}")


def _logs_of(location: LogLocation) -> Iterator[LogLocation]:
    if isinstance(location, LogUrl):
        if location.is_pattern or location.is_folder:
            yield from _list_objects(location if location.is_pattern else _all_below(location))
        else:
            remote_object.open_filesystem(location)  # its protocol is known, and its package installed
            yield location
        return
    if not location.is_dir():
        yield location
        return
    logs = logs_below(location)
    if not logs:
        raise IpsysError(f"{location}: has no file that ends in .mcap; name another folder")
    yield from logs


def _list_objects(pattern: LogUrl) -> list[LogUrl]:
    """Return the objects that match a pattern, by name."""
    return list(_list_entries(pattern))


def _list_states(pattern: LogUrl) -> dict[LogUrl, LogState | None]:
    """Return the objects that match a pattern, by name, with their states; None if the list has no sizes."""
    return {url: _state_of_entry(entry) for url, entry in _list_entries(pattern).items()}


def _list_entries(pattern: LogUrl) -> dict[LogUrl, Mapping[str, Any]]:
    filesystem, path = remote_object.open_filesystem(pattern)
    find = _find_flat if pattern.scheme in _FLAT else _find_by_folder
    matches = remote_object.repeat_request(pattern, lambda: find(filesystem, path))
    if not matches:
        raise UnreadError(f"{pattern}: no object matches; check the pattern and the permission to list")
    return {LogUrl(pattern.url, name): entry for name, entry in sorted(matches.items())}


def _find_by_folder(filesystem: Any, path: str) -> dict[str, Mapping[str, Any]]:
    return _object_entries(filesystem.glob(path, detail=True))


def _find_flat(filesystem: Any, path: str) -> dict[str, Mapping[str, Any]]:
    """List all objects that begin as the pattern does, page by page, and select those that match.

    A glob of fsspec would list each folder of such a store, with three requests for each of them.
    """
    from fsspec.utils import glob_translate

    folder, _, start = re.split(r"[*?\[]", path, maxsplit=1)[0].rpartition("/")
    matches = re.compile(glob_translate(path)).fullmatch
    entries = _object_entries(filesystem.find(folder, prefix=start, detail=True))
    return {name: entry for name, entry in entries.items() if matches(name)}


def _object_entries(found: Mapping[Any, Mapping[str, Any]]) -> dict[str, Mapping[str, Any]]:
    return {str(name): entry for name, entry in found.items() if entry.get("type") != "directory"}


def _state_of_entry(entry: Mapping[str, Any]) -> LogState | None:
    size = entry.get("size")
    if size is None:
        return None
    return LogState(int(size), remote_object.changed_ns_of(entry), "; ".join(remote_object.version_of(entry)))
