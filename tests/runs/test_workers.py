"""Worker processes: the same bytes with any number of them, and their ends, killed or interrupted."""

import errno
import multiprocessing.connection
import shutil
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.engine import pieces, workers
from ipsys_log.engine.output import append_messages
from ipsys_log.engine.pieces import Piece, PieceFrames, PiecePlan, PieceRun
from ipsys_log.engine.request import Request
from ipsys_log.engine.workers import LocalWorkers
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import Message
from tests.conftest import Ipsys
from tests.publish.packs import write_points_log

pytestmark = pytest.mark.slow  # each process imports the package

REQUEST = Request(parameters={"reset_s": "2"})
MODELS = Request(models=("rigid", "poly", "rigid+poly", "kriging"))
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


def test_evaluations_of_several_models_have_the_same_bytes_for_any_number_of_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started, logs = _count_workers(monkeypatch), []
    monkeypatch.setattr(workers, "wait", newest_worker_first)
    for jobs in (1, 2, 3):
        logs.append(write_points_log(tmp_path / f"{jobs}.mcap"))
        replay([logs[-1]], MODELS, "evaluate", jobs=jobs)
        replay([logs[-1]], MODELS, "evaluate", jobs=jobs)  # it is complete: no worker starts
    assert len(started) == 0 + 2 + 3
    assert len({log.read_bytes() for log in logs}) == 1


def test_evaluation_does_not_use_what_a_worker_has_read_before_a_change(tmp_path: Path) -> None:
    logs = [write_points_log(tmp_path / f"{jobs}.mcap") for jobs in (1, 2)]

    def withdraw(log: Path, step: str, done: int, _total: int | None) -> None:
        if (step, done) == ("models", 1):
            with Session([log]) as session:
                end_ns, first = session.end_ns, session.payloads(["/measurements"])[1]
            gone = replace(first, timestamp=end_ns, id="w", withdraws=first.id, splits=())
            append_messages(log, [Message("/measurements", end_ns + 1, end_ns, gone)])

    for jobs, log in enumerate(logs, 1):
        replay([log], MODELS, "evaluate", progress=partial(withdraw, log), jobs=jobs)
    assert logs[0].read_bytes() == logs[1].read_bytes()


def test_interrupt_keeps_the_models_that_are_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = write_points_log(tmp_path / "lab.mcap")
    results: list[Sequence[Any]] = []

    def interrupted_later(receivers: Sequence[Any]) -> list[Any]:
        if len(results) == 2:
            raise KeyboardInterrupt
        results.append(receivers)
        return [_wait(receivers)[0]]

    monkeypatch.setattr(workers, "wait", interrupted_later)
    with pytest.raises(KeyboardInterrupt):
        replay([log], MODELS, "evaluate", jobs=2)
    with Session([log]) as session:
        done = [run.run for run in session.runs() if run.stage == "evaluate"]
    assert 1 <= len(done) < len(MODELS.models)
    assert done == list(MODELS.models[: len(done)])


