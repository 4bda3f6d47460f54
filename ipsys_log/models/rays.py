"""Rays of a camera in the world: its pose and a small lens correction, fitted to calibration points.

A marker's depth from its size (eq. 3) is ten times as uncertain as its direction. If the height of a marker
is known, its position on the floor follows from the direction alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.vision.lenses import intersect_height
from ipsys_log.vision.poses import skew_matrices

# Errors on the floor above this get less weight: the usual error of a tape.
_USUAL_M = 0.005
# The correction of a calibrated lens has terms well below 0.05. This weak prior towards zero allows fits to
# few calibration points.
_LENS_PULL_M = 0.1
# Share of the tape in the variance of a residual. The share of the camera is about the same in the paper's
# lab.
_TAPE_SHARE = 0.5


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
    # Late: most commands fit nothing, and scipy and scikit-learn take 1.5 s.
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    from ipsys_log.models.plain_models import rigid_transform

    starts = [rigid_transform(places.points_m, places.world_m) for places in cameras]
    weights = _weights([name for places in cameras for name in places.point_names])
    first = np.concatenate([np.concatenate([np.zeros(3), t, np.zeros(3)]) for _, t in starts])
    ends = np.cumsum([0, *(len(places.names) for places in cameras)])

    def camera_rays(values: Array) -> list[CameraRays]:
        return [
            CameraRays(Rotation.from_rotvec(v[:3]).as_matrix() @ start, v[3:6], v[6:])
            for v, (start, _) in zip(values.reshape(-1, 9), starts, strict=True)
        ]

    def residuals(values: Array) -> Array:
        offsets = [_offsets(p, b) for p, b in zip(cameras, camera_rays(values), strict=True)]
        pulls = values.reshape(-1, 9)[:, 6:] * _LENS_PULL_M
        return np.concatenate([(weights @ np.vstack(offsets)).reshape(-1), pulls.reshape(-1)])

    def jacobian(values: Array) -> Array:
        rows = np.zeros((ends[-1], 2, len(values)))
        pulls = np.zeros((3 * len(cameras), len(values)))
        for n, (places, b) in enumerate(zip(cameras, camera_rays(values), strict=True)):
            rows[ends[n] : ends[n + 1], :, 9 * n : 9 * n + 9] = _slopes(places, b, values[9 * n : 9 * n + 3])
            pulls[3 * n : 3 * n + 3, 9 * n + 6 : 9 * n + 9] = _LENS_PULL_M * np.eye(3)
        return np.vstack([np.tensordot(weights, rows, axes=1).reshape(-1, len(values)), pulls])

    solved = least_squares(
        residuals, first, jacobian, loss="soft_l1", f_scale=_USUAL_M, x_scale="jac", max_nfev=200
    )
    if not np.isfinite(solved.x).all():
        raise FitError(
            "the rays of the camera do not fit the calibration points; check the heights of the points"
        )
    return camera_rays(solved.x)


def _offsets(places: CalibrationPoints, camera_rays: CameraRays) -> Array:
    """Return errors on the floor at the known heights, (n, 2) in m."""
    rays = directions(places.points_m, camera_rays.lens) @ camera_rays.rotation.T
    return (intersect_height(camera_rays.origin_m, rays, places.world_m[:, 2]) - places.world_m)[:, :2]


def _slopes(places: CalibrationPoints, camera_rays: CameraRays, turn: Array) -> Array:
    """Return the derivative of :func:`_offsets` by rotation vector, origin and lens, (n, 2, 9)."""
    points_m = places.points_m
    rays = directions(points_m, camera_rays.lens) @ camera_rays.rotation.T
    along = (places.world_m[:, 2] - camera_rays.origin_m[2]) / rays[:, 2]
    on_plane = np.zeros((len(rays), 2, 3))  # derivative of the point by the origin
    on_plane[:, 0, 0] = on_plane[:, 1, 1] = 1.0
    on_plane[:, :, 2] = -rays[:, :2] / rays[:, 2:]
    by_ray = along[:, None, None] * on_plane
    by_turn = -by_ray @ skew_matrices(rays) @ _left_jacobian(turn)
    u, v = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
    by_lens = by_ray @ camera_rays.rotation[:, :2] @ _lens_terms(u, v)
    return np.concatenate([by_turn, on_plane, by_lens], axis=2)


def _left_jacobian(turn: Array) -> Array:
    """Return the left Jacobian of a rotation by its rotation vector (3,) (Barfoot 2017, eq. 7.77).

    ``left_jacobians`` differs in the last bits, so rayplane would have another output with it.
    """
    angle = float(np.linalg.norm(turn))
    if angle < 1e-8:
        return np.eye(3)
    skew = skew_matrices(turn[None])[0]
    first, second = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    jacobian: Array = np.eye(3) + first * skew + second * skew @ skew
    return jacobian


def _weights(names: Sequence[str]) -> Array:
    """Return the matrix (n, n) that gives the residuals (n, ...) of calibration points equal variances.

    The residuals of a calibration point in k cameras share the tape's error T. Each also has the camera's own
    error C. Their mean has the variance T + C / k, and their differences have the variance C.
    """
    weights = np.eye(len(names))
    for name in {name for name in names if names.count(name) > 1}:
        rows = np.flatnonzero([other == name for other in names])
        basis = np.linalg.qr(np.column_stack([np.ones(len(rows)), np.eye(len(rows))[:, 1:]]))[0].T
        variances = np.full(len(rows), 1 - _TAPE_SHARE)
        variances[0] += len(rows) * _TAPE_SHARE
        weights[np.ix_(rows, rows)] = basis / np.sqrt(variances)[:, None]
    return weights
