"""Tasks of a batch: the functions of the single commands on one log, each with a small result.

A task runs in a worker process, perhaps on another machine. Each task can run twice: a log has its results as
runs, and a run that exists is not computed again. The first task of a long log gives the pieces of its
detection as further tasks. When these are done, the same task merges their results.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ipsys_log import __version__
from ipsys_log.errors import IpsysError, WriteError, os_error_text, reason_without
from ipsys_log.log.dataset import Session
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.runs.graph import VERSIONS
from ipsys_log.runs.output import check_source, choose_target, derived_log_of, logs_with_results
from ipsys_log.runs.piece_folder import (
    OtherSoftwareError,
    PieceFolder,
    PiecesMissingError,
    PieceTask,
    StoredPieces,
    store_piece,
)
from ipsys_log.runs.superseded import outdated_runs
from ipsys_log.soundness.finding import BROKEN, SOUND, UNREAD, LogCheck

__all__ = [
    "FAILED",
    "UP_TO_DATE",
    "BatchTask",
    "LogPieces",
    "LogResult",
    "PieceState",
    "VersionError",
    "Work",
    "check_log",
    "name_derived",
    "perform",
    "perform_or_divide",
    "perform_piece",
    "replay_log",
    "verify_log",
]

# States of a log after its task; the check of a log has its own ones.
COMPUTED, UP_TO_DATE, NOT_OUTDATED = "computed", "up to date", "not outdated"
IDENTICAL, DIFFERENT, FAILED = "identical", "different", "failed"
# Remarks of a log in its result; the rest is counted.
_MOST_REMARKS = 3


class VersionError(IpsysError):
    """A worker of another version of ipsys."""


@dataclass(frozen=True, slots=True)
class LogResult:
    """The result of a task on a log: a small row, whatever the size of the log.

    Attributes
    ----------
    log : the path of the log, as the user gave it.
    state : ``computed``, ``up to date``, ``not outdated``, ``identical``, ``different``, ``sound``,
        ``readable``, ``unread``, ``broken``, ``exported`` or ``failed``.
    good : False if the user must look at the log.
    text : the reason of a failure, or remarks; one line.
    runs : the runs that were computed, compared or exported.
    messages : the number of messages that were written, compared or exported.
    trace : the traceback of a fault of the program; "" otherwise.
    pieces : the number of merged pieces of a long log; None for a log that was one task.
    lost_attempts : the number of their further results, which were deleted; None for a log that was one task.
    derived : the derived log with results of the log, which was read or extended; None without one.
    """

    log: str
    state: str
    good: bool = True
    text: str = ""
    runs: tuple[str, ...] = ()
    messages: int = 0
    trace: str = ""
    pieces: int | None = None
    lost_attempts: int | None = None
    derived: str | None = None


@dataclass(frozen=True, slots=True)
class LogPieces:
    """The pieces that must be computed before the task of a long log is repeated."""

    tasks: tuple[PieceTask, ...]


@dataclass(frozen=True, slots=True)
class PieceState:
    """The state of a piece after its task.

    Attributes
    ----------
    failure : the result of its log, if the piece failed; None if the piece is stored.
    other_software : True if the worker has other libraries: the log must not be divided.
    """

    failure: LogResult | None = None
    other_software: bool = False


Work = Callable[..., LogResult]


@dataclass(frozen=True, slots=True)
class BatchTask:
    """The work of a batch on each log, with its options by name, and the versions of the driver.

    Attributes
    ----------
    work : one of the functions of this module.
    version, stage_versions : of the program that gives the work to the workers.
    divides : True if the work may divide a long log into pieces.
    targets : by log, the option ``target`` of its work; the driver gives a worker only that of its log.
    """

    work: Work
    options: Mapping[str, Any] = field(default_factory=dict)
    divides: bool = False
    targets: Mapping[LogLocation, Path] = field(default_factory=dict)
    version: str = __version__
    stage_versions: Mapping[str, int] = field(default_factory=lambda: dict(VERSIONS))

    def of_log(self, path: LogLocation) -> BatchTask:
        """Return the task of one log."""
        if path not in self.targets:
            return self
        return replace(self, options={**self.options, "target": self.targets[path]}, targets={})


def perform(task: BatchTask, path: LogLocation) -> LogResult:
    """Do the work on a log; every fault becomes a result, so that the other logs are not affected.

    Raises
    ------
    VersionError
        The worker has another version than the batch: it would compute other results.
    PiecesMissingError
        The work may divide the log, and pieces are missing.
    """
    _check_versions(task)
    try:
        with one_reading():
            return task.work(path, **task.options)
    except PiecesMissingError:
        raise
    except Exception as error:
        return _failure_of(path, error)


def perform_or_divide(task: BatchTask, path: LogLocation) -> LogResult | LogPieces:
    """Do the work on a log as :func:`perform`; of a long log, return the pieces that are not stored yet.

    Raises
    ------
    VersionError
        The worker has another version than the batch.
    """
    try:
        return perform(replace(task, options={**task.options, "divide": True}), path)
    except PiecesMissingError as missing:
        return LogPieces(tuple(missing.tasks))


def perform_piece(task: BatchTask, path: LogLocation, piece: PieceTask) -> PieceState:
    """Compute a piece of a log, and store its result.

    Raises
    ------
    VersionError
        The worker has another version than the batch.
    """
    _check_versions(task)
    try:
        store_piece(piece)
    except OtherSoftwareError:
        return PieceState(other_software=True)
    except Exception as error:
        return PieceState(_failure_of(path, error))
    return PieceState()


def _failure_of(path: LogLocation, error: Exception) -> LogResult:
    """Return the result of a log whose task had an error."""
    if isinstance(error, IpsysError):
        return _failure(path, reason_without(path, error))
    if isinstance(error, OSError):
        return _failure(path, os_error_text(error).removeprefix(f"{path}: "))
    if isinstance(error, MemoryError):
        return _failure(
            path, "the memory of the worker is full; use fewer workers, or a larger --memory-limit"
        )
    text = f"fault of ipsys: {type(error).__name__}: {error}"
    trace = "".join(traceback.format_exception(error))
    return _failure(path, text, trace)


def _failure(path: LogLocation, text: str, trace: str = "") -> LogResult:
    """Return the result of a log that failed; its reason is one line."""
    return LogResult(str(path), FAILED, False, text.partition("\n")[0], trace=trace)


def _check_versions(task: BatchTask) -> None:
    if task.version != __version__:
        raise VersionError(
            f"a worker has ipsys {__version__}, but the batch is of ipsys {task.version}; install one "
            "version everywhere"
        )
    if task.stage_versions != VERSIONS:
        raise VersionError(
            f"a worker has the stages {_differences(VERSIONS, task.stage_versions)}, but the batch has "
            f"{_differences(task.stage_versions, VERSIONS)}; install one version of ipsys everywhere"
        )


def _differences(ours: Mapping[str, int], theirs: Mapping[str, int]) -> str:
    named = [f"{name} {version}" for name, version in ours.items() if theirs.get(name) != version]
    return ", ".join(named) or "no others"


def replay_log(
    path: LogLocation,
    outdated: bool = False,
    folder: Path | None = None,
    divide: bool = False,
    **options: Any,
) -> LogResult:
    """Compute the results that a log lacks in this process, as :func:`ipsys_log.api.replay` does.

    Parameters
    ----------
    outdated : leave a log without outdated runs unchanged.
    folder : for the results of a log that cannot be appended to; None: the working folder.
    divide : do not detect markers in a long log here, but merge the stored results of its pieces.
    options : those of the replay.

    Raises
    ------
    PiecesMissingError
        Some pieces are not stored yet; nothing is written.
    """
    from ipsys_log import api

    logs, output = choose_target([path], None, folder)
    if outdated and not _has_outdated_run(logs):
        return LogResult(str(path), NOT_OUTDATED)
    target = output or logs[-1]
    assert isinstance(target, Path)  # the results are in a file, also those of a log at a URL
    target.parent.mkdir(parents=True, exist_ok=True)
    stored = StoredPieces(PieceFolder.beside(target))
    remarks: list[str] = []
    workers = stored if divide else None
    try:
        outcomes = api.replay(
            *logs, output=output, say=remarks.append, jobs=1, workers=workers, **options
        ).outcomes
    except WriteError:
        raise
    except IpsysError:
        if output is None and stored.is_complete:  # the log has their run already
            stored.folder.clear(stored.keys)
        raise
    lost = stored.folder.clear(stored.keys)
    new = [outcome for outcome in outcomes if outcome.fresh]
    remarks += [f"{outcome.run}: {remark}" for outcome in new for remark in outcome.remarks]
    return LogResult(
        str(path),
        COMPUTED if new else UP_TO_DATE,
        text=_remarks_text(remarks),
        runs=tuple(dict.fromkeys(outcome.run for outcome in new)),
        messages=sum(outcome.messages for outcome in new),
        pieces=stored.merged or None,
        lost_attempts=lost if stored.merged else None,
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
    """Repeat the runs of a log, and compare each channel, as :func:`ipsys_log.api.verify` does.

    Parameters
    ----------
    run : only this run.
    folder : of derived logs, whose runs are repeated, too; None: the working folder.
    """
    from ipsys_log import api

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
    """Read a log completely and check it, as :func:`ipsys_log.api.check` does.

    Parameters
    ----------
    folder : of derived logs; the state is the worst of the log and its derived log. None: the working folder.
    """
    from ipsys_log import api

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
