"""Recording and live tracking of real streams: drops, processor time, and from a frame to its position.

    python benchmarks/live.py --record-seconds 60 --live-seconds 30

FFmpeg serves JPEGs of the simulated lab, 1920 x 1080 at 30/s and about 300 kB, from loopback as HTTP MJPEG,
one process for each camera. ``ipsys record`` and ``ipsys live`` run as a user runs them; their processor time
is all that their process takes, its start included. Then more and more cameras are recorded at once, until
one is short of frames; the processes that serve them run on the same cores.
"""

from __future__ import annotations

import argparse
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from results import Report, command
from rounds import Row
from scenes import drawn

from ipsys_log import pipeline
from ipsys_log.log.session import Session
from ipsys_log.messages import FRAME_SKIPPED, CompressedImage, Event
from ipsys_log.recording.latency import latency_percentiles, recorded_latencies, step_times_s
from ipsys_log.runs.request import Request
from ipsys_log.sources.simulator import LabSettings

__all__ = ["measure"]

_RATE_HZ = 30.0
# A camera that has sent less than this share of its frames is too much.
_SHORT = 0.98


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _loops(lab: Path, folder: Path) -> dict[str, Path]:
    """The drive of each camera as a stream of JPEGs, to and fro, so that nothing jumps."""
    loops = {}
    with Session([lab]) as session:
        for name, topic in session.images.items():
            frames = [message.payload.data for message in session.messages([topic])][-60:]
            loops[name] = folder / f"{name}.mjpeg"
            loops[name].write_bytes(b"".join([*frames, *frames[-2:0:-1]]))
    return loops


def _lens_file(path: Path, lens: Any) -> str:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("camera_matrix", np.ascontiguousarray(lens.K))
    file.write("distortion_coefficients", np.ascontiguousarray(lens.D))
    file.write("image_width", lens.width)
    file.write("image_height", lens.height)
    file.release()
    return path.name


@contextmanager
def _served(lab: Path, loops: dict[str, Path], count: int, folder: Path) -> Iterator[Path]:
    """A rig of so many cameras that are served now."""
    from ipsys_log.rig import rig_toml

    with Session([lab]) as session:
        text = rig_toml(session.payloads(["/rig"])[0]).partition("[[cameras]]")[0]
        lenses = {name: session.payloads([topic])[0] for name, topic in session.calibrations.items()}
    kind = ["-f", "mpjpeg", "-content_type", "multipart/x-mixed-replace;boundary=ffmpeg", "-listen", "1"]
    with ExitStack() as stack:
        for number in range(count):
            base = sorted(loops)[number % len(loops)]
            name = base if number < len(loops) else f"{base}_{number}"
            address = f"http://127.0.0.1:{_free_port()}/{name}"
            loop = ["-re", "-stream_loop", "-1", "-f", "mjpeg", "-framerate", "30", "-i", str(loops[base])]
            program = subprocess.Popen(
                ["ffmpeg", "-v", "quiet", "-nostdin", *loop, "-c", "copy", *kind, address],
                stderr=subprocess.DEVNULL,
            )
            stack.callback(program.wait)
            stack.callback(program.kill)
            lens = _lens_file(folder / f"{name}.yaml", lenses[base])
            text += f'[[cameras]]\nname = "{name}"\nsource = "{address}"\ncalibration = "{lens}"\n'
        time.sleep(1.0)
        rig = folder / "lab.toml"
        rig.write_text(text, encoding="utf-8")
        yield rig


