"""Files for people: wholly written or not there, and never in place of a log."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.log.lock import dangling

__all__ = ["PICTURES", "check_file", "check_folder", "check_picture", "write_files"]

# How the name of a picture may end; it is written as that.
PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")


def check_file(path: Path, option: str, logs: Iterable[Path]) -> None:
    """Check that a file can be written, before any work is done.

    Raises
    ------
    IpsysError
        It cannot be written, or it is one of the logs.
    """
    if any(log.exists() and path.exists() and path.samefile(log) for log in logs):
        raise IpsysError(f"{option} {path}: this is the log itself; name another file")
    if (text := dangling(path)) is not None:
        raise IpsysError(f"{option} {text}")
    if path.is_dir():
        raise IpsysError(f"{option} {path}: is a folder; name a file in it")
    if not path.parent.is_dir():
        raise IpsysError(f"{option} {path}: there is no folder {path.parent}; make it first")
    _check_writable(path.parent, f"{option} {path}")


def check_picture(path: Path, option: str, logs: Iterable[Path]) -> None:
    """See that a picture can be written, and of what kind, before there is work that would be lost.

    Raises
    ------
    IpsysError
        Where it cannot, or where its name does not end in one of ``PICTURES``.
    """
    check_file(path, option, logs)
    if path.suffix.lower() not in PICTURES:
        ends = f"{', '.join(PICTURES[:-1])} or {PICTURES[-1]}"
        raise IpsysError(f"{option} {path}: is no kind of picture; let its name end in {ends}")


def check_folder(folder: Path, option: str) -> None:
    """See that a folder is there, or can be made, and can be written to.

    Raises
    ------
    IpsysError
        Where it cannot.
    """
    there = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not there.is_dir():
        raise IpsysError(f"{option} {folder}: {there} is a file; name a folder")
    _check_writable(there, f"{option} {folder}")


def _check_writable(folder: Path, where: str) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise IpsysError(f"{where}: cannot write into {folder}: {error.strerror}") from error


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files of these names into a folder, all of them or none; made if it is not there."""
    folder.mkdir(parents=True, exist_ok=True)
    partials = {folder / name: folder / f"{name}.{os.getpid()}.partial" for name in files}
    try:
        for (path, partial), content in zip(partials.items(), files.values(), strict=True):
            if path.is_dir():
                raise IpsysError(f"{path}: is a folder; move it away")
            with partial.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())  # else a power cut may leave an empty file under the new name
        for path, partial in partials.items():
            partial.replace(path)
    finally:
        for partial in partials.values():
            partial.unlink(missing_ok=True)
