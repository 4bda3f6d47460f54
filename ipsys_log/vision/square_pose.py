"""Pose estimation of square markers: both poses that explain the four corners."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners

_UNIT_CORNERS = marker_corners(1.0)[:, :2]
_UNIT = np.eye(2)


def solve_squares(uv: Array, lengths_m: Array) -> tuple[Array, Array]:
    """Return the two poses of square markers by IPPE, a closed formula that is exact for exact corners.

    OpenCV also has this method (``SOLVEPNP_IPPE_SQUARE``). It returns NaN, or wrong numbers, for markers that
    exactly face the camera.

    Parameters
    ----------
    uv : (n, 4, 2), normalized image coordinates of corners that go around (see
        :func:`ipsys_log.vision.square_pose.is_convex`).
    lengths_m : (n,), sides of the black squares, in m.

    Returns
    -------
    rotations : (n, 2, 3, 3), the marker's axes in camera coordinates.
    centres_m : (n, 2, 3).

    References
    ----------
    Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 2014.
    """
    slope, centre_uv = _homography(uv, lengths_m)
    camera_from_view = _along_view(centre_uv)
    # Image motion of a point near the centre. It is zero for a motion along the view direction.
    seen = camera_from_view[:, :2, :2] - centre_uv[:, :, None] * camera_from_view[:, 2:, :2]
    flat = _solve(seen, slope)
    # The upper two rows of two columns of a rotation have a largest singular value of 1, which is the scale.
    det = flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0]
    squares = (flat * flat).sum(axis=(1, 2))
    per_m2 = (squares + np.sqrt(np.maximum(squares * squares - 4 * det * det, 0))) / 2
    flat /= np.sqrt(per_m2)[:, None, None]
    depths = np.sqrt(np.maximum(1 - (flat * flat).sum(axis=1), 0))
    depths[:, 1] *= np.where((flat[:, :, 0] * flat[:, :, 1]).sum(axis=1) > 0, -1, 1)
    both = np.empty((len(uv), 2, 3, 3))
    both[:, :, :2, :2] = flat[:, None]
    both[..., 2, 2] = (det / per_m2)[:, None]
    # The third column is the cross product of the first two. Its x and y have the sign of their depths. Its
    # own depth is the same for both signs.
    normal = flat[:, ::-1, 0] * depths[:, 1:] - flat[:, ::-1, 1] * depths[:, :1]
    normal[:, 1] *= -1
    for pose, sign in enumerate((1, -1)):
        both[:, pose, 2, :2], both[:, pose, :2, 2] = sign * depths, sign * normal
    centres_m = np.ones((len(uv), 2, 3))
    centres_m[..., :2] = centre_uv[:, None]
    return camera_from_view[:, None] @ both, centres_m / np.sqrt(per_m2)[:, None, None]


def _homography(uv: Array, lengths_m: Array) -> tuple[Array, Array]:
    """Return slopes of (u, v) by the marker's x and y, (n, 2, 2), and (u, v), (n, 2), at marker centres."""
    corners_m = _UNIT_CORNERS * lengths_m[:, None, None]
    equations = np.zeros((len(uv), 4, 2, 8))
    equations[:, :, 0, 0:2] = equations[:, :, 1, 3:5] = corners_m
    equations[:, :, 0, 2] = equations[:, :, 1, 5] = 1
    equations[..., 6:] = -uv[..., None] * corners_m[:, :, None]
    coefficients = _solve(equations.reshape(-1, 8, 8), uv.reshape(-1, 8, 1))[..., 0]
    affine = coefficients[:, :6].reshape(-1, 2, 3)
    centre_uv = affine[:, :, 2]
    return affine[:, :, :2] - centre_uv[:, :, None] * coefficients[:, None, 6:], centre_uv


def _along_view(uv: Array) -> Array:
    """Return the smallest rotations (n, 3, 3) from the optical axis to the direction of (u, v)."""
    away = np.ones((len(uv), 3))
    away[:, :2] = uv
    away /= np.sqrt((away * away).sum(axis=1))[:, None]
    turns = np.empty((len(uv), 3, 3))
    turns[:, :2, :2] = _UNIT - away[:, :2, None] * away[:, None, :2] / (1 + away[:, 2, None, None])
    turns[:, :, 2], turns[:, 2, :2] = away, -away[:, :2]
    return turns


