"""False alarms: what a checkout says of honest labs that another checkout does not say.

    python benchmarks/contradictions.py --before ../before --honest-seeds 500:540

Every lab has a tape whose scale has a sigma of 0.1 %, heights and prints within their sigmas, and tops that
are tilted by up to 2 degrees. Each seed makes two logs: one of images of JPEG quality 80, one of markers
with a drive and 8 points. Both checkouts answer the same commands; a line of the output is compared without
its numbers. The samples, the golden logs and the real data (IPSYS_DATA) are answered too.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from fault_trials import Trial
from results import Report
from scenes import CACHE

from ipsys_log.capture.simulation.lab import simulate
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.messages import Measurement, Message
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session

__all__ = ["compare_honest_labs", "scale_tape"]

_ROOT = Path(__file__).resolve().parent.parent
_TAPE_SCALE_SIGMA = 0.001
_TOP_TILT_DEG = 2.0
_MARKERS = LabSettings(rate_hz=10.0, drive_s=60.0, markers=2)
_IMAGES = LabSettings(
    width=960,
    height=540,
    jpeg_quality=80,
    stations=9,
    frames_per_station=2,
    drive_s=2.0,
    rate_hz=15.0,
    top_tilt_deg=_TOP_TILT_DEG,
)
# Commands for each kind of log.
_OF_MARKERS = (["calibrate-lab", "LOG"], ["replay", "LOG", "--model", "joint"], ["info", "LOG"])
_OF_IMAGES = (
    ["replay", "LOG", "--model", "poly"],
    ["locate", "LOG", "--model", "rayplane"],
    ["locate", "LOG", "--model", "joint"],
    ["check", "LOG"],
    ["info", "LOG"],
)


def scale_tape(messages: Iterator[Message], scale: float) -> Iterator[Message]:
    """Yield messages whose tape readings, but not the heights, have a relative error."""
    for message in messages:
        payload = message.payload
        if isinstance(payload, Measurement):
            scaled = tuple(replace(one, distance_m=one.distance_m * scale) for one in payload.distances)
            payload = replace(payload, distances=scaled)
        yield replace(message, payload=payload)


def compare_honest_labs(report: Report, options: argparse.Namespace) -> None:
    """Answer honest labs with two checkouts; list the lines that only the second one prints."""
    first, last = map(int, options.honest_seeds.split(":"))
    found: Counter[str] = Counter()
    CACHE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=CACHE) as name:
        folder = Path(name)
        logs = list(_stored_logs(folder))
        for seed in range(first, last):
            logs += _make(folder, seed)
            for path, commands in logs:
                new = _new_lines(path, commands, Path(options.before), Path(options.package))
                found.update(new)
                report.details[path.name] = sorted(new)
                path.unlink()
            logs = []
    report.tables.append("\n".join([f"{count:5} x {line[:70]}" for line, count in found.most_common()]))
    report.remarks.append(f"{len(report.details)} logs, {len(found)} new lines")


def _make(folder: Path, seed: int) -> list[tuple[Path, Sequence[list[str]]]]:
    scale = 1 + np.random.default_rng([seed, 33]).normal(0.0, _TAPE_SCALE_SIGMA)
    settings = GeometricSettings(
        lab=replace(_MARKERS, seed=seed),
        points=8,
        wobble_deg=0.6,
        marker_scale_sigma=0.002,
        robot_height_sigma_m=0.001,
    )
    markers, images = folder / f"markers_{seed}.mcap", folder / f"images_{seed}.mcap"
    write_log(markers, scale_tape(simulate_session(build_lab(settings)), scale))
    write_log(images, scale_tape(simulate(replace(_IMAGES, seed=seed)), scale))
    return [(markers, _OF_MARKERS), (images, _OF_IMAGES)]


def _stored_logs(folder: Path) -> Iterator[tuple[Path, Sequence[list[str]]]]:
    """Yield copies of the samples, of the golden logs, and of the paper's data."""
    for source in sorted([*_ROOT.glob("sample_logs/*.mcap"), *_ROOT.glob("tests/golden/*.mcap")]):
        yield Path(shutil.copy(source, folder)), _OF_IMAGES
    data = Path(os.environ.get("IPSYS_DATA", _ROOT / "../shared/data")).resolve() / "imsel"
    if data.is_dir():
        trial = Trial(folder, 0, _ROOT)
        trial.ipsys("import", "imsel", data, "-o", "imsel.mcap")
        yield folder / "imsel.mcap", (["evaluate", "LOG", "--model", "best"], ["info", "LOG"])


def _new_lines(path: Path, commands: Sequence[list[str]], before: Path, package: Path) -> set[str]:
    """Return the lines of the answers of ``package`` that ``before`` does not print, numbers left out."""
    lines: list[set[str]] = []
    for checkout in (before, package):
        with tempfile.TemporaryDirectory(dir=path.parent) as name:
            log = Path(shutil.copy(path, name))
            trial = Trial(Path(name), 0, checkout.resolve())
            answers = [trial.ipsys(*[log.name if a == "LOG" else a for a in c]) for c in commands]
        lines.append({_template(line) for answer in answers for line in answer.splitlines()})
    return lines[1] - lines[0]


def _template(line: str) -> str:
    """Return a line without numbers, hashes and the widths of columns."""
    return re.sub(r"\s+", " ", re.sub(r"[-+]?\b[0-9a-f]*\d[0-9a-f.]*\b", "#", line)).strip()
