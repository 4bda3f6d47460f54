"""Recording and live tracking of real streams: drops, processor time, and latency of positions.

    python benchmarks/live.py --record-seconds 60 --live-seconds 30

FFmpeg serves JPEGs of the simulated lab, 1920 x 1080 at 30/s and about 300 kB, from loopback as HTTP MJPEG.
Each camera has one process; a remark names a stream that never comes. ``ipsys record`` and ``ipsys live``
run as for a user; their processor time is that of the whole process, with its start. Then the number of
cameras of a recording increases until a camera loses frames; the same cores serve their streams.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from results import Report, command
from rounds import Row
from scenes import drawn
from stream_server import Served, loops_of, serve

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.dataset import Session
from ipsys_log.messages import FRAME_SKIPPED, CompressedImage
from ipsys_log.messages.channels import EVENTS
from ipsys_log.statistics.latency import latency_percentiles, recorded_latencies, step_times_s

__all__ = ["measure"]

_RATE_HZ = 30.0
# A camera that has sent less than this share of its frames is too slow.
_SHORT = 0.98
# Numbers of cameras that are recorded in parallel, in increasing order.
_COUNTS = (6, 9, 12, 15, 18, 24)


class _FailedError(Exception):
    """The error of a command of ipsys whose exit code is not 0."""


def _run(arguments: Sequence[object]) -> float:
    """Return the processor time of a command, in s.

    Raises
    ------
    _FailedError
        The exit code is not 0; the text is the last line of the command.
    """
    with tempfile.TemporaryFile("w+") as said:
        program = subprocess.Popen(
            [sys.executable, "-m", "ipsys_log", *map(str, arguments)], stdout=subprocess.DEVNULL, stderr=said
        )
        _, status, usage = os.wait4(program.pid, 0)
        program.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        lines = said.read().strip().splitlines()
    if program.returncode:
        last = lines[-1] if lines else "no word"
        raise _FailedError(f"ipsys {arguments[0]} ended with {program.returncode}: {last}")
    return usage.ru_utime + usage.ru_stime


@contextmanager
def _measured(what: str, report: Report) -> Iterator[None]:
    """Turn a failure into a remark: the report keeps the results so far."""
    try:
        yield
    except _FailedError as error:
        report.remarks.append(f"{what}: {error}")
        report.failed = True


def _say_missing(what: str, served: Served, report: Report) -> None:
    report.remarks += [f"{what}: {name} never came: {why}" for name, why in served.missing.items()]
    report.failed = report.failed or bool(served.missing)
    if not served.cameras:
        raise _FailedError("no stream came; nothing was measured")


def _rates(log: Path, cameras: Iterable[str]) -> dict[str, tuple[int, float, int]]:
    """Return frames, frames per second, and the size of a frame in bytes; zeros without frames."""
    rates = {}
    with Session([log]) as session:
        for name in cameras:
            times, size = [], 0
            for message in session.messages([session.images[name]] if name in session.images else []):
                assert isinstance(message.payload, CompressedImage)
                times.append(message.log_time_ns)
                size += len(message.payload.data)
            rate_hz = (len(times) - 1) / (times[-1] - times[0]) * 1e9 if len(times) > 1 else 0.0
            rates[name] = len(times), rate_hz, size // max(len(times), 1)
    return rates


def _events(log: Path, kind: str) -> int:
    with Session([log]) as session:
        return sum(event.kind == kind for event in session.payloads(session.topics(EVENTS)))


def _record(
    lab: Path, loops: dict[str, Path], folder: Path, options: argparse.Namespace, report: Report
) -> None:
    seconds, log = 2.0 if options.smoke else options.record_seconds, folder / "record.mcap"
    with serve(lab, loops, 3, folder, options.wait_seconds) as served:
        _say_missing("record", served, report)
        cpu_s = _run(["record", "--rig", served.rig, "-o", log, "--seconds", seconds])
    rates = _rates(log, served.cameras)
    report.rows += [
        Row(f"record, {len(rates)} cameras: of one core", (100 * cpu_s / seconds,), "%", ("<=", 25)),
        Row("gaps by dropped frames", (_events(log, "frames_dropped"),), "events", ("<=", 0)),
        Row("least rate of a camera", (min(rate for _, rate, _ in rates.values()),), "Hz", (">=", 29.5)),
        Row("frame", (min(size for _, _, size in rates.values()) / 1e3,), "kB"),
    ]
    report.details["record"] = {"cpu_s": cpu_s, "seconds": seconds, "cameras": rates}
    log.unlink()


def _many(
    lab: Path, loops: dict[str, Path], folder: Path, options: argparse.Namespace, report: Report
) -> None:
    """Find the largest number of cameras that can be recorded in parallel."""
    sustained, log = 0, folder / "many.mcap"
    for count in _COUNTS:
        title, before = f"{count} cameras", len(report.remarks)
        with _measured(title, report), serve(lab, loops, count, folder, options.wait_seconds) as served:
            _say_missing(title, served, report)
            cpu_s = _run(["record", "--rig", served.rig, "-o", log, "--seconds", options.many_seconds])
            rates = _rates(log, served.cameras)
            slowest, dropped = min(rate for _, rate, _ in rates.values()), _events(log, "frames_dropped")
            details = {"cpu_s": cpu_s, "slowest_hz": slowest, "drops": dropped, "cameras": len(rates)}
            report.details[title] = details
        log.unlink(missing_ok=True)
        if len(report.remarks) > before or slowest < _SHORT * _RATE_HZ or dropped:
            break
        sustained = count
    report.rows.append(Row("cameras held at once", (sustained,), "cameras"))


def _live(
    lab: Path, loops: dict[str, Path], folder: Path, options: argparse.Namespace, report: Report
) -> None:
    seconds = 3.0 if options.smoke else options.live_seconds
    calibrated, log = folder / "calibration.mcap", folder / "live.mcap"
    pipeline.replay([lab], Request(), output=calibrated)
    with serve(lab, loops, 3, folder, options.wait_seconds) as served:
        _say_missing("live", served, report)
        cpu_s = _run(
            ["live", "--rig", served.rig, "--model-from", calibrated, "-o", log, "--seconds", seconds]
        )
    steps = latency_percentiles(step_times_s(recorded_latencies([log])))
    report.rows += [
        Row("live: skipped", (_events(log, FRAME_SKIPPED),), "frames", ("<=", 0)),
        Row("frame received to position, median", (1e3 * steps["total"].median_s,), "ms", ("<=", 40)),
        Row("the same, 99 %", (1e3 * steps["total"].p99_s,), "ms", ("<=", 100)),
        Row(f"live, {len(served.cameras)} cameras: of one core", (100 * cpu_s / seconds,), "%"),
    ]
    report.details["live"] = {
        "steps_ms": {
            name: [1e3 * s for s in (p.median_s, p.p90_s, p.p99_s, p.max_s)] for name, p in steps.items()
        },
        "cameras": _rates(log, served.cameras),
    }


def measure(options: argparse.Namespace) -> Report:
    """Measure recording and tracking of streams on loopback."""
    report = Report("live")
    if shutil.which("ffmpeg") is None:
        report.remarks.append("no ffmpeg to serve the streams; on Debian: sudo apt-get install ffmpeg")
        return report
    settings = LabSettings(stations=25, frames_per_station=2, drive_s=2.0, jpeg_quality=92)
    lab = drawn(replace(settings, width=640, height=360, stations=25) if options.smoke else settings)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loops = loops_of(lab, folder)
        with _measured("record", report):
            _record(lab, loops, folder, options, report)
        with _measured("live", report):
            _live(lab, loops, folder, options, report)
        if not options.smoke:
            _many(lab, loops, folder, options, report)
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--record-seconds", type=float, default=60.0, help="of three streams")
    parser.add_argument("--live-seconds", type=float, default=30.0, help="of three streams")
    parser.add_argument("--many-seconds", type=float, default=10.0, help="of 6 to 24 streams")
    parser.add_argument("--wait-seconds", type=float, default=60.0, help="for all streams to be there")


if __name__ == "__main__":
    command("live")
