"""Processor time of a node and of its centre, beside a plain recording of the same camera.

    python benchmarks/node_cost.py --node-seconds 45

FFmpeg serves JPEGs of the simulated lab, 1920 x 1080 at 30/s and about 300 kB, from loopback as HTTP MJPEG.
``ipsys record`` records them; then ``ipsys node`` records them and sends them to ``ipsys record`` at the
centre. Each program runs twice, for 25 s and for longer. The difference, divided by that of the frames, is
the time for a frame. It contains neither the start of the program nor the frequent exchanges of times at
first.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from results import Report, command
from rounds import Row
from scenes import drawn
from stream_server import Served, free_ports, loops_of, serve

from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.log.dataset import Session

__all__ = ["measure"]

_RATE_HZ, _SHORT_S, _WAIT_S, _MS_PER_S = 30.0, 25.0, 60.0, 1000.0


class _Cost(NamedTuple):
    """Processor time of a program in s, and the frames in its log."""

    cpu_s: float
    frames: int


def _start(*arguments: object) -> subprocess.Popen[bytes]:
    """Start a program without its remarks."""
    program = [sys.executable, "-m", "ipsys_log", *map(str, arguments)]
    return subprocess.Popen(program, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _end(program: subprocess.Popen[bytes], log: Path) -> _Cost:
    """Wait for the end of a program; return its cost."""
    _, status, usage = os.wait4(program.pid, 0)
    program.returncode = os.waitstatus_to_exitcode(status)
    if program.returncode:
        raise SystemExit(f"node_cost: {program.args!r} ended with {program.returncode}")
    with Session([log]) as session:
        frames = sum(session.count(topic) for topic in session.images.values())
    return _Cost(usage.ru_utime + usage.ru_stime, frames)


def _record(served: Served, folder: Path, seconds: float, _options: argparse.Namespace) -> dict[str, _Cost]:
    log = folder / "record.mcap"
    program = _start("record", "--rig", served.rig, "-o", log, "--seconds", seconds, "--force")
    return {"record": _end(program, log)}


def _send(served: Served, folder: Path, seconds: float, options: argparse.Namespace) -> dict[str, _Cost]:
    (camera,), (port,) = served.cameras, free_ports(1)
    rig = folder / "centre.toml"
    text = served.rig.read_text(encoding="utf-8")
    text = "\n".join(
        f'source = "zenoh:{camera}"' if row.startswith("source") else row for row in text.split("\n")
    )
    text += f'[nodes]\ncentre = "127.0.0.1:{port}"\n'
    more: tuple[object, ...] = ()
    if options.node_certificates:
        text += f'certificates = "{options.node_certificates.resolve()}"\n'
        more = "--certificates", options.node_certificates
    rig.write_text(text, encoding="utf-8")
    logs = folder / "node.mcap", folder / "centre.mcap"
    address = "--centre", f"127.0.0.1:{port}"
    node = _start("node", served.rig, "--camera", camera, *address, *more, "-o", logs[0], "--force")
    centre = _end(_start("record", "--rig", rig, "-o", logs[1], "--seconds", seconds, "--force"), logs[1])
    node.send_signal(signal.SIGTERM)
    return {"node": _end(node, logs[0]), "centre": centre}


def _times_ms(short: Mapping[str, _Cost], long: Mapping[str, _Cost]) -> dict[str, float]:
    """Return the processor time for a frame in ms, by program."""
    return {
        name: (cost.cpu_s - short[name].cpu_s) / max(cost.frames - short[name].frames, 1) * _MS_PER_S
        for name, cost in long.items()
    }


def measure(options: argparse.Namespace) -> Report:
    """Measure the programs in turns."""
    report = Report("node_cost")
    size = (640, 360) if options.smoke else (1920, 1080)
    lab = drawn(LabSettings(width=size[0], height=size[1], stations=0, drive_s=2.0))
    # A smoke run is too short for differences: it includes the start of the programs.
    durations_s = (4.0,) if options.smoke else (_SHORT_S, options.node_seconds)
    times: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        loops = dict([next(iter(loops_of(lab, folder).items()))])
        for _ in range(options.rounds):
            for work in (_record, _send):
                costs = []
                for duration_s in durations_s:
                    with serve(lab, loops, 1, folder, _WAIT_S) as served:
                        if served.missing:
                            raise SystemExit(f"node_cost: {served.missing}")
                        costs.append(work(served, folder, duration_s, options))
                short = costs[0] if len(costs) > 1 else dict.fromkeys(costs[0], _Cost(0.0, 0))
                for program, time_ms in _times_ms(short, costs[-1]).items():
                    times.setdefault(program, []).append(time_ms)
    for program in ("node", "centre"):
        ratios = zip(times[program], times["record"], strict=True)
        report.rows.append(Row(f"{program} / record", tuple(own / plain for own, plain in ratios)))
    for program, values in times.items():
        shares = tuple(value / _MS_PER_S * _RATE_HZ * 100 for value in values)
        report.rows.append(Row(f"{program}: of one core at 30/s", shares, "%"))
    report.details = {"ms_per_frame": times}
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--node-seconds", type=float, default=45.0, help="the length of a recording")
    parser.add_argument("--node-certificates", type=Path, metavar="FOLDER", help="encrypt the connection")


if __name__ == "__main__":
    command("node_cost")
