"""The policy of a batch, with a simulated scheduler: window, ended workers, losses; and results of tasks."""

from __future__ import annotations

import errno
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.api.batch.execution import MOST_ENDED_WORKERS, DaskPieces, run_batch
from ipsys_log.api.batch.tasks import (
    BatchTask,
    LogResult,
    OtherSoftwareError,
    VersionError,
    compute_alone,
    perform,
)
from ipsys_log.api.batch.workers import Workers
from ipsys_log.engine.pieces import Piece, PieceFrames, PiecePlan, PieceRun
from ipsys_log.errors import IpsysError, WriteError

distributed = pytest.importorskip("distributed", reason="no Dask: pip install 'ipsys_log[batch]'")


class Future:
    """A future that is done when its scheduler says so. Its work is on a log, or on a piece of a log."""

    def __init__(self, work: Path | Piece) -> None:
        self.work = work
        self.error: Exception | None = None
        self.callback: Callable[[Future], None] = lambda future: None

    @property
    def name(self) -> str:
        return self.work.name if isinstance(self.work, Path) else str(self.work.start_ns)

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        self.callback = callback

    def result(self) -> Any:
        if self.error is not None:
            raise self.error
        return LogResult(str(self.work), "computed") if isinstance(self.work, Path) else self.work

    def release(self) -> None:
        """Do nothing: the scheduler has forgotten the future already."""


class Scheduler:
    """A scheduler whose workers end in some tasks, with all other tasks that run meanwhile.

    It repeats a task itself ``retries`` times before it reports the end of a worker.
    """

    def __init__(self, deadly: set[str], order: list[int], losses: int = 0, retries: int = 0) -> None:
        self.deadly, self.order, self.losses, self.retries = deadly, order, losses, retries
        self.status, self.most = "running", 0
        self.running: list[Future] = []
        self.starts: Counter[str] = Counter()

    def submit(self, _work: Any, _task: Any, work: Path | Piece, *_: Any, **__: Any) -> Future:
        future = Future(work)
        self.starts[future.name] += 1
        self.running.append(future)
        self.most = max(self.most, len(self.running))
        return future

    def cancel(self, futures: list[Future]) -> None:
        self.running = [future for future in self.running if future not in futures]

    def advance(self) -> None:
        """End one task, or all of them if their worker ends."""
        place = self.order.pop() if self.order else 0
        future = self.running[place % len(self.running)]
        ended = [future]
        if future.name in self.deadly:
            ended = [*self.running]
            for one in ended:
                one.error = distributed.KilledWorker("task", SimpleNamespace(address="here"), self.retries)
        elif self.losses:
            self.losses -= 1
            future.error = distributed.CancelledError("lost")
        for one in ended:
            self.running.remove(one)
            one.callback(one)


def _queue_of(scheduler: Scheduler) -> type:
    """Return a queue whose reader lets the scheduler advance."""

    class Queue(list[Future]):
        put = list.append

        def get(self, timeout: float) -> Future:  # noqa: ARG002
            while not self:
                scheduler.advance()
            return self.pop(0)

    return Queue


