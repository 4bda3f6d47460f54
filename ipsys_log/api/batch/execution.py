"""Execution of a batch: a bounded number of tasks at once, and tasks again whose worker has ended.

Dask starts a task at least once. The results of a task are appended to its log in one step, or not at all. So
a task whose worker has ended runs again, and does what is missing. The detection in a long log is divided
into pieces, which all workers compute. This process appends their results; a worker does the later stages.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future as ThreadFuture
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING, Any, TypeVar

from ipsys_log.api.batch import tasks
from ipsys_log.api.batch.workers import Workers
from ipsys_log.engine.pieces import PiecePlan, PieceResult
from ipsys_log.engine.provenance import fingerprint
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation

if TYPE_CHECKING:
    from distributed import Future

# A log that has ended this many workers fails. The last time, it runs alone, so no other task is the cause.
MOST_ENDED_WORKERS = 4
_MOST_LOSSES = 3
# The pieces of one log use all workers but at its end. Those of a second one fill the gap.
_MOST_DIVIDED = 2
_POLL_S = 1.0
_GROW_AFTER = 32

ShowPieces = Callable[[LogLocation, int, int], None]
Arrived = TypeVar("Arrived")


@dataclass(slots=True)
class _Attempts:
    """The failed attempts at a task: the workers that it ended, and its losses by the scheduler."""

    ended: int = 0
    losses: int = 0

    def result_of(self, future: Future, workers: Workers) -> Any:
        """Return the result of a task; None if its worker has ended, or if the scheduler has lost it.

        Raises
        ------
        IpsysError
            The scheduler has lost the task several times, or was lost itself.
        Exception
            The error of the task.
        """
        from distributed import CancelledError, KilledWorker

        try:
            return future.result()
        except KilledWorker as error:
            self.ended += error.allowed_failures + 1
        except CancelledError:
            workers.check_connection()
            self.losses += 1
            if self.losses >= _MOST_LOSSES:
                raise IpsysError(
                    f"the scheduler lost its task {self.losses} times; to continue, repeat the command"
                ) from None
        return None

    def describe_end(self, place: str = "") -> str:
        return (
            f"its worker ended {self.ended} times{place}: it was killed, or its memory was full; "
            "give a larger --memory-limit, or try the single command"
        )


@dataclass(slots=True, eq=False)
class _Log:
    """A log of the batch.

    ``is_divided`` is False if the log must be one task. ``in_pieces`` is True while its detection is divided,
    and ``detected`` is the result of that. ``alone`` is True while no other log is in work.
    """

    path: LogLocation
    attempts: _Attempts = field(default_factory=_Attempts)
    is_divided: bool = True
    in_pieces: bool = False
    detected: tasks.LogResult | None = None
    alone: bool = False


def run_batch(
    workers: Workers,
    task: tasks.BatchTask,
    paths: Sequence[LogLocation],
    show_pieces: ShowPieces = lambda path, done, total: None,
) -> Iterator[tasks.LogResult]:
    """Do a task on each log; yield the results as they arrive, in any order.

    The number of tasks at once is bounded, so the memory does not grow with the number of logs.

    Parameters
    ----------
    show_pieces : called with a long log, the number of its pieces that are done, and of all its pieces.

    Raises
    ------
    IpsysError
        The scheduler was lost, or a worker has another version of ipsys.
    """
    workers.is_stopped = False
    with ThreadPoolExecutor(_MOST_DIVIDED) as threads:
        batch = _Batch(workers, task, paths, show_pieces, threads)
        try:
            while batch.submit():
                result = batch.take()
                if result is not None:
                    yield result
        finally:
            workers.is_stopped = True  # ends the threads
            threads.shutdown(wait=False, cancel_futures=True)


class _Batch:
    """The logs that wait, those in work, and those that are done alone at the end."""

    def __init__(
        self,
        workers: Workers,
        task: tasks.BatchTask,
        paths: Sequence[LogLocation],
        show_pieces: ShowPieces,
        threads: ThreadPoolExecutor,
    ) -> None:
        self._workers, self._task, self._show, self._threads = workers, task, show_pieces, threads
        self._waiting = deque(map(_Log, paths))
        self._alone: deque[_Log] = deque()
        self._running: dict[Future | ThreadFuture[tasks.LogResult], _Log] = {}
        self._arrived: SimpleQueue[Future | ThreadFuture[tasks.LogResult]] = SimpleQueue()
        # One group for all tasks: Dask keeps statistics of each group.
        self._name, self._submitted, self._done = f"ipsys-{secrets.token_hex(4)}", 0, 0
        self._window = workers.window()

    def submit(self) -> bool:
        """Submit tasks up to the window; return False if all logs are done."""
        while self._waiting and len(self._running) < self._window:
            self._start(self._waiting.popleft())
        if not self._running and self._alone:
            log = self._alone.popleft()
            log.alone = True
            self._start(log)
        return bool(self._running)

    def _start(self, log: _Log) -> None:
        task = self._task.of_log(log.path)
        future: Future | ThreadFuture[tasks.LogResult]
        if log.in_pieces:
            future = self._threads.submit(self._detect, task, log.path)
        else:
            if log.detected is not None and "outdated" in task.options:  # its detection is new now
                task = replace(task, options={**task.options, "outdated": False})
            may_divide = task.divides and log.is_divided and log.detected is None
            work = tasks.perform_or_divide if may_divide else tasks.perform
            key = (self._name, self._submitted)
            self._submitted += 1
            future = self._workers.client.submit(work, task, log.path, key=key, pure=False)
        self._running[future] = log
        future.add_done_callback(self._arrived.put)

    def _detect(self, task: tasks.BatchTask, path: LogLocation) -> tasks.LogResult:
        """Compute the first stage of a long log by pieces. For a thread."""
        pieces = DaskPieces(self._workers, partial(self._show, path))
        result = tasks.perform(replace(task, options={**task.options, "workers": pieces}), path)
        return replace(result, pieces=pieces.count or None)

    def take(self) -> tasks.LogResult | None:
        """Wait for a task; return the result of its log, or None if the log needs further tasks."""
        future = _next_of(self._arrived, self._workers)
        log = self._running.pop(future)
        answer = self._answer(future, log)
        if answer is None:
            return None
        if log.in_pieces and answer.good:
            log.in_pieces, log.detected = False, answer
            self._waiting.appendleft(log)
            return None
        if log.detected is not None and answer.good:
            answer = _joined(log.detected, answer)
        self._done += 1
        if self._done % _GROW_AFTER == 0:
            self._window = self._workers.window()
        return answer

    def _answer(self, future: Future | ThreadFuture[tasks.LogResult], log: _Log) -> tasks.LogResult | None:
        """Return the result of a task; None after the log waits for another one."""
        try:
            answer = log.attempts.result_of(future, self._workers)
        except tasks.VersionError:
            raise
        except tasks.OtherSoftwareError:
            log.in_pieces = log.is_divided = False
            self._waiting.appendleft(log)
            return None
        except IpsysError as error:
            self._workers.check_connection()
            return _failure(log, str(error))
        except Exception as error:  # the task itself turns its errors into results: this is one of Dask
            text = str(error).partition("\n")[0]
            return _failure(log, f"the task failed: {type(error).__name__}: {text}")
        finally:
            if not isinstance(future, ThreadFuture):
                future.release()
        if isinstance(answer, tasks.LongLog):
            log.in_pieces = True
            self._waiting.appendleft(log)
            return None
        if answer is None:
            return self._repeat(log)
        result: tasks.LogResult = answer
        return result

    def _repeat(self, log: _Log) -> tasks.LogResult | None:
        """Let a log wait again; give it up after too many ended workers, the last one alone."""
        if log.attempts.ended < MOST_ENDED_WORKERS - 1:
            self._waiting.append(log)
        elif log.attempts.ended < MOST_ENDED_WORKERS or not log.alone:
            self._alone.append(log)
        else:
            return _failure(log, log.attempts.describe_end())
        return None


class DaskPieces:
    """The workers of a batch, which compute the pieces of one log.

    Parameters
    ----------
    show : called with the number of finished pieces, and of all pieces.

    Attributes
    ----------
    count : the number of the pieces of the log.
    """

    divides, first_only = True, True

    def __init__(self, workers: Workers, show: Callable[[int, int], None]) -> None:
        self._workers, self._show, self.count = workers, show, 0
        self._arrived: SimpleQueue[Future] = SimpleQueue()
        self._running: dict[Future, tuple[int, _Attempts]] = {}

    def prepare(self, _plan: PiecePlan) -> None:
        """Do nothing: the workers run already."""

    def compute(self, plan: PiecePlan) -> Iterator[PieceResult]:
        """Yield the results of the pieces in their order; the workers may finish them in another order.

        Raises
        ------
        OtherSoftwareError
            A worker would compute other digits than this process.
        IpsysError
            A piece has ended several workers, or the scheduler was lost.
        """
        plan.run.load()  # imports the stage: its libraries are in the fingerprint
        start = partial(self._start, plan, fingerprint())
        finished: dict[int, PieceResult] = {}
        offered, self.count = 0, len(plan.pieces)
        try:
            for number in range(self.count):
                self._workers.check_connection()
                stop = min(number + plan.ahead(self._workers.window()), self.count)
                while offered < stop:
                    start(offered, _Attempts())
                    offered += 1
                while number not in finished:
                    place, attempts, result = self._take()
                    if result is not None:
                        finished[place] = result
                        self._show(number + len(finished), self.count)
                    elif attempts.ended < MOST_ENDED_WORKERS:
                        start(place, attempts)
                    else:
                        raise IpsysError(attempts.describe_end(f" in {plan.pieces[place]}"))
                yield finished.pop(number)
        finally:
            with suppress(Exception):  # the scheduler may be lost
                self._workers.client.cancel(list(self._running))

    def _start(self, plan: PiecePlan, software: dict[str, str], place: int, attempts: _Attempts) -> None:
        # A piece comes before the logs that wait.
        future = self._workers.client.submit(
            tasks.compute_alone, plan.run, plan.pieces[place], software, pure=False, priority=1
        )
        self._running[future] = place, attempts
        future.add_done_callback(self._arrived.put)

    def _take(self) -> tuple[int, _Attempts, PieceResult | None]:
        future = _next_of(self._arrived, self._workers)
        place, attempts = self._running.pop(future)
        result = attempts.result_of(future, self._workers)
        future.release()
        return place, attempts, result


def _next_of(arrived: SimpleQueue[Arrived], workers: Workers) -> Arrived:
    while True:
        try:
            return arrived.get(timeout=_POLL_S)
        except Empty:
            workers.check_connection()


def _joined(detected: tasks.LogResult, later: tasks.LogResult) -> tasks.LogResult:
    """Return the result of a log whose first stage was computed by pieces, and the others by a worker."""
    return replace(
        later,
        state=detected.state,
        text="; ".join(dict.fromkeys(text for text in (detected.text, later.text) if text)),
        runs=tuple(dict.fromkeys((*detected.runs, *later.runs))),
        messages=detected.messages + later.messages,
        pieces=detected.pieces,
    )


def _failure(log: _Log, text: str) -> tasks.LogResult:
    return tasks.LogResult(str(log.path), tasks.FAILED, False, text)
