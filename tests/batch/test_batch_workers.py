"""Batches with real workers: the bytes of the single command, killed workers, a full disk, a scheduler."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from ipsys_log.api import python_api as api
from ipsys_log.api.batch.log_work import replay_log
from ipsys_log.exchange.row_files import read_rows
from ipsys_log.tools.soundness.finding import BROKEN
from tests.batch.works import HELD, PATIENCE_S, batch, one_worker_killed, read_json, wait_for
from tests.conftest import ROOT, small_disk

pytestmark = pytest.mark.slow
pytest.importorskip("distributed", reason="no Dask: pip install 'ipsys_log[batch]'")

PAPER_LAB = ROOT / "sample_logs" / "paper_lab.mcap"


def copies(folder: Path, *names: str) -> list[Path]:
    """Return copies of a sample log with markers, in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    return [Path(shutil.copy(PAPER_LAB, folder / name)) for name in names]


@pytest.fixture(scope="module")
def replayed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Return the bytes of the log after the single command."""
    (log,) = copies(tmp_path_factory.mktemp("single"), "log.mcap")
    api.replay(log, models=("rigid",))
    return log.read_bytes()


def drive(logs: list[Path], notes: Path, **workers: object) -> dict[str, Any]:
    """Run the work of the tests on logs in a separate process; return the results by name, or the error."""
    notes.mkdir(exist_ok=True)
    request = {"logs": logs, "notes": notes, "workers": workers}
    done = subprocess.run(
        [sys.executable, "-m", "tests.batch.driver", json.dumps(request, default=str)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout)
    if "error" in answer:
        return answer
    return {Path(result["log"]).name: result for result in answer["results"]}


def test_logs_have_the_bytes_of_the_single_command(tmp_path: Path, replayed: bytes) -> None:
    logs = copies(tmp_path / "logs", *(f"{number}.mcap" for number in range(4)))
    broken = tmp_path / "logs" / "broken.mcap"
    broken.write_bytes(PAPER_LAB.read_bytes()[:100_000])
    command = ("replay", "logs", "--model", "rigid", "--workers", 2, "--table", "results.parquet")
    code, result, errors = batch(tmp_path, *command)
    assert code == 1
    assert "dashboard: http://127.0.0.1:" in errors
    assert [log.read_bytes() == replayed for log in logs] == [True] * 4
    assert result["states"] == {"computed": 4, "failed": 1}
    (failure,) = (row for row in result["results"] if not row["good"])
    assert failure["log"] == "logs/broken.mcap"
    assert "has no end" in failure["text"]
    assert broken.read_bytes() == PAPER_LAB.read_bytes()[:100_000]
    rows = {row["log"]: row["state"] for row in read_rows(tmp_path / "results.parquet")[1]}
    assert rows == {row["log"]: row["state"] for row in result["results"]}
    # The next call does only what is missing.
    broken.unlink()
    (new,) = copies(tmp_path / "logs", "new.mcap")
    code, result, _ = batch(tmp_path, *command)
    assert (code, result["states"]) == (0, {"up to date": 4, "computed": 1})
    assert new.read_bytes() == replayed


def test_killed_worker_costs_no_log(tmp_path: Path, replayed: bytes) -> None:
    """A log whose worker ends by kill -9 in its middle is repeated."""
    logs = copies(tmp_path / "logs", "0.mcap", HELD, "1.mcap")
    with one_worker_killed(tmp_path / "notes"):
        results = drive(logs, tmp_path / "notes", workers=2)
    assert [name for name, result in results.items() if not result["good"]] == []
    assert [log.name for log in logs if log.read_bytes() != replayed] == []


def test_interrupt_ends_all_workers_and_keeps_whole_logs(tmp_path: Path) -> None:
    """Send Ctrl-C to all processes of the batch, as a terminal does."""
    logs = copies(tmp_path, *(f"{number}.mcap" for number in range(24)))
    process = subprocess.Popen(
        [sys.executable, "-m", "ipsys_log", "batch", "replay", *map(str, logs), "--workers", "2"],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline().startswith("dashboard: ")
    os.killpg(process.pid, signal.SIGINT)
    errors = process.communicate(timeout=PATIENCE_S)[1]
    if process.returncode == 0:
        pytest.skip("the batch was faster than the signal")
    assert process.returncode == 128 + signal.SIGINT
    line = "ipsys: interrupted; complete results are kept; nothing else is changed"
    assert line in errors.splitlines()
    assert "KeyboardInterrupt" not in errors
    assert all(result.state != BROKEN for result in api.check(*logs))


def test_full_disk_on_one_worker_leaves_its_log_whole(tmp_path: Path, replayed: bytes) -> None:
    with small_disk(tmp_path / "small", 1) as small:
        (full,) = copies(small, "full.mcap")
        room = shutil.disk_usage(small).free
        (small / "filler").write_bytes(bytes(max(room - 100_000, 0)))
        logs = [full, *copies(tmp_path / "logs", "a.mcap", "b.mcap")]
        results = drive(logs, tmp_path / "notes", workers=2)
        failed = results.pop("full.mcap")
        assert (failed["state"], "No space left" in failed["text"]) == ("failed", True), failed
        assert api.check(full)[0].state != BROKEN
        assert all(result["good"] for result in results.values())
        assert [log.read_bytes() == replayed for log in logs[1:]] == [True, True]
        # With room, the next call completes it.
        (small / "filler").unlink()
        assert replay_log(full, models=("rigid",)).good


@contextmanager
def program(*arguments: object, **environment: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a program of Dask until the end of the block."""
    process = subprocess.Popen(
        # The metadata of a package in the working directory would come before those of PYTHONPATH.
        [sys.executable, "-P", "-m", *map(str, arguments)],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def certificates(folder: Path) -> list[object]:
    """Write the certificates of a new authority into a new folder; return the options that name them."""
    from distributed import Security

    folder.mkdir()
    security = Security.temporary()
    options: list[object] = []
    for name, text in (
        ("ca", security.tls_ca_file),
        ("cert", security.tls_client_cert),
        ("key", security.tls_client_key),
    ):
        (folder / f"{name}.pem").write_text(str(text))
        options += [f"--tls-{name}", folder / f"{name}.pem"]
    return options


class Cluster(NamedTuple):
    """A scheduler with a worker: its address, the options of a command for it, and its process."""

    address: str
    options: list[object]
    scheduler: subprocess.Popen[bytes]


@contextmanager
def cluster(folder: Path, **environment: str) -> Iterator[Cluster]:
    """Run a scheduler with certificates and a worker."""
    options = certificates(folder)
    programs = ["--tls-ca-file", *options[1:]]
    state = folder / "scheduler.json"
    listen = ("--host", "tls://127.0.0.1", "--no-dashboard")
    with (
        program(
            "distributed.cli.dask_scheduler", *listen, "--port", 0, "--scheduler-file", state, *programs
        ) as scheduler,
        program(
            *("distributed.cli.dask_worker", "--scheduler-file", state, "--nthreads", 1, "--no-nanny"),
            *("--no-dashboard", "--host", "127.0.0.1", "--protocol", "tls", *programs),
            **environment,
        ),
    ):
        yield Cluster(read_json(state)["address"], options, scheduler)


def test_workers_of_a_scheduler_with_certificates_are_used(tmp_path: Path, replayed: bytes) -> None:
    copies(tmp_path, "a.mcap", "b.mcap")
    with cluster(tmp_path / "cluster") as (address, options, _):
        logs = (tmp_path / "a.mcap", tmp_path / "b.mcap")
        # The working directory of the worker is another one.
        code, result, _ = batch(
            tmp_path, "replay", "a.mcap", "b.mcap", "--model", "rigid", "--scheduler", address, *options
        )
        assert (code, result["states"]) == (0, {"computed": 2})
        assert [log.read_bytes() == replayed for log in logs] == [True, True]
        # Other certificates are refused in one line.
        others = certificates(tmp_path / "strangers")
        code, result, errors = batch(tmp_path, "check", *logs, "--scheduler", address, *others)
        assert (code, result) == (1, None)
        (line,) = (line for line in errors.splitlines() if line.startswith("ipsys: "))
        assert line.startswith(f"ipsys: --scheduler {address}: cannot be reached")


def test_worker_of_another_version_is_refused_before_any_work(tmp_path: Path) -> None:
    (log,) = copies(tmp_path, "a.mcap")
    old = tmp_path / "old" / "ipsys_log-0.0.9.dist-info"
    old.mkdir(parents=True)
    (old / "METADATA").write_text("Metadata-Version: 2.1\nName: ipsys_log\nVersion: 0.0.9\n")
    with cluster(tmp_path / "cluster", PYTHONPATH=f"{tmp_path / 'old'}:{ROOT}") as (address, options, _):
        code, result, errors = batch(tmp_path, "replay", log, "--scheduler", address, *options)
    assert (code, result) == (1, None)
    # If the worker comes after the start, its first task refuses.
    assert re.search(r"has ipsys 0\.0\.9, but (this|the batch) is (of )?ipsys 0\.1", errors)
    assert "install one version everywhere" in errors
    assert log.read_bytes() == PAPER_LAB.read_bytes()


def test_scheduler_that_stops_ends_the_batch_and_keeps_results(tmp_path: Path, replayed: bytes) -> None:
    logs = copies(tmp_path / "logs", "0.mcap", HELD, "1.mcap")
    notes = tmp_path / "notes"
    with cluster(tmp_path / "cluster") as (address, options, scheduler):

        def stop() -> None:
            wait_for(notes / "pid")
            scheduler.kill()

        stopper = threading.Thread(target=stop)
        stopper.start()
        ca, cert, key = options[1::2]
        answer = drive(logs, notes, scheduler=address, tls_ca=ca, tls_cert=cert, tls_key=key)
        stopper.join()
    assert re.search(r"was lost; .* repeat the command", answer["error"])
    assert logs[0].read_bytes() == replayed
    # The next call does what is missing.
    assert [replay_log(log, models=("rigid",)).state for log in logs] == ["up to date", *["computed"] * 2]
    assert [log.read_bytes() == replayed for log in logs] == [True] * 3
