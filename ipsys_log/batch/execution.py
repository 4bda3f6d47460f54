"""Execution of a batch: a bounded number of tasks at once, and tasks again whose worker has ended.

Dask starts a task at least once. The results of a task are appended to its log in one step, or not at all. So
a task whose worker has ended runs again, and does what is missing. A long log gives the tasks of its pieces;
they come before the logs that wait, so only few logs are divided at the same time.
"""

from __future__ import annotations

import secrets
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import TYPE_CHECKING

from ipsys_log.batch.tasks import (
    FAILED,
    BatchTask,
    LogPieces,
    LogResult,
    PieceState,
    VersionError,
    perform,
    perform_or_divide,
    perform_piece,
)
from ipsys_log.batch.workers import Workers
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation
from ipsys_log.runs.piece_folder import PieceTask
from ipsys_log.units import format_time

if TYPE_CHECKING:
    from distributed import Future

# A task that has ended this many workers fails with its log. The last time, it runs alone, so no other task
# is the cause.
MOST_ENDED_WORKERS = 4
_MOST_LOSSES = 3
# A log whose stored pieces are not there so often fails: the workers do not see the same folder.
_MOST_DIVISIONS = 3
_POLL_S = 1.0
_GROW_AFTER = 32

ShowPieces = Callable[[LogLocation, int, int], None]


@dataclass(slots=True, eq=False)
class _Log:
    """A log of the batch, and the number of its pieces that are not stored yet.

    ``divisions`` counts the times that pieces were missing; ``is_divided`` is False if the log must be one
    task; ``is_over`` is True when the log has a result.
    """

    path: LogLocation
    divisions: int = 0
    is_divided: bool = True
    pieces: int = 0
    missing: int = 0
    is_over: bool = False


@dataclass(slots=True)
class _Attempt:
    """A task on a log or on a piece of it, and its earlier attempts: ended workers, losses by the scheduler.

    ``division`` is the one to which the piece belongs. ``alone`` is True while no other task runs.
    """

    log: _Log
    piece: PieceTask | None = None
    division: int = 0
    ended: int = 0
    losses: int = 0
    alone: bool = False

    @property
    def is_needed(self) -> bool:
        """False for a piece of a log that has a result already, or is one task now."""
        return self.piece is None or (self.division == self.log.divisions and not self.log.is_over)

    @property
    def place(self) -> str:
        """The part of the log, for errors; "" for the whole log."""
        if self.piece is None:
            return ""
        piece = self.piece.piece
        return f" in the piece of {piece.camera} that begins at {format_time(piece.start_ns)}"


def run_batch(
    workers: Workers,
    task: BatchTask,
    paths: Sequence[LogLocation],
    show_pieces: ShowPieces = lambda path, done, total: None,
) -> Iterator[LogResult]:
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
    batch = _Batch(workers, task, paths, show_pieces)
    while batch.submit():
        result = batch.take()
        if result is not None:
            yield result


