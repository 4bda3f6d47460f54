"""Export of many logs: a file of the log's name in one folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ipsys_log.batch.tasks import UP_TO_DATE, LogResult, name_derived
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation
from ipsys_log.log.log_files import read_log_state
from ipsys_log.log_export import EXPORT_FORMATS, ExportOptions, channel_of_table, find_format
from ipsys_log.runs.output import logs_with_results

__all__ = ["check_exports", "export_log"]

_EXPORTED = "exported"


def check_exports(
    logs: Sequence[LogLocation], folder: Path, table: str, run: str | None, robot: str | None, format: str
) -> str:
    """Check the options of an export, and the names of its files; return the suffix of the files.

    Raises
    ------
    IpsysError
        There is no such format or table, a library is missing, or two logs have the same name.
    """
    suffix = (EXPORT_FORMATS[format].suffix or "") if format in EXPORT_FORMATS else ""
    target = folder / f"log{suffix}"
    find_format(target, format).check(target, ExportOptions(table, robot), [run])
    channel_of_table(table)
    by_name: dict[str, LogLocation] = {}
    for log in logs:
        other = by_name.setdefault(log.stem, log)
        if other != log:
            raise IpsysError(
                f"{other} and {log} have the same name, so their files in {folder} would be the same; rename "
                "one, or export them into two folders"
            )
    if folder.exists() and not folder.is_dir():
        raise IpsysError(f"-o {folder}: is not a folder; name a folder for the files")
    return suffix


def export_log(
    path: LogLocation,
    folder: Path,
    suffix: str,
    overwrite: bool = False,
    derived: Path | None = None,
    **wishes: Any,
) -> LogResult:
    """Export a log to a file of its name, as :meth:`ipsys_log.opened_log.Log.export` does.

    A file that is newer than its log and its derived log is up to date. A log in a store that gives no times
    is always exported.

    Parameters
    ----------
    folder, suffix : of the exported file.
    overwrite : export also a log with a newer file.
    derived : the folder of derived logs, which are read, too; None: the working folder.
    """
    from ipsys_log import api

    target = folder / f"{path.stem}{suffix}"
    logs = logs_with_results(path, derived)
    if not overwrite and _is_newer(target, logs):
        return LogResult(str(path), UP_TO_DATE, derived=name_derived(logs))
    folder.mkdir(parents=True, exist_ok=True)
    with api.open(*logs) as log:
        exported = log.export(target, **wishes)
    return LogResult(
        str(path), _EXPORTED, runs=exported.runs, messages=exported.rows, derived=name_derived(logs)
    )


def _is_newer(target: Path, logs: Sequence[LogLocation]) -> bool:
    """Return whether a file exists and is newer than all logs."""
    if not target.exists():
        return False
    written_ns = target.stat().st_mtime_ns
    changes_ns = (read_log_state(log).changed_ns for log in logs)
    return all(changed_ns is not None and written_ns >= changed_ns for changed_ns in changes_ns)
