"""Files of this machine as parameters of commands: a URL in their place is refused in one line."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

# A path has lost one of the two slashes of a URL.
_URL_AS_PATH = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:/")

Paths = list[Path] | Path | None


def is_url(path: Path) -> bool:
    """Return whether a path is a URL, and no file of such a name."""
    return _URL_AS_PATH.match(str(path)) is not None and not path.exists()


def read_files(given: Paths) -> Paths:
    """Return the file, or the files, of an argument of a command that reads only files.

    Raises
    ------
    IpsysError
        A URL is among them.
    """
    _refuse(given, "is at a URL, but this command reads files; download them first")
    return given


def appended_logs(given: Paths) -> Paths:
    """Return the log, or the logs, that a command extends or repairs.

    Raises
    ------
    IpsysError
        A URL is among them.
    """
    _refuse(given, "is at a URL, but this command writes into the log; download the log first")
    return given


def needs_local_files(command: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap a command: it refuses a URL as the value of each parameter that is a path."""

    @functools.wraps(command)
    def run(*arguments: Any, **options: Any) -> Any:
        for name, value in options.items():
            option = "-o " if name == "output" else ""
            _refuse(value, "is a URL; name a file or a folder on this machine", option)
        return command(*arguments, **options)

    return run


def _refuse(given: object, why: str, option: str = "") -> None:
    for path in given if isinstance(given, list) else [given]:
        if isinstance(path, Path) and is_url(path):
            from ipsys_log.errors import IpsysError
            from ipsys_log.log.location import LogUrl

            url = LogUrl(str(path).replace(":/", "://", 1))
            raise IpsysError(f"{option}{url}: {why}")
