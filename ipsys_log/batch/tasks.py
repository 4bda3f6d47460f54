"""Tasks of a batch: the functions of the single commands on one log, each with a small result.

A task runs in a worker process, perhaps on another machine. Each task can run twice: a log has its results as
runs, and a run that exists is not computed again.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ipsys_log import __version__
from ipsys_log.errors import IpsysError, os_error_text, reason_without
from ipsys_log.log.dataset import Session
from ipsys_log.runs.graph import VERSIONS
from ipsys_log.runs.superseded import outdated_runs
from ipsys_log.soundness.finding import BROKEN, SOUND

__all__ = [
    "FAILED",
    "UP_TO_DATE",
    "BatchTask",
    "LogResult",
    "VersionError",
    "Work",
    "check_log",
    "perform",
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
        ``readable``, ``broken``, ``exported`` or ``failed``.
    good : False if the user must look at the log.
    text : the reason of a failure, or remarks; one line.
    runs : the runs that were computed, compared or exported.
    messages : the number of messages that were written, compared or exported.
    trace : the traceback of a fault of the program; "" otherwise.
    """

    log: str
    state: str
    good: bool = True
    text: str = ""
    runs: tuple[str, ...] = ()
    messages: int = 0
    trace: str = ""


Work = Callable[..., LogResult]


@dataclass(frozen=True, slots=True)
class BatchTask:
    """The work of a batch on each log, with its options by name, and the versions of the driver.

    Attributes
    ----------
    work : one of the functions of this module.
    version, stage_versions : of the program that gives the work to the workers.
    """

    work: Work
    options: Mapping[str, Any] = field(default_factory=dict)
    version: str = __version__
    stage_versions: Mapping[str, int] = field(default_factory=lambda: dict(VERSIONS))


def perform(task: BatchTask, path: Path) -> LogResult:
    """Do the work on a log; every fault becomes a result, so that the other logs are not affected.

    Raises
    ------
    VersionError
        The worker has another version than the batch: it would compute other results.
    """
    _check_versions(task)
    try:
        return task.work(path, **task.options)
    except IpsysError as error:
        return _failure(path, reason_without(path, error))
    except OSError as error:
        return _failure(path, os_error_text(error).removeprefix(f"{path}: "))
    except MemoryError:
        return _failure(
            path, "the memory of the worker is full; use fewer workers, or a larger --memory-limit"
        )
    except Exception as error:
        text = f"fault of ipsys: {type(error).__name__}: {error}"
        return _failure(path, text, traceback.format_exc())


def _failure(path: Path, text: str, trace: str = "") -> LogResult:
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


def replay_log(path: Path, outdated: bool = False, **options: Any) -> LogResult:
    """Compute the results that a log lacks in this process, as :func:`ipsys_log.api.replay` does.

    Parameters
    ----------
    outdated : leave a log without outdated runs unchanged.
    options : those of the replay.
    """
    from ipsys_log import api

    if outdated and not _has_outdated_run(path):
        return LogResult(str(path), NOT_OUTDATED)
    remarks: list[str] = []
    outcomes = api.replay(path, say=remarks.append, jobs=1, **options).outcomes
    new = [outcome for outcome in outcomes if outcome.fresh]
    remarks += [f"{outcome.run}: {remark}" for outcome in new for remark in outcome.remarks]
    runs = tuple(dict.fromkeys(outcome.run for outcome in new))
    messages = sum(outcome.messages for outcome in new)
    state = COMPUTED if new else UP_TO_DATE
    return LogResult(str(path), state, text=_remarks_text(remarks), runs=runs, messages=messages)


def _has_outdated_run(path: Path) -> bool:
    with Session([path]) as session:
        return bool(outdated_runs(session))


def _remarks_text(remarks: Sequence[str]) -> str:
    lines = [" ".join(remark.split()) for remark in dict.fromkeys(remarks)]
    more = [f"and {len(lines) - _MOST_REMARKS} more remarks"] if len(lines) > _MOST_REMARKS else []
    return "; ".join(lines[:_MOST_REMARKS] + more)


def verify_log(path: Path, run: str | None = None) -> LogResult:
    """Repeat the runs of a log, and compare each channel, as :func:`ipsys_log.api.verify` does."""
    from ipsys_log import api

    remarks: list[str] = []
    comparisons = api.verify(path, run=run, say=remarks.append)
    other = [comparison.topic for comparison in comparisons if not comparison.equal]
    text = f"{len(other)} of {len(comparisons)} channels differ, such as {other[0]}" if other else ""
    return LogResult(
        str(path),
        DIFFERENT if other else IDENTICAL,
        not other,
        text or _remarks_text(remarks),
        messages=sum(comparison.left for comparison in comparisons),
    )


def check_log(path: Path) -> LogResult:
    """Read a log completely and check it, as :func:`ipsys_log.api.check` does."""
    from ipsys_log import api

    (check,) = api.check(path)
    findings = check.remarks
    worst = next((finding for finding in findings if finding.level == BROKEN), None)
    first = worst or (findings[0] if findings else None)
    more = f" (and {len(findings) - 1} more)" if len(findings) > 1 else ""
    place = f"{first.topic}: " if first and first.topic else ""
    text = f"{place}{first.text}{more}" if first else ""
    return LogResult(str(path), check.state, check.state == SOUND, text)
