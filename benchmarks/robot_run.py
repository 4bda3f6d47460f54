"""Robot runs of the paper (sect. 4.3) in simulated time: errors at the waypoints, without and with faults.

    python benchmarks/robot_run.py --seeds 20
    python benchmarks/robot_run.py --seeds 3 --cases "no faults"
    python benchmarks/robot_run.py --seeds 5 --over ros2

Each seed has another start, other wheels, other noise and other lost datagrams; the lab and its model are the
same. Images of 1920 x 1080 px are drawn, recorded, detected, located, fused and streamed to the
example robot, which is a process of its own. The time is simulated, so the results do not depend on the load.
The table has one row for each waypoint: medians, 95th percentiles and maxima over the seeds, in cm.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from results import Report, command
from rounds import Row
from scenes import drawn

from ipsys_log.app.report.robot_run import robot_run_json
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.request import Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.live_runs.robot_runs.run import drive_robots
from ipsys_log.live_runs.robot_runs.settings import PROGRAM, CameraFailure, RobotRun, choose_paths, read_lab
from ipsys_log.log.dataset import Session
from ipsys_log.tools.robot_run import RobotRunResult, read_robot_run

__all__ = ["measure"]

_CM = 100.0
_MODELS = ("poly", "rigid", "best")
# As sample_logs/small_lab.mcap; with less data for a smoke test.
_LAB = LabSettings(markers=8, stations=40, frames_per_station=1, rate_hz=5.0, drive_s=0.4, jpeg_quality=70)
_SMALL = replace(_LAB, width=960, height=540, stations=26, frames_per_station=2)
_SHORT = "robot_0=2,2.2 2.2,2.2"
# The middle camera alone sees the robot on its way from the second waypoint to the third.
_FAULTS: dict[str, dict[str, Any]] = {
    "no faults": {},
    "5 % lost": {"loss": 0.05},
    "100 ms delay": {"delay_s": 0.1},
    "camera fails": {"failures": (CameraFailure("white", 22.0, 5.0),)},
    "all faults": {"loss": 0.05, "delay_s": 0.1, "failures": (CameraFailure("white", 22.0, 5.0),)},
}


def measure(options: argparse.Namespace) -> Report:
    """Drive with every seed, in every case."""
    report = Report("robot_run")
    cases = [name for name in _FAULTS if options.cases in name]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calibrated = folder / "cal.mcap"
        models = _MODELS[:1] if options.smoke else _MODELS
        # VRPN and ROS 2 withhold extrapolated positions; 120 points cover all waypoints.
        lab = _LAB if options.over == "udp" else replace(_LAB, stations=120)
        shutil.copy(drawn(_SMALL if options.smoke else lab), calibrated)
        replay([calibrated], Request(models=models))
        for case in cases[:1] if options.smoke else cases:
            results: list[RobotRunResult] = []
            for seed in range(1 if options.smoke else options.seeds):
                run = _run(calibrated, seed, case, options)
                request = Request(models=models, model_from=calibrated)
                results.append(_driven(run, folder / "run.mcap", request))
            _add(report, case, results)
    return report


def _run(calibrated: Path, seed: int, case: str, options: argparse.Namespace) -> RobotRun:
    lab = read_lab(calibrated, LabSettings(markers=1, rate_hz=options.frame_rate))
    paths = choose_paths(1, [_SHORT] if options.smoke else [])
    return RobotRun(lab, paths, PROGRAM, over=options.over, lockstep=True, port=0, seed=seed, **_FAULTS[case])


def _driven(run: RobotRun, log: Path, request: Request) -> RobotRunResult:
    drive_robots(run, log, request, overwrite=True)
    with Session([log]) as session:
        return read_robot_run(session)


def _add(report: Report, case: str, results: Sequence[RobotRunResult]) -> None:
    report.details[case] = [robot_run_json(result) for result in results]
    robots = [robot for result in results for robot in result.robots]
    unfinished = sum(not robot.is_finished for robot in robots)
    if unfinished:
        report.remarks.append(f"{case}: {unfinished} of {len(robots)} robots did not finish")
        report.failed = True
    by_number: dict[int, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for point in [point for robot in robots for point in robot.reached]:
        row = by_number[point.number]
        row["control"].append(_CM * point.control_m)
        for name, errors in {"true": point.true_m, **point.positioning_m}.items():
            if errors is not None and errors.median_m is not None:
                row[name].append(_CM * errors.median_m)
    report.tables.append(_table(case, by_number))
    controls = [value for row in by_number.values() for value in row["control"]]
    report.rows.append(Row(f"{case}: largest control error", (max(controls, default=0.0),), "cm", ("<=", 2)))
    moved = [_CM * stop.moved_m for robot in robots for stop in robot.stops if stop.moved_m is not None]
    if moved:
        report.rows.append(Row(f"{case}: moved while stopped", (max(moved),), "cm", ("<=", 0.5)))


def _table(case: str, by_number: Mapping[int, Mapping[str, Sequence[float]]]) -> str:
    """Return a table with median, 95 % and maximum over the seeds of each error."""
    models = [name for name in next(iter(by_number.values()), {}) if name not in ("control", "true")]
    lines = [case, f"  {'in cm':<6}{'control':>16}{'true':>16}" + "".join(f"{name:>8}" for name in models)]
    for number, row in sorted(by_number.items()):
        cells = [_three(row[name]) for name in ("control", "true")]
        line = f"  P{number:<5}" + "".join(f"{cell:>16}" for cell in cells)
        lines.append(line + "".join(f"{np.median(row[name]):>8.2f}" for name in models))
    return "\n".join(lines)


def _three(values: Sequence[float]) -> str:
    return " ".join(f"{value:.2f}" for value in np.percentile(values, [50, 95, 100])) if values else "-"


def add_options(parser: argparse._ArgumentGroup) -> None:
    parser.add_argument("--seeds", type=int, default=20, help="runs of each case")
    parser.add_argument(
        "--over", default="udp", help="stream of the positions: udp, vrpn (without loss) or ros2"
    )
    parser.add_argument("--cases", default="", help="only cases with this in their name")
    parser.add_argument("--frame-rate", type=float, default=5.0, help="frames per second of each camera")


if __name__ == "__main__":
    command("robot_run")
