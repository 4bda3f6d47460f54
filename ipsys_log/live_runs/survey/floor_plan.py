"""Plan of the next points to measure, from a log."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CameraCalibration, CameraModel, Model, Rig
from ipsys_log.messages.channels import MEASUREMENTS, MODEL
from ipsys_log.messages.stage import Progress
from ipsys_log.models.plain_models import rigid_transform
from ipsys_log.models.table import AppliedModel, reads_corners
from ipsys_log.models.uncertainty import Uncertainty
from ipsys_log.statistics.floor_cameras import FloorGrid
from ipsys_log.statistics.plan import FittedCamera, MeasurementPlan, plan_points
from ipsys_log.statistics.tape import TapeCovariances, expected_tape_covariances
from ipsys_log.vision.poses import invert_pose, make_pose
from ipsys_log.vision.trilateration import USUAL_TAPE_SIGMA_M, are_collinear

if TYPE_CHECKING:
    from ipsys_log.statistics.joint_plan import PlannedDrive

Lenses = Mapping[str, CameraCalibration]

# Distance from the centre of a marker to the corners of its white margin, in sides of the marker. A marker
# has 6 cells or more per side.
_RADIUS = 8 / 6 / np.sqrt(2)
# Step between candidates and size of the floor's cells; on a floor of 10 m, the step is twice as large.
_STEP_M, _SPAN_M = 0.1, 5.0
_AROUND_M = 0.5
_MOST_HEIGHTS = 5
# Usual noise and fit error of a camera with too few points for an estimate; both are relative, as in
# uncertainty.py.
_USUAL_NOISE, _USUAL_FIT = 3e-4, 2.5e-3
_LITTLE = 0.05
# For a model of corners, candidates are this many times as far apart: its error changes slowly.
_COARSE = 4
# The leverage has this many terms. With fewer points, it has no upper bound.
_LEAST_PLACES = 6


@dataclass(frozen=True, slots=True, eq=False)
class PlannedFloor:
    """A plan of the next points, with its model, its floor and its inputs.

    Attributes
    ----------
    model, run, rig : model, run and rig of the plan.
    plan : plan over the centres of the floor's cells, (b * a,), row by row.
    xs_m, ys_m : (a,), (b,), the centres of these cells.
    height_m : height of the marker whose error is predicted.
    measured_m : (n, 3), the points that the model was fitted on.
    notes : remarks on the plan.
    drive : the drive that reduces the error most; None for a model that reads no drives.
    """

    model: str
    run: str
    rig: Rig
    plan: MeasurementPlan
    xs_m: Array
    ys_m: Array
    height_m: float
    measured_m: Array
    notes: tuple[str, ...]
    drive: PlannedDrive | None = None

    def distances_m(self, point_m: Array) -> dict[str, float]:
        """Return the approximate tape distances to a point (3,), by reference point."""
        x_m, y_m, _ = point_m.tolist()
        return {p.name: math.hypot(x_m - p.x_m, y_m - p.y_m) for p in self.rig.reference_points}

    def side(self, point_m: Array) -> str | None:
        """Return the side of a point relative to the line from the first to the second reference point.

        Return None if tape measurements need no side.
        """
        known_m = _references(self.rig)
        if len(known_m) < 2 or not are_collinear(known_m):
            return None
        (x, y), (along, across) = known_m[1] - known_m[0], point_m[:2] - known_m[0]
        return "left" if x * across >= y * along else "right"


def plan_floor(
    session: Session,
    run: str,
    rig: Rig,
    lenses: Lenses,
    count: int,
    heights_m: Sequence[float] = (),
    progress: Progress = lambda done, total: None,
) -> PlannedFloor:
    """Plan the next points to measure for the fitted model of a run.

    Parameters
    ----------
    session : open logs.
    run : run of the fitted model.
    rig, lenses : rig and intrinsics in force; ``lenses`` by camera.
    count : number of points to plan.
    heights_m : possible heights of a marker; empty for the heights that were used so far.
    progress : called after each point.
    """
    model: Model = session.payloads(session.topics(MODEL, run))[-1]
    if reads_corners(model.name):
        return _plan_corner_model(session, model, run, rig, lenses, count, heights_m, progress)
    views = [
        view_of_model(model.name, camera, lenses.get(camera.camera))
        for camera in model.cameras
        if camera.pairs
    ]
    if not views:
        raise IpsysError(f"run {run}: its model does not contain its calibration points; fit it again")
    measured_m = np.unique(np.vstack([view.fitted_m for view in views]), axis=0)
    height_m = _usual_height(rig, measured_m)
    low_m, high_m = _corners(rig, measured_m)
    grid = _cells(low_m, high_m)
    side_m = _side(rig)
    plan = plan_points(
        views,
        mesh(grid.xs_m, grid.ys_m, [height_m]),
        _candidates(
            rig, low_m, high_m, grid.step_m, side_m / 2, heights_m or _used_heights(measured_m[:, 2])
        ),
        _tape(session, rig),
        _RADIUS * side_m,
        count,
        progress,
    )
    notes = tuple(_notes(model, rig, lenses, plan))
    return PlannedFloor(model.name, run, rig, plan, grid.xs_m, grid.ys_m, height_m, measured_m, notes)


def _plan_corner_model(
    session: Session,
    model: Model,
    run: str,
    rig: Rig,
    lenses: Lenses,
    count: int,
    heights_m: Sequence[float],
    progress: Progress,
) -> PlannedFloor:
    """Plan points and a drive for a model of corners: its covariance gives their effect."""
    # Late: scipy takes 1 s, and plans of other models do not need these.
    from ipsys_log.calibration.joint.payload import restore_joint
    from ipsys_log.statistics.joint_plan import choose_drive, expect_on_floor, plan_joint_points

    models = {camera: joint for camera, joint in restore_joint(model).items() if camera in lenses}
    if not models:
        raise IpsysError(f"run {run}: no camera of its model has a calibration; give one with --calibration")
    sizes_px = {name: (lenses[name].width, lenses[name].height) for name in models}
    pairs = [pair for camera in model.cameras for pair in camera.pairs]
    measured_m = np.unique(np.array([pair.world_m for pair in pairs]).reshape(-1, 3), axis=0)
    if rig.floor is None and not len(measured_m):
        raise IpsysError("the rig has no floor; write its width_m and depth_m into lab.toml, and give --rig")
    low_m, high_m = _corners(rig, measured_m)
    grid = _cells(low_m, high_m)
    side_m, height_m = _side(rig), _usual_height(rig, measured_m)
    expected = expect_on_floor(models, sizes_px, grid, height_m, side_m)
    candidates_m = _candidates(rig, low_m, high_m, _COARSE * grid.step_m, side_m / 2, heights_m or [0.0])
    tape_m2 = _tape_covariances(session, rig)
    plan = plan_joint_points(expected, candidates_m, tape_m2, count, progress)
    drive = choose_drive(expected, low_m, high_m, height_m)
    notes = tuple(_joint_notes(rig, {*models}))
    return PlannedFloor(model.name, run, rig, plan, grid.xs_m, grid.ys_m, height_m, measured_m, notes, drive)


def _usual_height(rig: Rig, measured_m: Array) -> float:
    """Return the usual known height of the robots' markers, or that of the measured points (n, 3)."""
    carried_m = [height for marker in rig.markers if (height := rig.height_of(marker.id)) is not None]
    if not carried_m and rig.marker_height_m is not None:
        carried_m = [rig.marker_height_m]
    return round(float(np.median(carried_m or measured_m[:, 2].tolist() or [0.0])), 3)


