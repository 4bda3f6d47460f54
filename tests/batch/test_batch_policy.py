"""The policy of a batch, with a simulated scheduler: window, ended workers, losses; and results of tasks."""

from __future__ import annotations

import errno
import json
import os
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ipsys_log.batch.execution import MOST_ENDED_WORKERS, run_batch
from ipsys_log.batch.exports import check_exports
from ipsys_log.batch.settings import WorkerSettings
from ipsys_log.batch.tasks import (
    BatchTask,
    LogPieces,
    LogResult,
    PieceState,
    VersionError,
    perform,
    perform_or_divide,
)
from ipsys_log.batch.workers import Workers
from ipsys_log.cli import batch as batch_command
from ipsys_log.errors import IpsysError, WriteError
from ipsys_log.log.log_files import expand_folders
from ipsys_log.report.batch import write_results
from ipsys_log.runs.piece_folder import PieceTask
from ipsys_log.runs.pieces import Piece, PieceRun
from tests.conftest import Ipsys

distributed = pytest.importorskip("distributed", reason="no Dask: pip install 'ipsys_log[batch]'")


class Future:
    """A future that is done when its scheduler says so."""

    def __init__(self, path: Path, piece: PieceTask | None) -> None:
        self.path, self.piece = path, piece
        self.answer: Any = None
        self.error: Exception | None = None
        self.callback: Callable[[Future], None] = lambda future: None

    def add_done_callback(self, callback: Callable[[Future], None]) -> None:
        self.callback = callback

    def result(self) -> Any:
        if self.error is not None:
            raise self.error
        return self.answer

    def release(self) -> None:
        """Do nothing: the scheduler has forgotten the future already."""


class Scheduler:
    """A scheduler whose workers end in the tasks of some logs, with all other tasks that run meanwhile.

    It repeats a task itself ``retries`` times before it reports the end of a worker. The logs in ``long``
    have this number of pieces, and the deadly ones among them end their workers in their first piece only.
    """

    def __init__(
        self,
        deadly: set[str],
        order: list[int],
        losses: int = 0,
        retries: int = 0,
        long: dict[str, int] | None = None,
        other_software: bool = False,
    ) -> None:
        self.deadly, self.order, self.losses, self.retries = deadly, order, losses, retries
        self.long, self.other_software = long or {}, other_software
        self.status, self.most = "running", 0
        self.running: list[Future] = []
        self.starts: Counter[str] = Counter()
        self.stored: set[tuple[str, int]] = set()
        self.forgets = False

    def submit(
        self, work: Any, _task: BatchTask, path: Path, piece: PieceTask | None = None, **_: Any
    ) -> Future:
        future = Future(path, piece)
        if piece is None:
            future.answer = self._answer(path, work is perform_or_divide)
        name = path.name if piece is None else f"{path.name}/{piece.key}"
        self.starts[name] += 1
        self.running.append(future)
        self.most = max(self.most, len(self.running))
        return future

    def _answer(self, path: Path, may_divide: bool) -> LogResult | LogPieces:
        count = self.long.get(path.name, 0) if may_divide else 0
        tasks = [n for n in range(count) if (path.name, n) not in self.stored]
        return (
            LogPieces(tuple(map(_piece, tasks))) if tasks else LogResult(str(path), "computed", pieces=count)
        )

    def advance(self) -> None:
        """End one task, or all of them if their worker ends."""
        place = self.order.pop() if self.order else 0
        future = self.running[place % len(self.running)]
        ended = [future]
        is_first = future.piece.key == "0" if future.piece else future.path.name not in self.long
        if future.path.name in self.deadly and is_first:
            ended = [*self.running]
            for one in ended:
                one.error = distributed.KilledWorker("task", SimpleNamespace(address="here"), self.retries)
        elif self.losses:
            self.losses -= 1
            future.error = distributed.CancelledError("lost")
        elif future.piece is not None:
            future.answer = PieceState(other_software=self.other_software)
            if not (self.other_software or self.forgets):
                self.stored.add((future.path.name, int(future.piece.key)))
        for one in ended:
            self.running.remove(one)
            one.callback(one)


def _piece(number: int) -> PieceTask:
    run = PieceRun(paths=(), stage="", parameters={}, topics=(), lenses={})
    return PieceTask(run, Piece("red", number, number + 1), str(number), Path("pieces"), {})


