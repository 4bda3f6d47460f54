"""Execution of a batch: a bounded number of tasks at once, and tasks again whose worker has ended.

Dask starts a task at least once. The results of a task are appended to its log in one step, or not at all. So
a task whose worker has ended runs again, and does what is missing.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from ipsys_log.batch.tasks import FAILED, BatchTask, LogResult, VersionError, perform
from ipsys_log.batch.workers import Workers
from ipsys_log.errors import IpsysError

if TYPE_CHECKING:
    from distributed import Future

__all__ = ["MOST_ENDED_WORKERS", "run_batch"]

# A log that has ended this many workers fails. The last time, it runs alone, so no other log is the cause.
MOST_ENDED_WORKERS = 4
_MOST_LOSSES = 3
_POLL_S = 1.0
_GROW_AFTER = 32


@dataclass(slots=True)
class _Attempt:
    """A log and its earlier attempts: ended workers, and losses by the scheduler.

    ``alone`` is True while no other task runs.
    """

    path: Path
    ended: int = 0
    losses: int = 0
    alone: bool = False


def run_batch(workers: Workers, task: BatchTask, paths: Sequence[Path]) -> Iterator[LogResult]:
    """Do a task on each log; yield the results as they arrive, in any order.

    The number of tasks at once is bounded, so the memory does not grow with the number of logs.

    Raises
    ------
    IpsysError
        The scheduler was lost, or a worker has another version of ipsys.
    """
    batch = _Batch(workers, task, paths)
    while batch.submit():
        result = batch.take()
        if result is not None:
            yield result


class _Batch:
    """The logs that wait, the logs that run, and those that run alone at the end."""

    def __init__(self, workers: Workers, task: BatchTask, paths: Sequence[Path]) -> None:
        self._workers, self._task, self._count = workers, task, len(paths)
        self._waiting = deque(_Attempt(path) for path in paths)
        self._alone: deque[_Attempt] = deque()
        self._running: dict[Future, _Attempt] = {}
        self._arrived: SimpleQueue[Future] = SimpleQueue()
        self._name, self._submitted, self._done = f"ipsys-{secrets.token_hex(4)}", 0, 0
        self._window = workers.window()

    def submit(self) -> bool:
        """Submit tasks up to the window; return False if all logs are done."""
        while self._waiting and len(self._running) < self._window:
            self._start(self._waiting.popleft())
        if not self._running and self._alone:
            attempt = self._alone.popleft()
            attempt.alone = True
            self._start(attempt)
        return bool(self._running)

    def _start(self, attempt: _Attempt) -> None:
        # One group for all tasks: Dask keeps statistics of each group.
        key = (self._name, self._submitted)
        self._submitted += 1
        future = self._workers.client.submit(perform, self._task, attempt.path, key=key, pure=False)
        self._running[future] = attempt
        future.add_done_callback(self._arrived.put)

    def take(self) -> LogResult | None:
        """Wait for a task; return its result, or None if it runs again."""
        future = self._next()
        attempt = self._running.pop(future)
        result = self._result(future, attempt)
        future.release()
        if result is None:
            (self._alone if attempt.ended >= MOST_ENDED_WORKERS - 1 else self._waiting).append(attempt)
        else:
            self._done += 1
            if self._done % _GROW_AFTER == 0:
                self._window = self._workers.window()
        return result

    def _next(self) -> Future:
        while True:
            try:
                return self._arrived.get(timeout=_POLL_S)
            except Empty:
                self._check_connection()

    def _check_connection(self) -> None:
        if self._workers.client.status in ("closing", "closed"):
            raise IpsysError(
                f"the scheduler {self._workers.address} was lost after {self._done} of {self._count} logs; "
                "results so far are in the logs; to continue, repeat the command"
            )

    def _result(self, future: Future, attempt: _Attempt) -> LogResult | None:
        from distributed import CancelledError, KilledWorker

        try:
            result: LogResult = future.result()
        except KilledWorker as error:
            return self._after_end(attempt, error.allowed_failures + 1)
        except CancelledError:
            return self._after_loss(attempt)
        except VersionError:
            raise
        except Exception as error:  # the task itself turns its errors into results: this is one of Dask
            text = str(error).partition("\n")[0]
            return LogResult(
                str(attempt.path), FAILED, False, f"the task failed: {type(error).__name__}: {text}"
            )
        return result

    def _after_end(self, attempt: _Attempt, times: int) -> LogResult | None:
        """Count the ended workers of a log; give it up if it has ended too many, the last one alone."""
        attempt.ended += times
        if attempt.ended < MOST_ENDED_WORKERS or not attempt.alone:
            return None
        text = (
            f"its worker ended {attempt.ended} times: it was killed, or its memory was full; give a larger "
            "--memory-limit, or try the single command"
        )
        return LogResult(str(attempt.path), FAILED, False, text)

    def _after_loss(self, attempt: _Attempt) -> LogResult | None:
        """Count the losses of a task by the scheduler, which has perhaps restarted."""
        self._check_connection()
        attempt.losses += 1
        if attempt.losses < _MOST_LOSSES:
            return None
        text = f"the scheduler lost its task {attempt.losses} times; to continue, repeat the command"
        return LogResult(str(attempt.path), FAILED, False, text)