class _Batch:
    """The tasks that wait, the tasks that run, and those that run alone at the end."""

    def __init__(
        self, workers: Workers, task: BatchTask, paths: Sequence[LogLocation], show_pieces: ShowPieces
    ) -> None:
        self._workers, self._task, self._count, self._show = workers, task, len(paths), show_pieces
        self._waiting = deque(_Attempt(_Log(path)) for path in paths)
        self._alone: deque[_Attempt] = deque()
        self._running: dict[Future, _Attempt] = {}
        self._arrived: SimpleQueue[Future] = SimpleQueue()
        self._name, self._submitted, self._done = f"ipsys-{secrets.token_hex(4)}", 0, 0
        self._window = workers.window()

    def submit(self) -> bool:
        """Submit tasks up to the window; return False if all logs are done."""
        while self._waiting and len(self._running) < self._window:
            attempt = self._waiting.popleft()
            if attempt.is_needed:
                self._start(attempt)
        while not self._running and self._alone:
            attempt = self._alone.popleft()
            attempt.alone = True
            if attempt.is_needed:
                self._start(attempt)
        return bool(self._running)

    def _start(self, attempt: _Attempt) -> None:
        # One group for all tasks: Dask keeps statistics of each group.
        key = (self._name, self._submitted)
        self._submitted += 1
        log, submit = attempt.log, self._workers.client.submit
        task = self._task.of_log(log.path)
        if attempt.piece is None:
            work = perform_or_divide if self._task.divides and log.is_divided else perform
            future = submit(work, task, log.path, key=key, pure=False)
        else:
            future = submit(perform_piece, task, log.path, attempt.piece, key=key, pure=False)
        self._running[future] = attempt
        future.add_done_callback(self._arrived.put)

    def take(self) -> LogResult | None:
        """Wait for a task; return the result of its log, or None if the log needs further tasks."""
        future = self._next()
        attempt = self._running.pop(future)
        answer = self._answer(future, attempt)
        future.release()
        if not attempt.is_needed:
            return None
        if isinstance(answer, LogPieces):
            answer = self._divide(attempt.log, answer)
        elif isinstance(answer, PieceState):
            answer = self._after_piece(attempt.log, answer)
        elif answer is None:
            self._repeat(attempt)
        if answer is not None:
            attempt.log.is_over = True
            self._done += 1
            if self._done % _GROW_AFTER == 0:
                self._window = self._workers.window()
        return answer

    def _repeat(self, attempt: _Attempt) -> None:
        if attempt.ended >= MOST_ENDED_WORKERS - 1:
            self._alone.append(attempt)
        elif attempt.piece is not None:
            self._waiting.appendleft(attempt)
        else:
            self._waiting.append(attempt)

    def _divide(self, log: _Log, pieces: LogPieces) -> LogResult | None:
        """Put the pieces of a log before the logs that wait."""
        log.divisions += 1
        if log.divisions > _MOST_DIVISIONS:
            folder = pieces.tasks[0].folder
            text = (
                f"its pieces are not in {folder}: all workers must see this folder; use a shared file system"
            )
            return LogResult(str(log.path), FAILED, False, text)
        log.missing = len(pieces.tasks)
        log.pieces = max(log.pieces, log.missing)
        self._show(log.path, log.pieces - log.missing, log.pieces)
        attempts = [_Attempt(log, piece, log.divisions) for piece in pieces.tasks]
        self._waiting.extendleft(reversed(attempts))
        return None

    def _after_piece(self, log: _Log, state: PieceState) -> LogResult | None:
        """Count a stored piece; after the last one, merge them all, before any other log."""
        if state.failure is not None:
            return state.failure
        log.missing -= 1
        self._show(log.path, log.pieces - log.missing, log.pieces)
        if state.other_software:
            log.is_divided = False
            log.divisions += 1
        if state.other_software or not log.missing:
            self._waiting.appendleft(_Attempt(log))
        return None

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

    def _answer(self, future: Future, attempt: _Attempt) -> LogResult | LogPieces | PieceState | None:
        from distributed import CancelledError, KilledWorker

        try:
            answer: LogResult | LogPieces | PieceState = future.result()
        except KilledWorker as error:
            return self._after_end(attempt, error.allowed_failures + 1)
        except CancelledError:
            return self._after_loss(attempt)
        except VersionError:
            raise
        except Exception as error:  # the task itself turns its errors into results: this is one of Dask
            text = str(error).partition("\n")[0]
            return _failure(attempt, f"the task failed: {type(error).__name__}: {text}")
        return answer

    def _after_end(self, attempt: _Attempt, times: int) -> LogResult | None:
        """Count the ended workers of a task; give its log up after too many, the last one alone."""
        attempt.ended += times
        if attempt.ended < MOST_ENDED_WORKERS or not attempt.alone:
            return None
        return _failure(
            attempt,
            f"its worker ended {attempt.ended} times{attempt.place}: it was killed, or its memory was full; "
            "give a larger --memory-limit, or try the single command",
        )

    def _after_loss(self, attempt: _Attempt) -> LogResult | None:
        """Count the losses of a task by the scheduler, which has perhaps restarted."""
        self._check_connection()
        attempt.losses += 1
        if attempt.losses < _MOST_LOSSES:
            return None
        text = f"the scheduler lost its task {attempt.losses} times; to continue, repeat the command"
        return _failure(attempt, text)


def _failure(attempt: _Attempt, text: str) -> LogResult:
    return LogResult(str(attempt.log.path), FAILED, False, text)
