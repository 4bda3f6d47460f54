"""Time that a command takes before it begins its work.

    python benchmarks/startup.py

``ipsys --help``, ``ipsys info`` on a log of 1 GB and on the small sample with its runs, ``ipsys
camera-frame`` on a log with all results, and the error of a missing log, compared with an interpreter that
does nothing. The commands take turns. The time is wall time of the whole process, with the files in the page
cache. For ``ipsys live``, which plays the cameras of the sample and has its model in a log, it is the time
until the first datagram with positions.
"""

from __future__ import annotations

import argparse
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from results import Report, command
from rounds import Row
from scenes import CACHE, drawn, lengthened

from ipsys_log.capture.simulation.settings import LabSettings

__all__ = ["measure"]

_SAMPLE = Path(__file__).resolve().parent.parent / "sample_logs" / "small_lab.mcap"
_LIMIT_S = 60.0


def _timed(arguments: list[str]) -> float:
    begin = time.perf_counter()
    done = subprocess.run(
        arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False
    )
    seconds = time.perf_counter() - begin
    if done.returncode != 0 and "does not exist" not in done.stderr:
        raise SystemExit(f"startup: {done.stderr}")
    return seconds


def _first_position(arguments: list[str]) -> float:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(_LIMIT_S)
        address = f"127.0.0.1:{receiver.getsockname()[1]}"
        begin = time.perf_counter()
        with subprocess.Popen(
            [*arguments, "--udp", address], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        ) as program:
            try:
                receiver.recv(1 << 16)
                return time.perf_counter() - begin
            finally:
                program.terminate()


def _write_rig(path: Path, played: Path) -> None:
    """Write a rig file whose cameras play those of a log."""
    _timed([*_ipsys(), "init", str(path), "--from", str(played)])
    source = rf'\1\nsource = "file:{played}?\2"\ncalibration = "{played}"'
    text = re.sub(r'(\[\[cameras\]\]\nname = "(\w+)")', source, path.read_text(encoding="utf-8"))
    path.write_text(text, encoding="utf-8")


def _ipsys() -> list[str]:
    """Return the command that pip installed beside this interpreter."""
    installed = Path(sys.executable).with_name("ipsys")
    return [str(installed)] if installed.exists() else [sys.executable, "-m", "ipsys_log"]


def measure(options: argparse.Namespace) -> Report:
    """Start the commands in turns."""
    report = Report("startup")
    width, height = (640, 360) if options.smoke else (1920, 1080)
    base = drawn(LabSettings(width=width, height=height, stations=0, drive_s=1.0))
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        path = Path(folder) / "large.mcap"
        size = base.stat().st_size
        frames = 90 if options.smoke else round(90 * options.startup_gb * 1e9 / size)
        lengthened(base, path, frames)
        replayed = Path(shutil.copy(base, Path(folder) / "replayed.mcap"))
        _timed([*_ipsys(), "camera-frame", str(replayed)])
        sample, rig = Path(shutil.copy(_SAMPLE, Path(folder) / "sample.mcap")), Path(folder) / "lab.toml"
        _timed([*_ipsys(), "replay", str(sample)])
        _write_rig(rig, sample)
        live = [*_ipsys(), "live", "--rig", str(rig), "--model-from", str(sample), "--force"]
        live += ["-o", str(Path(folder) / "live.mcap")]
        commands = {
            "python -c pass": [sys.executable, "-c", "pass"],
            "ipsys --help": [*_ipsys(), "--help"],
            "ipsys info": [*_ipsys(), "info", str(path)],
            "ipsys info, sample": [*_ipsys(), "info", str(sample)],
            "all done": [*_ipsys(), "camera-frame", str(replayed)],
            "missing log": [*_ipsys(), "replay", str(path.with_name("missing.mcap"))],
        }
        times: dict[str, list[float]] = {name: [] for name in commands}
        for arguments in commands.values():  # once for the page cache and the compiled modules
            _timed(arguments)
        for _ in range(2 if options.smoke else options.starts):
            for name, arguments in commands.items():
                times[name].append(_timed(arguments))
            times.setdefault("ipsys live", []).append(_first_position(live))
        report.remarks.append(f"ipsys info on {path.stat().st_size / 1e9:.2f} GB, {frames} frames")
    base_s = times["python -c pass"]
    wanted = {"ipsys --help": 0.2, "ipsys info": 0.6, "ipsys info, sample": 0.4, "all done": 0.8}
    wanted |= {"missing log": 0.2, "ipsys live": 1.5}
    for name in wanted:
        ratios = tuple(time_s / empty_s for time_s, empty_s in zip(times[name], base_s, strict=True))
        report.rows.append(Row(f"{name} / python -c pass", ratios))
    for name, seconds in times.items():
        limit = ("<=", wanted[name]) if name in wanted else None
        report.rows.append(Row(name, tuple(seconds), "s", limit))
        report.details[name] = seconds
    return report


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--starts", type=int, default=7, help="of each command")
    parser.add_argument("--startup-gb", type=float, default=1.0, help="size of the log for ipsys info")


if __name__ == "__main__":
    command("startup")
