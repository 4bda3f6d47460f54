"""Accuracy of calibrations over the floor of simulated labs with known ground truth.

    python benchmarks/joint.py --labs 20                 # every scene
    python benchmarks/joint.py --labs 5 --lab-scene 16     # scenes with this in their name
    python benchmarks/joint.py --picture floor.png       # also a map of the errors of one lab
    python benchmarks/joint.py --coverage --labs 200     # are the covariances of joint those of its errors?

Most labs have no images: markers have the noise that detect has in rendered labs (see
tests/geometric/corner_noise.py). Some labs are rendered, to confirm this. Each lab has another seed, and
all calibrations get the same labs. The error over the floor is defined in tests/geometric/floor_error.py.
The script prints a table, and writes JSON with -o.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from floor_map import draw_floor_map
from geometric_labs import (
    CONTENDERS,
    SCENES,
    USE_DRIVES,
    Scene,
    Session,
    make_session,
    nodes_of,
    shares_by_place,
    standing_robots,
)
from joint_coverage import COVERAGE_SCENES, coverage_table, measure_coverage
from results import Report, command
from rounds import Row
from threadpoolctl import threadpool_limits

from ipsys_log.errors import FitError
from tests.geometric.floor_error import KnownSightings, Locator, SightingErrors, compute_errors, summarize

__all__ = ["measure"]

# No other part of the project uses these seeds.
_FIRST_SEED = 1000
_MM = 1000.0
_STANDING_FRAMES, _EVERY_NODE = 300, 23
# Limits of the median error of joint calibration over flat labs, in mm.
_WANTED_MM = {
    "75 points": 1.0,
    "75 points, nominal": 1.0,
    "16 points": 2.2,
    "16 points, nominal": 2.2,
    "drive and 4": 3.5,
    "drive and 8": 2.7,
    "drive and 16": 1.8,
}

Figures = dict[str, Any]


def measure(options: argparse.Namespace) -> Report:
    """Calibrate the labs of every scene with every contender."""
    report = Report("joint")
    if options.coverage:
        _add_coverage(report, options)
        return report
    scenes = [scene for scene in SCENES if options.lab_scene in scene.name]
    if not options.rendered_labs:
        scenes = [scene for scene in scenes if not scene.rendered]
    if options.smoke:
        scenes = [scene for scene in scenes if not scene.drives][:1]
    names = options.models.split(",") if options.models else list(CONTENDERS)
    if unknown := sorted(set(names) - set(CONTENDERS)):
        raise SystemExit(f"no calibration {unknown[0]!r}; there are {', '.join(CONTENDERS)}")
    skipped = 0
    with threadpool_limits(1):
        for scene in scenes:
            fitting = [name for name in names if not scene.drives or name in USE_DRIVES]
            skipped += not fitting
            if fitting:
                _add(report, scene, _measure_scene(scene, fitting, options, report))
    if skipped:
        report.remarks.append(f"{skipped} scenes with a drive: no calibration here uses it")
    return report


def _add_coverage(report: Report, options: argparse.Namespace) -> None:
    """Add the statistics of the covariances of joint calibration: a table for each scene."""
    scenes = [scene for scene in COVERAGE_SCENES if options.lab_scene in scene.name]
    labs = 1 if options.smoke else options.labs
    with threadpool_limits(1):
        for scene in scenes[:1] if options.smoke else scenes:
            figures = measure_coverage(scene, range(_FIRST_SEED, _FIRST_SEED + labs))
            report.details[scene.name] = figures
            report.tables.append(coverage_table(scene.name, figures))


def _measure_scene(
    scene: Scene, names: Sequence[str], options: argparse.Namespace, report: Report
) -> dict[str, list[Figures | None]]:
    figures: dict[str, list[Figures | None]] = defaultdict(list)
    labs = options.rendered_labs if scene.rendered else options.labs
    for number in range(1 if options.smoke else labs):
        session = make_session(scene, _FIRST_SEED + number)
        nodes = nodes_of(session.lab)
        maps: dict[str, list[SightingErrors]] = {}
        for name in names:
            begin = time.perf_counter()
            try:
                locator = CONTENDERS[name](session)
            except FitError:
                figures[name].append(None)
                continue
            fit_s = time.perf_counter() - begin
            maps[name] = compute_errors(nodes, locator)
            figures[name].append(_figures(session, nodes, maps[name], locator, fit_s))
        if number == 0 and options.picture and scene is _first(options):
            draw_floor_map(Path(options.picture), maps, session.measured_m, scene.name)
            report.remarks.append(f"{scene.name}, the first lab: {options.picture}")
    return figures


def _first(options: argparse.Namespace) -> Scene:
    return next(scene for scene in SCENES if options.lab_scene in scene.name)


def _figures(
    session: Session,
    nodes: Sequence[KnownSightings],
    errors: Sequence[SightingErrors],
    locator: Locator,
    fit_s: float,
) -> Figures:
    error = asdict(summarize(errors, session.measured_m))
    shares = error.pop("shares")
    figures = {
        f"{key}m" if key.endswith("_m") else key: value * (_MM if key.endswith("_m") else 1)
        for key, value in error.items()
    }
    figures["coverage"] = None if shares is None else shares_by_place(session, locator)
    figures["standing_mm"] = _MM * _repeatability(session, nodes, locator)
    figures["fit_s"] = fit_s
    return figures


def _repeatability(session: Session, nodes: Sequence[KnownSightings], locator: Locator) -> float:
    """Return the standard deviation per axis of robots that stand still, the median over the floor, in m."""
    robots = standing_robots(session.lab, nodes, _STANDING_FRAMES, _EVERY_NODE)
    spreads = [
        one.errors_m.reshape(-1, _STANDING_FRAMES, 2).std(axis=1) for one in compute_errors(robots, locator)
    ]
    return float(np.nanmedian(np.concatenate(spreads)))


def _add(report: Report, scene: Scene, figures: dict[str, list[Figures | None]]) -> None:
    """Add the figures of a scene: a table, rows with limits, and details."""
    titles = f"{'mean (90 %)':>15}{'p95':>8}{'aligned':>9}{'outside':>9}{'still':>8}"
    lines = [scene.name, f"  {'in mm':<20}{titles}"]
    covered = [f"  {'% inside, NEES':<20}{'grid':>19}{'points':>19}{'drive':>19}"]
    means: dict[str, tuple[float, ...]] = {}
    for name, labs in figures.items():
        known = [one for one in labs if one is not None]
        report.details.setdefault(scene.name, {})[name] = labs
        if not known:
            lines.append(f"  {name:<20}{'too few points':>15}")
            continue
        means[name] = tuple(one["mean_mm"] for one in known)
        lines.append(_line(name, known, len(labs)))
        if all(one["coverage"] for one in known):
            covered.append(_covered(name, known))
        if name == "joint" and (limit := _WANTED_MM.get(scene.name)) is not None:
            report.rows.append(Row(f"{scene.name}, {name}", means[name], "mm", ("<=", limit)))
    report.tables.append("\n".join(lines + covered))
    today = means.pop("rayplane", ())
    for name, values in means.items():
        if len(values) == len(today):
            ratios = [mine / usual for mine, usual in zip(values, today, strict=True)]
            report.rows.append(Row(f"{scene.name}: {name} / rayplane", tuple(ratios)))


def _line(name: str, known: list[Figures], labs: int) -> str:
    def median(key: str) -> float:
        # A lab without nodes outside the hull of its points has no value there.
        values = [one[key] for one in known if np.isfinite(one[key])]
        return float(np.median(values)) if values else float("nan")

    title = name if len(known) == labs else f"{name}, {len(known)} labs"
    mean = f"{median('mean_mm'):.2f} ({np.percentile([one['mean_mm'] for one in known], 90):.2f})"
    line = f"  {title:<20}{mean:>15}{median('p95_mm'):>8.2f}{median('aligned_mean_mm'):>9.2f}"
    return line + f"{median('outside_mean_mm'):>9.2f}{median('standing_mm'):>8.3f}"


def _covered(name: str, known: list[Figures]) -> str:
    """Return the mean shares inside the 68 and 95 % regions, with standard errors over labs, and the NEES."""
    line = f"  {name:<20}"
    for kind in ("grid", "points", "drive"):
        shares = [one["coverage"][kind] for one in known]
        cells = []
        for key in ("inside_68", "inside_95"):
            values = [100 * one[key] for one in shares]
            cell = f"{np.mean(values):.0f}"
            if len(values) > 1:
                cell += f"±{np.std(values, ddof=1) / np.sqrt(len(values)):.0f}"
            cells.append(cell)
        cells.append(f"{np.mean([one['nees'] for one in shares]):.2f}")
        line += f"{' '.join(cells):>19}"
    return line


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--labs", type=int, default=5, help="of each scene without images")
    parser.add_argument("--rendered-labs", type=int, default=3, help="of each scene with images")
    parser.add_argument("--lab-scene", default="", help="only scenes with this in their name")
    parser.add_argument("--models", default="", help=f"of {', '.join(CONTENDERS)}, separated by commas")
    parser.add_argument("--coverage", action="store_true", help="only the statistics of the covariances")
    parser.add_argument("--picture", help="map of the errors in the first lab of the first scene")


if __name__ == "__main__":
    command("joint")