def _count_workers(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return a list that gets each worker that starts."""
    started: list[Any] = []
    create = workers._Worker.__init__

    def counted(self: Any) -> None:
        started.append(self)
        create(self)

    monkeypatch.setattr(workers._Worker, "__init__", counted)
    return started


def _kill_at_begin(monkeypatch: pytest.MonkeyPatch, started: list[Any], places: set[int]) -> None:
    """Kill the workers that start at some places, when they get their run."""
    send = workers._Worker.send

    def send_and_kill(self: Any, message: object) -> None:
        send(self, message)
        if isinstance(message, tuple) and started.index(self) in places:
            self.process.kill()

    monkeypatch.setattr(workers._Worker, "send", send_and_kill)


def test_pieces_of_a_killed_worker_go_to_another_one(
    lab_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = [Path(shutil.copy(lab_log, tmp_path / f"{jobs}.mcap")) for jobs in (1, 2)]
    replay([logs[0]], REQUEST, "detect", jobs=1)
    started = _count_workers(monkeypatch)
    _kill_at_begin(monkeypatch, started, {1})
    replay([logs[1]], REQUEST, "detect", jobs=2)
    assert [worker.process.poll() for worker in started] == [-9, -9, -9]
    assert logs[0].read_bytes() == logs[1].read_bytes()


def test_piece_that_ends_all_its_workers_leaves_the_log_unchanged(
    lab: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    started = _count_workers(monkeypatch)
    before = lab.read_bytes()
    with monkeypatch.context() as patch:
        _kill_at_begin(patch, started, set(range(99)))
        done = ipsys("detect", lab, "--jobs", "2")
    assert done.code == 1
    assert "2 worker processes have ended by signal 9 in the piece of " in done.err
    assert "--jobs" in done.err
    assert "Traceback" not in done.err
    assert lab.read_bytes() == before
    assert {worker.process.poll() for worker in started} == {-9}
    assert ipsys("detect", lab, "--jobs", "2").code == 0


def test_workers_start_only_for_a_missing_run(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They start before other work on the run, and end if this work fails."""
    started = _count_workers(monkeypatch)

    def interrupted() -> dict[str, str]:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("ipsys_log.engine.execute.fingerprint", interrupted)
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
        def __init__(self) -> None:
            if len(started) == 2:
                raise OSError(errno.EMFILE, "Too many open files")
            super().__init__()
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


def test_worker_ends_with_its_pipe_in_the_middle_of_a_piece(lab_log: Path) -> None:
    """The end of the process that started it closes the pipe."""
    worker = workers._Worker()
    with LogReader(lab_log) as reader:
        start_ns, end_ns = reader.start_ns or 0, (reader.end_ns or 0) + 1
    worker.send((_run(lab_log), [Piece("red", 0, 1), Piece("red", start_ns, end_ns)]))
    worker.send(0)
    result = worker.receive()
    assert result is not None
    assert result.frames == []
    worker.send(1)
    worker.close()
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
        assert len(taken) == 5
        assert sum(1 for _ in results) == 99
    assert taken == list(range(100))


def test_slow_worker_leaves_almost_all_pieces_to_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """The pieces are not distributed in advance: at the end, one worker would wait for the other."""
    taken: list[int] = []
    _pretend(monkeypatch, taken, slow=0)
    plan = _plan(_run(Path("log.mcap")), *(Piece("red", n, n + 1) for n in range(1, 6)))
    with LocalWorkers(2) as local:
        results = local.compute(plan)
        places: list[Any] = [next(results) for _ in range(5)]
    assert places == [0, 1, 1, 1, 1]


def test_result_that_cannot_be_sent_is_an_error() -> None:
    """The process that waits for the last result of a worker must get an answer."""
    ours, theirs = multiprocessing.Pipe()
    workers._send(theirs, threading.Lock())
    assert ours.poll(PATIENCE_S)
    failure = ours.recv()
    assert "cannot pickle" in str(failure.error)
    assert "Traceback" in failure.trace


def _pretend(monkeypatch: pytest.MonkeyPatch, taken: list[int], slow: int | None = None) -> None:
    """Replace the processes by objects that have a result when it is wanted: the place of the worker.

    A ``slow`` worker has its result only if no other one has a piece.
    """
    started: list[Any] = []

    class Pretended:
        def __init__(self) -> None:
            self.pieces: deque[int] = deque()
            self.receiver = self
            started.append(self)

        def send(self, message: object) -> None:
            if isinstance(message, int):
                taken.append(message)

        def receive(self) -> Any:
            return started.index(self)

        def stop(self) -> None: ...

    def ready(_receivers: object) -> list[Any]:
        busy = [worker for worker in started if worker.pieces]
        fast = [worker for worker in busy if started.index(worker) != slow]
        return (fast or busy)[:1]

    monkeypatch.setattr(workers, "_Worker", Pretended)
    monkeypatch.setattr(workers, "wait", ready)