def _cells(low_m: Array, high_m: Array) -> FloorGrid:
    """Return the grid of the centres of the floor's cells."""
    step_m = _STEP_M * max(1, round(float((high_m - low_m).max()) / _SPAN_M))
    return FloorGrid.of_cells(low_m, high_m, step_m)


def _side(rig: Rig) -> float:
    return max((rig.length_of(marker.id) for marker in rig.markers), default=rig.marker_length_m)


def view_of_model(name: str, camera: CameraModel, lens: CameraCalibration | None) -> FittedCamera:
    """Return the view of a fitted camera; ``name`` is the name of its model, ``lens`` None if not known."""
    points_m, world_m = (np.array([getattr(p, key) for p in camera.pairs]) for key in ("camera_m", "world_m"))
    arrays = {p.name: p.values.reshape(p.shape) for p in camera.parameters}
    if {"rotation", "origin", "lens"} <= set(arrays):
        rotation, origin_m, bend = arrays["rotation"], arrays["origin"], arrays["lens"]
    else:
        (rotation, origin_m), bend = rigid_transform(points_m, world_m), np.zeros(3)
    noise = camera.noise
    if noise is None:
        fit = _USUAL_FIT**2 * np.eye(3)
        uncertainty = Uncertainty(_USUAL_NOISE, _USUAL_NOISE, 1.0, fit, points_m)
    else:
        uncertainty = Uncertainty(noise.along, noise.across, noise.growth, noise.fit, points_m)
    pose = invert_pose(make_pose(rotation, origin_m))
    return FittedCamera(
        camera.camera, pose, bend, lens, AppliedModel(name, camera).predict, uncertainty, world_m
    )


