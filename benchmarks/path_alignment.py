"""Errors of clock, pivot and alignment between tracks and another system, beside their standard deviations.

    python benchmarks/path_alignment.py                     # all parts
    python benchmarks/path_alignment.py --only a --windows 6

a  Real paths of Vicon (mrclam6 in IPSYS_DATA) are the other system. The tracks are the same paths at 30 Hz,
   with the errors of a camera lab: independent noise of 1 mm and 0.2 degrees, and a smooth random field over
   the floor. Windows of 300 s overlap by more than 80 %: only their field and noise are independent.
c  The odometry of the same robots is the other system, and the paths of Vicon are the tracks.
d  Simulated drives with random pivots, body turns, offsets, clock drifts and coordinate frames.

Offsets are added to the times of the other system. "in 2 s" counts errors within two standard deviations.
MSNE is the mean squared normalised error. The ratio is the median error over 0.6745 times the median
Cramer-Rao bound; in column "smooth", the bound has rates over 0.2 s, without the jitter of Vicon.
"""

import argparse
import itertools
import json
import re
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from recorded_drives import (
    RATE_HZ,
    OtherSystem,
    TrackNoise,
    odometry,
    odometry_pair,
    offset_bound_s,
    simulated_pair,
    turn_rate_offset_s,
    vicon_drive,
    vicon_pair,
    wrap,
)
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from ipsys_log.errors import IpsysError
from ipsys_log.statistics.path_alignment import PathAlignment, align_trajectories
from ipsys_log.statistics.trajectories import KnownParts, TrajectoryPair
from ipsys_log.units import NS_PER_S

Row = dict[str, Any]

_ROBOTS, _RECORDED_S = (1, 2, 3), 359.9
# Correlation of the turn rates in mrclam6 gives these offsets, to add to the times of the odometry.
_LOW_S, _HIGH_S, _NEAR_S = 0.18, 0.34, 0.04
_UNITS = {
    "offset ms": 1e3,
    "drift ppm": 1e6,
    "pivot mm": 1e3,
    "rotation deg": 57.296,
    "body turn deg": 57.296,
    "scale %": 1e2,
}


def attempt(pair: TrajectoryPair, truth: OtherSystem | None, align: str, **condition: object) -> Row:
    """Estimate; return the condition, the seconds, and the errors or the reason of a refusal."""
    begin_s = time.perf_counter()
    try:
        found = align_trajectories([pair], KnownParts(align=align), "paths")
    except IpsysError as error:
        return {**condition, "seconds": time.perf_counter() - begin_s, "refused": str(error)}
    row = {**condition, "seconds": time.perf_counter() - begin_s, "remarks": found.remarks}
    row |= {"offset_s": found.offset_ns / NS_PER_S, "sigma_s": found.offset_sigma_s}
    return row | {"pivot_m": found.bodies[0].pivot_m.tolist()} | (_errors(found, truth) if truth else {})


def _errors(found: PathAlignment, truth: OtherSystem) -> Row:
    """Return the errors and standard deviations, (n, 2), of each unknown, in the unit of its name."""
    body, free = found.bodies[0], np.isfinite(found.turn_sigmas_rad)
    turn = (Rotation.from_matrix(found.motion.rotation) * truth.rotation.inv()).as_rotvec()
    offset_s = found.offset_ns / NS_PER_S - truth.offset_at_s(found.reference_ns)
    drift = [found.drift - truth.drift] if truth.drift else []
    errors: dict[str, tuple[Any, Any]] = {
        "offset ms": ([offset_s], [found.offset_sigma_s]),
        "drift ppm": (drift, [found.drift_sigma] * len(drift)),
        "pivot mm": ((body.pivot_m - truth.pivot_m)[:2], body.pivot_sigmas_m[:2]),
        "rotation deg": (turn[free], found.turn_sigmas_rad[free]),
        "body turn deg": (wrap(np.array([body.turn_rad - truth.turn_rad])), [body.turn_sigma_rad]),
        "scale %": ([found.scale - 1], [found.scale_sigma]),
    }
    return {name: (np.column_stack(pair) * _UNITS[name]).tolist() for name, pair in errors.items()}


def _score(rows: Sequence[Row], name: str) -> list[str]:
    """Return the share within two sigma, MSNE, the median and largest error, and the median sigma."""
    values = np.array([value for row in rows for value in row.get(name, [])]).reshape(-1, 2)
    if not len(values):
        return ["-"] * 5
    errors, sigmas = np.abs(values[:, 0]), values[:, 1]
    figures = np.mean((errors / sigmas) ** 2), np.median(errors), errors.max(), np.median(sigmas)
    return [f"{np.sum(errors <= 2 * sigmas)}/{len(errors)}", *map(_short, figures)]


def _short(value: float) -> str:
    if np.isnan(value):
        return "-"
    return f"{value:.3g}" if value < 999.5 else f"{value:.0e}".replace("e+0", "e")


def _refusals(rows: Sequence[Row]) -> str:
    """Return the refusals by their text after ``paths: ``, with x for numbers, as lines of text."""
    texts = Counter(re.sub(r"\d[\d.]*", "x", row["refused"]) for row in rows if "refused" in row)
    return "".join(f"\n  refused {count:3}: {text[7:71]}" for text, count in texts.most_common())


