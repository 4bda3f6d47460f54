"""A pack in a working folder: downloaded or copied; its manifest, checksums and sizes are checked.

All files of the folder or the zip archive are listed and checked before one is read.
"""

import hashlib
import os
import re
import shutil
import stat
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, BinaryIO, cast

from ipsys_log.errors import IpsysError, is_full
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import hide_password, join_names, plain_text
from ipsys_log.tools.publish.manifest import (
    CHECKSUMS,
    LARGEST_TEXT,
    MANIFEST,
    MAX_MEMBERS,
    SCORES,
    Manifest,
    Member,
    check_member_name,
    check_unique,
    checksum_lines,
    copy_member,
    parse_manifest,
)
from ipsys_log.tools.publish.scores import StatedScores, parse_scores
from ipsys_log.units import format_bytes

_NAMED = 3  # files that an error names
# Images and chunks of logs do not compress; texts shrink by a factor of ten.
_MAX_RATIO = 100
_SMALL = 1 << 16  # a member of this size may have any ratio
# zipfile reads the table of an archive at once, with the size that the archive states.
_LARGEST_READ = 2 << 20
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1


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
    with _open_files(path) as files:
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


def _read_text(files: "_PackFiles", name: str) -> bytes:
    if files.sizes[name] > LARGEST_TEXT:
        raise IpsysError(
            f"{files.where}: {name} has {format_bytes(files.sizes[name])}, more than a pack "
            "needs, so it is refused"
        )
    with files.open(name) as file, _read_errors(f"{files.where}: {name}"):
        return file.read(LARGEST_TEXT)


def _check_list(files: "_PackFiles", manifest: Manifest) -> None:
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
    return f"{join_names(listed, _NAMED)} {'is' if len(listed) == 1 else 'are'}"


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


def _copy(files: "_PackFiles", member: Member, folder: Path) -> None:
    target = folder / member.name
    target.parent.mkdir(parents=True, exist_ok=True)
    where = f"{files.where}: {member.name}"
    with files.open(member.name) as source, target.open("xb") as copy, _read_errors(where):
        size, sha256 = copy_member(source, copy, member.size)
    if (size, sha256) != (member.size, member.sha256):
        raise IpsysError(
            f"{where} has changed: its SHA-256 is not that of the manifest; download the pack again"
        )


@dataclass(frozen=True, slots=True)
class _PackFiles:
    """The files of a pack.

    Attributes
    ----------
    where : the pack, for errors.
    sizes : stated size in bytes by name.
    open : returns a file by its name, opened to be read.
    """

    where: str
    sizes: Mapping[str, int]
    open: Callable[[str], BinaryIO]


@contextmanager
def _open_files(path: Path) -> Iterator[_PackFiles]:
    """Yield the files of a pack: a folder or a zip archive. Nothing is extracted."""
    if path.is_dir():
        yield _PackFiles(str(path), _list_folder(path), lambda name: _open_plain(path, name))
    elif not path.exists():
        raise IpsysError(f"{path}: does not exist; give the folder or the .zip of ipsys pack")
    else:
        with path.open("rb") as file, _open_archive(file, path) as files:
            yield files


@contextmanager
def _read_errors(where: str) -> Iterator[None]:
    """Convert the errors of a damaged archive to an error of one line."""
    try:
        yield
    except (
        *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error, EOFError),
        *(NotImplementedError, RuntimeError, ValueError, OverflowError, OSError),
    ) as error:
        if isinstance(error, OSError) and is_full(error):
            raise
        raise IpsysError(f"{where}: cannot be read: {error}; download the pack again") from error


def _list_folder(folder: Path) -> dict[str, int]:
    sizes: dict[str, int] = {}
    waiting, count = [("", folder)], 0
    while waiting:
        prefix, path = waiting.pop()
        with os.scandir(path) as entries:
            for entry in entries:
                count += 1
                _check_count(count, str(folder))
                name = check_member_name(prefix + entry.name, str(folder))
                if entry.is_symlink():
                    raise IpsysError(f"{folder}: {name} is a symbolic link; replace it with the file itself")
                if entry.is_dir(follow_symlinks=False):
                    waiting.append((f"{name}/", Path(entry.path)))
                elif entry.is_file(follow_symlinks=False):
                    sizes[name] = entry.stat(follow_symlinks=False).st_size
                else:
                    raise IpsysError(f"{folder}: {name} is not a regular file; remove it")
    return dict(sorted(sizes.items()))


