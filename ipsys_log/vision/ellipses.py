"""Ellipses of covariances on the floor, and their enlargement in a drawing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ipsys_log.messages.arrays import Array

# The region of 95 % of a normal distribution in two dimensions ends at so many standard deviations.
SIGMAS_95 = float(np.sqrt(-2 * np.log(0.05)))
_FACTORS = (1, 2, 5, 10, 20, 50, 100)


class FloorEllipse(NamedTuple):
    """The half axes of an ellipse in m, the longer one first, and the angle of the longer one in rad."""

    major_m: float
    minor_m: float
    angle_rad: float


def covariance_ellipse(covariance_m2: Array) -> FloorEllipse:
    """Return the region of 95 % of a covariance (2, 2).

    Examples
    --------
    >>> major_m, minor_m, angle_rad = covariance_ellipse(np.diag([1.0, 4.0]))
    >>> round(major_m / minor_m, 9), round(abs(angle_rad), 6)
    (2.0, 1.570796)
    """
    variances, directions = np.linalg.eigh(covariance_m2)
    minor_m, major_m = (SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))).tolist()
    return FloorEllipse(major_m, minor_m, float(np.arctan2(directions[1, 1], directions[0, 1])))


def enlargement(covariances_m2: Sequence[Array] | Array, radius_m: float) -> int:
    """Return the factor, at least 1, that gives usual ellipses of covariances (n, 2, 2) about a radius."""
    covariances_m2 = np.asarray(covariances_m2, dtype=np.float64).reshape(-1, 2, 2)
    if not len(covariances_m2):
        return 1
    usual_m = SIGMAS_95 * np.sqrt(np.median(covariances_m2[:, [0, 1], [0, 1]]))
    fitting = [factor for factor in _FACTORS if factor * usual_m <= radius_m]
    return fitting[-1] if fitting else 1