def run(
    scheduler: Scheduler, paths: list[Path], window: int, monkeypatch: pytest.MonkeyPatch
) -> dict[str, Any]:
    workers = Workers(scheduler, "tls://here", "", window)

    class Queue(list[Future]):
        put = list.append

        def get(self, timeout: float) -> Future:  # noqa: ARG002
            while not self:
                scheduler.advance()
            return self.pop(0)

    with monkeypatch.context() as patch:
        patch.setattr("ipsys_log.batch.execution.SimpleQueue", Queue)
        task = BatchTask(lambda path: LogResult("", ""), divides=True)
        results = list(run_batch(workers, task, paths))
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
    counts=st.lists(st.integers(0, 7), min_size=1, max_size=8),
    window=st.integers(1, 6),
    deadly=st.sets(st.integers(0, 7), max_size=2),
    order=st.lists(st.integers(0, 5), max_size=60),
    retries=st.sampled_from([0, 3]),
)
def test_deadly_piece_fails_only_its_log(
    counts: list[int], window: int, deadly: set[int], order: list[int], retries: int
) -> None:
    long = {f"{number}.mcap": count for number, count in enumerate(counts) if count}
    names = {f"{number}.mcap" for number in deadly if number < len(counts)}
    scheduler = Scheduler(names, order, retries=retries, long=long)
    with pytest.MonkeyPatch.context() as monkeypatch:
        results = run(
            scheduler, [Path(f"{number}.mcap") for number in range(len(counts))], window, monkeypatch
        )
    assert {name for name, result in results.items() if not result.good} == names
    assert all("in the piece of red" in results[name].text for name in names & long.keys())
    for name in long.keys() - names:
        assert {(name, number) for number in range(long[name])} <= scheduler.stored
    assert scheduler.most <= window


def test_pieces_of_a_log_run_once_and_on_all_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler(set(), [2, 0, 1, 2, 2], long={"a.mcap": 9})
    results = run(scheduler, [Path("a.mcap")], 3, monkeypatch)
    assert results["a.mcap"].pieces == 9
    assert scheduler.most == 3
    assert scheduler.starts == {"a.mcap": 2, **{f"a.mcap/{number}": 1 for number in range(9)}}


def test_log_is_one_task_if_workers_have_other_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler(set(), [], long={"a.mcap": 9}, other_software=True)
    results = run(scheduler, [Path("a.mcap")], 3, monkeypatch)
    assert (results["a.mcap"].state, results["a.mcap"].pieces) == ("computed", 0)


