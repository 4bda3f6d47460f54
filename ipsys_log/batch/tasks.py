"""Tasks of a batch: the work on one log in a worker process, its pieces, and its result.

A task runs in a worker process, perhaps on another machine. Each task can run twice: a log has its results as
runs, and a run that exists is not computed again. The first task of a long log gives the pieces of its
detection as further tasks. When these are done, the same task merges their results.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ipsys_log import __version__
from ipsys_log.errors import IpsysError, os_error_text, reason_without
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.runs.graph import VERSIONS
from ipsys_log.runs.piece_folder import (
    OtherSoftwareError,
    PiecesMissingError,
    PieceTask,
    store_piece,
)

# The state of a log whose task had an error; the works on logs have others.
FAILED = "failed"


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