def _solve(a: Array, b: Array) -> Array:
    return np.asarray(np.linalg.solve(a, b), dtype=np.float64)


# Most markers are level, to about the first angle; a few are tilted, by about the second one. The tilt
# selects a pose if the corners do not. With the first angle alone, 6 % of small markers that are tilted by 15
# to 30 degrees get their mirrored pose; with the second alone, 1 % of small level markers do.
_LEVEL_RAD, _TILTED_RAD = np.deg2rad(3.0), np.deg2rad(20.0)
# Density of tilted markers at a tilt of 0, relative to that of level ones.
_TILTED_SHARE = 0.03
# Two poses that are nearly equal converge slowly. They do not need more iterations.
_ITERATIONS = 5
# A fit has converged if the expected decrease of chi2 by a step is less than _SETTLED chi2 + _EXACT. This is
# about 0.01 times the noise of the corners, and far below the noise for exact corners.
_SETTLED, _EXACT = 1e-3, 1e-6
_DAMPING = 0.01
_DIAGONAL = np.eye(6)
# A marker with a smaller corner is a line: the area at the corner, divided by the squared perimeter.
_FLAT = 1e-6


class SquarePoses(NamedTuple):
    """Two poses for each of n markers, the likelier pose first.

    ``rotations`` (n, 2, 3, 3) and ``centres_m`` (n, 2, 3) are the marker's axes and centre in camera
    coordinates. ``chi2`` (n, 2) is the sum of the squared residuals of the eight whitened coordinates.
    ``covariances_m2`` (n, 3, 3) are those of the centre of the first pose, ``tilt_sigmas_rad`` (n,) the
    standard deviations of the direction of its normal.
    """

    rotations: Array
    centres_m: Array
    chi2: Array
    covariances_m2: Array
    tilt_sigmas_rad: Array


def fit_squares(uv: Array, whitening: Array, lengths_m: Array) -> SquarePoses:
    """Estimate both poses of square markers from their corners, with a lens that is linear over a pixel.

    The Gauss-Newton method refines both solutions of IPPE until the weighted squares of the reprojection
    error are minimal. If a step fails, it uses Levenberg-Marquardt damping. The first pose has the smaller
    sum of these squares and of :func:`tilt_cost`, for the tilt against the direction opposite to the optical
    axis.

    Parameters
    ----------
    uv : (n, 4, 2), normalized image coordinates of corners that go around (see :func:`is_convex`).
    whitening : (n, 8, 8), matrices that turn changes of u0 v0 .. u3 v3 into numbers of variance 1 (see
        :func:`ipsys_log.vision.markers.whiten`, times the slopes of the lens).
    lengths_m : (n,), sides of the black squares, in m.

    References
    ----------
    Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 2014, for the two solutions.

    Examples
    --------
    >>> uv = np.array([[[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]])
    >>> found = fit_squares(uv, 4000 * np.eye(8)[None], np.array([0.2]))
    >>> found.centres_m[0, 0].round(6).tolist()
    [0.0, 0.0, 2.0]
    """
    corners_m = marker_corners(1.0) * lengths_m[:, None, None]
    seen = _Seen(uv[:, None], whitening[:, None], corners_m[:, None])
    fit = _refine(seen, *solve_squares(uv, lengths_m))
    order = np.argsort(fit.chi2 + tilt_cost(-fit.rotations[..., 2, 2]), axis=1, kind="stable")
    row = np.arange(len(uv))
    rotations, centres_m, chi2 = (
        values[row[:, None], order] for values in (fit.rotations, fit.centres_m, fit.chi2)
    )
    covariances = _pose_covariances(fit.slopes[row, order[:, 0]])
    covariances_m2 = covariances[:, 3:, 3:] * centres_m[:, 0, 2, None, None] ** 2
    return SquarePoses(rotations, centres_m, chi2, covariances_m2, _tilt_sigmas(covariances, rotations[:, 0]))


