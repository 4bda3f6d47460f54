"""Output files: written completely or not at all, and never over a log."""

import tempfile
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.location import LogLocation, is_one_of

# Valid suffixes of a figure file; the suffix gives the file format.
FIGURE_SUFFIXES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")


def check_file(path: Path, option: str, logs: Sequence[LogLocation]) -> None:
    """Check that a file can be written and is none of the logs, before any work is done."""
    from ipsys_log.log.location import describe_broken_link

    if is_one_of(path, logs):
        raise IpsysError(f"{option} {path}: this is the log itself; name another file")
    if (text := describe_broken_link(path)) is not None:
        raise IpsysError(f"{option} {text}")
    if path.is_dir():
        raise IpsysError(f"{option} {path}: is a folder; name a file in it")
    if not path.parent.is_dir():
        raise IpsysError(f"{option} {path}: there is no folder {path.parent}; make it first")
    _check_writable(path.parent, f"{option} {path}")


def check_parquet_name(path: Path, option: str) -> None:
    """Check that the name of a table ends in ``.parquet``: its readers choose the format by the name."""
    if path.suffix != ".parquet":
        name = path.with_suffix(".parquet") if path.name else "FILE.parquet"
        raise IpsysError(f"{option} {path}: the name must end in .parquet; use {name}")


def check_figure_file(path: Path, option: str) -> None:
    """Check that a figure can be drawn and written, by a name with a suffix of ``FIGURE_SUFFIXES``."""
    check_installed(f"{option} needs", "matplotlib")
    check_file(path, option, [])
    if path.suffix.lower() not in FIGURE_SUFFIXES:
        ends = f"{', '.join(FIGURE_SUFFIXES[:-1])} or {FIGURE_SUFFIXES[-1]}"
        raise IpsysError(f"{option} {path}: is not a figure file; use a name that ends in {ends}")


def figure_folder(path: Path) -> tuple[Path, str] | None:
    """Return the folder of a path for all figures, and their suffix; None if the path is that of one figure.

    Examples
    --------
    >>> figure_folder(Path("figures")), figure_folder(Path("figures/*.svg")), figure_folder(Path("a.png"))
    ((PosixPath('figures'), '.png'), (PosixPath('figures'), '.svg'), None)
    """
    if path.stem == "*" and path.suffix.lower() in FIGURE_SUFFIXES:
        return path.parent, path.suffix.lower()
    return (path, ".png") if path.is_dir() or not path.suffix else None


def check_figures(path: Path, option: str) -> None:
    """Check a path for one figure or for a folder of all figures, as :func:`check_figure_file` does."""
    if (folder := figure_folder(path)) is None:
        check_figure_file(path, option)
    else:
        check_installed(f"{option} needs", "matplotlib")
        check_folder(folder[0], option)


def check_folder(folder: Path, option: str) -> None:
    """Check that a folder exists or can be created, and can be written to."""
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    if not existing.is_dir():
        raise IpsysError(f"{option} {folder}: {existing} is a file; name a folder")
    _check_writable(existing, f"{option} {folder}")


def _check_writable(folder: Path, where: str) -> None:
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise IpsysError(f"{where}: cannot write into {folder}: {error.strerror}") from error


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, all of them or none; create the folder if it does not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    with ExitStack() as replaced:
        for name, content in files.items():
            if (folder / name).is_dir():
                raise IpsysError(f"{folder / name}: is a folder; move it away")
            file = replaced.enter_context(replacement_of(folder / name))
            file.write(content)
            file.flush()  # a full disk is found before the first file is replaced