def _run(arguments: Sequence[object]) -> float:
    """Processor time of a command, in s."""
    program = subprocess.Popen(
        [sys.executable, "-m", "ipsys_log", *map(str, arguments)], stdout=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(program.pid, 0)
    program.returncode = os.waitstatus_to_exitcode(status)
    if program.returncode:
        raise SystemExit(f"live: ipsys {arguments[0]} ended with {program.returncode}")
    return usage.ru_utime + usage.ru_stime


def _rates(log: Path) -> dict[str, tuple[int, float, int]]:
    """Frames, frames per second, and the size of a frame in bytes, of each camera."""
    found = {}
    with Session([log]) as session:
        for name, topic in session.images.items():
            times, size = [], 0
            for message in session.messages([topic]):
                assert isinstance(message.payload, CompressedImage)
                times.append(message.log_time_ns)
                size += len(message.payload.data)
            found[name] = (
                len(times),
                (len(times) - 1) / max(times[-1] - times[0], 1) * 1e9,
                size // len(times),
            )
    return found


def _events(log: Path, kind: str) -> int:
    with Session([log]) as session:
        return sum(event.kind == kind for event in session.payloads(session.topics(Event)))


def _record(
    lab: Path, loops: dict[str, Path], folder: Path, options: argparse.Namespace, report: Report
) -> None:
    seconds = 2.0 if options.smoke else options.record_seconds
    with _served(lab, loops, 3, folder) as rig:
        cpu_s = _run(["record", "--rig", rig, "-o", folder / "record.mcap", "--seconds", seconds])
    rates = _rates(folder / "record.mcap")
    report.rows += [
        Row("record, 3 cameras: of one core", (100 * cpu_s / seconds,), "%", ("<=", 25)),
        Row(
            "gaps by dropped frames",
            (_events(folder / "record.mcap", "frames_dropped"),),
            "events",
            ("<=", 0),
        ),
        Row("least rate of a camera", (min(rate for _, rate, _ in rates.values()),), "Hz", (">=", 29.5)),
        Row("frame", (min(size for _, _, size in rates.values()) / 1e3,), "kB"),
    ]
    report.details["record"] = {"cpu_s": cpu_s, "seconds": seconds, "cameras": rates}
    (folder / "record.mcap").unlink()


def _many(lab: Path, loops: dict[str, Path], folder: Path, report: Report) -> None:
    """How many cameras can be recorded at once."""
    held, log = 0, folder / "many.mcap"
    for count in (6, 9, 12, 15, 18, 24):
        with _served(lab, loops, count, folder) as rig:
            cpu_s = _run(["record", "--rig", rig, "-o", log, "--seconds", 10])
        slowest = min(rate for _, rate, _ in _rates(log).values())
        dropped = _events(log, "frames_dropped")
        log.unlink()
        report.details[f"{count} cameras"] = {"cpu_s": cpu_s, "slowest_hz": slowest, "drops": dropped}
        if slowest < _SHORT * _RATE_HZ or dropped:
            break
        held = count
    report.rows.append(Row("cameras held at once", (held,), "cameras"))


def _live(
    lab: Path, loops: dict[str, Path], folder: Path, options: argparse.Namespace, report: Report
) -> None:
    seconds = 3.0 if options.smoke else options.live_seconds
    calibrated, log = folder / "calibration.mcap", folder / "live.mcap"
    pipeline.replay([lab], Request(), output=calibrated)
    with _served(lab, loops, 3, folder) as rig:
        cpu_s = _run(["live", "--rig", rig, "--model-from", calibrated, "-o", log, "--seconds", seconds])
    steps = latency_percentiles(step_times_s(recorded_latencies([log])))
    report.rows += [
        Row("live: skipped", (_events(log, FRAME_SKIPPED),), "frames", ("<=", 0)),
        Row("frame received to position, median", (1e3 * steps["total"].median_s,), "ms", ("<=", 40)),
        Row("the same, 99 %", (1e3 * steps["total"].p99_s,), "ms", ("<=", 100)),
        Row("live, 3 cameras: of one core", (100 * cpu_s / seconds,), "%"),
    ]
    report.details["live"] = {
        "steps_ms": {
            name: [1e3 * s for s in (p.median_s, p.p90_s, p.p99_s, p.max_s)] for name, p in steps.items()
        },
        "cameras": _rates(log),
    }


def measure(options: argparse.Namespace) -> Report:
    """Record and track from streams on loopback."""
    report = Report("live")
    if shutil.which("ffmpeg") is None:
        report.remarks.append("no ffmpeg to serve the streams; on Debian: sudo apt-get install ffmpeg")
        return report
    settings = LabSettings(stations=25, frames_per_station=2, drive_s=2.0, jpeg_quality=92)
    lab = drawn(replace(settings, width=640, height=360, stations=25) if options.smoke else settings)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loops = _loops(lab, folder)
        _record(lab, loops, folder, options, report)
        _live(lab, loops, folder, options, report)
        if not options.smoke:
            _many(lab, loops, folder, report)
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--record-seconds", type=float, default=60.0, help="of three streams")
    parser.add_argument("--live-seconds", type=float, default=30.0, help="of three streams")


if __name__ == "__main__":
    command("live")
