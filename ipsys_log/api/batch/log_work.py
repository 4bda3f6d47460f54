"""The works of a batch on one log: replay, verify, check and export, each with a small result.

Each work can run twice: a log has its results as runs, and a run that exists is not computed again.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ipsys_log.api.batch.tasks import LogResult
from ipsys_log.api.log_export import EXPORT_FORMATS, ExportOptions, channel_of_table, find_format
from ipsys_log.engine.output import check_source, choose_target, derived_log_of, logs_with_results
from ipsys_log.engine.pieces import PieceWorkers
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.log.log_files import name_places, read_log_state
from ipsys_log.tools.cut import outdated_runs
from ipsys_log.tools.soundness.finding import BROKEN, SOUND, UNREAD, LogCheck

# States of a log after its work; the check of a log has its own ones.
COMPUTED, UP_TO_DATE, NOT_OUTDATED = "computed", "up to date", "not outdated"
IDENTICAL, DIFFERENT = "identical", "different"
# Remarks of a log in its result; the rest is counted.
_MOST_REMARKS = 3
_EXPORTED = "exported"


def replay_log(
    path: LogLocation,
    outdated: bool = False,
    folder: Path | None = None,
    workers: PieceWorkers | None = None,
    **options: Any,
) -> LogResult:
    """Compute the results that a log lacks in this process, as :func:`ipsys_log.api.python_api.replay` does.

    Parameters
    ----------
    outdated : leave a log without outdated runs unchanged.
    folder : for the results of a log that cannot be appended to; None: the working folder.
    workers : they compute the pieces of a long log.
    options : those of the replay.
    """
    from ipsys_log.api import python_api as api

    logs, output = choose_target([path], None, folder)
    if outdated and not _has_outdated_run(logs):
        return LogResult(str(path), NOT_OUTDATED)
    target = output or logs[-1]
    assert isinstance(target, Path)  # the results are in a file, also those of a log at a URL
    target.parent.mkdir(parents=True, exist_ok=True)
    remarks: list[str] = []
    outcomes = api.replay(
        *logs, output=output, say=remarks.append, jobs=1, workers=workers, **options
    ).outcomes
    new = [outcome for outcome in outcomes if outcome.fresh]
    remarks += [f"{outcome.run}: {remark}" for outcome in new for remark in outcome.remarks]
    return LogResult(
        str(path),
        COMPUTED if new else UP_TO_DATE,
        text=_remarks_text(remarks),
        runs=tuple(dict.fromkeys(outcome.run for outcome in new)),
        messages=sum(outcome.messages for outcome in new),
        derived=None if target == path else str(target),
    )


def _has_outdated_run(logs: Sequence[LogLocation]) -> bool:
    with Session(logs) as session:
        return bool(outdated_runs(session))


def _remarks_text(remarks: Sequence[str]) -> str:
    lines = [" ".join(remark.split()) for remark in dict.fromkeys(remarks)]
    more = [f"and {len(lines) - _MOST_REMARKS} more remarks"] if len(lines) > _MOST_REMARKS else []
    return "; ".join(lines[:_MOST_REMARKS] + more)


def verify_log(path: LogLocation, run: str | None = None, folder: Path | None = None) -> LogResult:
    """Repeat the runs of a log, and compare each channel, as :func:`ipsys_log.api.python_api.verify` does.

    Parameters
    ----------
    run : only this run.
    folder : of derived logs, whose runs are repeated, too; None: the working folder.
    """
    from ipsys_log.api import python_api as api

    remarks: list[str] = []
    logs = logs_with_results(path, folder)
    comparisons = api.verify(*logs, run=run, say=remarks.append)
    other = [comparison.topic for comparison in comparisons if not comparison.equal]
    text = f"{len(other)} of {len(comparisons)} channels differ, such as {other[0]}" if other else ""
    return LogResult(
        str(path),
        DIFFERENT if other else IDENTICAL,
        not other,
        text or _remarks_text(remarks),
        messages=sum(comparison.left for comparison in comparisons),
        derived=name_derived(logs),
    )


def check_log(path: LogLocation, folder: Path | None = None) -> LogResult:
    """Read a log completely and check it, as :func:`ipsys_log.api.python_api.check` does.

    Parameters
    ----------
    folder : of derived logs; the state is the worst of the log and its derived log. None: the working folder.
    """
    from ipsys_log.api import python_api as api

    derived = derived_log_of(path, folder)
    if derived is not None and not derived.exists():
        derived = None
    logs = [path] if derived is None else [path, derived]
    checks = api.check(*logs)
    state = LogCheck.worst(checks)
    if state not in (BROKEN, UNREAD) and derived is not None:
        check_source([path], derived)
    return LogResult(str(path), state, state == SOUND, _worst_text(checks), derived=name_derived(logs))


def _worst_text(checks: Sequence[LogCheck]) -> str:
    """Return the worst remark on a log and its derived log, and the number of the others."""
    remarks = [
        (finding, "" if number == 0 else f"{check.path.name}: ")
        for number, check in enumerate(checks)
        for finding in check.remarks
    ]
    if not remarks:
        return ""
    faults = [remark for level in (BROKEN, UNREAD) for remark in remarks if remark[0].level == level]
    finding, log = (faults or remarks)[0]
    place = f"{finding.topic}: " if finding.topic else ""
    more = f" (and {len(remarks) - 1} more)" if len(remarks) > 1 else ""
    return f"{log}{place}{finding.text}{more}"


def name_derived(logs: Sequence[LogLocation]) -> str | None:
    """Return the name of the derived log in the result of a log; None without one."""
    return str(logs[-1]) if len(logs) > 1 else None


def plan_exports(
    logs: Iterable[LogLocation], folder: Path, table: str, run: str | None, robot: str | None, format: str
) -> dict[LogLocation, Path]:
    """Check the options of an export; return the file of each log.

    Parameters
    ----------
    logs : logs, folders and patterns, as :func:`ipsys_log.log.log_files.name_places` names them.
    folder : of the files.
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