def tilt_cost(cosines: Array) -> Array:
    """Return -2 log of the probability of a tilt of markers, in the shape of the cosines of the tilts.

    Most tilts have a standard deviation of 3 degrees about each axis, a few have one of 20 degrees.
    """
    # 2 (1 - cosine) is the square of the angle, if the angle is small.
    halves_rad2 = cosines - 1
    usual = halves_rad2 / _LEVEL_RAD**2
    return np.asarray(-2 * np.logaddexp(usual, np.log(_TILTED_SHARE) + halves_rad2 / _TILTED_RAD**2))


def is_convex(uv: Array) -> bool:
    """Return whether corners, (4, 2), go around a convex figure, in the order of a marker in front view."""
    sides = uv[[1, 2, 3, 0]] - uv
    after = sides[[1, 2, 3, 0]]
    turns = sides[:, 0] * after[:, 1] - sides[:, 1] * after[:, 0]
    return bool(turns.min() > _FLAT * (sides * sides).sum())


# Errors that all images of a marker at one place share. The print and the focal length: relative standard
# deviation of the depth. The rest of the lens model, the compression of the images and the bending of a
# print: that of a direction in px. For the real board of tests/stages/real_board.py, chi2 / 3 is then 0.6 to
# 1.5 in four cameras; with the noise of the corners alone, it is 6 to 51.
DEPTH_SHARE = 0.002
_DIRECTION_PX = 0.18


def calibration_covariances(centres_m: Array, lens_slopes: Array) -> Array:
    """Return covariances (n, 3, 3) in m^2 of marker centres by errors of the intrinsics and of the print.

    Parameters
    ----------
    centres_m : (n, 3), in camera coordinates.
    lens_slopes : (n, 2, 2), derivatives of pixels with respect to (u, v).
    """
    across_m = _DIRECTION_PX * centres_m[:, 2, None, None] * np.linalg.inv(lens_slopes)
    covariances: Array = DEPTH_SHARE**2 * centres_m[:, :, None] * centres_m[:, None]
    covariances[:, :2, :2] += across_m @ across_m.swapaxes(1, 2)
    return covariances


def reprojection_px(
    rotations: Array, centres_m: Array, lengths_m: Array, corners_px: Array, lens: CameraCalibration
) -> Array:
    """Return the RMS reprojection error: the distances between corners from poses and measured corners.

    Parameters
    ----------
    rotations, centres_m : (n, 2, 3, 3) and (n, 2, 3), both poses of n markers.
    lengths_m : (n,), sides of the black squares, in m.
    corners_px : (n, 4, 2), measured corners in the raw image.
    lens : the camera's calibration.

    Returns
    -------
    (n, 2), in px.
    """
    corners_m = marker_corners(1.0) * lengths_m[:, None, None]
    points_m = corners_m[:, None] @ rotations.swapaxes(-1, -2) + centres_m[:, :, None]
    again_px = project(points_m.reshape(-1, 3), lens).reshape(-1, 2, 4, 2)
    misses_px2 = ((again_px - corners_px[:, None]) ** 2).sum(axis=-1)
    rms_px: Array = np.sqrt(misses_px2.mean(axis=-1))
    return rms_px


class _Seen(NamedTuple):
    """Inputs of the fit of n markers, the same for both poses: (n, 1, 4, 2), (n, 1, 8, 8), (n, 1, 4, 3)."""

    uv: Array
    whitening: Array
    corners_m: Array


class _Fit(NamedTuple):
    """Two poses for each of n markers, with residuals and slopes as in :func:`_look`, and chi2 (n, 2)."""

    rotations: Array
    centres_m: Array
    residuals: Array
    slopes: Array
    chi2: Array


