"""World points from tape distances (eq. 25 of the paper), by least squares, and their covariance."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError

__all__ = [
    "SIDES",
    "Trilaterated",
    "crossing_angle",
    "meeting_point",
    "multilaterate",
    "side_of",
    "sides_alike",
    "tape_covariance",
    "trilaterate",
]

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


# Reference points nearer to one line than this hardly tell its sides apart.
_BESIDE_LINE_M = 0.05
_NEAREST_M = 1e-9
# Two places fit equally well as long as their sums of squares, in sigmas, are no further apart.
_ALIKE = 9.0
_USUAL_SIGMA_M = 0.003
_STARTS = 6
_STEPS = 50
_STEP_M = 1e-10


class Trilaterated(NamedTuple):
    """A place and how well the tape knows it.

    ``point_m`` (2,); ``covariance_m2`` (2, 2), None without sigmas; ``residuals_m`` (n,), each distance
    as measured minus as it is from the point, all 0 for two distances; ``reduced_chi2``, about 1 where the
    distances agree within their sigmas, None for two distances or without sigmas.
    """

    point_m: Array
    covariance_m2: Array | None
    residuals_m: Array
    reduced_chi2: float | None


def multilaterate(
    references_m: Array, distances_m: Array, sigmas_m: Array | None = None, side: str | None = None
) -> Trilaterated:
    """The point at given distances from two or more reference points.

    Two distances are eq. (25) as it stands; more are weighted least squares of it, each distance with
    the weight 1 / sigma^2, or all the same. Distances that contradict one another are not refused:
    their residuals tell.

    Parameters
    ----------
    references_m : (n, 2), n >= 2, on the floor, in m.
    distances_m : (n,), from the point to each of them.
    sigmas_m : (n,), standard deviations of the distances; without them there is no covariance.
    side : "left" or "right" of the line from the first reference point to the next one elsewhere. Needed
        where all of them lie within 5 cm of one line, as two always do; else it decides between places that
        the distances fit equally well.

    Returns
    -------
    Trilaterated : point, covariance (see :func:`tape_covariance`), residuals, reduced chi-square.

    Raises
    ------
    IpsysError
        Where two circles do not meet, the side is needed and missing, all reference points are one, or
        a distance or sigma is not a positive number.

    References
    ----------
    Ou et al., Robotica 2023, eq. (25).

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0]])
    >>> found = multilaterate(corners, np.array([1.424, 3.162, 3.162]), np.full(3, 0.003))
    >>> found.point_m.round(3).tolist(), found.residuals_m.round(3).tolist()
    ([1.005, 1.005], [0.003, 0.003, 0.003])
    """
    _check_numbers(references_m, distances_m, sigmas_m)
    if side is not None and side not in SIDES:
        raise IpsysError(f"side {side!r} of AB is neither 'left' nor 'right'")
    if sides_alike(references_m) and side is None:
        raise IpsysError(
            f"the {len(references_m)} reference points lie on one line and the distances fit on both "
            "sides of it; say whether the place is 'left' or 'right' of it"
        )
    if len(references_m) == 2:
        (a_m, b_m), (d1_m, d2_m) = references_m, distances_m.tolist()
        point_m, residuals_m = trilaterate(a_m, b_m, d1_m, d2_m, str(side)), np.zeros(2)
    else:
        point_m = _least_squares(references_m, distances_m, sigmas_m, side)
        residuals_m = distances_m - np.linalg.norm(point_m - references_m, axis=1)
    if sigmas_m is None:
        return Trilaterated(point_m, None, residuals_m, None)
    free = len(references_m) - 2
    chi2 = float(((residuals_m / sigmas_m) ** 2).sum()) / free if free else None
    return Trilaterated(point_m, tape_covariance(point_m, references_m, sigmas_m), residuals_m, chi2)


def sides_alike(references_m: Array) -> bool:
    """Whether reference points, (n, 2) in m, lie so near to one line that the side must be told.

    Examples
    --------
    >>> sides_alike(np.array([[0.0, 0.0], [2.0, 0.0]]))
    True
    >>> sides_alike(np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]))
    False
    """
    if len(references_m) == 2:
        return True
    centred_m = references_m - references_m.mean(axis=0)
    beside_m = centred_m @ np.linalg.svd(centred_m, full_matrices=False)[2][1]
    return bool(np.abs(beside_m).max() <= _BESIDE_LINE_M)


def side_of(point_m: Array, references_m: Array) -> str:
    """The side on which a point, (2,), lies of the line from the first of the reference points, (n, 2), to
    the next one elsewhere; "left" where it lies on it.

    Examples
    --------
    >>> side_of(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [0.0, 0.0], [2.0, 0.0]]))
    'left'
    """
    onward_m = references_m - references_m[0]
    other = int(np.argmax(np.linalg.norm(onward_m, axis=1) > _NEAREST_M))
    return "left" if _cross(onward_m[other], point_m - references_m[0]) >= 0 else "right"


def tape_covariance(point_m: Array, references_m: Array, sigmas_m: Array) -> Array:
    """Covariance of a point from those of its distances, to first order: (J' S^-1 J)^-1, J of eq. (25).

    Where the circles cross flatly the point slides along them, and first order knows no bound. Their
    curvature does: a slide by s changes a distance d by sqrt(d^2 + s^2) - d, and no sigma is greater than
    the slide that changes the distances by a sigma in all. It is reached below some 3 degrees (2 m, 3 mm).

    Parameters
    ----------
    point_m : (2,), in m.
    references_m : (n, 2), in m.
    sigmas_m : (n,), standard deviations of the distances.

    Returns
    -------
    (2, 2), in m^2; finite and positive definite wherever the point is.

    Examples
    --------
    >>> at_right_angles = np.array([[0.0, 0.0], [2.0, 2.0]])
    >>> tape_covariance(np.array([2.0, 0.0]), at_right_angles, np.array([0.003, 0.004])).round(9).tolist()
    [[9e-06, 0.0], [0.0, 1.6e-05]]
    """
    ranges_m, units = _directions(point_m, references_m)
    weighted = units / sigmas_m[:, None]
    known, axes = np.linalg.eigh(weighted.T @ weighted)
    curved = np.sqrt(((1 / (sigmas_m * (2 * ranges_m + sigmas_m))) ** 2).sum())
    covariance: Array = (axes / np.maximum(known, curved)) @ axes.T
    return covariance


def crossing_angle(point_m: Array, references_m: Array) -> float:
    """The angle in rad, 0 to pi/2, at which the tapes from reference points, (n, 2) in m with n >= 2, to a
    point, (2,), cross: the widest of any two of them.

    Examples
    --------
    >>> angle = crossing_angle(np.array([1.0, 1.0]), np.array([[0.0, 0.0], [2.0, 0.0]]))
    >>> round(float(np.degrees(angle)), 9)
    90.0
    """
    _, units = _directions(point_m, references_m)
    pairs = combinations(units, 2)
    return max(float(np.arctan2(abs(_cross(one, two)), abs(one @ two))) for one, two in pairs)


def _least_squares(
    references_m: Array, distances_m: Array, sigmas_m: Array | None, side: str | None
) -> Array:
    """The best of what is found from where two of the circles meet, on ``side`` if that fits as well."""
    weights = 1 / (np.full_like(distances_m, _USUAL_SIGMA_M) if sigmas_m is None else sigmas_m)
    # Several distances from one reference point begin nowhere else than one of them.
    first = np.unique(references_m, axis=0, return_index=True)[1][:_STARTS]
    found = []
    for i, j in combinations(first.tolist(), 2):
        two = references_m[i], references_m[j], float(distances_m[i]), float(distances_m[j])
        starts_m = [meeting_point(*two, one) for one in SIDES]
        found += [_descend(start_m, references_m, distances_m, weights) for start_m in starts_m]
    likely = min(cost for cost, _ in found) + _ALIKE
    there = [one for one in found if one[0] <= likely and side_of(one[1], references_m) == side]
    # A place on the line itself may come out on either side of it.
    return min(there or found, key=lambda one: one[0])[1]


def _descend(point_m: Array, references_m: Array, distances_m: Array, weights: Array) -> tuple[float, Array]:
    """Damped Newton: the weighted sum of squares at the point it comes to, and the point."""

    def misfit(at_m: Array) -> tuple[float, Array, Array]:
        ranges_m, units = _directions(at_m, references_m)
        off = (distances_m - ranges_m) * weights
        outer = units[:, :, None] * units[:, None, :]
        # Where the circles cross flatly their curvature is what there is to go by.
        bend = (off * weights / ranges_m)[:, None, None] * (np.eye(2) - outer)
        hessian = (weights[:, None, None] ** 2 * outer - bend).sum(axis=0)
        return float(off @ off), (off * weights) @ units, hessian

    cost, downhill, hessian = misfit(point_m)
    damping = 1e-6
    for _ in range(_STEPS):
        # Enough to make it positive definite, whatever the curvature.
        lift = damping * np.abs(hessian).max() - min(float(np.linalg.eigvalsh(hessian)[0]), 0.0) * 1.1
        step_m = np.linalg.solve(hessian + lift * np.eye(2), downhill)
        lower, *there = misfit(point_m + step_m)
        if lower > cost:
            damping *= 10
        else:
            point_m, cost, (downhill, hessian) = point_m + step_m, lower, there
            damping = max(damping / 10, 1e-12)
        if np.hypot(*step_m) < _STEP_M:
            break
    return cost, point_m


def _directions(point_m: Array, references_m: Array) -> tuple[Array, Array]:
    """Distances (n,) in m from the references to a point, and unit vectors (n, 2) along them."""
    offsets_m = point_m - references_m
    ranges_m = np.maximum(np.linalg.norm(offsets_m, axis=1), _NEAREST_M)
    return ranges_m, offsets_m / ranges_m[:, None]


def _cross(first: Array, second: Array) -> float:
    return float(first[0] * second[1] - first[1] * second[0])


def _check_numbers(references_m: Array, distances_m: Array, sigmas_m: Array | None) -> None:
    count = len(references_m)
    if count < 2 or references_m.shape != (count, 2) or distances_m.shape != (count,):
        raise IpsysError(
            f"{count} reference points and {distances_m.size} distances; give two or more, one distance each"
        )
    if count > 2:
        if (np.linalg.norm(references_m - references_m[0], axis=1) <= _NEAREST_M).all():
            raise IpsysError("the reference points are one and the same; give them different coordinates")
        if not (np.isfinite(distances_m) & (distances_m > 0)).all():
            raise IpsysError(f"the distances {distances_m.tolist()} m are not all above 0; measure again")
    if sigmas_m is not None and not (np.isfinite(sigmas_m) & (sigmas_m > 0)).all():
        raise IpsysError(f"the sigmas {sigmas_m.tolist()} m of the tape are not all above 0; correct them")
