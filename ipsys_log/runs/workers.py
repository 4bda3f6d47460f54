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
from collections.abc import Iterator, Sequence
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.interrupts import undivided
from ipsys_log.runs.pieces import Piece, PiecePlan, PieceResult, PieceRun

__all__ = ["LocalWorkers", "available_cores", "serve"]

# Number of pieces for each worker that may be finished before the pieces in front of them.
_AHEAD = 2
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
    """A worker process, its pipe, and the number of the piece that it computes now."""

    def __init__(self, run: PieceRun) -> None:
        self.piece: int | None = None
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
        self._sender = Connection(os.dup(self.process.stdin.fileno()), readable=False)
        self.receiver = Connection(os.dup(self.process.stdout.fileno()), writable=False)
        self.process.stdin.close()
        self.process.stdout.close()
        self._run = run
        self._has_run = False

    def send(self, number: int, piece: Piece) -> None:
        try:
            if not self._has_run:
                self._sender.send(self._run)
                self._has_run = True
            self._sender.send(piece)
        except OSError:
            raise self._ended() from None
        self.piece = number

    def receive(self) -> PieceResult:
        try:
            answer = self.receiver.recv()
        except (EOFError, OSError):
            raise self._ended() from None
        self.piece = None
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
            A worker was killed.
        Exception
            An error in a worker, with a note of its traceback.
        """
        pieces = plan.pieces
        limit = _AHEAD * self.jobs + len(plan.frames.cameras)
        finished: dict[int, PieceResult] = {}
        sent = 0
        try:
            for _ in range(min(self.jobs, len(pieces))):
                with undivided():
                    self._workers.append(_Worker(plan.run))
            for number in range(len(pieces)):
                while number not in finished:
                    for worker in self._workers:
                        if worker.piece is None and sent < min(len(pieces), number + limit):
                            worker.send(sent, pieces[sent])
                            sent += 1
                    self._receive(finished)
                yield finished.pop(number)
        finally:
            self._stop()

    def _receive(self, finished: dict[int, PieceResult]) -> None:
        """Wait for results, and add them by the numbers of their pieces."""
        ready: Sequence[Any] = wait([worker.receiver for worker in self._workers if worker.piece is not None])
        for worker in self._workers:
            if worker.piece is not None and worker.receiver in ready:
                number = worker.piece
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
    try:
        answers = _answers(run, receiver)
        for answer in answers:
            sender.send(answer)
    except (EOFError, ConnectionError):
        raise
    except Exception as error:
        sender.send(_Failure(_portable(error), traceback.format_exc()))


def _answers(run: PieceRun, receiver: Connection) -> Iterator[PieceResult]:
    import cv2

    from ipsys_log.log.dataset import Session
    from ipsys_log.runs.blas import one_blas_thread
    from ipsys_log.runs.pieces import compute_piece

    cv2.setNumThreads(1)
    with Session(run.paths) as session, one_blas_thread():
        while True:
            yield compute_piece(session, run, receiver.recv())


def _portable(error: Exception) -> Exception:
    """Return an error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
