"""Locations of logs: a file, or the URL of an object in a store or on a server."""

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from ipsys_log.plain_text import hide_password, plain_text

_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)(://|::)")
_LOCAL = ("file", "local")
_GLOB = re.compile(r"[*\[]")


@dataclass(frozen=True, slots=True)
class LogUrl:
    """The URL of a log. Its texts have neither the password nor the query, which may be a secret.

    Attributes
    ----------
    url : the address as the user wrote it, with credentials.
    key : the object in its file system, if `url` is a pattern that it matches; "" otherwise.

    Examples
    --------
    >>> log = LogUrl("https://ada:secret@example.org/logs/monday.mcap?token=abc")
    >>> str(log), log.name, log.stem, log.suffix
    ('https://ada:***@example.org/logs/monday.mcap', 'monday.mcap', 'monday', '.mcap')
    """

    url: str = field(repr=False)
    key: str = ""

    def __str__(self) -> str:
        text = hide_password(self.url)
        if self.key:
            scheme, _, rest = text.partition("://")
            host = rest.partition("/")[0] if self.key.startswith("/") else ""
            text = self.key if "://" in self.key else f"{scheme}://{host}{self.key}"
        return plain_text(text.partition("?")[0], longest=500)

    @property
    def name(self) -> str:
        """The last part of the path."""
        return unquote(str(self).rstrip("/").rpartition("/")[2])

    @property
    def stem(self) -> str:
        """The name without its suffix."""
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        """The suffix of the name, such as ``.mcap``."""
        return PurePosixPath(self.name).suffix

    @property
    def below_pattern(self) -> PurePosixPath:
        """The path below the folder in which the pattern begins; without a pattern, the name.

        Examples
        --------
        >>> LogUrl("s3://lab/logs/2026-*/a.mcap", "lab/logs/2026-05/a.mcap").below_pattern
        PurePosixPath('2026-05/a.mcap')
        """
        folder = _GLOB.split(self.url, maxsplit=1)[0].rpartition("/")[0]
        below = PurePosixPath(str(self).removeprefix(str(LogUrl(folder))).lstrip("/"))
        # An object store permits any names: no file may come outside of the folder of the user.
        is_inside = bool(self.key) and "://" not in str(below) and ".." not in below.parts
        return below if is_inside else PurePosixPath(self.name)

    @property
    def is_folder(self) -> bool:
        """True if the URL stands for all logs below it: it ends with ``/``."""
        return not self.key and self.url.partition("?")[0].endswith("/")

    @property
    def scheme(self) -> str:
        """The protocol, such as ``s3``."""
        match = _URL.match(self.url)
        return match[1].lower() if match else ""

    @property
    def is_pattern(self) -> bool:
        """True if the URL may match several objects."""
        path = self.url.partition("://")[2].partition("?")[0]
        return not self.key and bool(_GLOB.search(path.partition("/")[2]))


LogLocation = Path | LogUrl


@dataclass(frozen=True, slots=True)
class LogState:
    """The state of a log: a log with an equal state has the same content.

    Attributes
    ----------
    size : in bytes.
    changed_ns : time of the last change, in ns since 1970; None if the store of a URL does not tell it.
    version : of an object in a store, such as its ETag; "" for a file.
    """

    size: int
    changed_ns: int | None
    version: str = ""


def parse_location(text: str | os.PathLike[str] | LogUrl) -> LogLocation:
    """Return the location of a log: a `LogUrl` for a URL, except ``file://``, and a path otherwise.

    Examples
    --------
    >>> parse_location("file:///data/monday.mcap"), parse_location("monday.mcap")
    (PosixPath('/data/monday.mcap'), PosixPath('monday.mcap'))
    """
    if isinstance(text, LogUrl):
        return text
    match = _URL.match(text) if isinstance(text, str) else None
    if match is None:
        return Path(text)
    text = str(text)
    if match[2] == "://" and match[1].lower() in _LOCAL:
        return Path(unquote(text[match.end() :]))
    return LogUrl(text)


def is_one_of(path: Path, logs: Sequence[LogLocation]) -> bool:
    """Return whether a file is one of some logs, perhaps under another name."""
    return any(
        isinstance(log, Path) and log.exists() and path.exists() and path.samefile(log) for log in logs
    )


def file_beside(log: LogLocation, suffix: str) -> Path:
    """Return the file with the name of a log and another suffix.

    It is in the current folder if the log is at a URL, or in a folder without write permission.
    """
    if isinstance(log, Path) and os.access(log.absolute().parent, os.W_OK):
        return log.with_suffix(suffix)
    return Path(f"{log.stem}{suffix}")


def describe_broken_link(path: Path) -> str | None:
    """Return an error text for a path that is a broken link; None for any other path.

    Such a path does not exist, but no file can be created there.
    """
    if not path.is_symlink() or path.exists():
        return None
    return f"{path} is a link to {path.readlink()}, which does not exist: remove it, or choose another name"
