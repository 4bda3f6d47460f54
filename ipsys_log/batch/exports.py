"""Export of many logs: a file for each log in one folder, with the folders of the logs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipsys_log.batch.log_work import UP_TO_DATE, name_derived
from ipsys_log.batch.tasks import LogResult
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation
from ipsys_log.log.log_files import name_places, read_log_state
from ipsys_log.log_export import EXPORT_FORMATS, ExportOptions, channel_of_table, find_format
from ipsys_log.runs.output import logs_with_results

_EXPORTED = "exported"


def plan_exports(
    logs: Iterable[LogLocation], folder: Path, table: str, run: str | None, robot: str | None, format: str
) -> dict[LogLocation, Path]:
    """Check the options of an export; return the file of each log.

    Parameters
    ----------
    logs : logs, folders and patterns, as :func:`ipsys_log.log.log_files.name_places` names them.
    folder : of the files.

    Raises
    ------
    IpsysError
        There is no such format or table, a library is missing, or two logs would have the same file.
    """
    suffix = (EXPORT_FORMATS[format].suffix or "") if format in EXPORT_FORMATS else ""
    target = folder / f"log{suffix}"
    find_format(target, format).check(target, ExportOptions(table, robot), [run])
    channel_of_table(table)
    if folder.exists() and not folder.is_dir():
        raise IpsysError(f"-o {folder}: is not a folder; name a folder for the files")
    places = name_places(logs)
    targets = {log: folder / place.with_name(f"{place.stem}{suffix}") for log, place in places.items()}
    _check_distinct(targets)
    return targets


def _check_distinct(targets: Mapping[LogLocation, Path]) -> None:
    log_of: dict[Path, LogLocation] = {}
    for log, target in targets.items():
        other = log_of.setdefault(target, log)
        if other != log:
            raise IpsysError(
                f"{other} and {log} would both be exported to {target}; rename one, or export them into two "
                "folders"
            )


def export_log(
    path: LogLocation, target: Path, overwrite: bool = False, derived: Path | None = None, **wishes: Any
) -> LogResult:
    """Export a log to a file, as :meth:`ipsys_log.opened_log.Log.export` does.

    A file that is newer than its log and its derived log is up to date. A log in a store that gives no times
    is always exported.

    Parameters
    ----------
    target : the exported file. Its folder is made.
    overwrite : export also a log with a newer file.
    derived : the folder of derived logs, which are read, too; None: the working folder.
    """
    from ipsys_log import api

    logs = logs_with_results(path, derived)
    if not overwrite and _is_newer(target, logs):
        return LogResult(str(path), UP_TO_DATE, derived=name_derived(logs))
    target.parent.mkdir(parents=True, exist_ok=True)
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
