"""Members of a pack: their names, checksums and limits."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.plain_text import plain_text

MANIFEST, CHECKSUMS = "croissant.json", "SHA256SUMS"
README, RIG_FILE, SCORES, LOGS = "README.md", "lab.toml", "scores.json", "logs"

# A session has a few logs; the limits stop a hostile pack before any work.
MAX_MEMBERS = 1000
LARGEST_TEXT = 1 << 20  # bytes of the manifest, of the checksums and of the scores
_LONGEST_NAME = 200
_PIECE = 1 << 20  # bytes that are copied at once

_PART = r"[A-Za-z0-9_][A-Za-z0-9._-]*"
_NAME = re.compile(rf"{_PART}(/{_PART})*")


class Member(NamedTuple):
    """A file of a pack: its name relative to the pack, its size in bytes, and its SHA-256 in hexadecimal."""

    name: str
    size: int
    sha256: str


def check_member_name(name: str, where: str) -> str:
    """Return the name of a member if it stays inside the folder of the pack.

    Allowed are parts of letters, digits, ``_``, ``-`` and ``.``, separated by ``/``. No part begins with a
    dot. So a name is never absolute, and has no ``..``, backslash, drive or control character.

    Raises
    ------
    IpsysError
        The name has another form.

    Examples
    --------
    >>> check_member_name("logs/monday.mcap", "pack")
    'logs/monday.mcap'
    """
    if len(name) > _LONGEST_NAME or not _NAME.fullmatch(name):
        raise IpsysError(
            f"{where}: the name '{plain_text(name, longest=80)}' is refused: names of files in a pack are "
            "relative, of letters, digits, _, - and .; pack the dataset again with ipsys pack"
        )
    return name


def check_unique(names: Iterable[str], where: str) -> None:
    """Check that no two names are equal, in upper or lower case: some file systems do not distinguish them.

    Raises
    ------
    IpsysError
        Two names are equal, or a name is also the folder of another.
    """
    known: set[str] = set()
    folders: set[str] = set()
    for name in names:
        folded = name.casefold()
        parts = folded.split("/")[:-1]
        own_folders = {"/".join(parts[: count + 1]) for count in range(len(parts))}
        if folded in known | folders or own_folders & known:
            raise IpsysError(f"{where}: has {name} twice; pack the dataset again with ipsys pack")
        known.add(folded)
        folders |= own_folders


def free_member_name(stem: str, names: Iterable[str]) -> str:
    """Return the name of a log in a pack, made from the stem of its file name and different from ``names``.

    Examples
    --------
    >>> free_member_name("../Tag 1", []), free_member_name("a", ["logs/a.mcap"])
    ('logs/Tag_1.mcap', 'logs/a_2.mcap')
    """
    clean = re.sub(r"[^A-Za-z0-9_-]+", "_", stem)[:80].strip("_-") or "log"
    known = {name.casefold() for name in names}
    name, number = f"{LOGS}/{clean}.mcap", 2
    while name.casefold() in known:
        name, number = f"{LOGS}/{clean}_{number}.mcap", number + 1
    return name


def copy_member(source: BinaryIO, target: BinaryIO | None, size: int) -> tuple[int, str]:
    """Copy at most ``size`` + 1 bytes; return the number of copied bytes and their SHA-256.

    ``target`` is None to compute the checksum only. A source with more bytes than stated is not read to its
    end.
    """
    digest, copied = hashlib.sha256(), 0
    while copied <= size and (piece := source.read(min(_PIECE, size + 1 - copied))):
        digest.update(piece)
        copied += len(piece)
        if target is not None:
            target.write(piece)
    return copied, digest.hexdigest()


def describe_member(folder: Path, name: str) -> Member:
    """Return a file of a folder as a member, with its checksum."""
    path = folder / name
    with path.open("rb") as file:
        size, sha256 = copy_member(file, None, path.stat().st_size)
    return Member(name, size, sha256)


def checksum_lines(members: Iterable[Member]) -> str:
    """Return the text of ``SHA256SUMS``, which ``sha256sum --check`` reads."""
    return "".join(f"{member.sha256}  {member.name}\n" for member in members)
