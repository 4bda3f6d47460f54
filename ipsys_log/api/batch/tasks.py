"""Tasks of a batch: the work on one log in a worker process, its pieces, and its result.

A task runs in a worker process, perhaps on another machine. Each task can run twice: a log has its results as
runs, and a run that exists is not computed again. The first task of a long log only reports that it is long.
"""

import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

from ipsys_log import __version__
from ipsys_log.engine.execute import one_blas_thread
from ipsys_log.engine.graph import VERSIONS
from ipsys_log.engine.pieces import Piece, PiecePlan, PieceResult, PieceRun, check_versions, compute_piece
from ipsys_log.engine.provenance import fingerprint
from ipsys_log.errors import IpsysError, os_error_text, reason_without
from ipsys_log.log.dataset import Session
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation

# The state of a log whose task had an error; the works on logs have others.
FAILED = "failed"


class VersionError(IpsysError):
    """A worker of another version of ipsys."""


class OtherSoftwareError(IpsysError):
    """A worker with other versions of libraries than the process that merges the pieces."""


class LongLogError(Exception):
    """The interruption of a work: the log is long, so its detection can be divided."""


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
    pieces : the number of pieces of a long log; None for a log that was one task.
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
    derived: str | None = None


@dataclass(frozen=True, slots=True)
class LongLog:
    """The answer of a task on a log that is long; nothing was done."""


class LongLogs:
    """Workers that compute no pieces: a work on a long log ends with :class:`LongLogError`."""

    divides, first_only = True, False

    def prepare(self, _plan: PiecePlan) -> None:
        raise LongLogError

    def compute(self, _plan: PiecePlan) -> Iterator[PieceResult]:
        raise LongLogError


Work = Callable[..., LogResult]


@dataclass(frozen=True, slots=True)
class BatchTask:
    """The work of a batch on each log, with its options by name, and the versions of the driver.

    Attributes
    ----------
    work : a function of a log, such as those of ``log_work.py``.
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

    def of_log(self, path: LogLocation) -> Self:
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
    LongLogError, OtherSoftwareError
        The work may divide the log, and it is long; or a worker of its pieces has other libraries.
    """
    _check_versions(task)
    try:
        with one_reading():
            return task.work(path, **task.options)
    except (LongLogError, OtherSoftwareError):
        raise
    except Exception as error:
        return _failure_of(path, error)


def perform_or_divide(task: BatchTask, path: LogLocation) -> LogResult | LongLog:
    """Do the work on a log as :func:`perform`, but not on a long log."""
    try:
        return perform(replace(task, options={**task.options, "workers": LongLogs()}), path)
    except LongLogError:
        return LongLog()


def compute_alone(run: PieceRun, piece: Piece, software: Mapping[str, str]) -> PieceResult:
    """Compute a piece of a log.

    Raises
    ------
    OtherSoftwareError
        This process has other versions of libraries than the process that planned the pieces.
    IpsysError
        A log has changed since the pieces were planned, or cannot be opened.
    """
    run.load()
    own = fingerprint()
    if own != software:
        names = [name for name in software if own.get(name) != software[name]]
        raise OtherSoftwareError(f"the workers have different versions: {', '.join(names)}")
    with Session(run.paths) as session, one_blas_thread():
        check_versions(session, run)
        result = compute_piece(session, run, piece)
        check_versions(session, run)
    return result


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
