"""Worker processes of this machine, which compute the pieces of a work, such as a run.

Each worker gets the numbers of its pieces through its pipe, and sends their results back. A worker ends with
its pipe, so that none remains after this process. The pieces of a worker that was killed go to another one.
"""

from __future__ import annotations

import os
import pickle
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, suppress
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Protocol

from ipsys_log.engine.piped_process import PipedProcess, parent_pipe
from ipsys_log.errors import IpsysError

# With fewer waiting pieces for each worker, none gets a second one: it could wait behind a slow one.
_FEW_PIECES = 2
# A piece that has ended so many workers is their cause, such as by a lack of memory.
_MOST_ENDED_WORKERS = 2
# More processes than these only take memory, 0.15 GB each. A script may run on machines of other sizes.
_MOST_JOBS_OF_CORE = 4
_MOST_JOBS_OF_SMALL_MACHINE = 16


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_jobs(jobs: int) -> None:
    """Check a number of processes."""
    cores = available_cores()
    most = max(_MOST_JOBS_OF_CORE * cores, _MOST_JOBS_OF_SMALL_MACHINE)
    if jobs > most:
        raise IpsysError(
            f"--jobs {jobs}: is too large for the cores of this machine ({cores}); give {most} or fewer"
        )


class Work(Protocol):
    """The part of a work that all its pieces have in common. It can be pickled."""

    def open(self) -> AbstractContextManager[Callable[[Any], Any]]:
        """Open the inputs; the context manager gives the function from a piece to its result."""
        ...


class Plan(Protocol):
    """The division of a work into pieces."""

    @property
    def run(self) -> Work: ...

    @property
    def pieces(self) -> Sequence[Any]: ...

    def ahead(self, workers: int, /) -> int:
        """Return how many pieces may be in work or finished before the pieces in front of them are used."""
        ...


class _Failure(NamedTuple):
    """An error in a worker, with its traceback."""

    error: Exception
    trace: str


class _Worker(PipedProcess):
    """A worker process; ``pieces`` has the numbers of its pieces, the first one in work."""

    def __init__(self) -> None:
        super().__init__(serve)
        self.pieces: deque[int] = deque()

    def send(self, message: object) -> None:
        """Send the run with its pieces, or the number of the next piece."""
        with suppress(OSError):  # if it has ended, receive() tells so
            self.sender.send(message)

    def receive(self) -> Any:
        """Return the result of its first piece; None if the process has ended."""
        try:
            answer: Any = self.receiver.recv()
        except (EOFError, OSError):
            return None
        if isinstance(answer, _Failure):
            answer.error.add_note(f"in a worker process:\n{answer.trace}")
            raise answer.error
        return answer


class LocalWorkers:
    """Worker processes, started for each run. A context manager that ends them.

    With one of them (``jobs``), runs are computed in this process.
    """

    first_only = False

    def __init__(self, jobs: int) -> None:
        self.jobs = jobs
        self._workers: list[_Worker] = []

    def __enter__(self) -> LocalWorkers:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()

    @property
    def divides(self) -> bool:
        """True if there is more than one process."""
        return self.jobs > 1

    def prepare(self, plan: Plan) -> None:
        """Start the workers of a plan; they import the package while this process prepares the run."""
        count = min(self.jobs, len(plan.pieces))
        while len(self._workers) < count:
            try:
                self._workers.append(_Worker())
            except OSError as error:
                raise IpsysError(
                    f"only {len(self._workers)} of {count} worker processes can be started "
                    f"({error.strerror}); give fewer processes with --jobs"
                ) from error

    def compute(self, plan: Plan) -> Iterator[Any]:
        """Yield the results of the pieces in their order; the workers may finish them in another order.

        Raises
        ------
        IpsysError
            A piece has ended several workers, or a worker cannot be started.
        Exception
            An error in a worker, with a note of its traceback.
        """
        ended: Counter[int] = Counter()
        finished: dict[int, Any] = {}
        waiting = deque(range(len(plan.pieces)))
        try:
            self.prepare(plan)
            for worker in self._workers:
                worker.send((plan.run, plan.pieces))
            for number in range(len(plan.pieces)):
                self._offer(waiting, number + plan.ahead(self.jobs))
                while number not in finished:
                    for worker in self._ready():
                        result = worker.receive()
                        if result is not None:
                            finished[worker.pieces.popleft()] = result
                        else:
                            self._replace(worker, plan, waiting, ended)
                    self._offer(waiting, number + plan.ahead(self.jobs))
                yield finished.pop(number)
        finally:
            self._stop()

    def _offer(self, waiting: deque[int], stop: int) -> None:
        """Give pieces before ``stop`` to workers: one to each without a piece, and then a second one to each.

        With a second piece, a worker goes on while this process is busy.
        """
        for most in (0, 1):
            for worker in self._workers:
                has_more = len(waiting) > most * _FEW_PIECES * len(self._workers)
                if has_more and waiting[0] < stop and len(worker.pieces) == most:
                    worker.pieces.append(waiting.popleft())
                    worker.send(worker.pieces[-1])

    def _ready(self) -> list[_Worker]:
        """Wait for results; return the workers with one, or that have ended."""
        ready: Sequence[Any] = wait([worker.receiver for worker in self._workers])
        return [worker for worker in self._workers if worker.receiver in ready]

    def _replace(self, worker: _Worker, plan: Plan, waiting: deque[int], ended: Counter[int]) -> None:
        """Start another worker instead of one that has ended, and let its pieces wait again."""
        text = worker.describe_end()
        self._workers.remove(worker)
        worker.close()
        waiting.extendleft(reversed(worker.pieces))
        number = worker.pieces[0] if worker.pieces else -1
        ended[number] += 1
        if ended[number] >= _MOST_ENDED_WORKERS:
            place = f" in {plan.pieces[number]}" if worker.pieces else ""
            raise IpsysError(
                f"{ended[number]} worker processes have ended {text}{place}, perhaps for lack of memory; "
                "their results are not written. Repeat the command, or give fewer processes with --jobs"
            )
        self.prepare(plan)
        self._workers[-1].send((plan.run, plan.pieces))

    def _stop(self) -> None:
        while self._workers:
            self._workers.pop().stop()


def serve() -> None:
    """Compute the pieces with the numbers from the pipe, until it ends. A worker's main function."""
    receiver, sender = parent_pipe()
    try:
        run, pieces = receiver.recv()
        _serve(run, pieces, receiver, sender)
    except (EOFError, ConnectionError):
        os._exit(0)  # the process that waits for results has ended


def _serve(run: Work, pieces: Sequence[Any], receiver: Connection, sender: Connection) -> None:
    import cv2

    cv2.setNumThreads(1)
    sent: Future[None] | None = None
    try:
        # The next piece is computed while the other process has no time to read a result.
        with run.open() as compute, ThreadPoolExecutor(1) as thread:
            while True:
                result = compute(pieces[receiver.recv()])
                if sent is not None:
                    sent.result()
                sent = thread.submit(_send, sender, result)
    except (EOFError, ConnectionError):
        raise
    except Exception as error:
        sender.send(_failure(error))


def _send(sender: Connection, result: object) -> None:
    """Send a result, or the error that prevents it: the other process waits for one of them."""
    try:
        sender.send(result)
    except ConnectionError:
        raise
    except Exception as error:
        sender.send(_failure(error))


def _failure(error: Exception) -> _Failure:
    trace = "".join(traceback.format_exception(error))
    return _Failure(_portable(error), trace)


def _portable(error: Exception) -> Exception:
    """Return an error that another process can read."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error
