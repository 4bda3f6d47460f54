"""Where rays meet horizontal planes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["meet_height"]

# A ray that rises or falls by less than this per metre meets no floor that a camera sees.
_LEAST_SLOPE = 1e-6


def meet_height(
    origin_m: NDArray[np.float64], directions: NDArray[np.float64], heights_m: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The points at given heights on rays from one origin.

    Parameters
    ----------
    origin_m : (3,), in world m.
    directions : (n, 3), of any length.
    heights_m : (n,), the z to meet, in m.

    Returns
    -------
    (n, 3): world points in m; NaN where a ray is level or the height lies behind the origin.

    Examples
    --------
    >>> down = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, -1.0], [0.0, 0.0, 1.0]])
    >>> meet_height(np.array([0.0, 0.0, 2.0]), down, np.array([0.0, 0.5, 0.0])).tolist()
    [[0.0, 0.0, 0.0], [1.5, 0.0, 0.5], [nan, nan, nan]]
    """
    falls = directions[:, 2]
    slope = np.where(np.abs(falls) > _LEAST_SLOPE * np.linalg.norm(directions, axis=1), falls, np.nan)
    along = (heights_m - origin_m[2]) / slope
    along = np.where(along > 0, along, np.nan)
    points_m: NDArray[np.float64] = origin_m + along[:, None] * directions
    points_m[:, 2] = np.where(np.isnan(along), np.nan, heights_m)
    return points_m
