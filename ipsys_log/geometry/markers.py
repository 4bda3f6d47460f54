"""Where a square marker lies in the frame of its camera (sect. 2.1 of the paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["camera_point", "camera_point_slopes", "heading", "marker_corners"]

# Around the marker.
_NEXT, _BEFORE = [1, 2, 3, 0], [3, 0, 1, 2]


def camera_point(corners_uv: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    """Centre of a marker that lies parallel to the image plane, in the frame of the camera.

    Parameters
    ----------
    corners_uv : (4, 2), normalized image coordinates, in order around the marker.
    length_m : side of the marker's black square, in m.

    Returns
    -------
    (3,): Xc right, Yc down, Zc forward, in m.

    Raises
    ------
    ValueError
        Where the four corners fall together.

    References
    ----------
    Ou et al., Robotica 2023, eq. (3), (4) and (5). In (4) and (5) as printed a factor 1/4 is
    missing in the middle: Xc0 is the mean of the corners' Xc.

    Examples
    --------
    >>> uv = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.1], [0.0, 0.1]])
    >>> camera_point(uv, 0.2).round(9).tolist()
    [0.1, 0.1, 2.0]
    """
    sides = np.linalg.norm(corners_uv[_NEXT] - corners_uv, axis=1)
    perimeter = float(sides.sum())
    if perimeter == 0.0:
        raise ValueError("the four corners fall together")
    z_m = 4.0 * length_m / perimeter  # eq. (3)
    u, v = corners_uv.mean(axis=0)
    return np.array([z_m * u, z_m * v, z_m])  # eq. (4), (5)


def camera_point_slopes(corners_uv: NDArray[np.float64], length_m: float) -> NDArray[np.float64]:
    """By how much :func:`camera_point` moves with the corners.

    Parameters
    ----------
    corners_uv : (4, 2), normalized image coordinates, not all the same.
    length_m : side of the marker's black square, in m.

    Returns
    -------
    (4, 3, 2): for each corner rows Xc, Yc, Zc in m, columns u and v.
    """
    sides = corners_uv[_NEXT] - corners_uv
    lengths = np.sqrt((sides * sides).sum(axis=1))
    perimeter = lengths.sum()
    # A side that has no length has no direction either.
    along = sides / np.maximum(lengths, np.finfo(np.float64).tiny)[:, None]
    z_m = 4.0 * length_m / perimeter
    slopes = np.empty((4, 3, 2))
    slopes[:, 2] = z_m / perimeter * (along - along[_BEFORE])
    slopes[:, :2] = corners_uv.mean(axis=0)[:, None] * slopes[:, 2:] + z_m / 4 * np.eye(2)
    return slopes


def heading(corners_uv: NDArray[np.float64]) -> float:
    """Minus the angle from corner 3 to corner 0 in the plane of the image, in rad in (-pi, pi].

    Parameters
    ----------
    corners_uv : (4, 2), normalized image coordinates.

    References
    ----------
    The authors' program; the paper does not define the heading.
    """
    du, dv = corners_uv[0] - corners_uv[3]
    return float(np.arctan2(-dv, du))


def marker_corners(length_m: float) -> NDArray[np.float64]:
    """Corners of a marker in its own frame (x right, y up, z towards the viewer), (4, 3) in m.

    In OpenCV's order: clockwise, as seen from in front, from the top left.
    """
    half = length_m / 2
    return np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
