"""Detection of moved cameras over simulated weeks: false alarms, and detection and size against the truth.

    python benchmarks/drift.py                    # 20 labs for each size, 100 undisturbed logs
    python benchmarks/drift.py --labs 5 --logs 20

Each lab has other cameras, and one of them is knocked before week 5 of 8, by a random turn and shift of a
given size on the floor. The cameras warm up by 0.2 px, and the light changes. Poses and intrinsics are known
exactly: an error of the calibration has no effect on a difference. The script prints a table.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.append(str(Path(__file__).resolve().parent.parent))

from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings
from ipsys_log.messages import Floor, Markers
from ipsys_log.statistics.camera_moves import DriftLog, LabDrift, Window, find_drift
from ipsys_log.statistics.drift import MeanCorners
from ipsys_log.statistics.floor_cameras import floor_grid, shift_floor_map
from ipsys_log.units import MM_PER_M, NS_PER_S
from ipsys_log.vision.poses import PosedCamera
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.weeks import FIRST_REFERENCE, Knock, WeekSettings, simulate_week

__all__ = ["measure"]

_FIRST_SEED = 7000
_SIZES_MM = (1.0, 1.5, 2.0, 3.0, 5.0, 20.0)
_WEEKS, _KNOCKED = 8, 5
_FLOOR = Floor(FLOOR_M, FLOOR_M)


def measure(labs: int, logs: int, sizes_mm: Sequence[float] = _SIZES_MM) -> list[str]:
    """Return the table: undisturbed logs first, then one line for each size of the knock."""
    lines = [f"{logs} undisturbed logs: {_false_alarms(logs)} false alarms", ""]
    lines.append("mean shift  camera and week found  other moves  error (rms)  in 95 % band")
    for size_mm in sizes_mm:
        found, others, errors_mm, inside = 0, 0, [], 0
        for number in range(labs):
            lab, knock, truth_m = _knocked_lab(_FIRST_SEED + number, size_mm)
            moves = _drift(lab, WeekSettings(duration_s=3.0, knocks=(knock,)), _WEEKS).moves
            right = [m for m in moves if (m.camera, m.after) == (knock.camera, _name(_KNOCKED))]
            found, others = found + bool(right), others + len(moves) - len(right)
            for move in right[:1]:
                error_m = move.motion.mean_shift_m - truth_m
                errors_mm.append(error_m * MM_PER_M)
                inside += abs(error_m) < 1.96 * move.motion.sigma_m
        rms = f"{np.sqrt(np.mean(np.square(errors_mm))):.2f} mm" if errors_mm else "-"
        share = f"{inside} of {len(errors_mm)}"
        lines.append(f"{size_mm:7.1f} mm  {found:>10} of {labs:<10} {others:>11}  {rms:>11}  {share:>12}")
    return lines


def _false_alarms(logs: int) -> int:
    drift = _drift(_lab(_FIRST_SEED - 1), WeekSettings(duration_s=3.0), logs)
    return len(drift.moves) + len(drift.marker_moves)


def _lab(seed: int) -> GeometricLab:
    settings = LabSettings(seed=seed, rate_hz=10.0, drive_s=0.0, markers=1)
    return build_lab(GeometricSettings(lab=settings, points=1, intrinsics="true"))


def _knocked_lab(seed: int, size_mm: float) -> tuple[GeometricLab, Knock, float]:
    """Return a lab, the knock of one of its cameras, and the true mean shift of its floor map in m."""
    lab, rng = _lab(seed), np.random.default_rng([seed, 1])
    camera = _floor_cameras(lab)[lab.cameras[seed % len(lab.cameras)].name]
    points_m = floor_grid(camera, _FLOOR)
    motion = rng.normal(size=6) * [1.0, 1.0, 1.0, 0.3, 0.3, 0.3]

    def mean_m(scale: float) -> float:
        return float(np.linalg.norm(shift_floor_map(camera, points_m, scale * motion), axis=1).mean())

    scale = 1e-4
    for _ in range(4):
        scale *= size_mm / MM_PER_M / mean_m(scale)
    turn, shift = tuple((scale * motion[:3]).tolist()), tuple((scale * motion[3:]).tolist())
    return lab, Knock(camera.name, _KNOCKED, turn, shift), mean_m(scale)


def _drift(lab: GeometricLab, settings: WeekSettings, weeks: int) -> LabDrift:
    length_m = lab.settings.lab.marker_length_m
    ids = range(FIRST_REFERENCE, FIRST_REFERENCE + len(settings.references))
    logs = [DriftLog(_name(week), _windows(lab, settings, week)) for week in range(1, weeks + 1)]
    return find_drift(logs, _floor_cameras(lab), dict.fromkeys(ids, length_m), _FLOOR)


def _name(week: int) -> str:
    return f"week {week}"


def _floor_cameras(lab: GeometricLab) -> dict[str, PosedCamera]:
    return {one.name: PosedCamera.at_pose(one.name, one.lens, one.camera_from_world) for one in lab.cameras}


def _windows(lab: GeometricLab, settings: WeekSettings, week: int) -> list[Window]:
    """Return the windows of a log of a second each, without writing the log."""
    rows: dict[int, dict[str, dict[int, list[np.ndarray]]]] = defaultdict(
        lambda: defaultdict(lambda: defaultdict(list))
    )
    for message in simulate_week(lab, settings, week):
        if isinstance(message.payload, Markers):
            for marker in message.payload.markers:
                second = message.publish_time_ns // NS_PER_S
                rows[second][str(message.camera)][marker.id].append(marker.corners_px)
    windows = []
    for second, cameras in sorted(rows.items()):
        means = {
            camera: {one: MeanCorners(np.median(px, axis=0), len(px)) for one, px in seen.items()}
            for camera, seen in cameras.items()
        }
        windows.append(Window(second * NS_PER_S, (second + 1) * NS_PER_S, means))
    return windows


def main() -> None:
    """Parse the options, and print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--labs", type=int, default=20, help="labs for each size of the knock")
    parser.add_argument("--logs", type=int, default=100, help="undisturbed logs")
    parser.add_argument(
        "--sizes-mm", type=float, nargs="+", default=_SIZES_MM, help="mean shifts of the floor map"
    )
    options = parser.parse_args()
    with threadpool_limits(1):
        print("\n".join(measure(options.labs, options.logs, options.sizes_mm)))


if __name__ == "__main__":
    main()
