"""Worker processes: the same bytes with any number of them, and their ends, killed or interrupted."""

from __future__ import annotations

import errno
import multiprocessing.connection
import os
import shutil
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.errors import IpsysError
from ipsys_log.log.reader import LogReader
from ipsys_log.pipeline import replay
from ipsys_log.runs import pieces, workers
from ipsys_log.runs.options import Request
from ipsys_log.runs.pieces import Piece, PieceFrames, PiecePlan, PieceRun
from ipsys_log.runs.workers import LocalWorkers
from tests.conftest import Ipsys

pytestmark = pytest.mark.slow  # each process imports the package

REQUEST = Request(parameters={"reset_s": "2"})
# A worker that was told to end has minutes to do so.
PATIENCE_S = 240.0


@pytest.fixture(autouse=True)
def _workers_for_short_logs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pieces, "_MIN_FRAMES", 1)


def newest_worker_first(receivers: Sequence[Any]) -> list[Any]:
    """Return the last worker with a result only: its pieces finish before those of the others."""
    ready = _wait(receivers)
    return [receiver for receiver in receivers if receiver in ready][-1:]


_wait = multiprocessing.connection.wait


def test_bytes_are_equal_for_any_number_of_processes(
    lab_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = _count_workers(monkeypatch)
    monkeypatch.setattr(workers, "wait", newest_worker_first)
    logs = {jobs: Path(shutil.copy(lab_log, tmp_path / f"{jobs}.mcap")) for jobs in (1, 2, 5)}
    counts = {}
    for jobs, log in logs.items():
        replay([log], REQUEST, "camera-frame", jobs=jobs)
        counts[jobs] = len(started)
    assert counts == {1: 0, 2: 2, 5: 7}
    assert len({log.read_bytes() for log in logs.values()}) == 1


def _count_workers(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list that gets each worker that starts."""
    started: list[Any] = []
    create = workers._Worker.__init__

    def counted(self: Any, numbers: int) -> None:
        started.append(self)
        create(self, numbers)

    monkeypatch.setattr(workers._Worker, "__init__", counted)
    return started


def test_killed_worker_leaves_the_log_unchanged(
    lab: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = _count_workers(monkeypatch)
    begin = workers._Worker.begin

    def begin_and_kill(self: Any, plan: PiecePlan) -> None:
        begin(self, plan)
        if self is started[1]:
            self.process.kill()

    monkeypatch.setattr(workers._Worker, "begin", begin_and_kill)
    before = lab.read_bytes()
    done = ipsys("detect", lab, "--jobs", "2")
    assert done.code == 1
    assert "a worker process has ended by signal 9" in done.err
    assert "--jobs" in done.err
    assert "Traceback" not in done.err
    assert lab.read_bytes() == before
    assert [worker.process.poll() for worker in started] == [-9, -9]
    monkeypatch.setattr(workers._Worker, "begin", begin)
    assert ipsys("detect", lab, "--jobs", "2").code == 0


def test_workers_start_only_for_a_missing_run(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They start before other work on the run, and end if this work fails."""
    started = _count_workers(monkeypatch)

    def interrupted() -> dict[str, str]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("ipsys_log.runs.execute.fingerprint", interrupted)
        with pytest.raises(KeyboardInterrupt):
            replay([lab], REQUEST, "detect", jobs=2)
    assert [worker.process.poll() for worker in started] == [-9, -9]
    for _ in range(2):
        replay([lab], REQUEST, "detect", jobs=2)
        assert len(started) == 4


def test_interrupt_ends_all_workers(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    started = _count_workers(monkeypatch)

    def interrupted(_: Sequence[Any]) -> list[Any]:
        raise KeyboardInterrupt

    monkeypatch.setattr(workers, "wait", interrupted)
    before = lab.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        replay([lab], REQUEST, "detect", jobs=2)
    assert lab.read_bytes() == before
    assert [worker.process.poll() for worker in started] == [-9, -9]


@pytest.mark.parametrize(("cores", "most"), [(1, 16), (2, 16), (8, 32)])
def test_too_many_processes_are_refused(
    lab_log: Path, ipsys: Ipsys, cores: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(workers, "available_cores", lambda: cores)
    workers.check_jobs(most)
    done = ipsys("replay", lab_log, "--jobs", str(most + 1))
    assert done.code == 1
    assert f"--jobs {most + 1}: is too large" in done.err
    assert f"give {most} or fewer" in done.err


def test_too_many_workers_for_the_system_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """The workers before the failed one end."""
    started: list[workers._Worker] = []

    class Limited(workers._Worker):
        def __init__(self, numbers: int) -> None:
            if len(started) == 2:
                raise OSError(errno.EMFILE, "Too many open files")
            super().__init__(numbers)
            started.append(self)

    monkeypatch.setattr(workers, "_Worker", Limited)
    plan = _plan(_run(Path("log.mcap")), *(Piece("red", n, n + 1) for n in range(9)))
    text = r"only 2 of 9 worker processes can be started \(Too many open files\).*fewer processes with --jobs"
    with LocalWorkers(1000) as local, pytest.raises(IpsysError, match=text):
        list(local.compute(plan))
    assert [worker.process.poll() for worker in started] == [-9, -9]


def test_bug_in_a_worker_keeps_its_traceback(lab_log: Path) -> None:
    run = _run(lab_log)
    with LocalWorkers(2) as local, pytest.raises(KeyError) as bug:
        list(local.compute(_plan(run, Piece("nobody", 0, 1))))
    assert "in compute_piece" in "".join(bug.value.__notes__)


def test_log_that_disappears_is_an_error_of_one_line(lab: Path) -> None:
    run = _run(lab)
    lab.unlink()
    with LocalWorkers(2) as local, pytest.raises(IpsysError, match=r"lab\.mcap"):
        list(local.compute(_plan(run, Piece("red", 0, 1))))


def test_log_that_is_replaced_is_an_error_of_one_line(lab_log: Path, tmp_path: Path) -> None:
    """The results of another log would come into a run that names the first one as its input."""
    log = Path(shutil.copy(lab_log, tmp_path / "lab.mcap"))
    run = _run(log)
    Path(shutil.copy(lab_log, tmp_path / "other.mcap")).rename(log)
    with LocalWorkers(2) as local, pytest.raises(IpsysError, match=r"lab\.mcap changed while it was read"):
        list(local.compute(_plan(run, Piece("red", 0, 1))))


def test_worker_ends_with_the_process_that_started_it(lab_log: Path) -> None:
    """The end of that process closes all its pipes."""
    taken, offered = os.pipe()
    worker = workers._Worker(taken)
    os.close(taken)
    worker.begin(_plan(_run(lab_log), Piece("red", 0, 1), Piece("red", 1, 2)))
    os.write(offered, (1).to_bytes(4, "little"))
    number, result = worker.receive()
    assert (number, result.frames) == (1, [])
    worker.close()
    os.close(offered)
    assert worker.process.wait(PATIENCE_S) == 0


def _run(log: Path) -> PieceRun:
    parameters = {"corners": "stock"}
    versions: tuple[object, ...] = ()
    if log.exists():
        with LogReader(log) as reader:
            versions = (reader.view.identity()[1],)
    return PieceRun(
        paths=(log,), stage="detect", parameters=parameters, topics=(), lenses={}, versions=versions
    )


def _plan(run: PieceRun, *pieces: Piece) -> PiecePlan:
    none = np.empty(0, np.int64)
    return PiecePlan(run, PieceFrames(("red",), none, none), list(pieces))


def test_results_wait_for_at_most_some_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """While the first result is not used, only a limited number of later pieces is computed."""
    taken: list[int] = []
    _pretend(monkeypatch, taken)
    with LocalWorkers(2) as local:
        results = local.compute(_plan(_run(Path("log.mcap")), *(Piece("red", n, n + 1) for n in range(100))))
        next(results)
        offered = os.read(local._numbers[0], 1000)
        assert len(taken) + len(offered) // 4 == 5
        os.write(local._numbers[1], offered)
        assert sum(1 for _ in results) == 99
    assert taken == list(range(100))


def test_slow_worker_leaves_all_other_pieces_to_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pieces are not distributed in advance: at the end, one worker would wait for the other."""
    taken: list[int] = []
    _pretend(monkeypatch, taken, slow=0)
    plan = _plan(_run(Path("log.mcap")), *(Piece("red", n, n + 1) for n in range(5)))
    with LocalWorkers(2) as local:
        places: list[Any] = list(local.compute(plan))
    assert places == [1, 1, 1, 1, 1]


def test_worker_computes_while_its_result_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """The result is larger than the pipe: without a thread of its own, its sending stops the worker."""
    computed = threading.Event()

    def answers(_run: Any, _pieces: Any, numbers: int) -> Iterator[Any]:
        yield bytes(1 << 24)
        computed.set()
        os.read(numbers, 4)

    with _served(monkeypatch, answers) as ours:
        assert computed.wait(PATIENCE_S)
        assert len(ours.recv()) == 1 << 24


def test_result_that_cannot_be_sent_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process that waits for the last result of a worker must get an answer."""

    def answers(_run: Any, _pieces: Any, numbers: int) -> Iterator[Any]:
        yield threading.Lock()
        os.read(numbers, 4)

    with _served(monkeypatch, answers) as ours:
        assert ours.poll(PATIENCE_S)
        failure = ours.recv()
        assert "cannot pickle" in str(failure.error)
        assert "Traceback" in failure.trace


@contextmanager
def _served(
    monkeypatch: pytest.MonkeyPatch, answers: Callable[[Any, Any, int], Iterator[Any]]
) -> Iterator[Connection]:
    """Serve answers in a thread; yield the end of the pipe that has no place for a large one."""
    monkeypatch.setattr(workers, "_answers", answers)
    ours, theirs = multiprocessing.Pipe()
    taken, offered = os.pipe()

    def serve() -> None:
        with suppress(EOFError, ConnectionError):
            workers._serve(theirs, theirs, taken)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        ours.send(("the run", "its pieces"))
        yield ours
    finally:
        ours.close()
        os.close(offered)
        thread.join()
        theirs.close()
        os.close(taken)


def _pretend(monkeypatch: pytest.MonkeyPatch, taken: list[int], slow: int | None = None) -> None:
    """Replace the processes by objects that take a piece when their result is wanted.

    The result of a piece is the place of its worker. A ``slow`` worker has no result.
    """
    started: list[Any] = []

    class Pretended:
        def __init__(self, numbers: int) -> None:
            self.numbers, self.receiver = numbers, self
            started.append(self)

        def begin(self, _plan: PiecePlan) -> None: ...

        def receive(self) -> Any:
            taken.append(int.from_bytes(os.read(self.numbers, 4), "little"))
            return taken[-1], started.index(self)

        def stop(self) -> None: ...

    monkeypatch.setattr(workers, "_Worker", Pretended)
    ready = [worker for worker in (0, 1) if worker != slow][:1]
    monkeypatch.setattr(workers, "wait", lambda receivers: [receivers[n] for n in ready])