def _used_heights(heights_m: Array) -> list[float]:
    """Return the used heights, rounded to centimetres.

    If there are many, return some of them, from the lowest to the highest.
    """
    used_m = np.unique(np.round(heights_m, 2))
    chosen = np.linspace(0, len(used_m) - 1, min(len(used_m), _MOST_HEIGHTS)).round().astype(int)
    return [float(height_m) for height_m in used_m[chosen]]


def _corners(rig: Rig, measured_m: Array) -> tuple[Array, Array]:
    if rig.floor is not None:
        return np.zeros(2), np.array([rig.floor.width_m, rig.floor.depth_m])
    low_m, high_m = measured_m[:, :2].min(axis=0), measured_m[:, :2].max(axis=0)
    return np.round(low_m - _AROUND_M, 1), np.round(high_m + _AROUND_M, 1)


def _candidates(
    rig: Rig, low_m: Array, high_m: Array, step_m: float, half_m: float, heights_m: Sequence[float]
) -> Array:
    """Return possible points for a marker, (c, 3): not over the edge of the floor or a reference point."""
    inset_m = _STEP_M * math.ceil(half_m / _STEP_M - 1e-9)
    # The coordinates are in whole centimetres, as the plan prints them.
    xs_m, ys_m = (
        np.arange(a + inset_m, b - half_m + 1e-9, step_m).round(2) for a, b in zip(low_m, high_m, strict=True)
    )
    points_m = mesh(xs_m, ys_m, heights_m)
    apart_m = np.linalg.norm(points_m[:, None, :2] - _references(rig), axis=2)
    free: Array = points_m[(apart_m > half_m).all(axis=1)]
    return free


def mesh(xs_m: Array, ys_m: Array, zs_m: Sequence[float]) -> Array:
    """Return all points of a grid, (n, 3), row by row."""
    return np.stack(np.meshgrid(xs_m, ys_m, zs_m), axis=-1).reshape(-1, 3)


def _references(rig: Rig) -> Array:
    return np.array([(p.x_m, p.y_m) for p in rig.reference_points]).reshape(-1, 2)


def _tape(session: Session, rig: Rig) -> Callable[[Array], Array]:
    """Return a function for the variance of x plus the variance of y at points (n, 3), by tape.

    Without two reference points, the function returns 0.
    """
    covariances = _tape_covariances(session, rig)

    def variances(world_m: Array) -> Array:
        if len(rig.reference_points) < 2:
            return np.zeros(len(world_m))
        floor_m, rows = np.unique(world_m[:, :2], axis=0, return_inverse=True)
        return np.asarray(np.trace(covariances(floor_m), axis1=1, axis2=2)[rows.reshape(-1)])

    return variances


def _tape_covariances(session: Session, rig: Rig) -> TapeCovariances:
    """Return the covariances of tape measurements with the usual sigma of the measurements in a log."""
    payloads = session.payloads(session.topics(MEASUREMENTS)) if rig.tape_sigma_m is None else []
    named_m = [d.sigma_m for measurement in payloads for d in measurement.distances if d.sigma_m]
    return expected_tape_covariances(rig, float(np.median(named_m or USUAL_TAPE_SIGMA_M)))


def _joint_notes(rig: Rig, fitted: set[str]) -> Iterator[str]:
    for camera in sorted({camera.name for camera in rig.cameras} - fitted):
        yield f"camera {camera} has no model: drive a robot through its field of view first"
    yield from _rig_notes(rig)


def _rig_notes(rig: Rig) -> Iterator[str]:
    if rig.floor is None:
        yield "the rig has no floor: the plan covers the measured points and 50 cm around them"
    if len(rig.reference_points) < 2:
        yield "the rig has fewer than two reference points: the plan ignores tape errors"


def _notes(model: Model, rig: Rig, lenses: Lenses, plan: MeasurementPlan) -> Iterator[str]:
    fitted = {camera.camera for camera in model.cameras if camera.pairs}
    for camera in sorted({camera.name for camera in rig.cameras} - fitted):
        yield (
            f"camera {camera} has no model: first measure about 10 points in its field "
            "of view, up to its edges"
        )
    for row in model.cameras:
        if 0 < len(row.pairs) < _LEAST_PLACES:
            yield (
                f"camera {row.camera} has fewer than {_LEAST_PLACES} points: its "
                "present error is only a rough estimate"
            )
        if row.camera in fitted and row.camera not in lenses:
            yield (
                f"camera {row.camera} has no intrinsics in the log: its field of view "
                "is taken as the area of its points"
            )
        if row.camera in fitted and row.noise is None:
            yield (
                f"camera {row.camera} has too few points for an estimate of its noise: usual noise is assumed"
            )
    yield from _rig_notes(rig)
    if plan.places[-1].mean_after_m > (1 - _LITTLE) * plan.places[0].mean_before_m:
        yield "these points change little: most of the predicted error is camera noise, not fit error"
