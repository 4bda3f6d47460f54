"""Worker processes of this machine, which compute the pieces of a run.

All workers take the numbers of their pieces from one pipe, besides the pipe that each of them has for the
results. A worker ends with its pipes, so that none remains after this process.
"""

from __future__ import annotations

import os
import pickle
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.interrupts import undivided
from ipsys_log.piped_process import PipedProcess, parent_pipe
from ipsys_log.runs.pieces import Piece, PiecePlan, PieceResult, PieceRun

# Number of pieces for each worker that may be finished before the pieces in front of them.
_AHEAD = 2
# The size of a piece's number in the common pipe. A system call reads or writes such a number completely.
_NUMBER_BYTES = 4
# More processes than these only take memory, 0.15 GB each. A script may run on machines of other sizes.
_MOST_JOBS_OF_CORE = 4
_MOST_JOBS_OF_SMALL_MACHINE = 16


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_jobs(jobs: int) -> None:
    """Check a number of processes.

    Raises
    ------
    IpsysError
        The number is too large for this machine.
    """
    cores = available_cores()
    most = max(_MOST_JOBS_OF_CORE * cores, _MOST_JOBS_OF_SMALL_MACHINE)
    if jobs > most:
        raise IpsysError(
            f"--jobs {jobs}: is too large for the cores of this machine ({cores}); give {most} or fewer"
        )


class _Failure(NamedTuple):
    """An error in a worker, with its traceback."""

    error: Exception
    trace: str


class _Worker(PipedProcess):
    """A worker process; ``numbers`` is the file descriptor with the numbers of its pieces."""

    def __init__(self, numbers: int) -> None:
        super().__init__(serve, numbers)

    def begin(self, plan: PiecePlan) -> None:
        """Send the run and the pieces whose numbers follow."""
        try:
            self.sender.send((plan.run, plan.pieces))
        except OSError:
            raise self._ended() from None

    def receive(self) -> tuple[int, PieceResult]:
        """Return the number and the result of a piece."""
        try:
            answer = self.receiver.recv()
        except (EOFError, OSError):
            raise self._ended() from None
        if isinstance(answer, _Failure):
            answer.error.add_note(f"in a worker process:\n{answer.trace}")
            raise answer.error
        number, result = answer
        return number, result

    def _ended(self) -> IpsysError:
        return IpsysError(
            f"a worker process has ended {self.describe_end()}, perhaps for lack of memory; its results are "
            "not written. Repeat the command, or give fewer processes with --jobs"
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
        self._numbers: tuple[int, ...] = ()  # the ends of the common pipe: to read, to write

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

    def prepare(self, plan: PiecePlan) -> None:
        """Start the workers of a plan; they import the package while this process prepares the run.

        Raises
        ------
        IpsysError
            A worker cannot be started.
        """
        self._start(min(self.jobs, len(plan.pieces)))

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
        offered = 0
        try:
            self.prepare(plan)
            for worker in self._workers:
                worker.begin(plan)
            for number in range(len(plan.pieces)):
                offered = self._offer(offered, min(number + limit, len(plan.pieces)))
                while number not in finished:
                    self._receive(finished)
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
                    self._numbers = self._numbers or os.pipe()
                    self._workers.append(_Worker(self._numbers[0]))
                except OSError as error:
                    raise IpsysError(
                        f"only {len(self._workers)} of {count} worker processes can be started "
                        f"({error.strerror}); give fewer processes with --jobs"
                    ) from error

    def _offer(self, start: int, stop: int) -> int:
        """Offer the pieces from ``start`` up to ``stop`` to all workers; return the next number.

        A worker takes a piece when it has finished one, even while this process writes. A piece that waits
        behind another one in a slow worker would leave the others idle at the end.
        """
        for number in range(start, stop):
            os.write(self._numbers[1], number.to_bytes(_NUMBER_BYTES, "little"))
        return stop

    def _receive(self, finished: dict[int, PieceResult]) -> None:
        """Wait for results, and add them by the numbers of their pieces."""
        ready: Sequence[Any] = wait([worker.receiver for worker in self._workers])
        for worker in self._workers:
            if worker.receiver in ready:
                number, result = worker.receive()
                finished[number] = result

    def _stop(self) -> None:
        while self._workers:
            with undivided():
                self._workers.pop().stop()
        with undivided():
            for end in self._numbers:
                os.close(end)
            self._numbers = ()


def serve(numbers: int) -> None:
    """Compute the pieces with the numbers from a file descriptor, until it ends. A worker's main function."""
    receiver, sender = parent_pipe()
    try:
        _serve(receiver, sender, numbers)
    except (EOFError, ConnectionError, BrokenPipeError):
        os._exit(0)  # the process that waits for results has ended


def _serve(receiver: Connection, sender: Connection, numbers: int) -> None:
    run, pieces = receiver.recv()
    sent: Future[None] | None = None
    try:
        # The next piece is computed while the other process has no time to read a result.
        with ThreadPoolExecutor(1) as thread:
            for answer in _answers(run, pieces, numbers):
                if sent is not None:
                    sent.result()
                sent = thread.submit(_send, sender, answer)
    except (EOFError, ConnectionError):
        raise
    except Exception as error:
        sender.send(_failure(error))


def _send(sender: Connection, answer: tuple[int, PieceResult]) -> None:
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


def _answers(run: PieceRun, pieces: Sequence[Piece], numbers: int) -> Iterator[tuple[int, PieceResult]]:
    """Yield the numbers and the results of the pieces that this worker takes."""
    import cv2

    from ipsys_log.log.dataset import Session
    from ipsys_log.runs.pieces import check_versions, compute_piece

    cv2.setNumThreads(1)
    with Session(run.paths) as session:
        check_versions(session, run)
        while taken := os.read(numbers, _NUMBER_BYTES):
            number = int.from_bytes(taken, "little")
            yield number, compute_piece(session, run, pieces[number])


def _portable(error: Exception) -> Exception:
    """Return an error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
