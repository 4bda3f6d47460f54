"""The lenses that can be calibrated: pixels of points in the frame of the camera, with derivatives.

The parameters of a lens are one row: fx, fy, cx, cy in px, then the coefficients in OpenCV's order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError

__all__ = ["LENSES", "LensModel", "find_lens", "project_points"]

Array = NDArray[np.float64]

# Points nearer to the plane of a pinhole than this share of their distance have no place in its picture.
_LEAST_DEPTH = 1e-3
_TINY = 1e-12
# Far less than what corners say, and enough where they say nothing.
_PULL_PX = 0.1


class LensModel(NamedTuple):
    """A kind of lens: the name in the log, what its coefficients are called, how many of them are fitted.

    Those that are not fitted stay 0. ``usual`` is how large coefficients usually are, where pictures may not
    tell them from one another: a common factor above and below a fraction bends nothing.
    """

    distortion_model: str
    coefficients: tuple[str, ...]
    fitted: int
    bend: Callable[[Array, Array], tuple[Array, Array, Array]]
    usual: float = np.inf

    @property
    def names(self) -> tuple[str, ...]:
        """All parameters, in order."""
        return ("fx", "fy", "cx", "cy", *self.coefficients)

    @property
    def pull(self) -> Array:
        """By how much each parameter is drawn to 0, (p,): the square of a residual of ``_PULL_PX`` when it is
        as large as usual."""
        strength = (_PULL_PX / self.usual) ** 2
        return np.array([0.0] * 4 + [strength] * len(self.coefficients))


def project_points(model: LensModel, parameters: Array, points_m: Array) -> tuple[Array, Array, Array]:
    """Pixels of points, and how they change with the point and with the lens.

    Parameters
    ----------
    model : the kind of lens.
    parameters : (p,), as ``model.names`` says.
    points_m : (n, 3), in the frame of the camera; for a fisheye also beside and behind it.

    Returns
    -------
    Pixels (n, 2), their derivatives by the point (n, 2, 3), in px/m, and by the parameters (n, 2, p).
    """
    bent, by_point, by_coefficients = model.bend(points_m, parameters[4:])
    focal_px = parameters[:2]
    by_parameters = np.zeros((len(points_m), 2, parameters.size))
    by_parameters[:, 0, 0], by_parameters[:, 1, 1] = bent.T
    by_parameters[:, 0, 2] = by_parameters[:, 1, 3] = 1.0
    by_parameters[:, :, 4:] = by_coefficients * focal_px[:, None]
    return bent * focal_px + parameters[2:4], by_point * focal_px[:, None], by_parameters


def _bend_fisheye(points_m: Array, k: Array) -> tuple[Array, Array, Array]:
    """Kannala and Brandt (PAMI 2006), in OpenCV's form: the angle from the axis bends, not its tangent.

    The angle is atan2(r, z), so that it goes on beyond 90 degrees.
    """
    x, y, z = points_m.T
    square = x * x + y * y + z * z
    r = np.maximum(np.hypot(x, y), 1e-9 * np.sqrt(square))
    theta = np.arctan2(r, z)
    powers = theta[:, None] ** np.array([3, 5, 7, 9])
    bent = theta + powers @ k
    slope = 1 + (theta[:, None] ** np.array([2, 4, 6, 8]) * np.array([3, 5, 7, 9])) @ k
    scale = bent / r
    # d scale / d (x, y, z), of bent(theta(r, z)) / r(x, y).
    along_r = (slope * z / square - scale) / r**2
    by_scale = np.stack([along_r * x, along_r * y, -slope / square], axis=1)
    planar = points_m[:, :2]
    by_point = planar[:, :, None] * by_scale[:, None, :]
    by_point[:, 0, 0] += scale
    by_point[:, 1, 1] += scale
    directions = planar / r[:, None]
    return planar * scale[:, None], by_point, directions[:, :, None] * powers[:, None, :]


def _bend_pinhole(points_m: Array, k: Array) -> tuple[Array, Array, Array]:
    """Brown's radial and tangential terms, as OpenCV has them: k1 k2 p1 p2 k3, and a divisor k4 k5 k6."""
    z = np.maximum(points_m[:, 2], _LEAST_DEPTH * np.linalg.norm(points_m, axis=1) + _TINY)
    a, b = (points_m[:, :2] / z[:, None]).T
    k1, k2, p1, p2, k3, k4, k5, k6 = np.append(k, np.zeros(8 - k.size))
    r2 = a * a + b * b
    powers = r2[:, None] ** np.array([1, 2, 3])
    top, bottom = 1 + powers @ np.array([k1, k2, k3]), 1 + powers @ np.array([k4, k5, k6])
    radial = top / bottom
    climb = np.column_stack([np.ones_like(r2), 2 * r2, 3 * r2 * r2])
    slope = 2 * (climb @ np.array([k1, k2, k3]) - radial * (climb @ np.array([k4, k5, k6]))) / bottom
    ab = np.stack([a, b], axis=1)
    bent = ab * radial[:, None]
    bent[:, 0] += 2 * p1 * a * b + p2 * (r2 + 2 * a * a)
    bent[:, 1] += p1 * (r2 + 2 * b * b) + 2 * p2 * a * b
    by_ab = ab[:, :, None] * ab[:, None, :] * slope[:, None, None]
    by_ab[:, 0, 0] += radial + 2 * p1 * b + 6 * p2 * a
    by_ab[:, 1, 1] += radial + 6 * p1 * b + 2 * p2 * a
    cross = 2 * p1 * a + 2 * p2 * b
    by_ab[:, 0, 1] += cross
    by_ab[:, 1, 0] += cross
    by_point = np.concatenate([by_ab, -by_ab @ ab[:, :, None]], axis=2) / z[:, None, None]
    rise = powers[:, None, :] * (ab / bottom[:, None])[:, :, None]
    tangential = np.stack(
        [np.stack([2 * a * b, r2 + 2 * a * a], axis=1), np.stack([r2 + 2 * b * b, 2 * a * b], axis=1)], axis=1
    )
    fall = -rise * radial[:, None, None]
    by_k = np.concatenate([rise[:, :, :2], tangential, rise[:, :, 2:], fall], axis=2)
    return bent, by_point, by_k[:, :, : k.size]


_FIVE = ("k1", "k2", "p1", "p2", "k3")

# By the name a user gives.
LENSES = {
    "fisheye": LensModel("kannala_brandt", ("k1", "k2", "k3", "k4"), 4, _bend_fisheye),
    "pinhole": LensModel("plumb_bob", _FIVE, 5, _bend_pinhole),
    "pinhole4": LensModel("plumb_bob", _FIVE, 4, _bend_pinhole),
    "pinhole8": LensModel("rational_polynomial", (*_FIVE, "k4", "k5", "k6"), 8, _bend_pinhole, 2.0),
}


def find_lens(name: str) -> LensModel:
    """The kind of lens of a name.

    Raises
    ------
    IpsysError
        Where there is none.
    """
    if name not in LENSES:
        raise IpsysError(f"--lens {name}: there is no such lens; use one of {', '.join(LENSES)}")
    return LENSES[name]
