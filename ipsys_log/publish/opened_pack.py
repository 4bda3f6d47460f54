"""A pack that was copied to a working folder: its manifest, checksums and sizes are checked on the way."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.plain_text import plain_text
from ipsys_log.publish.manifest import Manifest, parse_manifest
from ipsys_log.publish.members import (
    CHECKSUMS,
    LARGEST_TEXT,
    MANIFEST,
    SCORES,
    Member,
    checksum_lines,
    copy_member,
)
from ipsys_log.publish.pack_files import PackFiles, open_pack_files, read_errors
from ipsys_log.publish.scores import StatedScores, parse_scores
from ipsys_log.units import format_bytes

_NAMED = 3  # files that an error names


@dataclass(frozen=True, slots=True)
class OpenedPack:
    """A checked copy of a pack: its manifest, its expected scores and its logs."""

    manifest: Manifest
    stated: StatedScores
    logs: tuple[Path, ...]


def copy_pack(path: Path, folder: Path) -> OpenedPack:
    """Copy the files of a pack into an empty folder, and check each.

    The list of files, their sizes and the manifest are checked before the first byte is copied.

    Raises
    ------
    IpsysError
        The pack is damaged, has a file too much or too few, is refused, or needs more space than there is.
    """
    with open_pack_files(path) as files:
        if MANIFEST not in files.sizes:
            raise IpsysError(f"{path}: has no {MANIFEST}; give the folder or the .zip of ipsys pack")
        data = _read_text(files, MANIFEST)
        manifest = parse_manifest(data, files.where)
        _check_list(files, manifest)
        _check_space(sum(files.sizes.values()), folder, files.where)
        for name, content in ((MANIFEST, data), (CHECKSUMS, _read_text(files, CHECKSUMS))):
            (folder / name).write_bytes(content)
        _check_checksums(folder, manifest.members, files.where)
        for member in manifest.members:
            _copy(files, member, folder)
    stated = parse_scores((folder / SCORES).read_bytes(), str(path))
    return OpenedPack(manifest, stated, tuple(folder / name for name in manifest.logs))


def _read_text(files: PackFiles, name: str) -> bytes:
    if files.sizes[name] > LARGEST_TEXT:
        raise IpsysError(
            f"{files.where}: {name} has {format_bytes(files.sizes[name])}, more than a pack "
            "needs, so it is refused"
        )
    with files.open(name) as file, read_errors(f"{files.where}: {name}"):
        return file.read(LARGEST_TEXT)


def _check_list(files: PackFiles, manifest: Manifest) -> None:
    named = {member.name: member.size for member in manifest.members}
    expected = {*named, MANIFEST, CHECKSUMS}
    if missing := sorted(expected - set(files.sizes)):
        raise IpsysError(f"{files.where}: {_listed(missing)} missing; download the pack again")
    if extra := sorted(set(files.sizes) - expected):
        raise IpsysError(
            f"{files.where}: {_listed(extra)} not in the manifest; remove the file, or pack again"
        )
    for name, size in named.items():
        if files.sizes[name] != size:
            raise IpsysError(
                f"{files.where}: {name} has {files.sizes[name]} bytes, and the manifest states {size}; "
                "download the pack again"
            )
    if named[SCORES] > LARGEST_TEXT:
        raise IpsysError(f"{files.where}: {SCORES} is larger than a pack needs, so it is refused")


def _listed(names: Iterable[str]) -> str:
    listed = [*names]
    more = f" and {len(listed) - _NAMED} more" if len(listed) > _NAMED else ""
    return f"{', '.join(listed[:_NAMED])}{more} {'is' if len(listed) == 1 else 'are'}"


def _check_space(size: int, folder: Path, where: str) -> None:
    free = shutil.disk_usage(folder).free
    if size > free:
        raise IpsysError(
            f"{where}: needs {format_bytes(size)} for a temporary copy, and {folder.parent} has "
            f"{format_bytes(free)}; set TMPDIR to a folder on a larger disk"
        )


def _check_checksums(folder: Path, members: Iterable[Member], where: str) -> None:
    """Check that the file of checksums names the files of the manifest, and the manifest as it is."""
    stated = (folder / CHECKSUMS).read_bytes().decode(errors="replace")
    manifest = (folder / MANIFEST).read_bytes()
    own = Member(MANIFEST, len(manifest), hashlib.sha256(manifest).hexdigest())
    expected = checksum_lines([*members, own])
    if stated != expected:
        lines = stated.split("\n")
        wrong = [line for line in expected.split("\n") if line not in lines] or lines
        raise IpsysError(
            f"{where}: {CHECKSUMS} and {MANIFEST} contradict each other at "
            f"{plain_text(wrong[0].split('  ')[-1], longest=80)}; "
            "download the pack again"
        )


def _copy(files: PackFiles, member: Member, folder: Path) -> None:
    target = folder / member.name
    target.parent.mkdir(parents=True, exist_ok=True)
    where = f"{files.where}: {member.name}"
    with files.open(member.name) as source, target.open("xb") as copy, read_errors(where):
        size, sha256 = copy_member(source, copy, member.size)
    if (size, sha256) != (member.size, member.sha256):
        raise IpsysError(
            f"{where} has changed: its SHA-256 is not that of the manifest; download the pack again"
        )
