"""Speed and memory of ``ipsys batch``: one worker against two, overhead for each log, memory of the driver.

    python benchmarks/batch.py
    python benchmarks/batch.py --batch-logs 8 --rounds 3

Speed: a running cluster of one worker and one of two take turns at the detection of the same logs, and so
does a loop in one process without Dask. Start and stop of a cluster are not in these times; they have rows of
their own. Processor time is that of the workers and of the driver with its scheduler.

Overhead: the wall time of a check of many small logs by one worker, less that of a loop in one process, for
each log. Both run once before, so that all imports are done.

Memory: the anonymous memory of the driver, with its scheduler, over batches of more and more tasks that
return at once.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from handling import Memory
from results import Report, command
from rounds import Row
from scenes import CACHE, drawn

from ipsys_log.api.batch.execution import run_batch
from ipsys_log.api.batch.log_work import check_log, replay_log
from ipsys_log.api.batch.tasks import BatchTask, LogResult, perform
from ipsys_log.api.batch.workers import Workers, WorkerSettings, open_workers
from ipsys_log.capture.simulation.settings import LabSettings

__all__ = ["Spent", "lap", "measure", "ratios"]

_SMALL_LOG = Path(__file__).resolve().parent.parent / "sample_logs" / "paper_lab.mcap"
_SCENE = LabSettings(width=960, height=540, stations=12, frames_per_station=2, rate_hz=15.0, drive_s=3.0)
_SMOKE = LabSettings(width=480, height=270, stations=2, frames_per_station=1, rate_hz=5.0, drive_s=0.4)
_TASKS = (100, 1_000, 10_000)


@dataclass(frozen=True, slots=True)
class Spent:
    """Wall time, and processor time of all processes of a cluster, in s."""

    wall_s: float
    cpu_s: float


def return_at_once(path: Path) -> LogResult:
    return LogResult(str(path), "computed")


def lap(task: BatchTask, logs: Sequence[Path], workers: Workers | None) -> Spent:
    """Do a task on logs by workers, or in this process."""
    wall_s, cpu_s = time.perf_counter(), _cpu_s(workers)
    results = run_batch(workers, task, logs) if workers else (perform(task, log) for log in logs)
    failures = [result for result in results if not result.good]
    assert not failures, failures[0]
    return Spent(time.perf_counter() - wall_s, _cpu_s(workers) - cpu_s)


def _cpu_s(workers: Workers | None) -> float:
    of_workers: dict[str, float] = workers.client.run(time.process_time) if workers else {}
    return time.process_time() + sum(of_workers.values())


def _copies(source: Path, folder: Path, count: int) -> list[Path]:
    folder.mkdir()
    return [Path(shutil.copy(source, folder / f"{number:05}.mcap")) for number in range(count)]


def _speed(folder: Path, options: argparse.Namespace, report: Report) -> None:
    count = 2 if options.smoke else options.batch_logs
    source = drawn(_SMOKE if options.smoke else _SCENE)
    task = BatchTask(replay_log, {"until": "detect"})
    laps: dict[str, list[Spent]] = {"loop": [], "one": [], "two": []}
    begin_s = time.perf_counter()
    with open_workers(WorkerSettings(workers=1), 2) as one, open_workers(WorkerSettings(workers=2), 2) as two:
        report.rows.append(Row("start of clusters of 1 and 2", (time.perf_counter() - begin_s,), "s"))
        for number in range(-1, options.rounds):
            for name, workers in (("loop", None), ("one", one), ("two", two)):
                logs = _copies(source, folder / f"{name}{number}", 2 if number < 0 else count)
                spent = lap(task, logs, workers)
                shutil.rmtree(folder / f"{name}{number}")
                if number >= 0:  # the first turn imports
                    laps[name].append(spent)
        begin_s = time.perf_counter()
    report.rows.append(Row("stop of both", (time.perf_counter() - begin_s,), "s"))
    size = source.stat().st_size
    report.remarks.append(f"detection of {count} logs of {size / 1e6:.1f} MB, 960 x 540")
    report.rows[:0] = [
        Row("wall: one worker / two", ratios(laps, "one", "two", "wall_s"), wanted=(">=", 1.85)),
        Row(
            "wall: one worker / loop without Dask",
            ratios(laps, "one", "loop", "wall_s"),
            wanted=("<=", 1.05),
        ),
        Row("processor: one worker / loop", ratios(laps, "one", "loop", "cpu_s")),
        Row("processor: two workers / one", ratios(laps, "two", "one", "cpu_s")),
    ]
    report.details = {
        name: {"wall_s": [lap.wall_s for lap in of], "cpu_s": [lap.cpu_s for lap in of]}
        for name, of in laps.items()
    }


def ratios(laps: dict[str, list[Spent]], over: str, under: str, value: str) -> tuple[float, ...]:
    pairs = zip(laps[over], laps[under], strict=True)
    return tuple(getattr(a, value) / getattr(b, value) for a, b in pairs)


def _overhead(folder: Path, options: argparse.Namespace, report: Report) -> None:
    logs = _copies(_SMALL_LOG, folder / "small", 4 if options.smoke else options.small_logs)
    task = BatchTask(check_log)
    walls_s, cpus_s = [], []
    with open_workers(WorkerSettings(workers=1), 2) as workers:
        for number in range(-1, options.rounds):
            loop = lap(task, logs[:2] if number < 0 else logs, None)
            batch = lap(task, logs[:2] if number < 0 else logs, workers)
            if number >= 0:
                walls_s.append(1000 * (batch.wall_s - loop.wall_s) / len(logs))
                cpus_s.append(1000 * (batch.cpu_s - loop.cpu_s) / len(logs))
    report.rows.append(
        Row(f"overhead on {len(logs)} small logs, wall", tuple(walls_s), "ms/log", ("<=", 100.0))
    )
    report.rows.append(Row("the same, processor", tuple(cpus_s), "ms/log"))


def _memory(options: argparse.Namespace, report: Report) -> None:
    task = BatchTask(return_at_once)
    with open_workers(WorkerSettings(workers=1), 2) as workers:
        for count in _TASKS[:1] if options.smoke else _TASKS:
            logs = [Path(f"/none/{number:05}.mcap") for number in range(count)]
            with Memory() as memory:
                results = list(run_batch(workers, task, logs))
            assert len(results) == count
            report.rows.append(Row(f"driver, {count} logs", (memory.most_mb,), "MB", ("<=", 500.0)))


def measure(options: argparse.Namespace) -> Report:
    """Measure speed, overhead and memory."""
    report = Report("batch")
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as name:
        folder = Path(name)
        _speed(folder, options, report)
        _overhead(folder, options, report)
        _memory(options, report)
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--batch-logs", type=int, default=8, help="number of logs for the speed")
    parser.add_argument("--small-logs", type=int, default=200, help="number of logs for the overhead")


if __name__ == "__main__":
    command("batch")
