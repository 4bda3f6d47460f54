"""Knocked cameras that robots show: how soon they are named, and the errors after their repair.

    python benchmarks/knocks.py                         # 16 labs for each row but slow turns, 1 to 2 hours
    python benchmarks/knocks.py --labs 4 --rows 0.3 one
    python benchmarks/knocks.py --labs 2 --rows over    # slow turns
    python benchmarks/knocks.py --hours 10              # undisturbed drives only: false alarms, and the cost
    python benchmarks/knocks.py --hall 6x4 --robots 12  # only the cost in a hall

The labs have three cameras out of step with rolling shutters, four robots (or one) with a wobble of 0.2
degrees, markers of other heights (1 mm) and sides (0.2 %), and principal points that move by 0.2 px. Each
lab is calibrated with 16 points and a drive of 2 minutes. At 90 s of another drive, one camera is knocked in
a random direction, or its lens changes, or it turns slowly. Other rows have the cameras of rigs that others
published (`published_rigs.py`). The errors are means over the floor that this camera sees, 10 cm above it, in
mm; those after the repair are minus those before. A cell has the median and the 95 % limit; NEES is that of
the pose, ``inside`` the share of positions in the 95 % regions of their covariances.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

sys.path.append(str(Path(__file__).resolve().parent.parent))

from geometric_labs import Scene, Session, fit_session, make_session, nodes_of
from published_rigs import RIGS

from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.payload import (
    add_pose_modes,
    find_motion,
    joint_payload,
    move_camera,
    restore_joint,
)
from ipsys_log.capture.simulation.lab import EPOCH_NS
from ipsys_log.capture.simulation.settings import LabSettings, hall_settings, parse_grid
from ipsys_log.messages import CameraPose, CameraPoses, Event, Message, Model, Rig
from ipsys_log.messages.events import CAMERA_DRIFTED, CLOCK_JUMPED
from ipsys_log.messages.models import MOVED, SUSPECTED
from ipsys_log.statistics.camera_watch import WatchCameras
from ipsys_log.statistics.expected_error import mean_lengths
from ipsys_log.units import MM_PER_M, NS_PER_S
from tests.geometric.floor_error import region_shares
from tests.geometric.knocks import Disturbance, disturb, drive_messages, keep_markers, lying
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

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
    """A row of the table: the change of a camera, the floor, the robots, and what the cameras see.

    Attributes
    ----------
    turn_deg, shift_m : of the camera; gradual with ``over_s``.
    zoom, centre_px : relative change of the focal length, and shift of the principal point.
    second_s : time until another camera has such a change, too; 0 for none.
    references, overlap : whether only reference markers are there; without an overlap, the middle camera is
        off.
    rig : of cameras that others published; our own lab without.
    """

    name: str
    turn_deg: float = 0.0
    shift_m: float = 0.002
    floor_rms_m: float = 0.0
    robots: int = _ROBOTS
    references: bool = False
    overlap: bool = True
    over_s: float = 0.0
    zoom: float = 0.0
    centre_px: float = 0.0
    second_s: float = 0.0
    after_s: float = _AFTER_S
    rig: str = ""

    @property
    def drive_s(self) -> float:
        """The duration of the drive."""
        return _KNOCK_S + self.second_s + self.over_s + self.after_s


ROWS = (
    Row("0.06 degrees + 0.5 mm", 0.06, 0.0005),
    Row("0.1 degrees + 2 mm", 0.1),
    Row("0.3 degrees + 2 mm", 0.3),
    Row("1.0 degree + 2 mm", 1.0),
    Row("0.3, floor uneven by 1.5 mm", 0.3, floor_rms_m=0.0015),
    Row("0.3, one robot", 0.3, robots=1),
    Row("0.3, no overlap, references", 0.3, references=True),
    Row("0.3, no overlap", 0.3, overlap=False, after_s=76.0),
    Row("0.3, two cameras within 30 s", 0.3, second_s=30.0),
    Row("focal length 0.5 %, centre 2 px", shift_m=0.0, zoom=0.005, centre_px=2.0, after_s=72.0),
    Row("focal length 2 %, centre 5 px", shift_m=0.0, zoom=0.02, centre_px=5.0, after_s=72.0),
    Row("0.1 degrees over 20 minutes", 0.1, 0.0, over_s=1200.0),
    Row("0.3 degrees over 1 hour", 0.3, 0.0, over_s=3600.0),
    Row("0.3 degrees over 8 hours", 0.3, 0.0, over_s=28_800.0),
    *(
        Row(f"{rig}: {turn_deg:g} degrees + {1000 * shift_m:g} mm", turn_deg, shift_m, rig=rig)
        for rig in RIGS
        for turn_deg, shift_m in ((0.06, 0.0005), (0.3, 0.002), (1.0, 0.002))
    ),
)


def settings(seed: int, row: Row, drive_s: float) -> GeometricSettings:
    """Return the settings of a lab."""
    lab = LabSettings(rate_hz=10.0, drive_s=drive_s, markers=row.robots, row_time_ns=31_000, seed=seed)
    if row.rig:
        rig, count = RIGS[row.rig], len(RIGS[row.rig].cameras)
        names, (width, height) = tuple(f"camera{n}" for n in range(count)), rig.size_px
        lab = replace(lab, cameras=names, width=width, height=height, marker_length_m=rig.marker_length_m)
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
    lab = _build_lab(seed, replace(row, robots=_ROBOTS), 120.0)
    messages = list(simulate_session(lab))
    rig = next(message.payload for message in messages if isinstance(message.payload, Rig))
    return joint_payload(fit_session(Session(lab, messages, rig)), {}, 0)


def _build_lab(seed: int, row: Row, drive_s: float) -> GeometricLab:
    cameras = RIGS[row.rig].place_cameras() if row.rig else ()
    return build_lab(settings(seed, row, drive_s), cameras)


def _restart(lab: GeometricLab) -> GeometricLab:
    """Return a lab whose cameras were started again: their clocks have other offsets."""
    rng, sigma_ns = np.random.default_rng([lab.settings.lab.seed, 5]), lab.settings.clock_offset_s * NS_PER_S
    offsets_ns = {
        name: round(one)
        for name, one in zip(
            lab.clock_offsets_ns, rng.uniform(-1, 1, len(lab.cameras)) * sigma_ns, strict=True
        )
    }
    return replace(lab, clock_offsets_ns=offsets_ns)


@dataclass(frozen=True)
class Trial:
    """The result for one camera: times in s after the change, errors in mm, and misses of the last pose.

    ``pose_nees`` is that of the pose; ``inside`` the share of positions in the 95 % regions of their
    covariances, and ``stated_mm`` their mean expected error. ``state`` is the last one of the pose.
    """

    noticed_s: float
    named_s: float
    is_right: bool
    before_mm: float
    uncorrected_mm: float
    after_10_mm: float
    after_60_mm: float
    turn_deg: float
    shift_mm: float
    pose_nees: float
    inside: float
    stated_mm: float
    state: str


def draw_changes(seed: int, row: Row, cameras: Sequence[str]) -> list[Disturbance]:
    """Draw the changes of a row."""
    rng, changes = np.random.default_rng(seed), []
    for number, at_s in enumerate([_KNOCK_S] + [_KNOCK_S + row.second_s] * (row.second_s > 0)):
        turn, shift = rng.normal(size=3), rng.normal(size=3)
        turn_rad = np.radians(row.turn_deg) * turn / np.linalg.norm(turn)
        shift_m = row.shift_m * shift / np.linalg.norm(shift)
        zoom, towards = row.zoom, 0.0
        if zoom:
            zoom, towards = zoom * rng.choice([-1, 1]), rng.uniform(0, 2 * np.pi)
        change = Disturbance(
            cameras[(seed + number) % len(cameras)],
            at_s,
            tuple(turn_rad.tolist()),
            tuple(shift_m.tolist()),
            zoom=zoom,
            centre_px=(row.centre_px * np.cos(towards), row.centre_px * np.sin(towards)),
            over_s=row.over_s,
        )
        changes.append(change)
    return changes


def run_lab(seed: int, row: Row, model: Model) -> list[Trial]:
    """Change one or two cameras of a lab during a drive."""
    lab = _restart(_build_lab(seed, row, row.drive_s))
    names = [camera.name for camera in lab.cameras]
    changes = draw_changes(seed, row, names if row.overlap else names[::2])
    poses, drifted = list[tuple[float, CameraPose]](), list[tuple[float, str]]()
    for after_s, payload in watch(model, _messages(lab, changes, row)):
        if isinstance(payload, CameraPoses):
            poses += [(after_s, pose) for pose in payload.poses]
        elif payload.kind == CAMERA_DRIFTED:
            drifted.append((after_s, str(payload.camera)))
    named = {(one.camera, one.since): after_s for after_s, one in reversed(poses) if one.state == MOVED}
    reported = [*drifted, *((after_s, camera) for (camera, _), after_s in named.items())]
    cameras = [change.camera for change in changes]
    accused = [camera for _, camera in sorted(reported)]
    # A slow turn or another lens may be named in several parts.
    is_right = accused == cameras or (row.over_s + row.zoom > 0 and set(accused) == set(cameras))
    return [_score(lab, row, model, change, poses, reported, is_right) for change in changes]


def _score(
    lab: GeometricLab,
    row: Row,
    model: Model,
    change: Disturbance,
    poses: Sequence[tuple[float, CameraPose]],
    reported: Sequence[tuple[float, str]],
    is_right: bool,
) -> Trial:
    """Return the result for one camera."""
    camera, fitted = change.camera, restore_joint(model)[change.camera]
    noticed = [s - change.at_s for s, one in poses if one.state in (SUSPECTED, MOVED) and s > change.at_s]
    named = [s - change.at_s for s, name in sorted(reported) if name == camera]
    moved = replace(lab, cameras=tuple(disturb(c, change) if c.name == camera else c for c in lab.cameras))
    # With one robot or few sightings, the time counts from the first one that two cameras share.
    first_s = noticed[0] if row.robots == 1 and noticed else 0.0
    errors_mm, known, last = [_errors(lab, fitted)[0], _errors(moved, fitted)[0]], fitted, None
    for age_s in (10.0, 62.0 if row.after_s == _AFTER_S else row.after_s):
        ready = [
            one
            for s, one in poses
            if one.camera == camera and s - change.at_s <= row.over_s + first_s + age_s
        ]
        if ready:
            last = ready[-1]
            known = replace(fitted, camera_from_world=last.camera_from_world, origin_m=last.position_m)
        errors_mm.append(_errors(moved, known)[0])
    motion = np.concatenate([change.turn_rad, change.shift_m])
    misses, nees = find_motion(move_camera(fitted, motion), known), np.nan
    if last is not None:
        nees = float(misses @ np.linalg.solve(last.covariance, misses)) / 6
        known = add_pose_modes({camera: known}, {camera: last.covariance})[camera]
    before_mm, uncorrected_mm, after_10_mm, after_60_mm = errors_mm
    return Trial(
        noticed[0] if noticed else np.inf,
        named[0] if named else np.inf,
        is_right,
        *(before_mm, uncorrected_mm, after_10_mm, after_60_mm),
        float(np.degrees(np.linalg.norm(misses[:3]))),
        float(np.linalg.norm(misses[3:]) * MM_PER_M),
        nees,
        *_errors(moved, known)[1:],
        "none" if last is None else last.state,
    )


def watch(model: Model, messages: Iterator[Message]) -> Iterator[tuple[float, Any]]:
    """Yield the payloads of a watch with their times from the start of the drive, in s."""
    step = WatchCameras(model, self_calibrate=True)
    for message in messages:
        for payload in step(message):
            yield (message.log_time_ns - EPOCH_NS) / NS_PER_S - 1, payload


def _messages(lab: GeometricLab, changes: Sequence[Disturbance], row: Row) -> Iterator[Message]:
    if not row.references:
        messages = drive_messages(lab, changes, 0.2)
        return (one for one in messages if row.overlap or one.camera != lab.cameras[1].name)
    fixed = {marker_id: lying(*place) for marker_id, place in _REFERENCES.items()}
    return keep_markers(drive_messages(lab, changes, 0.2, fixed, list(fixed)), fixed)


def _errors(lab: GeometricLab, model: JointModel) -> tuple[float, float, float]:
    """Return the errors of level markers over the floor that the camera of a model sees.

    These are their mean in mm, the share inside the 95 % regions of the covariances, and the mean expected
    error in mm.
    """
    names = [camera.name for camera in lab.cameras]
    origins_m = [np.linalg.norm(camera.origin_m - model.origin_m) for camera in lab.cameras]
    seen = next(one for one in nodes_of(lab) if one.camera == names[int(np.argmin(origins_m))])
    count = len(seen.corners_px)
    covariances = np.broadcast_to(0.012**2 * np.eye(8), (count, 8, 8))
    lengths_m = np.full(count, lab.settings.lab.marker_length_m)
    located = locate_markers(model, seen.corners_px, covariances, seen.heights_m, lengths_m)
    errors_m, stated_m2 = located.points_m[:, :2] - seen.truth_m, located.covariances_m2[:, :2, :2]
    shares = region_shares(errors_m, stated_m2)
    mean_m = float(np.nanmean(np.linalg.norm(errors_m, axis=1)))
    return mean_m * MM_PER_M, shares.inside_95, float(np.nanmean(mean_lengths(stated_m2))) * MM_PER_M


def measure(rows: Sequence[Row], labs: int) -> list[str]:
    """Return the lines of the table."""
    cells: list[list[str]] = []
    models: dict[tuple[int, float, str], Model] = {}
    for row in rows:
        trials = []
        for seed in range(_FIRST_SEED, _FIRST_SEED + labs):
            key = seed, row.floor_rms_m, row.rig
            models[key] = models.get(key) or calibrate(seed, row)
            trials += run_lab(seed, row, models[key])
        cells.append([row.name, *_cells(trials)])
    head = [
        *("knock", "noticed s", "named s", "right", "before", "uncorrected", "after 10 s", "after 60 s"),
        *("turn deg", "shift mm", "NEES", "inside %", "expected", "state"),
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
        f"{np.nanmean([one.pose_nees for one in trials]):.2f}",
        f"{100 * np.mean([one.inside for one in trials]):.0f}",
        limits([one.stated_mm for one in trials], 2),
        ", ".join(f"{count} {state}" for state, count in Counter(one.state for one in trials).items()),
    ]


def count_alarms(hours: float, robots: int) -> str:
    """Return the alarms in undisturbed drives on uneven floors, and the share of a core for the watch."""
    row, drive_s, events, cost_s = replace(ROWS[4], robots=robots), min(1800.0, 3600 * hours), 0, 0.0
    drives = max(round(hours * 3600 / drive_s), 1)
    for seed in range(_FIRST_SEED, _FIRST_SEED + drives):
        messages = list(drive_messages(_restart(_build_lab(seed, row, drive_s)), (), 0.2))
        model = calibrate(seed, row)
        start_s = time.process_time()
        for after_s, one in watch(model, iter(messages)):
            # At the start, other clock offsets than those of the calibration are reported.
            is_offset = isinstance(one, Event) and one.kind == CLOCK_JUMPED and after_s < 60
            events += isinstance(one, Event) and not is_offset
        cost_s += time.process_time() - start_s
    share = 100 * cost_s / (drives * drive_s)
    hours = drives * drive_s / 3600
    return f"{hours:g} h undisturbed, {robots} robots: {events} events, {share:.1f} % of a core"


def cost_in_hall(grid: tuple[int, int], robots: int) -> str:
    """Return the share of a core for the watch in a hall."""
    seed, drive_s = _FIRST_SEED, 60.0
    hall = settings(seed, ROWS[0], drive_s)
    lab = hall_settings(*grid, markers=robots, rate_hz=10.0, drive_s=drive_s, row_time_ns=31_000, seed=seed)
    session = make_session(Scene("hall", replace(hall, lab=lab)), seed)
    model = joint_payload(fit_session(session), {}, 0)
    messages = list(drive_messages(session.lab, (), 0.2))
    start_s = time.process_time()
    events = sum(isinstance(one, Event) for _, one in watch(model, iter(messages)))
    share = 100 * (time.process_time() - start_s) / drive_s
    return f"{grid[0] * grid[1]} cameras, {robots} robots: {events} events, {share:.1f} % of a core"


def _main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--labs", type=int, default=16)
    parser.add_argument(
        "--rows", nargs="*", default=[], help="only rows whose names contain one of these texts"
    )
    parser.add_argument("--hours", type=float, default=0.0)
    parser.add_argument("--robots", type=int, default=_ROBOTS, help="with --hours and --hall")
    parser.add_argument("--hall", type=parse_grid, help="only the cost in a hall, such as 6x4")
    given = parser.parse_args()
    wanted = given.rows or [row.name for row in ROWS if not row.over_s]
    rows = [row for row in ROWS if any(text in row.name for text in wanted)]
    with threadpool_limits(1):
        if given.hall:
            lines = [cost_in_hall(given.hall, given.robots)]
        else:
            lines = [count_alarms(given.hours, given.robots)] if given.hours else measure(rows, given.labs)
    print("\n".join(lines))


if __name__ == "__main__":
    _main()
