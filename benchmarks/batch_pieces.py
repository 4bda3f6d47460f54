"""One long log in a batch: one worker against two, overhead of the cluster, and memory of the workers.

    python benchmarks/batch_pieces.py --piece-frames 7200 --rounds 3

Detection in a log of three cameras of 960 x 540 at 30/s. Running clusters of one worker and of two take
turns over copies of the log, which they divide into pieces. Two others take turns with them: the same log as
one task in one process (the loop), and ``--jobs 2`` without Dask. All
library threads are set to 1. All logs must have the same bytes.

Overhead: the wall time of one worker over that of the loop. The figure counts only if the loop takes 180 s or
more; the remarks give its time. Start and stop of the clusters are not in these times; they have rows of
their own. A short log comes first, so that all imports are done.

Memory: the largest resident memory of each worker (``VmHWM``), with its libraries and the pages of its files.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from batch import Spent, lap, ratios
from results import Report, command
from rounds import Row
from scenes import CACHE, drawn, lengthened

from ipsys_log.api.batch.log_work import replay_log
from ipsys_log.api.batch.tasks import BatchTask
from ipsys_log.api.batch.workers import Workers, WorkerSettings, open_workers
from ipsys_log.capture.simulation.settings import LabSettings

__all__ = ["measure"]

_DIVIDED = BatchTask(replay_log, {"until": "detect"}, divides=True)
_SCENE = LabSettings(width=960, height=540, stations=0, drive_s=4.0)
_SMOKE = LabSettings(width=240, height=136, stations=0, rate_hz=5.0, drive_s=1.0)
_LEAST_FRAMES = 1_200  # a shorter log is not divided
_LEAST_WORK_S = 180.0

Lap = Callable[[Path], Spent]


def replay_with_jobs(path: Path) -> Spent:
    """Detect with two local processes, without Dask."""
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.pipeline import replay

    begin_s = time.perf_counter()
    replay([path], Request(), until="detect", jobs=2)
    return Spent(time.perf_counter() - begin_s, 0.0)


def largest_memory_mb() -> float:
    """Return the largest resident memory of this process in MB."""
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmHWM"):
            return int(line.split()[1]) / 1000
    return 0.0


def _laps(one: Workers, two: Workers) -> dict[str, Lap]:
    return {
        "loop": lambda log: lap(_DIVIDED, [log], None),
        "jobs": replay_with_jobs,
        "one": lambda log: lap(_DIVIDED, [log], one),
        "two": lambda log: lap(_DIVIDED, [log], two),
    }


def _turn(source: Path, folder: Path, one: Workers, two: Workers) -> dict[str, Spent]:
    """Detect in copies of a log, once in each way."""
    spent, digests = {}, set()
    for name, work in _laps(one, two).items():
        log = Path(shutil.copy(source, folder / f"{name}.mcap"))
        spent[name] = work(log)
        digests.add(hashlib.sha256(log.read_bytes()).hexdigest())
        log.unlink()
    if len(digests) != 1:
        raise SystemExit("batch_pieces: the logs differ")
    return spent


def _in_turns(
    source: Path, short: Path, folder: Path, options: argparse.Namespace, report: Report
) -> dict[str, list[Spent]]:
    """Detect in copies of a log, in turns; add the rows of start, stop and memory."""
    begin_s = time.perf_counter()
    spent: dict[str, list[Spent]] = {}
    with open_workers(WorkerSettings(workers=1), 1) as one, open_workers(WorkerSettings(workers=2), 2) as two:
        report.rows.append(Row("start of clusters of 1 and 2", (time.perf_counter() - begin_s,), "s"))
        _turn(short, folder, one, two)
        for _ in range(options.rounds):
            for name, turn in _turn(source, folder, one, two).items():
                spent.setdefault(name, []).append(turn)
        memory = {**one.client.run(largest_memory_mb), **two.client.run(largest_memory_mb)}
        begin_s = time.perf_counter()
    report.rows.append(Row("stop of both", (time.perf_counter() - begin_s,), "s"))
    report.rows.append(Row("resident memory of a worker", tuple(memory.values()), "MB", ("<=", 500.0)))
    return spent


def measure(options: argparse.Namespace) -> Report:
    """Measure speed, overhead and memory."""
    import cv2

    cv2.setNumThreads(1)
    report = Report("batch_pieces")
    CACHE.mkdir(parents=True, exist_ok=True)
    frames = _LEAST_FRAMES if options.smoke else options.piece_frames
    settings = _SMOKE if options.smoke else _SCENE
    with tempfile.TemporaryDirectory(dir=CACHE) as name:
        source, short = Path(name) / "long.mcap", Path(name) / "short.mcap"
        lengthened(drawn(settings), source, frames)
        lengthened(drawn(settings), short, _LEAST_FRAMES)
        spent = _in_turns(source, short, Path(name), options, report)
        report.remarks.append(f"{frames} frames, {source.stat().st_size / 1e9:.2f} GB")
    loop_s = min(turn.wall_s for turn in spent["loop"])
    report.remarks.append(f"the loop takes {loop_s:.0f} s; for the overhead, 180 s or more are needed")
    wanted = ("<=", 1.05) if loop_s >= _LEAST_WORK_S else None
    report.rows[:0] = [
        Row("wall: one worker / two", ratios(spent, "one", "two", "wall_s"), wanted=(">=", 1.85)),
        Row("wall: one worker / log as one task", ratios(spent, "one", "loop", "wall_s"), wanted=wanted),
        Row("wall: two workers / --jobs 2", ratios(spent, "two", "jobs", "wall_s")),
        Row("processor: one worker / loop", ratios(spent, "one", "loop", "cpu_s")),
        Row("processor: two workers / one", ratios(spent, "two", "one", "cpu_s")),
    ]
    report.details = {
        name: {"wall_s": [turn.wall_s for turn in of], "cpu_s": [turn.cpu_s for turn in of]}
        for name, of in spent.items()
    }
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--piece-frames", type=int, default=7200, help="of the long log")


if __name__ == "__main__":
    command("batch_pieces")