def test_pieces_that_others_cannot_see_fail_the_log(monkeypatch: pytest.MonkeyPatch) -> None:
    scheduler = Scheduler(set(), [], long={"a.mcap": 2})
    scheduler.forgets = True
    results = run(scheduler, [Path("a.mcap"), Path("b.mcap")], 2, monkeypatch)
    assert results["b.mcap"].good
    assert scheduler.starts["a.mcap"] == 4  # three divisions
    assert results["a.mcap"].text == (
        "its pieces are not in pieces: all workers must see this folder; use a shared file system"
    )


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
    with pytest.raises(IpsysError, match=r"tls://here was lost after 0 of 2 logs; .* repeat the command"):
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


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (WorkerSettings("tcp://10.0.0.1:8786"), "can run code on its workers; use tls:// with certificates"),
        (WorkerSettings("10.0.0.1:8786"), "is not encrypted"),
        (WorkerSettings("tls://head:1", workers=2), "--workers: the scheduler has its own workers"),
        (WorkerSettings("tls://head:1", tls_ca=Path("none.pem")), "--tls-ca none.pem: is not a file"),
        (WorkerSettings(insecure=True), "--insecure: has an effect only with --scheduler"),
        (WorkerSettings(tls_key=Path("key.pem")), "--tls-key: has an effect only with --scheduler"),
    ],
)
def test_settings_without_effect_or_protection_are_refused(settings: WorkerSettings, text: str) -> None:
    with pytest.raises(IpsysError) as caught:
        settings.check()
    assert text in str(caught.value)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["logs", "--model", "bst"], "model 'bst' is not known; use one of rigid, poly"),
        (["logs", "--memory-limit", "much"], "--memory-limit much: is not a size"),
        (["logs", "--memory-limit", "10MB"], "--memory-limit 10MB: a worker needs 256 MB or more"),
        (["logs", "--table", "rows.csv"], "--table rows.csv: the name must end in .parquet"),
        (["lgs"], "lgs does not exist"),
    ],
)
def test_wrong_options_are_refused_before_a_worker_starts(
    options: list[str], text: str, tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("logs").mkdir()
    Path("logs/a.mcap").write_bytes(b"")

    def start(**_: object) -> None:
        raise AssertionError("a worker is started")

    monkeypatch.setattr(distributed, "LocalCluster", start)
    done = ipsys("batch", "replay", *options)
    assert (done.code, done.out) == (1, "")
    assert done.err.startswith(f"ipsys: {text}")
    assert done.err.count("\n") == 1


def test_logs_are_named_once_and_folders_searched(tmp_path: Path) -> None:
    (tmp_path / "week" / "monday").mkdir(parents=True)
    for name in ("b.mcap", "week/monday/a.mcap", "week/c.mcap", "week/notes.txt"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "link.mcap").symlink_to(tmp_path / "b.mcap")
    (tmp_path / "hard.mcap").hardlink_to(tmp_path / "b.mcap")
    given_names = ("b.mcap", "week", "link.mcap", "hard.mcap", "none.mcap")
    found = expand_folders(tmp_path / name for name in given_names)
    assert [path.name for path in found] == ["b.mcap", "c.mcap", "a.mcap", "none.mcap"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(IpsysError, match="has no file that ends in"):
        expand_folders([tmp_path / "empty"])


def test_links_that_lead_nowhere_are_not_left_out(tmp_path: Path) -> None:
    """A log on a disk that is not mounted must not be missing without a word."""
    (tmp_path / "gone.mcap").symlink_to("nowhere")
    (tmp_path / "loop.mcap").symlink_to("loop.mcap")
    (tmp_path / "folder.mcap").mkdir()
    links = [tmp_path / "gone.mcap", tmp_path / "loop.mcap"]
    assert expand_folders([tmp_path, *links]) == links


@pytest.mark.parametrize("command", [("check",), ("export", "-o", "out")])
def test_link_without_a_file_fails_alone(
    command: tuple[str, ...], tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("logs").mkdir()
    Path("logs/gone.mcap").symlink_to("nowhere")
    Path("logs/text.mcap").write_text("no log")

    def perform_here(task: BatchTask, paths: list[Path], _: WorkerSettings) -> list[LogResult]:
        return [perform(task, path) for path in paths]

    monkeypatch.setattr(batch_command, "_collect", perform_here)
    done = ipsys("batch", command[0], "logs", *command[1:], "--json")
    texts = {row["log"]: row["text"] for row in json.loads(done.out)["results"]}
    assert texts["logs/gone.mcap"] == "does not exist"
    assert "is not an MCAP file" in texts["logs/text.mcap"]
    assert done.code == 1
    # A log that the user names must exist.
    done = ipsys("batch", command[0], "logs/gone.mcap", *command[1:])
    assert (done.code, done.err) == (1, "ipsys: logs/gone.mcap does not exist\n")


def test_table_names_files_that_are_not_utf_8(tmp_path: Path) -> None:
    name = os.fsdecode(b"red\xff.mcap")
    write_results(tmp_path / "rows.parquet", [LogResult(name, "failed", False, f"run: ipsys repair {name}")])
    (row,) = pd.read_parquet(tmp_path / "rows.parquet").to_dict("records")
    assert (row["log"], row["text"]) == ("red\\udcff.mcap", "run: ipsys repair red\\udcff.mcap")


def test_exports_that_would_have_one_file_are_refused(tmp_path: Path) -> None:
    wishes: dict[str, Any] = {"table": "tracks", "run": None, "robot": None}
    logs = [Path("a/monday.mcap"), Path("b/monday.mcap")]
    with pytest.raises(IpsysError, match=r"a/monday.mcap and b/monday.mcap have the same name"):
        check_exports(logs, tmp_path, format="csv", **wishes)
    assert check_exports(logs[:1], tmp_path, format="tum", **wishes) == ".tum"
    with pytest.raises(IpsysError, match="--format xlsx: is not known"):
        check_exports(logs, tmp_path, format="xlsx", **wishes)
