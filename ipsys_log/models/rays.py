"""Rays of a camera in the world: its pose and a small lens correction, fitted to calibration points.

A marker's depth from its size (eq. 3) is ten times as uncertain as its direction. If the height of a marker
is known, its position on the floor follows from the direction alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.models.plain_models import rigid_transform
from ipsys_log.vision.lenses import intersect_height
from ipsys_log.vision.poses import rotate, skew_matrices

# Errors on the floor above this get less weight: the usual error of a tape.
_USUAL_M = 0.005
# The correction of a calibrated lens has terms well below 0.05. This weak prior towards zero allows fits to
# few calibration points.
_LENS_PULL_M = 0.1
# Share of the tape in the variance of a residual. The share of the camera is about the same in the paper's
# lab.
_TAPE_SHARE = 0.5
_MOST_STEPS = 200
_FIRST_DAMPING = 1e-4
# With this damping, the curvature is regular.
_LEAST_DAMPING = 1e-10
# The fit has converged if a step is expected to decrease the cost by less than this share: the step is then
# about a millionth of the standard deviation.
_STALLED = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class CameraRays:
    """A camera's ``rotation`` (3, 3) and ``origin_m`` (3,) in the world, and its correction ``lens`` (3,)."""

    rotation: Array
    origin_m: Array
    lens: Array


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationPoints:
    """Calibration points that one camera measured.

    ``points_m`` (n, 3) are in camera coordinates, ``world_m`` (n, 3) in world coordinates. ``names`` are the
    names of the measurements. ``calibration_points`` name the points of the floor: several measurements, also
    of other cameras, may be of the same point. If it is empty, each measurement has its own point.
    """

    points_m: Array
    world_m: Array
    names: tuple[str, ...]
    calibration_points: tuple[str, ...] = ()

    @property
    def point_names(self) -> tuple[str, ...]:
        """The point of the floor of each measurement."""
        return self.calibration_points or self.names


def directions(points_m: Array, lens: Array) -> Array:
    """Return directions (u', v', 1) in camera coordinates, (n, 3), from camera points (n, 3).

    The lens correction ``lens`` = (k1, p1, p2) of u = Xc / Zc, v = Yc / Zc has the first radial and the two
    tangential terms of Brown and Conrady.

    Examples
    --------
    >>> directions(np.array([[2.0, 0.0, 2.0]]), np.array([0.01, 0.0, 0.0])).tolist()
    [[1.01, 0.0, 1.0]]
    """
    u, v = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
    shift = _lens_terms(u, v) @ lens
    along = np.empty((len(u), 3))  # np.stack takes several times as long for the few points of a frame
    along[:, 0], along[:, 1], along[:, 2] = u + shift[:, 0], v + shift[:, 1], 1.0
    return along


def _lens_terms(u: Array, v: Array) -> Array:
    """Return the derivative of (u', v') by (k1, p1, p2), (n, 2, 3)."""
    r2 = u * u + v * v
    terms = np.empty((len(u), 2, 3))
    terms[:, 0, 0], terms[:, 1, 0] = u * r2, v * r2
    terms[:, 0, 1] = terms[:, 1, 2] = 2 * u * v
    terms[:, 0, 2], terms[:, 1, 1] = r2 + 2 * u * u, r2 + 2 * v * v
    return terms


def fit_rays(cameras: Sequence[CalibrationPoints]) -> list[CameraRays]:
    """Estimate pose and lens correction of each camera, from calibration points of known height.

    The fit minimises the errors on the floor with a soft-L1 loss and starts from the rigid transformation.
    Calibration points that several cameras measured tie these cameras together. Differences between the
    cameras cannot be errors of the tape, so they get more weight than the common part.

    Raises
    ------
    FitError
        A camera has fewer than three calibration points, or they are on a line.
    """
    fitted: list[CameraRays | None] = [None] * len(cameras)
    for group in group_cameras(cameras):
        for index, camera_rays in zip(group, _fit_group([cameras[i] for i in group]), strict=True):
            fitted[index] = camera_rays
    return [camera_rays for camera_rays in fitted if camera_rays is not None]


def group_cameras(cameras: Sequence[CalibrationPoints]) -> list[list[int]]:
    """Return groups of cameras that share calibration points, directly or through other cameras."""
    groups: list[tuple[list[int], set[str]]] = []
    for index, places in enumerate(cameras):
        names = set(places.point_names)
        met = [group for group in groups if group[1] & names]
        groups = [group for group in groups if not group[1] & names]
        indices = sorted([index, *(i for group in met for i in group[0])])
        groups.append((indices, names.union(*(group[1] for group in met))))
    return [indices for indices, _ in groups]


