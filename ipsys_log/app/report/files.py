"""Output files: written completely or not at all, and never over a log; tables in cm."""

from __future__ import annotations

import csv
import io
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

from ipsys_log.app.report.findings import Findings, errors_in
from ipsys_log.errors import IpsysError
from ipsys_log.extras import check_installed
from ipsys_log.log.atomic_files import replacement_of
from ipsys_log.log.location import LogLocation, describe_broken_link, is_one_of
from ipsys_log.units import CM_PER_M

# Names of the methods in Tables I and II of the paper.
_PAPER_NAMES = {
    "rigid": "RT",
    "poly": "PR",
    "rigid+poly": "RT + PR",
    "ann": "ANN",
    "rigid+ann": "RT + ANN",
    "kriging": "KI",
    "rigid+kriging": "RT + KI",
    "kriging-regression": "KR",
    "rigid+kriging-regression": "RT + KR",
}
_FIGURES = {"mean": "mean_m", "min": "min_m", "max": "max_m", "std": "std_m"}


def paper_csv(findings: Findings, in_space: bool) -> bytes:
    """Return Table I of the paper (errors in space) or Table II (errors on the floor), one row per model.

    The columns are those of the paper: the means of the cameras, then their minima, maxima and standard
    deviations. The errors are on held-out points, against the tape. Unknown values are empty.
    """
    header = ["method", "paper"] + [f"{figure}_cm_{c}" for figure in _FIGURES for c in findings.cameras]
    rows = []
    for accuracy in findings.accuracies:
        by_camera = {row.camera: row for row in accuracy.rows(False) if row.against == "tape"}
        errors = [errors_in(by_camera.get(camera), in_space) for camera in findings.cameras]
        cells = [_cm(getattr(e, name) if e else None) for name in _FIGURES.values() for e in errors]
        rows.append([accuracy.model, _PAPER_NAMES.get(accuracy.model, ""), *cells])
    return _csv(header, rows)


_STATISTICS = {
    "mean": "mean_m",
    "mean_low": "mean_low_m",
    "mean_high": "mean_high_m",
    "min": "min_m",
    "median": "median_m",
    "p95": "p95_m",
    "max": "max_m",
    "std": "std_m",
}


def cross_validation_csv(findings: Findings) -> bytes:
    """Return a table with one row per model, camera (``all``: all together) and reference (tape or truth)."""
    header = ["method", "camera", "against", "places"]
    header += [f"{name}_{space}_cm" for space in ("3d", "2d") for name in (*_STATISTICS, "rmse")]
    header += [f"bias_{axis}_cm" for axis in "xyz"] + ["within_68", "within_95"]
    rows = []
    for accuracy in findings.accuracies:
        for row in accuracy.rows(True):
            cells = [accuracy.model, row.camera or "all", row.against, str(row.error_2d.count)]
            for errors in (row.error_3d, row.error_2d):
                cells += [_cm(getattr(errors, name) if errors else None) for name in _STATISTICS.values()]
                cells.append(_cm(accuracy.errors_of(row).rmse_m(errors)))
            cells += map(_cm, [None] * 3 if row.bias_m is None else row.bias_m.tolist())
            cells += ["" if v is None else f"{v:.4f}" for v in (row.within_68, row.within_95)]
            rows.append(cells)
    return _csv(header, rows)


def _cm(value_m: float | None) -> str:
    return "" if value_m is None else f"{value_m * CM_PER_M:.3f}"


def _csv(header: Sequence[str], rows: Iterable[Sequence[str]]) -> bytes:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([header, *rows])
    return text.getvalue().encode()


# Valid suffixes of a figure file; the suffix gives the file format.
FIGURE_SUFFIXES = (".png", ".pdf", ".svg", ".jpg", ".jpeg", ".webp")


def check_file(path: Path, option: str, logs: Sequence[LogLocation]) -> None:
    """Check that a file can be written, before any work is done.

    Raises
    ------
    IpsysError
        The file cannot be written, or it is one of the logs.
    """
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
    """Check that the name of a table ends in ``.parquet``: its readers choose the format by the name.

    Raises
    ------
    IpsysError
        The name has another end.
    """
    if path.suffix != ".parquet":
        name = path.with_suffix(".parquet") if path.name else "FILE.parquet"
        raise IpsysError(f"{option} {path}: the name must end in .parquet; use {name}")


def check_figure_file(path: Path, option: str, logs: Sequence[LogLocation]) -> None:
    """Check that a figure can be written and has a valid format, before any work is done.

    Raises
    ------
    IpsysError
        Matplotlib is not installed, the file cannot be written, or its name does not end in one of
        ``FIGURE_SUFFIXES``.
    """
    check_installed(f"{option} needs", "matplotlib")
    check_file(path, option, logs)
    if path.suffix.lower() not in FIGURE_SUFFIXES:
        ends = f"{', '.join(FIGURE_SUFFIXES[:-1])} or {FIGURE_SUFFIXES[-1]}"
        raise IpsysError(f"{option} {path}: is not a figure file; use a name that ends in {ends}")


def check_folder(folder: Path, option: str) -> None:
    """Check that a folder exists or can be created, and can be written to.

    Raises
    ------
    IpsysError
        The folder cannot be created or written to.
    """
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