def measure_windows(windows: int) -> list[Row]:
    """Print the table of real paths with simulated errors of tracks."""
    print(f"a  real paths, simulated errors of tracks\n{'':<28}offset{'':<27}pivot")
    print("time field kernel  head  cm in 2 s   MSNE     ms ratio smooth in 2 s  MSNE    mm")
    kinds = (("gauss", "yes", 0.0), ("gauss", "yes", 0.15), ("matern", "yes", 0.15), ("gauss", "no", 0.15))
    found = []
    for length_s, field_m, (kernel, head, lever_m) in itertools.product((35.0, 300.0), (0.003, 0.02), kinds):
        noise, rows = TrackNoise(field_m, kernel, TrackNoise().heading_rad if head == "yes" else None), []
        for number in range(min(windows, 30)):
            robot, start_s = _ROBOTS[number % 3], number // 3 * (_RECORDED_S - length_s) / 9
            condition = {"part": "a", "robot": robot, "start_s": start_s, "length_s": length_s}
            condition |= {**noise._asdict(), "lever_m": lever_m}
            for name, rate_s in (("bound_ms", 1 / RATE_HZ), ("smooth_bound_ms", 0.2)):
                bound_s = offset_bound_s(vicon_drive(robot), start_s, length_s, noise, rate_s)
                condition[name] = 1e3 * bound_s
            pair, truth = vicon_pair(robot, start_s, length_s, noise, lever_m, number)
            rows.append(attempt(pair, truth, "2d", **condition))
        within, msne, median, *_ = _score(rows, "offset ms")
        errors = [abs(row["offset ms"][0][0]) for row in rows if "refused" not in row]
        ratios = [
            _short(np.median(errors) / np.median([0.6745 * row[name] for row in rows])) if errors else "-"
            for name in ("bound_ms", "smooth_bound_ms")
        ]
        pivot = "".join(f"{cell:>6}" for cell in _score(rows, "pivot mm")[:3])
        print(f"{length_s:4.0f}{1e3 * field_m:3.0f} mm {kernel:<8}{head:<4}{100 * lever_m:4.0f}", end="")
        print(
            f"{within:>7}{msne:>7}{median:>7}{ratios[0]:>6}{ratios[1]:>7}{pivot}{_refusals(rows)}", flush=True
        )
        found += rows
    return found


def measure_odometry(windows: int) -> list[Row]:
    """Print the table of real odometry."""
    print("\nc  real odometry, windows of 90 s; offset to add to the times of the odometry")
    print("robot   start   by turn rates    offset     sigma   near")
    rows: list[Row] = []
    for number in range(min(windows, 12)):
        robot = _ROBOTS[number % 3]
        first_s = odometry(robot)[0, 0]
        start_s = first_s + number // 3 * (_RECORDED_S - 90 - first_s) / 3
        by_rates_s = turn_rate_offset_s(robot, start_s, 90.0)
        condition = {"part": "c", "robot": robot, "start_s": start_s, "by_turn_rates_s": by_rates_s}
        row = attempt(odometry_pair(robot, start_s, 90.0), None, "2d", **condition)
        outside_s = max(_LOW_S - row.get("offset_s", np.inf), row.get("offset_s", np.inf) - _HIGH_S, 0.0)
        row["near"] = outside_s <= _NEAR_S
        row["elsewhere"] = not row["near"] and "refused" not in row and outside_s > 3 * row["sigma_s"]
        offset = "refused" if "refused" in row else f"{row['offset_s']:+.3f} s {1e3 * row['sigma_s']:7.1f} ms"
        print(
            f"{robot:5}{start_s:6.0f} s{by_rates_s:+14.2f} s   {offset}{'   yes' * row['near']}", flush=True
        )
        rows.append(row)
    near, elsewhere = (sum(row[key] for row in rows) for key in ("near", "elsewhere"))
    print(f"within {1e3 * _NEAR_S:.0f} ms of {_LOW_S} to {_HIGH_S} s: {near} of {len(rows)}", end="; ")
    print(f"others, beyond it by 3 sigma: {elsewhere}{_refusals(rows)}")
    return rows


def measure_drives(drives: int) -> list[Row]:
    """Print the table of simulated drives."""
    print("\nd  simulated drives; 1 mm of noise, and a field of 3 mm")
    rows = []
    for number in range(min(drives, 50)):
        pair, truth, kind = simulated_pair(number)
        lever_m = float(np.linalg.norm(truth.pivot_m))
        rows.append(attempt(pair, truth, kind[:2].lower(), part="d", kind=kind, lever_m=lever_m))
    print(f"{'':<20}{'in 2 s':>9}{'MSNE':>9}{'median':>9}{'largest':>9}{'sigma':>9}")
    for kind in dict.fromkeys(row["kind"] for row in rows):
        alike = [row for row in rows if row["kind"] == kind]
        print(f"{kind}, {len(alike)} drives{_refusals(alike)}")
        for name in _UNITS if any("refused" not in row for row in alike) else ():
            cells = "".join(f"{cell:>9}" for cell in _score(alike, name))
            print(f"  {name:<18}{cells}")
    return rows


PARTS = {"a": measure_windows, "c": measure_odometry, "d": measure_drives}


def main() -> None:
    """Parse the options, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default=",".join(PARTS), metavar="PARTS", help="of a,c,d")
    parser.add_argument("--windows", type=int, default=50, help="most windows or drives for each line")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all errors and refusals")
    options = parser.parse_args()
    parts = options.only.split(",")
    if unknown := set(parts) - set(PARTS):
        parser.error(f"no part {min(unknown)!r}; there are {', '.join(PARTS)}")
    begin_s, rows = time.perf_counter(), []
    with threadpool_limits(1):
        for part in parts:
            found = PARTS[part](options.windows)
            seconds = [row["seconds"] for row in found]
            print(f"   an estimate took {np.mean(seconds):.2f} s, at most {max(seconds):.2f} s")
            rows += found
    print(f"{time.perf_counter() - begin_s:.0f} s in all")
    if options.json is not None:
        options.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
