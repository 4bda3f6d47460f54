"""The options of a batch: settings, paths, names of files, and the number of workers."""

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pandas as pd
import pytest

from ipsys_log.api.batch.log_work import plan_exports
from ipsys_log.api.batch.tasks import BatchTask, LogResult, perform
from ipsys_log.api.batch.workers import WorkerSettings, most_tasks, open_workers
from ipsys_log.app.cli import batch as batch_command
from ipsys_log.app.cli.signals import Interrupted
from ipsys_log.app.report.batch import write_results
from ipsys_log.errors import IpsysError
from ipsys_log.log.location import LogLocation, LogUrl
from ipsys_log.log.log_files import expand_folders
from tests.conftest import ROOT, Ipsys

distributed = pytest.importorskip("distributed", reason="no Dask: pip install 'ipsys_log[batch]'")


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
        (["logs", "--model-from", "none.mcap"], "none.mcap does not exist"),
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


def test_workers_of_a_scheduler_get_absolute_paths(
    tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have other working directories; a URL is the same everywhere."""
    monkeypatch.chdir(tmp_path)
    for name in ("a.mcap", "model.mcap"):
        Path(name).write_bytes(b"")
    given: list[tuple[BatchTask, list[LogLocation]]] = []

    def collect(task: BatchTask, paths: list[LogLocation], _settings: WorkerSettings) -> list[LogResult]:
        given.append((task, paths))
        return [LogResult(str(path), "computed") for path in paths]

    monkeypatch.setattr("ipsys_log.app.cli.batch._collect", collect)
    for model in ("model.mcap", "http://127.0.0.1:1/model.mcap"):
        logs = ("a.mcap", "http://127.0.0.1:1/b.mcap")
        done = ipsys("batch", "replay", *logs, "--model-from", model, "--scheduler", "tls://127.0.0.1:1")
        assert done.code == 0, done.err
        assert given[-1][1] == [tmp_path / "a.mcap", LogUrl("http://127.0.0.1:1/b.mcap")]
    assert [task.options["model_from"] for task, _ in given] == [tmp_path / "model.mcap", LogUrl(model)]
    assert all(task.options["folder"] == tmp_path for task, _ in given)


def test_long_log_has_all_workers_and_a_short_one_has_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[int] = []

    def start(n_workers: int, **_: object) -> None:
        started.append(n_workers)
        raise IpsysError("no worker in this test")

    monkeypatch.setattr(distributed, "LocalCluster", start)
    short, long = tmp_path / "short.mcap", tmp_path / "long.mcap"
    short.write_bytes(b"")
    with long.open("wb") as file:
        file.truncate(100 << 20)
    for logs in ([short], [short, short], [long], [LogUrl("s3://lab/a.mcap")]):
        with (
            pytest.raises(IpsysError, match="no worker"),
            open_workers(WorkerSettings(workers=5), most_tasks(logs)),
        ):
            pass
    assert started == [1, 2, 5, 5]


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
        return [perform(task.of_log(path), path) for path in paths]

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


WISHES: dict[str, Any] = {"table": "tracks", "run": None, "robot": None}


def files(logs: list[LogLocation], folder: Path) -> list[str]:
    """Return the files of an export below its folder."""
    targets = plan_exports(logs, folder, format="csv", **WISHES)
    return [str(target.relative_to(folder)) for target in targets.values()]


def test_exports_keep_the_folders_below_the_named_one(tmp_path: Path) -> None:
    for name in ("a.mcap", "mon/lab.mcap", "tue/lab.mcap", "tue/am/lab.mcap"):
        (tmp_path / "logs" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "logs" / name).write_text(name)
    below = ["a.csv", "mon/lab.csv", "tue/am/lab.csv", "tue/lab.csv"]
    assert files([tmp_path / "logs"], tmp_path / "out") == below
    assert files([tmp_path / "logs" / "tue"], tmp_path / "out") == ["am/lab.csv", "lab.csv"]
    assert files([tmp_path / "logs" / "tue/am/lab.mcap"], tmp_path / "out") == ["lab.csv"]
    # A shell gives the files of a pattern one by one.
    named: list[LogLocation] = [*sorted((tmp_path / "logs").glob("*/lab.mcap"))]
    assert files([*named, tmp_path / "logs/a.mcap"], tmp_path / "out") == [
        "mon/lab.csv",
        "tue/lab.csv",
        "a.csv",
    ]


def test_exports_of_urls_keep_the_folders_below_the_pattern(tmp_path: Path) -> None:
    pattern = "s3://lab/2026-*/*.mcap"
    logs: list[LogLocation] = [LogUrl(pattern, f"lab/2026-{day}/run.mcap") for day in ("05", "06")]
    assert files(logs, tmp_path) == ["2026-05/run.csv", "2026-06/run.csv"]
    two: list[LogLocation] = [LogUrl("s3://north/run.mcap"), LogUrl("s3://south/run.mcap")]
    assert files(two, tmp_path) == ["north/run.csv", "south/run.csv"]
    outside: list[LogLocation] = [LogUrl("s3://lab/../../run.mcap"), LogUrl("s3://lab/run.mcap")]
    with pytest.raises(IpsysError, match="would both be exported"):
        files(outside, tmp_path)


def test_exports_that_would_have_one_file_are_refused(tmp_path: Path) -> None:
    logs: list[LogLocation] = [Path("a/monday.mcap"), Path("a/monday.MCAP")]
    with pytest.raises(
        IpsysError, match=r"a/monday.mcap and a/monday.MCAP would both be exported to .*monday.csv"
    ):
        files(logs, tmp_path)
    with pytest.raises(IpsysError, match="--format xlsx: is not known"):
        plan_exports(logs, tmp_path, format="xlsx", **WISHES)


def test_logs_of_one_name_are_exported_to_distinct_files(
    tmp_path: Path, ipsys: Ipsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("mon", "tue"):
        Path("logs", name).mkdir(parents=True)
        shutil.copy(ROOT / "sample_logs" / "paper_lab.mcap", Path("logs", name, "lab.mcap"))

    def perform_here(task: BatchTask, paths: list[Path], _: WorkerSettings) -> list[LogResult]:
        return [perform(task.of_log(path), path) for path in paths]

    monkeypatch.setattr(batch_command, "_collect", perform_here)
    done = ipsys("batch", "export", "logs", "-o", "out", "--channel", "measurements", "--json")
    assert done.code == 0, done.out
    tables = [Path("out", name, "lab.csv").read_bytes() for name in ("mon", "tue")]
    assert tables[0] == tables[1]
    assert sorted(path.name for path in Path("out").iterdir()) == ["mon", "tue"]


@pytest.mark.parametrize("scheduler", [None, "tls://head:8786"])
def test_interrupt_says_what_workers_of_a_scheduler_do(
    scheduler: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers of this machine end with the command; those of a scheduler go on with their logs."""

    @contextmanager
    def open_none(*_: object) -> Iterator[Any]:
        yield SimpleNamespace(dashboard="")

    def interrupt(*_: object) -> None:
        raise Interrupted(130, "interrupted")

    monkeypatch.setattr("ipsys_log.api.batch.workers.open_workers", open_none)
    monkeypatch.setattr(batch_command, "say", interrupt)
    log = Path(shutil.copy(ROOT / "sample_logs/paper_lab.mcap", tmp_path))
    with pytest.raises(Interrupted) as interrupted:
        batch_command._collect(BatchTask(perform, {}), [log], WorkerSettings(scheduler))
    assert ("nothing else is changed" in interrupted.value.text) == (scheduler is None)
    assert ("complete the logs that they have begun" in interrupted.value.text) == (scheduler is not None)
