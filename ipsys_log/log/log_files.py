"""Log files on the disk: the files of a list of paths, where a folder stands for all logs below it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from ipsys_log.errors import IpsysError

__all__ = ["expand_folders", "logs_below"]


def expand_folders(paths: Iterable[Path]) -> list[Path]:
    """Return the logs of some paths, in their order; a folder stands for all logs below it.

    A log that is named twice, or by a link, is returned once.

    Raises
    ------
    IpsysError
        A folder has no logs.

    Examples
    --------
    >>> expand_folders([Path("b.mcap"), Path("a.mcap"), Path("./b.mcap")])
    [PosixPath('b.mcap'), PosixPath('a.mcap')]
    """
    found: dict[Path, Path] = {}
    for path in paths:
        for log in _logs_of(path):
            found.setdefault(log.resolve(), log)
    return list(found.values())


def logs_below(folder: Path) -> list[Path]:
    """Return all files below a folder whose name ends in ``.mcap``, sorted by path.

    Raises
    ------
    IpsysError
        There is no such folder.
    """
    if not folder.is_dir():
        raise IpsysError(f"{folder}: is not a folder; name a folder with logs")
    return sorted(path for path in folder.rglob("*.mcap") if path.is_file())


def _logs_of(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
        return
    logs = logs_below(path)
    if not logs:
        raise IpsysError(f"{path}: has no file that ends in .mcap; name another folder")
    yield from logs
