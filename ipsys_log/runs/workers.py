"""Worker processes of this machine, which compute the pieces of a run.

A worker has a pipe to this process and a session of its own: the keys of the terminal and a closed terminal
concern this process only. A worker ends with its pipe, so that none remains after this process.
"""

from __future__ import annotations

import json
import os
import pickle
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.interrupts import undivided
from ipsys_log.runs.pieces import Piece, PiecePlan, PieceResult, PieceRun

__all__ = ["LocalWorkers", "available_cores", "serve"]

# Number of pieces for each worker that may be finished before the pieces in front of them.
_AHEAD = 2
# A worker has the next piece already when it finishes one: this process may be busy with writing.
_PIECES_OF_WORKER = 2
# The path of modules is that of this process: the folder of the user has no part in it.
_START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from ipsys_log.runs.workers import serve; serve()"
)


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class _Failure(NamedTuple):
    """An error in a worker, with its traceback."""

    error: Exception
    trace: str


class _Worker:
    """A worker process, its pipe, and the numbers of the pieces that it has, in their order."""

    def __init__(self) -> None:
        self.pieces: deque[int] = deque()
        command = [sys.executable, "-P", "-c", _START, json.dumps([path for path in sys.path if path])]
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        try:
            self._sender = Connection(os.dup(self.process.stdin.fileno()), readable=False)
            self.receiver = Connection(os.dup(self.process.stdout.fileno()), writable=False)
        except OSError:  # no file descriptor is free
            self.process.kill()
            self.process.wait()
            raise
        self.process.stdin.close()
        self.process.stdout.close()

    def begin(self, run: PieceRun) -> None:
        """Send the run of the pieces that follow."""
        self._send(run)

    def send(self, number: int, piece: Piece) -> None:
        self._send(piece)
        self.pieces.append(number)

    def _send(self, what: PieceRun | Piece) -> None:
        try:
            self._sender.send(what)
        except OSError:
            raise self._ended() from None

    def receive(self) -> PieceResult:
        try:
            answer = self.receiver.recv()
        except (EOFError, OSError):
            raise self._ended() from None
        self.pieces.popleft()
        if isinstance(answer, _Failure):
            answer.error.add_note(f"in a worker process:\n{answer.trace}")
            raise answer.error
        result: PieceResult = answer
        return result

    def close(self) -> None:
        """Close the pipe; the worker then ends by itself."""
        self._sender.close()
        self.receiver.close()

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()
        self.close()

    def _ended(self) -> IpsysError:
        code = self.process.wait()
        how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
        return IpsysError(
            f"a worker process has ended {how}, perhaps for lack of memory; its results are not written. "
            "Repeat the command, or give fewer processes with --jobs"
        )


class LocalWorkers:
    """Worker processes, started for each run. A context manager that ends them.

    Parameters
    ----------
    jobs : number of processes; with 1, runs are computed in this process.
    """

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._workers: list[_Worker] = []

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    @property
    def divides(self) -> bool:
        """True if there is more than one process."""
        return self.jobs > 1

    def compute(self, plan: PiecePlan) -> Iterator[PieceResult]:
        """Yield the results of the pieces in their order; the workers may finish them in another order.

        Raises
        ------
        IpsysError
            A worker was killed, or cannot be started.
        Exception
            An error in a worker, with a note of its traceback.
        """
        limit = _AHEAD * self.jobs + len(plan.frames.cameras)
        finished: dict[int, PieceResult] = {}
        waiting = deque(enumerate(plan.pieces))
        try:
            self._start(min(self.jobs, len(plan.pieces)))
            for worker in self._workers:
                worker.begin(plan.run)
            for number in range(len(plan.pieces)):
                self._feed(waiting, number + limit)
                while number not in finished:
                    self._receive(finished)
                    self._feed(waiting, number + limit)
                yield finished.pop(number)
        finally:
            self._stop()

    def _start(self, count: int) -> None:
        """Start workers up to a number of them.

        Raises
        ------
        IpsysError
            The system has no more processes or file descriptors for this program.
        """
        while len(self._workers) < count:
            with undivided():
                try:
                    self._workers.append(_Worker())
                except OSError as error:
                    raise IpsysError(
                        f"only {len(self._workers)} of {count} worker processes can be started "
                        f"({error.strerror}); give fewer processes with --jobs"
                    ) from error

    def _feed(self, waiting: deque[tuple[int, Piece]], stop: int) -> None:
        """Send pieces with numbers below ``stop``: first to idle workers, then one more to each of them."""
        for most in range(1, _PIECES_OF_WORKER + 1):
            for worker in self._workers:
                if waiting and waiting[0][0] < stop and len(worker.pieces) < most:
                    worker.send(*waiting.popleft())

    def _receive(self, finished: dict[int, PieceResult]) -> None:
        """Wait for results, and add them by the numbers of their pieces."""
        busy = [worker for worker in self._workers if worker.pieces]
        ready: Sequence[Any] = wait([worker.receiver for worker in busy])
        for worker in busy:
            if worker.receiver in ready:
                number = worker.pieces[0]
                finished[number] = worker.receive()

    def _stop(self) -> None:
        while self._workers:
            with undivided():
                self._workers.pop().stop()


def serve() -> None:
    """Compute the pieces that arrive at the standard input, until it ends. The main function of a worker."""
    receiver, sender = Connection(os.dup(0), writable=False), Connection(os.dup(1), readable=False)
    os.dup2(2, 1)  # a print of another package must not come between the results
    try:
        _serve(receiver, sender)
    except (EOFError, ConnectionError, BrokenPipeError):
        os._exit(0)  # the process that waits for results has ended


def _serve(receiver: Connection, sender: Connection) -> None:
    run = receiver.recv()
    sent: Future[None] | None = None
    try:
        # The next piece is computed while the other process has no time to read a result.
        with ThreadPoolExecutor(1) as thread:
            for answer in _answers(run, receiver):
                if sent is not None:
                    sent.result()
                sent = thread.submit(_send, sender, answer)
    except (EOFError, ConnectionError):
        raise
    except Exception as error:
        sender.send(_failure(error))


def _send(sender: Connection, answer: PieceResult) -> None:
    """Send an answer, or the error that prevents it: the other process waits for one of them."""
    try:
        sender.send(answer)
    except ConnectionError:
        raise
    except Exception as error:
        sender.send(_failure(error))


def _failure(error: Exception) -> _Failure:
    trace = "".join(traceback.format_exception(error))
    return _Failure(_portable(error), trace)


def _answers(run: PieceRun, receiver: Connection) -> Iterator[PieceResult]:
    import cv2

    from ipsys_log.log.dataset import Session
    from ipsys_log.runs.blas import one_blas_thread
    from ipsys_log.runs.pieces import check_versions, compute_piece

    cv2.setNumThreads(1)
    with Session(run.paths) as session, one_blas_thread():
        check_versions(session, run)
        while True:
            yield compute_piece(session, run, receiver.recv())


def _portable(error: Exception) -> Exception:
    """Return an error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
