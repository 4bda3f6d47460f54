"""Knocked cameras that robots show: how soon they are named, and the errors after their repair.

    python benchmarks/knocks.py                         # 16 labs for each row, about 40 minutes
    python benchmarks/knocks.py --labs 4 --rows 0.3 one
    python benchmarks/knocks.py --hours 10              # undisturbed drives only: false alarms, and the cost

The labs have three cameras out of step with rolling shutters, four robots (or one) with a wobble of 0.2
degrees, markers of other heights (1 mm) and sides (0.2 %), and principal points that move by 0.2 px. Each
lab is calibrated with 16 points and a drive of 2 minutes. At 90 s of another drive, one camera is knocked in
a random direction. The errors are means over the floor that this camera sees, 10 cm above it, in mm; those
after the repair are minus those before. A cell has the median and the 95 % limit.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.append(str(Path(__file__).resolve().parent.parent))

from geometric_labs import Scene, fit_session, make_session, nodes_of

from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import find_motion, joint_payload, move_camera, restore_joint
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CameraPoses, Event, Message, Model
from ipsys_log.messages.models import MOVED, PARTLY, REPAIRED
from ipsys_log.statistics.camera_watch import WatchCameras
from ipsys_log.units import MM_PER_M, NS_PER_S
from tests.geometric.knocks import Disturbance, disturb, drive_messages, keep_markers, lying
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab

_FIRST_SEED, _ROBOTS = 600, 4
_KNOCK_S, _AFTER_S = 90.0, 66.0
_REFERENCES = {
    90: (1.0, 1.62),
    91: (3.9, 1.62),
    92: (1.0, 3.25),
    93: (3.9, 3.25),
    94: (2.4, 0.4),
    95: (2.4, 4.5),
}


@dataclass(frozen=True)
class Row:
    """A row of the table: the knock, the floor, the robots, and whether only reference markers are there."""

    name: str
    turn_deg: float
    shift_m: float = 0.002
    floor_rms_m: float = 0.0
    robots: int = _ROBOTS
    references: bool = False


ROWS = (
    Row("0.06 degrees + 0.5 mm", 0.06, 0.0005),
    Row("0.1 degrees + 2 mm", 0.1),
    Row("0.3 degrees + 2 mm", 0.3),
    Row("1.0 degree + 2 mm", 1.0),
    Row("0.3, floor uneven by 1.5 mm", 0.3, floor_rms_m=0.0015),
    Row("0.3, one robot", 0.3, robots=1),
    Row("0.3, no overlap, references", 0.3, references=True),
)


def settings(seed: int, row: Row, drive_s: float) -> GeometricSettings:
    """Return the settings of a lab."""
    lab = LabSettings(rate_hz=10.0, drive_s=drive_s, markers=row.robots, row_time_ns=31_000, seed=seed)
    return GeometricSettings(
        lab=lab,
        points=16,
        floor_rms_m=row.floor_rms_m,
        wobble_deg=0.2,
        clock_offset_s=0.025,
        frame_delays_s=(0.0, 0.011, 0.022),
        marker_scale_sigma=0.002,
        robot_height_sigma_m=0.001,
    )


def calibrate(seed: int, row: Row) -> Model:
    """Return the model of a lab: all rows with the same floor have the same one."""
    scene = Scene("calibration", settings(seed, replace(row, robots=_ROBOTS), 120.0))
    return joint_payload(fit_session(make_session(scene, seed)), {}, 0)


@dataclass(frozen=True)
class Trial:
    """The result of one lab: times in s after the knock, errors in mm, and misses of the last pose."""

    noticed_s: float
    named_s: float
    is_right: bool
    before_mm: float
    uncorrected_mm: float
    after_10_mm: float
    after_60_mm: float
    turn_deg: float
    shift_mm: float
    nees: float


def run_trial(seed: int, row: Row, model: Model) -> Trial:
    """Knock one camera of a lab during a drive."""
    lab = build_lab(settings(seed, row, _KNOCK_S + _AFTER_S))
    camera, rng = lab.cameras[seed % len(lab.cameras)].name, np.random.default_rng(seed)
    turn, shift = rng.normal(size=3), rng.normal(size=3)
    turn_rad = np.radians(row.turn_deg) * turn / np.linalg.norm(turn)
    shift_m = row.shift_m * shift / np.linalg.norm(shift)
    knock = Disturbance(camera, _KNOCK_S, tuple(turn_rad.tolist()), tuple(shift_m.tolist()))
    poses = []
    for after_s, payload in watch(model, _messages(lab, knock, row)):
        if isinstance(payload, CameraPoses):
            poses += [(after_s - _KNOCK_S, pose) for pose in payload.poses]
    named = [(after_s, pose.camera) for after_s, pose in poses if pose.state == MOVED]
    used = [(s, one) for s, one in poses if one.state in (REPAIRED, PARTLY) and one.camera == camera]
    fitted = restore_joint(model)[camera]
    moved = replace(lab, cameras=tuple(disturb(c, knock) if c.name == camera else c for c in lab.cameras))
    # With one robot or few sightings, the time counts from the first one that two cameras share.
    first_s = poses[0][0] if row.robots == 1 and poses else 0.0
    errors_mm = [_error_mm(lab, fitted), _error_mm(moved, fitted)]
    last = None
    for age_s in (10.0, 62.0):
        ready = [pose for after_s, pose in used if after_s <= first_s + age_s]
        last = ready[-1] if ready else None
        known = (
            fitted
            if last is None
            else replace(fitted, camera_from_world=last.camera_from_world, origin_m=last.position_m)
        )
        errors_mm.append(_error_mm(moved, known))
    misses = find_motion(move_camera(fitted, np.concatenate([turn_rad, shift_m])), known)
    nees = np.nan if last is None else float(misses @ np.linalg.solve(last.covariance, misses)) / 6
    is_right = [one for _, one in named] == [camera]
    sizes = np.degrees(np.linalg.norm(misses[:3])), np.linalg.norm(misses[3:]) * MM_PER_M
    times_s = (poses[0][0] if poses else np.inf), (named[0][0] if named else np.inf)
    before_mm, uncorrected_mm, after_10_mm, after_60_mm = errors_mm
    after_mm = before_mm, uncorrected_mm, after_10_mm, after_60_mm
    return Trial(times_s[0], times_s[1], is_right, *after_mm, float(sizes[0]), float(sizes[1]), nees)


def watch(model: Model, messages: Iterator[Message]) -> Iterator[tuple[float, object]]:
    """Yield the payloads of a watch with their times from the start of the drive, in s."""
    step = WatchCameras(model, self_calibrate=True)
    for message in messages:
        for payload in step(message):
            yield (message.log_time_ns - EPOCH_NS) / NS_PER_S - 1, payload


def _messages(lab: GeometricLab, knock: Disturbance, row: Row) -> Iterator[Message]:
    if not row.references:
        return drive_messages(lab, [knock], 0.2)
    fixed = {marker_id: lying(*place) for marker_id, place in _REFERENCES.items()}
    return keep_markers(drive_messages(lab, [knock], 0.2, fixed, list(fixed)), fixed)


def _error_mm(lab: GeometricLab, model: JointModel) -> float:
    """Return the mean error of level markers over the floor that the camera of a model sees, in mm."""
    names = [camera.name for camera in lab.cameras]
    origins_m = [np.linalg.norm(camera.origin_m - model.origin_m) for camera in lab.cameras]
    seen = next(one for one in nodes_of(lab) if one.camera == names[int(np.argmin(origins_m))])
    count = len(seen.corners_px)
    covariances = np.broadcast_to(0.012**2 * np.eye(8), (count, 8, 8))
    lengths_m = np.full(count, lab.settings.lab.marker_length_m)
    located = locate_markers(model, seen.corners_px, covariances, seen.heights_m, lengths_m)
    return float(np.nanmean(np.linalg.norm(located.points_m[:, :2] - seen.truth_m, axis=1)) * MM_PER_M)


def measure(rows: Sequence[Row], labs: int) -> list[str]:
    """Return the lines of the table."""
    cells: list[list[str]] = []
    models: dict[tuple[int, float], Model] = {}
    for row in rows:
        trials = []
        for seed in range(_FIRST_SEED, _FIRST_SEED + labs):
            key = seed, row.floor_rms_m
            models[key] = models.get(key) or calibrate(seed, row)
            trials.append(run_trial(seed, row, models[key]))
        cells.append([row.name, *_cells(trials)])
    head = [
        *("knock", "noticed s", "named s", "right", "before", "uncorrected", "after 10 s", "after 60 s"),
        *("turn deg", "shift mm", "NEES"),
    ]
    widths = [max(map(len, column)) for column in zip(head, *cells, strict=True)]
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(one, widths, strict=True))
        for one in (head, *cells)
    ]


def _cells(trials: Sequence[Trial]) -> list[str]:
    def limits(values: Sequence[float], digits: int) -> str:
        return f"{np.median(values):.{digits}f}/{np.percentile(values, 95):.{digits}f}"

    return [
        limits([one.noticed_s for one in trials], 1),
        limits([one.named_s for one in trials], 1),
        f"{sum(one.is_right for one in trials)} of {len(trials)}",
        limits([one.before_mm for one in trials], 2),
        limits([one.uncorrected_mm for one in trials], 1),
        limits([one.after_10_mm - one.before_mm for one in trials], 2),
        limits([one.after_60_mm - one.before_mm for one in trials], 2),
        limits([one.turn_deg for one in trials], 4),
        limits([one.shift_mm for one in trials], 3),
        f"{np.nanmedian([one.nees for one in trials]):.2f}",
    ]


def count_alarms(hours: float, robots: int) -> str:
    """Return the alarms in undisturbed drives on uneven floors, and the share of a core for the watch."""
    row, drive_s, events, cost_s = replace(ROWS[4], robots=robots), min(1800.0, 3600 * hours), 0, 0.0
    drives = max(round(hours * 3600 / drive_s), 1)
    for seed in range(_FIRST_SEED, _FIRST_SEED + drives):
        messages = list(drive_messages(build_lab(settings(seed, row, drive_s)), (), 0.2))
        model = calibrate(seed, row)
        start_s = time.process_time()
        events += sum(isinstance(one, Event) for _, one in watch(model, iter(messages)))
        cost_s += time.process_time() - start_s
    share = 100 * cost_s / (drives * drive_s)
    hours = drives * drive_s / 3600
    return f"{hours:g} h undisturbed, {robots} robots: {events} events, {share:.1f} % of a core"


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--labs", type=int, default=16)
    parser.add_argument(
        "--rows", nargs="*", default=[], help="only rows whose names contain one of these texts"
    )
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--robots", type=int, default=_ROBOTS, help="with --hours")
    given = parser.parse_args()
    rows = [row for row in ROWS if not given.rows or any(text in row.name for text in given.rows)]
    with threadpool_limits(1):
        lines = [count_alarms(given.hours, given.robots)] if given.hours else measure(rows, given.labs)
    print("\n".join(lines))


if __name__ == "__main__":
    _main()