def _open_plain(folder: Path, name: str) -> BinaryIO:
    # Without O_NOFOLLOW, a link that replaces the file after the listing would be followed.
    number = os.open(folder / name, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    return os.fdopen(number, "rb")


def _check_count(count: int, where: str) -> None:
    if count > MAX_MEMBERS:
        raise IpsysError(f"{where}: has more than {MAX_MEMBERS} files; a pack has fewer, so it is refused")


class _BoundedReads:
    """A file that refuses to read many bytes at once."""

    def __init__(self, file: IO[bytes], where: str) -> None:
        self._file, self._where = file, where
        self.seek, self.tell, self.seekable = file.seek, file.tell, file.seekable

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes."""
        data = b"" if size > _LARGEST_READ else self._file.read(_LARGEST_READ + 1 if size < 0 else size)
        if max(size, len(data)) > _LARGEST_READ:
            raise IpsysError(f"{self._where}: its table of files is too large for a pack, so it is refused")
        return data


@contextmanager
def _open_archive(file: BinaryIO, path: Path) -> Iterator[_PackFiles]:
    where = str(path)
    if not zipfile.is_zipfile(file):
        raise IpsysError(f"{where}: is not a pack; give the folder or the .zip of ipsys pack")
    with _read_errors(where):
        archive = zipfile.ZipFile(cast(IO[bytes], _BoundedReads(file, where)))
    infos = archive.infolist()
    _check_count(len(infos), where)
    # zipfile replaces backslashes in filename on Windows, and cuts the name at a null character.
    by_name = _without_top_folder(
        {check_member_name(info.orig_filename, where): info for info in infos if not info.is_dir()}, where
    )
    check_unique([info.filename for info in infos], where)
    for name, info in by_name.items():
        _check_entry(info, name, where)
    _check_ratio(sum(info.file_size for info in infos), path.stat().st_size, where)

    def open_entry(name: str) -> BinaryIO:
        with _read_errors(f"{where}: {name}"):
            return cast(BinaryIO, archive.open(by_name[name]))

    yield _PackFiles(where, {name: info.file_size for name, info in by_name.items()}, open_entry)


def _without_top_folder(by_name: dict[str, zipfile.ZipInfo], where: str) -> dict[str, zipfile.ZipInfo]:
    """Remove the name of the one folder around all files: some programs put it into an archive."""
    top = next(iter(by_name), "").partition("/")[0] + "/"
    if MANIFEST in by_name or f"{top}{MANIFEST}" not in by_name:
        return by_name
    if not all(name.startswith(top) for name in by_name):
        raise IpsysError(f"{where}: has files outside of {top}; pack the dataset again with ipsys pack")
    return {name.removeprefix(top): info for name, info in by_name.items()}


def _check_entry(info: zipfile.ZipInfo, name: str, where: str) -> None:
    mode = info.external_attr >> 16
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise IpsysError(f"{where}: {name} is a symbolic link or a device; replace it with the file itself")
    if info.flag_bits & _ENCRYPTED:
        raise IpsysError(f"{where}: {name} is encrypted; give the pack without a password")
    if info.compress_type not in _METHODS:
        raise IpsysError(f"{where}: {name} has an unusual compression; pack the dataset with ipsys pack")
    if info.file_size > _SMALL:
        _check_ratio(info.file_size, info.compress_size, f"{where}: {name}")


def _check_ratio(size: int, stored: int, where: str) -> None:
    if size > _MAX_RATIO * stored + _SMALL:
        raise IpsysError(
            f"{where}: would be {format_bytes(size)} from {format_bytes(stored)}, more than {_MAX_RATIO} "
            "times its size in the archive, so it is refused"
        )


# fsspec has file systems that read other files or combine several; these read one file from a server.
_SCHEMES = ("http", "https", "s3", "gs", "gcs", "az", "abfs", "abfss")
_ADDRESS = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):")
_PIECE = 1 << 20  # bytes


def fetch_pack(source: str, folder: Path) -> Path:
    """Return the path of a pack; the archive at an address is downloaded into ``folder``.

    Raises
    ------
    IpsysError
        The address is refused, fsspec is missing, or the download fails.
    """
    scheme = _ADDRESS.match(source)
    if Path(source).exists() or (scheme is None and "::" not in source):
        return Path(source)
    _check_address(source, scheme)
    check_installed("the address of a dataset needs", "fsspec")
    target = folder / "pack.zip"
    # The copy of the files needs space, too.
    most = shutil.disk_usage(folder).free // 2
    with target.open("xb") as file:
        for piece in _download(source):
            file.write(piece)
            if file.tell() > most:
                raise IpsysError(
                    f"{_shown(source)}: has more than {format_bytes(most)}, half of the free space; set "
                    "TMPDIR to a folder on a larger disk"
                )
    return target


def _shown(source: str) -> str:
    return plain_text(hide_password(source), longest=200)


def _check_address(source: str, scheme: re.Match[str] | None) -> None:
    if "::" in source:
        raise IpsysError(
            f"{_shown(source)}: chained addresses (::) are refused; download the .zip and name it"
        )
    if scheme is None or scheme[1].lower() not in _SCHEMES or not source[scheme.end() :].startswith("//"):
        raise IpsysError(
            f"{_shown(source)}: this address is refused; use a path, or an address that begins with one of "
            f"{', '.join(f'{name}://' for name in _SCHEMES)}"
        )
    if not source.partition("?")[0].lower().endswith(".zip"):
        raise IpsysError(
            f"{_shown(source)}: a dataset at an address must be a .zip; pack it with -o dataset.zip"
        )


def _download(source: str) -> Iterator[bytes]:
    """Yield the bytes of the file at an address."""
    import fsspec

    try:
        with fsspec.open(source, "rb", compression=None) as file:
            while piece := file.read(_PIECE):
                yield piece
    except Exception as error:  # each file system of fsspec has errors of its own
        # fsspec hides a failed connection behind a missing file, whose text is only the address.
        cause = error.__cause__ if isinstance(error, FileNotFoundError) and error.__cause__ else error
        text = plain_text(str(cause) or type(cause).__name__, longest=200)
        raise IpsysError(
            f"{_shown(source)}: the download failed: {text}; check the address and the connection"
        ) from error