def export_log(
    path: LogLocation, target: Path, overwrite: bool = False, derived: Path | None = None, **wishes: Any
) -> LogResult:
    """Export a log to a file, as :meth:`ipsys_log.api.opened_log.Log.export` does.

    A file that is newer than its log and its derived log is up to date. A log in a store that gives no times
    is always exported.

    Parameters
    ----------
    target : the exported file. Its folder is made.
    overwrite : export also a log with a newer file.
    derived : the folder of derived logs, which are read, too; None: the working folder.
    """
    from ipsys_log.api import python_api as api

    logs = logs_with_results(path, derived)
    if not overwrite and _is_newer(target, logs):
        return LogResult(str(path), UP_TO_DATE, derived=name_derived(logs))
    target.parent.mkdir(parents=True, exist_ok=True)
    with api.open(*logs) as log:
        exported = log.export(target, **wishes)
    return LogResult(
        str(path), _EXPORTED, runs=exported.runs, messages=exported.rows, derived=name_derived(logs)
    )


def _check_distinct(targets: Mapping[LogLocation, Path]) -> None:
    log_of: dict[Path, LogLocation] = {}
    for log, target in targets.items():
        other = log_of.setdefault(target, log)
        if other != log:
            raise IpsysError(
                f"{other} and {log} would both be exported to {target}; rename one, or export them into two "
                "folders"
            )


def _is_newer(target: Path, logs: Sequence[LogLocation]) -> bool:
    """Return whether a file exists and is newer than all logs."""
    if not target.exists():
        return False
    written_ns = target.stat().st_mtime_ns
    changes_ns = (read_log_state(log).changed_ns for log in logs)
    return all(changed_ns is not None and written_ns >= changed_ns for changed_ns in changes_ns)