def run(
    scheduler: Scheduler, paths: list[Path], window: int, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    workers = Workers(scheduler, "tls://here", "", window)
    with monkeypatch.context() as patch:
        patch.setattr("ipsys_log.api.batch.execution.SimpleQueue", _queue_of(scheduler))
        results = list(run_batch(workers, BatchTask(lambda path: LogResult("", "")), paths))
    assert sorted(result.log for result in results) == sorted(map(str, paths))
    return {Path(result.log).name: result for result in results}


@given(
    count=st.integers(1, 30),
    window=st.integers(1, 6),
    deadly=st.sets(st.integers(0, 29), max_size=3),
    order=st.lists(st.integers(0, 5), max_size=60),
    retries=st.sampled_from([0, 3]),
)
def test_only_logs_that_end_their_workers_fail(
    count: int, window: int, deadly: set[int], order: list[int], retries: int
) -> None:
    """Other logs that lose their worker at the same time are done, whatever the order."""
    names = {f"{number}.mcap" for number in deadly if number < count}
    scheduler = Scheduler(names, order, retries=retries)
    with pytest.MonkeyPatch.context() as monkeypatch:
        results = run(scheduler, [Path(f"{number}.mcap") for number in range(count)], window, monkeypatch)
    assert {name for name, result in results.items() if not result.good} == names
    assert all(scheduler.starts[name] * (retries + 1) >= MOST_ENDED_WORKERS for name in names)
    assert scheduler.most <= window


@given(
    count=st.integers(1, 12),
    window=st.integers(1, 6),
    order=st.lists(st.integers(0, 11), max_size=60),
    losses=st.integers(0, 2),
)
def test_pieces_come_in_order(count: int, window: int, order: list[int], losses: int) -> None:
    scheduler = Scheduler(set(), order, losses)
    shown: list[tuple[int, int]] = []
    assert compute(scheduler, count, window, shown) == list(range(count))
    assert scheduler.most <= 2 * window + 1
    assert sum(scheduler.starts.values()) == count + losses
    assert shown == [(number, count) for number in range(1, count + 1)]


def test_piece_that_ends_its_workers_is_named() -> None:
    scheduler = Scheduler({"2"}, [])
    with pytest.raises(IpsysError, match=r"its worker ended 4 times in the piece of red that begins at .*"):
        compute(scheduler, 5, 1, [])
    assert (scheduler.starts["2"], scheduler.running) == (4, [])


def test_worker_with_other_libraries_computes_no_piece() -> None:
    with pytest.raises(OtherSoftwareError, match="different versions: numpy"):
        compute_alone(_RUN, Piece("red", 0, 1), {"numpy": "0.1"})


_RUN = PieceRun(paths=(), stage="detect", parameters={"corners": "stock"}, topics=(), lenses={})


def compute(scheduler: Scheduler, count: int, window: int, shown: list[tuple[int, int]]) -> list[int]:
    """Compute pieces of one camera; return the numbers of the results in their order."""
    none = np.empty(0, np.int64)
    plan = PiecePlan(_RUN, PieceFrames(("red",), none, none), [Piece("red", n, n + 1) for n in range(count)])
    workers = Workers(scheduler, "tls://here", "", window)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ipsys_log.api.batch.execution.SimpleQueue", _queue_of(scheduler))
        results: Any = DaskPieces(workers, lambda done, total: shown.append((done, total))).compute(plan)
        return [piece.start_ns for piece in results]


def test_log_that_ends_four_workers_alone_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler({"bad.mcap"}, [])
    results = run(scheduler, [Path("bad.mcap"), Path("good.mcap")], 1, monkeypatch)
    assert results["good.mcap"].state == "computed"
    assert "its worker ended 4 times" in results["bad.mcap"].text
    assert scheduler.starts == {"bad.mcap": 4, "good.mcap": 1}


def test_tasks_that_the_scheduler_loses_run_again(monkeypatch: pytest.MonkeyPatch) -> None:
    results = run(Scheduler(set(), [], losses=2), [Path("a.mcap"), Path("b.mcap")], 2, monkeypatch)
    assert all(result.good for result in results.values())
    results = run(Scheduler(set(), [], losses=99), [Path("a.mcap")], 1, monkeypatch)
    assert "the scheduler lost its task 3 times" in results["a.mcap"].text


def test_lost_scheduler_ends_the_batch_with_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler(set(), [], losses=1)
    scheduler.status = "closed"
    with pytest.raises(IpsysError, match=r"tls://here was lost; .* repeat the command"):
        run(scheduler, [Path("a.mcap"), Path("b.mcap")], 1, monkeypatch)


def fail(path: Path, error: Exception) -> LogResult:
    raise error


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (IpsysError("a.mcap: has no rig\nsecond line"), "has no rig"),
        (OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), "the disk is full; free some space and try again"),
        (WriteError("a.mcap: the disk is full", OSError()), "the disk is full"),
        (PermissionError(errno.EACCES, "Permission denied", "b.csv"), "b.csv: Permission denied"),
        (MemoryError(), "the memory of the worker is full; use fewer workers, or a larger --memory-limit"),
    ],
)
def test_error_in_a_task_is_a_result_of_one_line(error: Exception, text: str) -> None:
    result = perform(BatchTask(fail, {"error": error}), Path("a.mcap"))
    assert (result.log, result.state, result.good, result.text) == ("a.mcap", "failed", False, text)
    assert result.trace == ""


def test_fault_of_the_program_keeps_its_traceback() -> None:
    result = perform(BatchTask(fail, {"error": ZeroDivisionError("by zero")}), Path("a.mcap"))
    assert result.text == "fault of ipsys: ZeroDivisionError: by zero"
    assert "in fail" in result.trace


def test_worker_of_another_version_refuses_with_both() -> None:
    with pytest.raises(VersionError, match=r"has ipsys 0.* the batch is of ipsys 9.8.7"):
        perform(BatchTask(fail, version="9.8.7"), Path("a.mcap"))
    versions = {**BatchTask(fail).stage_versions, "poly": 99}
    with pytest.raises(VersionError, match=r"has the stages poly 1, but the batch has poly 99"):
        perform(BatchTask(fail, stage_versions=versions), Path("a.mcap"))
