"""Cost of the whole chain compared with detection alone, and memory of a replay of ten minutes.

    python benchmarks/replay.py --replay-seconds 40

Speed: ``pipeline.replay`` from frames to tracks writes its results to a log. The same detection in the same
threads discards its results. Both take turns over one log of three cameras of 1920 x 1080 at 30/s. The times
are wall time, and processor time, which other programs do not disturb. Two more contenders detect in one
process for each core, as the command does: the whole replay, and ``detect`` alone, which writes its results.

Memory: RssAnon of a process that replays ten minutes of three cameras (54,000 frames), read ten times a
second. The frames of that log are smaller (--memory-size), because only a few frames of each camera are in
memory at a time. Both logs are a short simulated log; its last frames repeat forward and backward.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import statistics
import tempfile
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from results import Report, command
from rounds import Contender, Row, Turn, race, ratio_row
from scenes import CACHE, drawn, lengthened

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages.channels import CALIBRATIONS, RIG

__all__ = ["measure"]

_EVERY_S = 0.1
_CAMERAS = 3


def _whole(path: Path, jobs: int = 1, until: str | None = None) -> Turn:
    from ipsys_log.engine.request import Request
    from ipsys_log.live_runs.pipeline import replay

    target = path.with_name("replayed.mcap")

    def turn(_number: int) -> list[tuple[str, float]]:
        starts: dict[str, float] = {}

        def progress(stage: str, _done: int, _total: int | None) -> None:
            starts.setdefault(stage, time.monotonic())

        target.unlink(missing_ok=True)
        replay([path], Request(), until, output=target, progress=progress, jobs=jobs)
        times = [*starts.values(), time.monotonic()]
        return [
            (stage, end - start)
            for stage, (start, end) in zip(starts, itertools.pairwise(times), strict=True)
        ]

    return turn


def _detection(path: Path) -> Turn:
    from ipsys_log.engine.stream import in_threads, run, wire
    from ipsys_log.log.dataset import Session
    from ipsys_log.stages import detect

    stage = wire(detect.STAGE, "bench", {}, detect.Detect(detect.EDGES))

    def turn(_number: int) -> int:
        with Session([path]) as session:
            topics = [*session.topics(RIG), *session.topics(CALIBRATIONS), *session.images.values()]
            return sum(1 for _ in run(session.messages(topics), [stage], in_threads))

    return turn


def _speed(path: Path, frames: int, options: argparse.Namespace, report: Report) -> None:
    from ipsys_log.engine.workers import available_cores

    jobs = max(available_cores(), 2)
    contenders = [
        Contender("replay", _whole, (path,)),
        Contender("detection", _detection, (path,)),
        Contender("replay, processes", _whole, (path, jobs)),
        Contender("detection, processes", _whole, (path, jobs, "detect")),
    ]
    timings = race(contenders, 1, options.rounds)
    both = timings["detection"], timings["replay"]
    divided = timings["detection, processes"], timings["replay, processes"]
    report.rows.append(ratio_row("replay / detection alone, frames/s", *both, (">=", 0.92), wall=True))
    report.rows.append(ratio_row("the same by the processor's time", *both))
    report.rows.append(ratio_row(f"the same with {jobs} processes", *divided, (">=", 0.92), wall=True))
    for name, timing in timings.items():
        report.rows.append(Row(name, tuple(frames / s for s in timing.wall_s), "frames/s"))
        report.details[name] = {"wall_s": timing.wall_s, "cpu_s": timing.cpu_s, "frames": frames}
    for name in ("replay", "replay, processes"):
        report.details[name]["stages_s"] = timings[name].kept[0]


def _replayed(line: Connection, path: Path) -> None:
    line.send(_whole(path)(0))


def _rss_anon_mb(pid: int) -> float | None:
    try:
        status = Path(f"/proc/{pid}/status").read_text(encoding="utf-8")
    except OSError:
        return None
    return next(
        (int(line.split()[1]) / 1000 for line in status.splitlines() if line.startswith("RssAnon")), None
    )


def _memory(path: Path, frames: int, report: Report) -> None:
    context = multiprocessing.get_context("spawn")
    line, remote = context.Pipe()
    process = context.Process(target=_replayed, args=(remote, path))
    begin = time.monotonic()
    process.start()
    samples: list[tuple[float, float]] = []
    while not line.poll(_EVERY_S):
        used_mb = _rss_anon_mb(process.pid or 0)
        if not process.is_alive() and not line.poll():
            raise SystemExit("replay: its process has ended; its traceback stands above")
        if used_mb is not None:
            samples.append((time.monotonic() - begin, used_mb))
    stages_s: list[tuple[str, float]] = line.recv()
    end_s = time.monotonic() - begin
    process.join()
    peaks, growth_mb = _by_stage(samples, stages_s, end_s)
    amount = f"{frames} frames"
    report.rows.append(Row(f"RssAnon at most, {amount}", (max(mb for _, mb in samples),), "MB", ("<=", 500)))
    report.rows.append(Row("RssAnon, growth while detecting", (growth_mb,), "MB"))
    report.details["memory"] = {
        "peak_mb_by_stage": peaks,
        "stages_s": stages_s,
        "seconds_and_mb": samples[:: max(len(samples) // 200, 1)],
        "frames": frames,
        "seconds": end_s,
    }


def _by_stage(
    samples: list[tuple[float, float]], stages_s: list[tuple[str, float]], end_s: float
) -> tuple[dict[str, float], float]:
    """Return peaks in MB by stage, and the growth from the second to the last quarter of detect."""
    peaks: dict[str, float] = {}
    growth_mb = 0.0
    start_s = end_s - sum(seconds for _, seconds in stages_s)
    for stage, seconds in stages_s:
        part = [(time_s - start_s, mb) for time_s, mb in samples if start_s <= time_s < start_s + seconds]
        if part:
            peaks[stage] = max(mb for _, mb in part)
        if stage == "detect" and len(part) >= 8:
            early, late = (
                [mb for time_s, mb in part if low <= time_s / seconds < high]
                for low, high in ((0.25, 0.5), (0.75, 1.0))
            )
            growth_mb = statistics.median(late) - statistics.median(early)
        start_s += seconds
    return peaks, growth_mb


def measure(options: argparse.Namespace) -> Report:
    """Measure speed, then memory."""
    report = Report("replay")
    stations: dict[str, Any] = {"stations": 16, "drive_s": 0.5 if options.smoke else 10.0}
    width, height = (int(size) for size in ("640x360" if options.smoke else options.memory_size).split("x"))
    small = LabSettings(width=width, height=height, **stations)
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        path = Path(folder) / "long.mcap"
        frames = round((1 if options.smoke else options.replay_seconds) * 30 * _CAMERAS)
        large = small if options.smoke else LabSettings(**stations)
        lengthened(drawn(large), path, frames)
        frames = _frames(path)
        _speed(path, frames, options, report)
        path.unlink()
        lengthened(
            drawn(small), path, round((1 if options.smoke else options.memory_seconds) * 30 * _CAMERAS)
        )
        report.remarks.append(f"memory with frames of {width} x {height}, {path.stat().st_size / 1e9:.1f} GB")
        _memory(path, _frames(path), report)
    return report


def _frames(path: Path) -> int:
    from ipsys_log.log.dataset import Session

    with Session([path]) as session:
        return sum(session.count(topic) for topic in session.images.values())


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--replay-seconds", type=float, default=40.0, help="of stream, for speed")
    parser.add_argument("--memory-seconds", type=float, default=600.0, help="of stream, for memory")
    parser.add_argument("--memory-size", default="640x360", help="of its frames (1920x1080 takes 16 GB)")


if __name__ == "__main__":
    command("replay")