def _refine(seen: _Seen, rotations: Array, centres_m: Array) -> _Fit:
    """Refine approximate poses by least squares."""
    now = _look(seen, rotations, centres_m)
    damping = np.zeros((len(rotations), 2, 1, 1))
    for _ in range(_ITERATIONS):
        across = now.slopes.swapaxes(-1, -2)
        normal, gradient = across @ now.slopes, across @ now.residuals[..., None]
        step = _solve(normal + damping * (_DIAGONAL * normal), -gradient)
        expected = -(step * gradient).sum(axis=(-1, -2))
        turned = _small_turns(step[..., :3, 0]) @ now.rotations
        moved_m = now.centres_m + step[..., 3:, 0] * now.centres_m[..., 2:]
        tried = _look(seen, turned, moved_m)
        better = (tried.chi2 <= now.chi2) & (moved_m[..., 2] > 0)
        settled = (expected <= _SETTLED * now.chi2 + _EXACT).all()
        now = tried if better.all() else _choose(better, tried, now)
        if settled:
            break
        damping = np.where(better[..., None, None], damping / 100, np.maximum(10 * damping, _DAMPING))
    return now


def _choose(better: NDArray[np.bool_], tried: _Fit, now: _Fit) -> _Fit:
    def pick(new: Array, old: Array) -> Array:
        return np.where(better.reshape(*better.shape, *[1] * (new.ndim - 2)), new, old)

    return _Fit(*(pick(new, old) for new, old in zip(tried, now, strict=True)))


def _look(seen: _Seen, rotations: Array, centres_m: Array) -> _Fit:
    """Return poses with their whitened residuals (n, 2, 8) and the slopes of the residuals, (n, 2, 8, 6).

    The first three parameters are a rotation of the marker about its centre, in rad about the camera's axes.
    The other three are a translation of its centre, in units of its distance z.
    """
    arms_m = seen.corners_m @ rotations.swapaxes(-1, -2)
    points_m = arms_m + centres_m[..., None, :]
    per_m = 1 / points_m[..., 2:]
    uv = points_m[..., :2] * per_m
    u, v = uv[..., 0], uv[..., 1]
    arms = arms_m * per_m
    a, b, c = arms[..., 0], arms[..., 1], arms[..., 2]
    far = centres_m[..., 2, None] * per_m[..., 0]
    # A turn w moves a point by w x arm; u moves by (dx - u dz) / z, v by (dy - v dz) / z.
    slopes = np.zeros((*u.shape, 2, 6))
    slopes[..., 0, 0], slopes[..., 0, 1], slopes[..., 0, 2] = -u * b, c + u * a, -b
    slopes[..., 1, 0], slopes[..., 1, 1], slopes[..., 1, 2] = -c - v * b, v * a, a
    slopes[..., 0, 3] = slopes[..., 1, 4] = far
    slopes[..., 0, 5], slopes[..., 1, 5] = -u * far, -v * far
    residuals = (seen.whitening @ (uv - seen.uv).reshape(*uv.shape[:2], 8, 1))[..., 0]
    slopes = seen.whitening @ slopes.reshape(*uv.shape[:2], 8, 6)
    return _Fit(rotations, centres_m, residuals, slopes, (residuals * residuals).sum(axis=-1))


def _small_turns(vectors_rad: Array) -> Array:
    """Return Cayley's rotations (..., 3, 3) by vectors (..., 3): exact rotations, angles to second order."""
    half = np.zeros((*vectors_rad.shape, 3))
    x, y, z = vectors_rad[..., 0] / 2, vectors_rad[..., 1] / 2, vectors_rad[..., 2] / 2
    half[..., 0, 1], half[..., 0, 2], half[..., 1, 2] = -z, y, -x
    half[..., 1, 0], half[..., 2, 0], half[..., 2, 1] = z, -y, x
    scale = 2 / (1 + x * x + y * y + z * z)
    turns: Array = np.eye(3) + scale[..., None, None] * (half + half @ half)
    return turns


def _pose_covariances(slopes: Array) -> Array:
    """Return covariances of the parameters of :func:`_look`, (n, 6, 6), to first order in the noise."""
    return np.asarray(np.linalg.inv(slopes.swapaxes(1, 2) @ slopes), dtype=np.float64)


def _tilt_sigmas(covariances: Array, rotations: Array) -> Array:
    """Return the standard deviations (n,) of normals; a turn about its normal does not move a normal."""
    normals = rotations[:, :, 2:]
    about = (normals.swapaxes(1, 2) @ covariances[:, :3, :3] @ normals)[:, 0, 0]
    variances: Array = np.trace(covariances[:, :3, :3], axis1=1, axis2=2) - about
    return np.sqrt(np.maximum(variances, 0.0))
