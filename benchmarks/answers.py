"""Time that a user waits for an answer: the start of commands, evaluations, the report, a calibration.

    python benchmarks/answers.py                      # wall and processor time
    python benchmarks/answers.py --other ../before    # also beside another checkout, in turns

Start: ``ipsys --help``, ``ipsys info`` on a log of 1 GB and on the small sample with its runs, ``ipsys
camera-frame`` on a log with all results, and the error of a missing log, compared with an interpreter that
does nothing. The commands take turns. The time is wall time of the whole process, with the files in the page
cache. For ``ipsys live``, which plays the cameras of the sample and has its model in a log, it is the time
until the first datagram with positions.

Answers: ``ipsys evaluate`` of all models and of ``joint``, and ``ipsys report``, on copies of the samples
without any run; ``ipsys calibrate-lab`` on two minutes of drive and 9 points, whose markers are
detected. The ratio to another checkout is that of processor times.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from results import Report, command
from rounds import Row, Spent
from scenes import CACHE, drawn, lengthened

from ipsys_log.capture.simulation.settings import LabSettings

__all__ = ["measure"]

_ROOT = Path(__file__).resolve().parent.parent
_SAMPLES = _ROOT / "sample_logs"
# Wanted wall times in s.
_STARTS = {"ipsys --help": 0.2, "ipsys info": 0.6, "ipsys info, sample": 0.4, "all done": 0.8}
_STARTS |= {"missing log": 0.2, "ipsys live": 1.5}
_ANSWERS = {
    "report": (12.0, "small_lab.mcap", ["report"]),
    "evaluate, small sample": (10.0, "small_lab.mcap", ["evaluate"]),
    "evaluate, log of the paper": (20.0, "paper_lab.mcap", ["evaluate"]),
    "evaluate joint": (3.0, "small_lab.mcap", ["evaluate", "--model", "joint"]),
    "calibrate-lab": (3.0, "", ["calibrate-lab"]),
}
_LIMIT_S = 60.0


def _timed(arguments: list[str]) -> float:
    begin = time.perf_counter()
    done = subprocess.run(
        arguments, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False
    )
    seconds = time.perf_counter() - begin
    if done.returncode != 0 and "does not exist" not in done.stderr:
        raise SystemExit(f"answers: {done.stderr}")
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
    report = Report("answers")
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as folder:
        _measure_starts(Path(folder), options, report)
        _measure_answers(Path(folder), options, report)
    return report


def _measure_starts(folder: Path, options: argparse.Namespace, report: Report) -> None:
    width, height = (640, 360) if options.smoke else (1920, 1080)
    base = drawn(LabSettings(width=width, height=height, stations=0, drive_s=1.0))
    path = folder / "large.mcap"
    size = base.stat().st_size
    frames = 90 if options.smoke else round(90 * options.startup_gb * 1e9 / size)
    lengthened(base, path, frames)
    replayed = Path(shutil.copy(base, folder / "replayed.mcap"))
    _timed([*_ipsys(), "camera-frame", str(replayed)])
    sample, rig = Path(shutil.copy(_SAMPLES / "small_lab.mcap", folder / "sample.mcap")), folder / "lab.toml"
    _timed([*_ipsys(), "replay", str(sample)])
    _write_rig(rig, sample)
    live = [*_ipsys(), "live", "--rig", str(rig), "--model-from", str(sample), "--force"]
    live += ["-o", str(folder / "live.mcap")]
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
    for name in _STARTS:
        ratios = tuple(time_s / empty_s for time_s, empty_s in zip(times[name], base_s, strict=True))
        report.rows.append(Row(f"{name} / python -c pass", ratios))
    for name, seconds in times.items():
        limit = ("<=", _STARTS[name]) if name in _STARTS else None
        report.rows.append(Row(name, tuple(seconds), "s", limit))
        report.details[name] = seconds


def _answer(checkout: Path, log: Path, words: Sequence[str]) -> Spent:
    """Run a command of a checkout on a copy of a log; its processor time includes that of its workers."""
    copied = Path(shutil.copy(log, log.with_name(f"answered_{log.name}")))
    arguments = [sys.executable, "-m", "ipsys_log", words[0], str(copied), *words[1:]]
    begin, before = time.perf_counter(), os.times()
    done = subprocess.run(
        arguments,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(checkout)},
    )
    wall_s, after = time.perf_counter() - begin, os.times()
    if done.returncode != 0:
        raise SystemExit(f"answers: {' '.join(arguments)}: {done.stderr}")
    cpu_s = after.children_user + after.children_system - before.children_user - before.children_system
    return Spent(wall_s, cpu_s)


def _driven_lab(folder: Path, smoke: bool) -> Path:
    """Return a log of two minutes of drive and 9 points, with its markers."""
    settings = LabSettings(
        width=960, height=540, stations=3, frames_per_station=5, rate_hz=10.0, drive_s=5.0 if smoke else 120.0
    )
    log = Path(shutil.copy(drawn(settings), folder / "driven.mcap"))
    _timed([*_ipsys(), "replay", str(log), "--until", "camera-frame"])
    return log


def _measure_answers(folder: Path, options: argparse.Namespace, report: Report) -> None:
    driven = _driven_lab(folder, options.smoke)
    checkouts = [_ROOT, *([Path(options.other).resolve()] if options.other else [])]
    for name, (wanted_s, sample, words) in _ANSWERS.items():
        if options.smoke and name != "evaluate joint":
            continue
        log = Path(shutil.copy(_SAMPLES / sample, folder / sample)) if sample else driven
        turns = [[_answer(checkout, log, words) for checkout in checkouts] for _ in range(options.answers)]
        if options.other:
            ratios = tuple(other.cpu_s / this.cpu_s for this, other in turns)
            report.rows.append(Row(f"{name}: other / this", ratios))
        own = [turn[0] for turn in turns]
        report.rows.append(Row(name, tuple(spent.wall_s for spent in own), "s", ("<=", wanted_s)))
        report.rows.append(Row(f"{name}, processor", tuple(spent.cpu_s for spent in own), "s"))


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--starts", type=int, default=7, help="of each command")
    parser.add_argument("--startup-gb", type=float, default=1.0, help="size of the log for ipsys info")
    parser.add_argument("--answers", type=int, default=3, help="repeats of each answer")


if __name__ == "__main__":
    command("answers")
