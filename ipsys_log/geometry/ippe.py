"""The two poses of a square marker by formula: infinitesimal plane-based pose estimation."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.markers import marker_corners

__all__ = ["solve_squares"]

Array = NDArray[np.float64]

_UNIT_CORNERS = marker_corners(1.0)[:, :2]
_UNIT = np.eye(2)


def solve_squares(uv: Array, lengths_m: Array) -> tuple[Array, Array]:
    """IPPE's two poses of square markers: by formula, and exact where the corners are.

    OpenCV has it as well (``SOLVEPNP_IPPE_SQUARE``), but returns no numbers, or wrong ones, for markers that
    exactly face the camera.

    Parameters
    ----------
    uv : (n, 4, 2), normalized image coordinates of corners that go around (see
        :func:`ipsys_log.geometry.square_pose.goes_around`).
    lengths_m : (n,), sides of the black squares, in m.

    Returns
    -------
    rotations : (n, 2, 3, 3), the marker's axes in the frame of the camera.
    centres_m : (n, 2, 3).

    References
    ----------
    Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 2014.
    """
    slope, centre_uv = _homography(uv, lengths_m)
    camera_from_view = _along_view(centre_uv)
    # How the image moves with a point about the centre: not at all along the view.
    seen = camera_from_view[:, :2, :2] - centre_uv[:, :, None] * camera_from_view[:, 2:, :2]
    flat = _solve(seen, slope)
    # Of the upper two rows of a rotation's two columns the larger singular value is 1: that is the scale.
    det = flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0]
    squares = (flat * flat).sum(axis=(1, 2))
    per_m2 = (squares + np.sqrt(np.maximum(squares * squares - 4 * det * det, 0))) / 2
    flat /= np.sqrt(per_m2)[:, None, None]
    depths = np.sqrt(np.maximum(1 - (flat * flat).sum(axis=1), 0))
    depths[:, 1] *= np.where((flat[:, :, 0] * flat[:, :, 1]).sum(axis=1) > 0, -1, 1)
    both = np.empty((len(uv), 2, 3, 3))
    both[:, :, :2, :2] = flat[:, None]
    both[..., 2, 2] = (det / per_m2)[:, None]
    # The first two columns' cross product has, but for its depth, the sign of theirs.
    normal = flat[:, ::-1, 0] * depths[:, 1:] - flat[:, ::-1, 1] * depths[:, :1]
    normal[:, 1] *= -1
    for pose, sign in enumerate((1, -1)):
        both[:, pose, 2, :2], both[:, pose, :2, 2] = sign * depths, sign * normal
    centres_m = np.ones((len(uv), 2, 3))
    centres_m[..., :2] = centre_uv[:, None]
    return camera_from_view[:, None] @ both, centres_m / np.sqrt(per_m2)[:, None, None]


def _homography(uv: Array, lengths_m: Array) -> tuple[Array, Array]:
    """At the centres of markers: slopes of (u, v) by the marker's x and y, (n, 2, 2), and (u, v), (n, 2)."""
    corners_m = _UNIT_CORNERS * lengths_m[:, None, None]
    equations = np.zeros((len(uv), 4, 2, 8))
    equations[:, :, 0, 0:2] = equations[:, :, 1, 3:5] = corners_m
    equations[:, :, 0, 2] = equations[:, :, 1, 5] = 1
    equations[..., 6:] = -uv[..., None] * corners_m[:, :, None]
    found = _solve(equations.reshape(-1, 8, 8), uv.reshape(-1, 8, 1))[..., 0]
    affine = found[:, :6].reshape(-1, 2, 3)
    centre_uv = affine[:, :, 2]
    return affine[:, :, :2] - centre_uv[:, :, None] * found[:, None, 6:], centre_uv


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
