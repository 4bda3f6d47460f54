"""A pack at an address: its zip archive is downloaded with fsspec, which is an optional library."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.plain_text import hide_password, plain_text
from ipsys_log.units import format_bytes

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
