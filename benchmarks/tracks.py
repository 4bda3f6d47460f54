"""Accuracy of tracks in simulated labs whose cameras are not synchronized, against the ground truth.

    python benchmarks/tracks.py --drive-labs 20                      # every condition and calibration
    python benchmarks/tracks.py --condition 1_m_s --calibrations best
    python benchmarks/tracks.py --track-coverage --drive-labs 200    # are the covariances right?

Three robots drive through each lab, on a path that no calibration has seen. The cameras are 0, 11 and 22 ms
out of step, and take 30 frames per second. The first 0.5 s of a track are left out.

Errors are medians over labs, of the mean and the 95th percentile. ``ratio`` compares the mean with that of
all single positions in the same drive. ``1 ms`` is the error on a grid of instants, by the rows at or before
each instant. A step is the change of the error between two rows up to 60 ms apart. At a hand-over, the set of
the cameras of the last 100 ms changes. Steps and velocities have 95th percentiles over all labs and robots.
The script prints tables, and writes JSON with -o.

``--rendered`` renders the labs and detects their markers. Each session is rendered once into the folder of
``--keep``; a run that was interrupted continues there. The log of a session is in it without its images.

``--track-coverage`` compares covariances with errors in many labs, with short drives (``track_coverage.py``).
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from results import Report, command
from rounds import Row
from scenes import CACHE
from stops import Stops
from threadpoolctl import threadpool_limits
from track_contenders import COASTING, CONTENDERS
from track_coverage import COVERAGE_DRIVE_S, coverage_of_lab, coverage_table
from track_drives import CALIBRATIONS, Condition, SeenDrive, calibrate, cover, drive_through
from track_errors import (
    Figures,
    LabErrors,
    compute_coasting_errors,
    compute_lab_errors,
    find_gaps,
    summarize_labs,
)

from ipsys_log.calibration.joint.payload import JOINT
from ipsys_log.errors import FitError

__all__ = ["measure"]

# No other part of the project uses these seeds.
_FIRST_SEED = 3000
# The acceleration is the default limit of the DWB controller of Nav2, whose robot drives at 0.26 m/s.
_STOPS = Stops(legs_s=6.0, stands_s=2.0, acceleration_m_s2=2.5)
_CONDITIONS = (
    Condition("0.26_m_s", 0.26),
    Condition("1_m_s", 1.0),
    Condition("0.26_m_s, rolling", 0.26, rolling=True),
    Condition("1_m_s, rolling", 1.0, rolling=True),
    Condition("0.26_m_s, clocks", 0.26, unknown_clocks=True),
    Condition("1_m_s, clocks", 1.0, unknown_clocks=True),
    Condition("0.26_m_s, uneven", 0.26, floor_rms_m=0.0015),
    Condition("1_m_s, uneven", 1.0, floor_rms_m=0.0015),
    Condition("0.26_m_s, stops", 0.26, stops=_STOPS),
    Condition("1_m_s, stops", 1.0, stops=_STOPS),
)
# Only a joint calibration with a drive estimates clock offsets.
_ESTIMATES_CLOCKS = "joint, drive"
_SMOKE_S = 3.0
# Limits of the figures, for the stage of the program: by key, calibration, and limits at 0.26 and at 1 m/s.
_WANTED = (
    ("mean_mm", "joint", 0.8, 0.8),
    ("p95_mm", "joint", 1.5, 1.5),
    ("mean_mm", "joint, drive", 0.6, 0.7),
    ("median_3d_mm", "best", 1.5, 1.9),
    ("p95_3d_mm", "best", 2.6, 3.5),
    ("heading_mean_deg", "joint", 0.05, 0.05),
    ("heading_p95_deg", "joint", 0.1, 0.1),
    ("heading_mean_deg", "best", 0.1, 0.1),
    ("heading_p95_deg", "best", 0.25, 0.25),
    ("heading_mean_deg", "poly", 0.2, 0.2),
    ("heading_p95_deg", "poly", 0.5, 0.5),
    ("hand_over_mm", "joint", 0.75, 1.7),
    ("velocity_m_s", "joint", 0.02, 0.10),
)
# The error of tracks relative to that of single positions.
_MOST_RATIO = 1.05
_WANTED_SMOOTHED = (("hand_over_mm", "joint", 0.15, 0.25), ("velocity_m_s", "joint", 0.005, 0.01))
_UNITS = {
    "mean_mm": "mm",
    "p95_mm": "mm",
    "median_3d_mm": "mm",
    "p95_3d_mm": "mm",
    "heading_mean_deg": "deg",
    "heading_p95_deg": "deg",
    "hand_over_mm": "mm",
    "velocity_m_s": "m/s",
}
_FAST_M_S = 1.0


def measure(options: argparse.Namespace) -> Report:
    """Track the robots of every condition, with every calibration and contender."""
    report = Report("tracks")
    if options.track_coverage:
        _add_coverage(report, options)
        return report
    sigma_m = options.height_sigma_mm / 1000
    conditions = [replace(one, height_sigma_m=sigma_m) for one in _chosen(options)]
    models = options.calibrations.split(";") if options.calibrations else list(CALIBRATIONS)
    contenders = options.contenders.split(",") if options.contenders else list(CONTENDERS)
    for names, known, kind in ((models, CALIBRATIONS, "calibration"), (contenders, CONTENDERS, "contender")):
        if unknown := sorted(set(names) - set(known)):
            raise SystemExit(f"no {kind} {unknown[0]!r}; there are {', '.join(known)}")
    if options.smoke:
        conditions, models = conditions[:1], models[:1] if options.calibrations else ["rayplane"]
    with threadpool_limits(1):
        for condition in conditions:
            for model in models:
                if not condition.unknown_clocks or model == _ESTIMATES_CLOCKS:
                    _add(report, condition, model, _measure_labs(condition, model, contenders, options))
    return report


def _chosen(options: argparse.Namespace) -> list[Condition]:
    """Return the conditions that the options select; those with images if there shall be images."""
    names = options.exactly.split(";") if options.exactly else [one.name for one in _CONDITIONS]
    if unknown := sorted(set(names) - {one.name for one in _CONDITIONS}):
        raise SystemExit(
            f"no condition {unknown[0]!r}; there are {'; '.join(one.name for one in _CONDITIONS)}"
        )
    chosen = [one for one in _CONDITIONS if options.condition in one.name and one.name in names]
    if not options.rendered:
        return chosen
    return [
        replace(one, name=f"{one.name}, rendered", keep=Path(options.keep))
        for one in chosen
        if not one.floor_rms_m
    ]


def _add_coverage(report: Report, options: argparse.Namespace) -> None:
    """Add the coverage of the covariances of ``joint``: a table for each condition."""
    conditions = _chosen(options)
    seeds = range(_FIRST_SEED, _FIRST_SEED + (1 if options.smoke else options.drive_labs))
    with threadpool_limits(1):
        for condition in conditions[:1] if options.smoke else conditions:
            model = _ESTIMATES_CLOCKS if condition.unknown_clocks else JOINT
            labs = [coverage_of_lab(condition, model, seed, COVERAGE_DRIVE_S) for seed in seeds]
            report.details[condition.name] = labs
            report.tables.append(coverage_table(f"{condition.name}: {model}", labs))


def _measure_labs(
    condition: Condition, model: str, contenders: Sequence[str], options: argparse.Namespace
) -> dict[str, list[LabErrors]]:
    errors: dict[str, list[LabErrors]] = {name: [] for name in contenders}
    for number in range(1 if options.smoke else options.drive_labs):
        seed = _FIRST_SEED + number
        try:
            calibration = calibrate(condition, model, seed)
        except FitError:
            continue
        drive = drive_through(condition, calibration, seed, _SMOKE_S if options.smoke else options.drive_s)
        for name in contenders:
            errors[name].append(_errors(name, drive))
    return errors


def _errors(name: str, drive: SeenDrive) -> LabErrors:
    coasting, gaps_ns = None, find_gaps(drive)
    if name in COASTING:
        coasting = compute_coasting_errors(drive, gaps_ns, CONTENDERS[name](cover(drive, gaps_ns)))
    return compute_lab_errors(drive, CONTENDERS[name](drive), coasting)


def _add(report: Report, condition: Condition, model: str, errors: dict[str, list[LabErrors]]) -> None:
    """Add the figures of a condition and a calibration: two tables, details, and rows with limits."""
    figures = {name: summarize_labs(labs) for name, labs in errors.items() if labs}
    report.details.setdefault(condition.name, {})[model] = figures
    if not figures:
        return
    labs = len(next(iter(errors.values())))
    single_mm = next(iter(figures.values()))["single_mm"]
    report.tables.append(
        "\n".join(
            [
                f"{condition.name}: {model}, {labs} labs; single cameras {single_mm:.2f} mm",
                f"  {'in mm':<16}{'mean':>6}{'p95':>7}{'ratio':>7}{'1 ms':>7}{'p95':>7}"
                f"{'step':>7}{'other':>7}{'m/s':>7}",
                *(_line(name, one) for name, one in figures.items()),
                f"  {'degrees; %':<16}{'head':>6}{'p95':>7}{'at rows':>15}{'between':>16}{'unseen':>16}",
                *(_second_line(name, one) for name, one in figures.items()),
            ]
        )
    )
    for name, wanted in (("fuse", _WANTED), ("smooth", _WANTED_SMOOTHED)):
        if name in figures and not condition.floor_rms_m:
            _add_limits(report, condition, name, model, figures[name], wanted)
        if name in figures:
            ratios = tuple(float(lab.error_2d_mm.mean() / lab.single_mm) for lab in errors[name])
            limit = ("<=", _MOST_RATIO) if model == "joint" else None
            report.rows.append(Row(f"{condition.name} {model}: {name} / single", ratios, wanted=limit))


_KEYS = (
    ("mean_mm", 6, 2),
    ("p95_mm", 7, 2),
    ("ratio", 7, 2),
    ("grid_mm", 7, 2),
    ("grid_p95_mm", 7, 2),
    ("hand_over_mm", 7, 2),
    ("other_camera_mm", 7, 2),
    ("velocity_m_s", 7, 3),
)


def _line(name: str, figures: Figures) -> str:
    return f"  {name:<16}" + "".join(_cell(figures.get(key), width, digits) for key, width, digits in _KEYS)


def _second_line(name: str, figures: Figures) -> str:
    line = (
        f"  {name:<16}" + _cell(figures["heading_mean_deg"], 6, 2) + _cell(figures["heading_p95_deg"], 7, 2)
    )
    for kind in ("at_rows", "between", "coasting"):
        shares = [figures.get(f"{kind}_{key}") for key in ("68", "95")]
        line += f"{_cell(shares[0], 5, 0)}{_cell(shares[1], 4, 0)}{_cell(figures.get(f'{kind}_nees'), 7, 2)}"
    return line


def _cell(value: float | None, width: int, digits: int) -> str:
    known = value is not None and math.isfinite(value)
    return f"{value:>{width}.{digits}f}" if known else f"{'-':>{width}}"


def _add_limits(
    report: Report,
    condition: Condition,
    name: str,
    model: str,
    figures: Figures,
    wanted: Sequence[tuple[str, str, float, float]],
) -> None:
    fast = condition.speed_m_s >= _FAST_M_S
    for key, of_model, slow_limit, fast_limit in wanted:
        if of_model == model and math.isfinite(figures[key]):
            limit = fast_limit if fast else slow_limit
            report.rows.append(
                Row(
                    f"{condition.name} {model}: {name} {_title(key)}",
                    (figures[key],),
                    _UNITS[key],
                    ("<=", limit),
                )
            )


def _title(key: str) -> str:
    return key.removesuffix("_mm").removesuffix("_deg").removesuffix("_m_s").replace("_", " ")


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--drive-labs", type=int, default=5, help="labs of each condition")
    parser.add_argument("--track-coverage", action="store_true", help="coverage of the covariances of joint")
    parser.add_argument("--drive-s", type=float, default=20.0, help="duration of a drive in s")
    parser.add_argument("--height-sigma-mm", type=float, default=0.0, help="sigma of the robots' heights")
    parser.add_argument("--condition", default="", help="only conditions with this in their name")
    parser.add_argument("--exactly", default="", help="only conditions with these names, separated by ;")
    parser.add_argument("--rendered", action="store_true", help="render the labs: a minute for each")
    parser.add_argument("--keep", default=str(CACHE / "labs"), help="folder of the rendered labs")
    parser.add_argument("--calibrations", default="", help=f"of {'; '.join(CALIBRATIONS)}")
    parser.add_argument("--contenders", default="", help=f"of {', '.join(CONTENDERS)}")


if __name__ == "__main__":
    command("tracks")