def _fit_group(cameras: Sequence[CalibrationPoints]) -> list[CameraRays]:
    """Fit cameras with common points by damped Gauss-Newton steps, with the curvature of the soft-L1 loss.

    References
    ----------
    Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment - a modern synthesis, 2000, sect. 4.3.
    """
    starts = [rigid_transform(places.points_m, places.world_m) for places in cameras]
    rays = [CameraRays(rotation, origin_m, np.zeros(3)) for rotation, origin_m in starts]
    weights = _weights([name for places in cameras for name in places.point_names])
    residuals = _residuals(cameras, rays, weights)
    cost, damping = _soft_cost(residuals), _FIRST_DAMPING
    if not np.isfinite(cost):
        raise FitError(
            "the rays of the camera do not fit the calibration points; check the heights of the points"
        )
    for _ in range(_MOST_STEPS):
        slopes = _jacobian(cameras, rays, weights)
        shares = 1 + (residuals / _USUAL_M) ** 2
        gradient = (residuals / np.sqrt(shares)) @ slopes
        curvature = (slopes.T * shares**-1.5) @ slopes
        while True:
            damped = curvature + damping * np.diag(curvature.diagonal())
            step = np.asarray(np.linalg.solve(damped, -gradient), dtype=np.float64)
            if -(gradient @ step) <= _STALLED * cost:
                return rays
            moved = _move(rays, step)
            residuals = _residuals(cameras, moved, weights)
            moved_cost = _soft_cost(residuals)
            if moved_cost <= cost:
                break
            damping *= 10
        rays, cost, damping = moved, moved_cost, max(damping / 10, _LEAST_DAMPING)
    return rays


def _soft_cost(residuals: Array) -> float:
    """Return half the soft-L1 loss of residuals in m, in m^2."""
    return float(_USUAL_M**2 * (np.sqrt(1 + (residuals / _USUAL_M) ** 2) - 1).sum())


def _move(rays: Sequence[CameraRays], step: Array) -> list[CameraRays]:
    """Return cameras after a turn in the world, a shift and a change of the lens, nine numbers for each."""
    steps = step.reshape(-1, 9)
    turns = rotate(steps[:, :3])
    return [
        CameraRays(turn @ own.rotation, own.origin_m + change[3:6], own.lens + change[6:])
        for own, turn, change in zip(rays, turns, steps, strict=True)
    ]


def _residuals(cameras: Sequence[CalibrationPoints], rays: Sequence[CameraRays], weights: Array) -> Array:
    """Return the weighted errors on the floor, and the pulls of the lens corrections, in m."""
    offsets = np.vstack([_offsets(places, own) for places, own in zip(cameras, rays, strict=True)])
    pulls = _LENS_PULL_M * np.concatenate([own.lens for own in rays])
    return np.concatenate([(weights @ offsets).reshape(-1), pulls])


def _jacobian(cameras: Sequence[CalibrationPoints], rays: Sequence[CameraRays], weights: Array) -> Array:
    """Return the derivative of :func:`_residuals` by the numbers of :func:`_move`."""
    rows, size, edge = np.zeros((len(weights), 2, 9 * len(rays))), 9 * len(rays), 0
    for n, (places, own) in enumerate(zip(cameras, rays, strict=True)):
        end = edge + len(places.names)
        rows[edge:end, :, 9 * n : 9 * n + 9] = _slopes(places, own)
        edge = end
    pulls = _LENS_PULL_M * np.eye(size)[np.arange(size) % 9 >= 6]
    return np.vstack([(weights @ rows.reshape(len(rows), -1)).reshape(-1, size), pulls])


def _offsets(places: CalibrationPoints, camera_rays: CameraRays) -> Array:
    """Return errors on the floor at the known heights, (n, 2) in m."""
    rays = directions(places.points_m, camera_rays.lens) @ camera_rays.rotation.T
    return (intersect_height(camera_rays.origin_m, rays, places.world_m[:, 2]) - places.world_m)[:, :2]


def _slopes(places: CalibrationPoints, camera_rays: CameraRays) -> Array:
    """Return the derivative of :func:`_offsets` by a turn in the world, origin and lens, (n, 2, 9)."""
    points_m = places.points_m
    rays = directions(points_m, camera_rays.lens) @ camera_rays.rotation.T
    along = (places.world_m[:, 2] - camera_rays.origin_m[2]) / rays[:, 2]
    on_plane = np.zeros((len(rays), 2, 3))  # derivative of the point by the origin
    on_plane[:, 0, 0] = on_plane[:, 1, 1] = 1.0
    on_plane[:, :, 2] = -rays[:, :2] / rays[:, 2:]
    by_ray = along[:, None, None] * on_plane
    by_turn = -by_ray @ skew_matrices(rays)
    u, v = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
    by_lens = by_ray @ camera_rays.rotation[:, :2] @ _lens_terms(u, v)
    return np.concatenate([by_turn, on_plane, by_lens], axis=2)


def _weights(names: Sequence[str]) -> Array:
    """Return the matrix (n, n) that gives the residuals (n, ...) of calibration points equal variances.

    The residuals of a calibration point in k cameras share the tape's error T. Each also has the camera's own
    error C. Their mean has the variance T + C / k, and their differences have the variance C.
    """
    rows_of: dict[str, list[int]] = {}
    for row, name in enumerate(names):
        rows_of.setdefault(name, []).append(row)
    weights = np.eye(len(names))
    for rows in rows_of.values():
        if len(rows) > 1:
            weights[np.ix_(rows, rows)] = _weights_of_a_point(len(rows))
    return weights


@cache
def _weights_of_a_point(count: int) -> Array:
    basis = np.linalg.qr(np.column_stack([np.ones(count), np.eye(count)[:, 1:]]))[0].T
    variances = np.full(count, 1 - _TAPE_SHARE)
    variances[0] += count * _TAPE_SHARE
    weights: Array = basis / np.sqrt(variances)[:, None]
    return weights
