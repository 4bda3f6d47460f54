"""The world point of a place on the floor from two tape distances (eq. 25 of the paper)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError

__all__ = ["SIDES", "meeting_point", "trilaterate"]

Array = NDArray[np.float64]

SIDES = ("left", "right")


def trilaterate(a_m: Array, b_m: Array, d1_m: float, d2_m: float, side: str) -> Array:
    """The point at distance ``d1_m`` from A and ``d2_m`` from B.

    Parameters
    ----------
    a_m, b_m : (2,), the reference points on the floor, in m.
    d1_m, d2_m : the tape distances to A and B, in m.
    side : "left" or "right" of the line from A to B, seen from above with x right and y up (T1, above
        the line in the paper's figure 8, is left).

    Returns
    -------
    (2,): Xw, Yw in m.

    Raises
    ------
    IpsysError
        Where A, B and the two distances form no triangle, with the numbers.

    References
    ----------
    Ou et al., Robotica 2023, eq. (25).

    Examples
    --------
    >>> a, b = np.array([1.2192, 2.4384]), np.array([3.6576, 2.4384])
    >>> trilaterate(a, b, 1.7, 1.9, "left").round(4).tolist()
    [2.2908, 3.7582]
    """
    if side not in SIDES:
        raise IpsysError(f"side {side!r} of AB is neither 'left' nor 'right'")
    base_m = float(np.hypot(*(b_m - a_m)))
    if base_m == 0.0:
        raise IpsysError("the two reference points are one and the same; give them different coordinates")
    if d1_m <= 0 or d2_m <= 0 or not (abs(d1_m - d2_m) <= base_m <= d1_m + d2_m):
        raise IpsysError(
            f"no triangle has the sides AB = {base_m:.4f} m, d1 = {d1_m:.4f} m and d2 = {d2_m:.4f} m; "
            "measure d1 and d2 again"
        )
    return meeting_point(a_m, b_m, d1_m, d2_m, side)


def meeting_point(a_m: Array, b_m: Array, d1_m: float, d2_m: float, side: str) -> Array:
    """Where two circles meet; where they do not, the point between them on AB or beyond."""
    ab = b_m - a_m
    base_m = float(np.hypot(*ab))
    along_m = (d1_m**2 - d2_m**2 + base_m**2) / (2 * base_m)
    # Rounding can leave a flat triangle with a height just below zero.
    across_m = np.sqrt(max(d1_m**2 - along_m**2, 0.0))
    unit = ab / base_m
    normal = np.array([-unit[1], unit[0]])
    point_m: Array = a_m + along_m * unit + (across_m if side == "left" else -across_m) * normal
    return point_m
