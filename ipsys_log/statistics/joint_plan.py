"""Next points to measure, and the next drive, for a joint calibration.

A sighting of a robot has eight coordinates of corners and three unknowns: its place and its heading. The rest
is information about the cameras and the floor. The information of all sightings of a drive, and the known
modes of the calibration, give the expected error after the drive, without a fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.locate import edge_motion, linearise_corners, marker_arms
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array
from ipsys_log.messages.stage import Progress
from ipsys_log.statistics.expected_error import (
    ExpectedErrors,
    choose_points,
    expect_errors,
    mean_error,
    mean_lengths,
    see_markers,
    some_modes,
)
from ipsys_log.statistics.floor_cameras import FloorGrid
from ipsys_log.statistics.plan import MeasurementPlan, PlannedPlace
from ipsys_log.statistics.tape import TapeCovariances

# A drive lasts this time.
DRIVE_S = 30.0
# A camera sees the robot so often per second.
_RATE_HZ = 10.0
# Places of the robot are this far apart.
_STEP_M = 0.3
# A drive covers a square of so many places.
_SQUARE = 4
# Usual noise of a detected corner.
_CORNER_SIGMA_PX = 0.02
# Two successive places have headings that differ by the golden angle, so that all headings occur.
_GOLDEN_RAD = np.pi * (3 - np.sqrt(5))
# A smaller reduction is not worth a drive.
_LITTLE = 0.05
_FLAT = np.array([0, 1, 5])


def expect_on_floor(
    models: Mapping[str, JointModel],
    sizes_px: Mapping[str, tuple[int, int]],
    grid: FloorGrid,
    height_m: float,
    length_m: float,
) -> list[ExpectedErrors]:
    """Return the expected errors of all cameras over the floor, see :func:`expect_errors`."""
    expected = expect_errors(models, sizes_px, grid, height_m, length_m)
    if not any(len(one.errors_m) for one in expected):
        raise IpsysError(f"no camera sees a whole marker {height_m:g} m above the floor; give another height")
    return expected


def plan_joint_points(
    expected: Sequence[ExpectedErrors],
    candidates_m: Array,
    tape_m2: TapeCovariances,
    count: int,
    progress: Progress = lambda done, total: None,
) -> MeasurementPlan:
    """Choose the points to measure next, and predict the error over the floor after each.

    Parameters
    ----------
    expected : from :func:`expect_on_floor`.
    candidates_m : (c, 3), possible positions of a marker.
    tape_m2 : function for the covariances of tape readings.
    count : number of points.
    progress : called after each point.
    """
    flat_m, heights_m = candidates_m[:, :2], candidates_m[:, 2]
    points = choose_points(expected, flat_m, tape_m2, 0.0, count, heights_m, progress)
    if not points:
        raise IpsysError("no camera sees a whole marker at these heights on the floor; give another height")
    updates = [None, *(point.update for point in points)]
    maps_m = _least(expected, updates)
    means_m = [float(np.nanmean(one)) for one in maps_m]
    places = tuple(
        PlannedPlace(np.append(point.point_m, point.height_m), point.cameras, before_m, after_m)
        for point, (before_m, after_m) in zip(points, pairwise(means_m), strict=True)
    )
    return MeasurementPlan(places, maps_m[0], maps_m[-1], {one.camera: one.seen for one in expected})


@dataclass(frozen=True, slots=True, eq=False)
class PlannedDrive:
    """A drive in curves through a rectangle of the floor, and its effect.

    ``low_m`` and ``high_m`` (2,) are the corners of the rectangle. ``cameras`` see the robot in it.
    ``mean_before_m`` and ``mean_after_m`` are the mean expected errors over the floor, without new points.
    """

    low_m: Array
    high_m: Array
    cameras: tuple[str, ...]
    mean_before_m: float
    mean_after_m: float

    @property
    def is_useful(self) -> bool:
        """True if the drive reduces the error noticeably: no drive reduces the error of the tape."""
        return self.mean_after_m < (1 - _LITTLE) * self.mean_before_m


def choose_drive(
    expected: Sequence[ExpectedErrors], low_m: Array, high_m: Array, height_m: float
) -> PlannedDrive | None:
    """Choose the square of the floor in which a drive of 30 s reduces the mean expected error most.

    Parameters
    ----------
    expected : expected errors of all cameras.
    low_m, high_m : (2,), corners of the floor.
    height_m : height of the robot's marker.

    Returns
    -------
    The drive; None if no camera sees a robot.
    """
    modes_m = some_modes(expected)
    grid = FloorGrid.of_cells(low_m, high_m, _STEP_M)
    if not len(modes_m) or not len(grid.nodes_m):
        return None
    seen, rows = _information(expected, grid.nodes_m, height_m)
    shape = len(grid.ys_m), len(grid.xs_m)
    places_m = grid.nodes_m.reshape(*shape, 2)
    seen, rows = seen.reshape(len(expected), *shape), rows.reshape(*shape, *rows.shape[1:])
    best: tuple[float, slice, slice] | None = None
    for y in range(0, max(1, shape[0] - _SQUARE + 1), _SQUARE // 2):
        for x in range(0, max(1, shape[1] - _SQUARE + 1), _SQUARE // 2):
            square = slice(y, y + _SQUARE), slice(x, x + _SQUARE)
            if not seen[:, *square].any():
                continue
            after_m = mean_error(modes_m @ _update(rows[square], seen[:, *square]))
            if best is None or after_m < best[0]:
                best = after_m, *square
    if best is None:
        return None
    after_m, rows_y, rows_x = best
    inside_m, half_m = places_m[rows_y, rows_x].reshape(-1, 2), _STEP_M / 2
    cameras = tuple(
        one.camera for one, own in zip(expected, seen[:, rows_y, rows_x], strict=True) if own.any()
    )
    drive_m = inside_m.min(axis=0) - half_m, np.minimum(inside_m.max(axis=0) + half_m, high_m)
    return PlannedDrive(*drive_m, cameras, mean_error(modes_m), after_m)


def _least(expected: Sequence[ExpectedErrors], updates: Sequence[Array | None]) -> list[Array]:
    """Return the least expected error of the cameras at each node, (n,), after each update of the modes.

    The error is NaN if no camera sees the node.
    """
    maps_m = [np.full(len(expected[0].seen), np.nan) for _ in updates]
    for one in expected:
        modes_m = one.modes_m()
        for least_m, update in zip(maps_m, updates, strict=True):
            updated_m = modes_m if update is None else modes_m @ update
            errors_m = mean_lengths(updated_m @ updated_m.swapaxes(1, 2))
            least_m[one.seen] = np.fmin(least_m[one.seen], errors_m)
    return maps_m


def _update(rows: Array, seen: NDArray[np.bool_]) -> Array:
    """Return a root (m, m) of the covariance of the modes after a drive.

    ``rows`` (..., k, m + 1) is the information of one sighting at each place, ``seen`` (c, ...) tells which
    cameras see the place. The robot spends the same time at each seen place.
    """
    places = int(seen.any(axis=0).sum())
    weighted = rows.reshape(-1, rows.shape[-1]) * np.sqrt(DRIVE_S * _RATE_HZ / places)
    # The last unknown is the height of the marker on its robot.
    covariance = np.linalg.inv(np.eye(rows.shape[-1]) + weighted.T @ weighted)[:-1, :-1]
    return np.asarray(np.linalg.cholesky((covariance + covariance.T) / 2))


def _information(
    expected: Sequence[ExpectedErrors], places_m: Array, height_m: float
) -> tuple[NDArray[np.bool_], Array]:
    """Return a mask (c, p) of the cameras that see a robot at p places, and slopes (p, 8 c, m + 1).

    The slopes are those of whitened corners by the modes and by the height of the robot, without the part
    that the place and the heading of the robot explain.
    """
    headings_rad = np.arange(len(places_m)) * _GOLDEN_RAD
    count = expected[0].model.modes.shape[1] + 1
    seen = np.zeros((len(expected), len(places_m)), dtype=np.bool_)
    slopes = np.zeros((len(places_m), 8 * len(expected), count))
    by_pose = np.zeros((len(places_m), 8 * len(expected), 3))
    for number, one in enumerate(expected):
        view = see_markers(one.model, one.size_px, places_m, height_m, one.length_m, headings_rad)
        seen[number] = view.seen
        own = slice(8 * number, 8 * number + 8)
        if view.seen.any():
            whitened = _whitened_slopes(one.model, *view[1:4], one.length_m)
            slopes[view.seen, own], by_pose[view.seen, own] = whitened
    visible = seen.any(axis=0)
    axes = np.linalg.qr(by_pose[visible])[0]
    slopes[visible] -= axes @ (axes.swapaxes(1, 2) @ slopes[visible])
    return seen, slopes


def _whitened_slopes(
    model: JointModel, corners_px: Array, centres_m: Array, turns: Array, length_m: float
) -> tuple[Array, Array]:
    """Return slopes of whitened corners (n, 8, ...): by modes and height (m + 1), and by x, y and heading."""
    settings = JointSettings()
    sizes_m = np.full(len(corners_px), length_m * model.scale)
    arms_m = marker_arms(turns, sizes_m)
    now = linearise_corners(model, corners_px, edge_motion(corners_px), centres_m, arms_m)
    _, floor_slopes, floor_modes = model.floor.evaluate(centres_m, model.amplitudes)
    by_height = now.by_pose[:, :, 2:3]
    by_pose = now.by_pose[:, :, _FLAT]
    by_pose[:, :, :2] += by_height * floor_slopes[:, None]
    by_modes = model.error_modes(now.by_camera, by_height, floor_modes)
    tilts = now.by_pose[:, :, 3:5] * settings.wobble_sigma_rad
    noise_px2 = _CORNER_SIGMA_PX**2 * np.eye(8)
    whitening = np.linalg.inv(np.linalg.cholesky(noise_px2 + tilts @ tilts.swapaxes(1, 2)))
    slopes = np.concatenate([by_modes, by_height * settings.robot_height_sigma_m], axis=2)
    return whitening @ slopes, whitening @ by_pose
