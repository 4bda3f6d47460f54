"""World points from tape distances (eq. 25 of the paper), by least squares, and their covariance."""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array

SIDES = ("left", "right")
# A hand lays a marker onto a reference point with this standard deviation, along each axis.
ON_REFERENCE_SIGMA_M = 0.001
# Standard deviation of a tape reading, if neither the reading nor the rig gives one.
USUAL_TAPE_SIGMA_M = 0.003
# Relative standard deviation of the scale of a tape, if the rig gives none: 1 mm per metre.
USUAL_TAPE_SCALE_SIGMA = 0.001


def trilaterate(a_m: Array, b_m: Array, d1_m: float, d2_m: float, side: str) -> Array:
    """Return the point at distance ``d1_m`` from A and ``d2_m`` from B.

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
        A, B and the two distances form no triangle. The text contains the numbers.

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
        raise IpsysError(f"side {side!r} of AB is not valid; write 'left' or 'right'")
    base_m = float(np.hypot(*(b_m - a_m)))
    if base_m == 0.0:
        raise IpsysError("the two reference points are identical; give them different coordinates")
    if d1_m <= 0 or d2_m <= 0 or not (abs(d1_m - d2_m) <= base_m <= d1_m + d2_m):
        raise IpsysError(
            f"the distances d1 = {d1_m:.4f} m and d2 = {d2_m:.4f} m do not meet, because AB is {base_m:.4f} "
            "m; measure d1 and d2 again"
        )
    return intersect_circles(a_m, b_m, d1_m, d2_m, side)


def intersect_circles(a_m: Array, b_m: Array, d1_m: float, d2_m: float, side: str) -> Array:
    """Return the intersection of two circles; without one, the point between them on the line AB."""
    ab = b_m - a_m
    base_m = float(np.hypot(*ab))
    along_m = (d1_m**2 - d2_m**2 + base_m**2) / (2 * base_m)
    # By rounding, the squared height of a flat triangle can be slightly below zero.
    across_m = np.sqrt(max(d1_m**2 - along_m**2, 0.0))
    unit = ab / base_m
    normal = np.array([-unit[1], unit[0]])
    point_m: Array = a_m + along_m * unit + (across_m if side == "left" else -across_m) * normal
    return point_m


# If all reference points are nearer to one line than this, they do not distinguish its sides.
_BESIDE_LINE_M = 0.05
_NEAREST_M = 1e-9
# Two positions fit equally well if their sums of squares, in squared sigmas, differ by less than this.
_ALIKE = 9.0
_STARTS = 6
_STEPS = 50
_STEP_M = 1e-10


class TapePosition(NamedTuple):
    """A point from tape distances, with its covariance and residuals.

    ``point_m`` is (2,). ``covariance_m2`` is (2, 2), None without sigmas. ``residuals_m`` (n,) are the
    measured distances minus those from the point, all 0 for two distances. ``reduced_chi2`` is about 1 if the
    distances agree within their sigmas. It is None for two distances or without sigmas.
    """

    point_m: Array
    covariance_m2: Array | None
    residuals_m: Array
    reduced_chi2: float | None


def multilaterate(
    references_m: Array, distances_m: Array, sigmas_m: Array | None = None, side: str | None = None
) -> TapePosition:
    """Return the point at given distances from two or more reference points.

    For two distances, the function solves eq. (25) exactly. For more distances, it solves eq. (25) by
    weighted least squares. Each distance has the weight 1 / sigma^2, or all have the same weight. Distances
    that contradict one another raise no error, but have large residuals.

    Parameters
    ----------
    references_m : (n, 2), n >= 2, reference points on the floor, in m.
    distances_m : (n,), distances from the point to each reference point, in m.
    sigmas_m : (n,), standard deviations of the distances; without them there is no covariance.
    side : "left" or "right" of the line from the first reference point to the next different one. The side is
        required if all reference points are within 5 cm of one line; two points always are. Otherwise
        it selects between positions that fit the distances equally well.

    Returns
    -------
    TapePosition : point, covariance (see :func:`tape_covariance`), residuals, reduced chi-square.

    Raises
    ------
    IpsysError
        Two circles do not meet, or the required side is missing. Or all reference points are the same point,
        or a distance or sigma is not a positive number.

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
        raise IpsysError(f"side {side!r} of AB is not valid; write 'left' or 'right'")
    if are_collinear(references_m) and side is None:
        raise IpsysError(
            f"the {len(references_m)} reference points are on one line, so the distances fit on both sides; "
            "give the side, 'left' or 'right'"
        )
    if len(references_m) == 2:
        (a_m, b_m), (d1_m, d2_m) = references_m, distances_m.tolist()
        point_m, residuals_m = trilaterate(a_m, b_m, d1_m, d2_m, str(side)), np.zeros(2)
    else:
        point_m = _least_squares(references_m, distances_m, sigmas_m, side)
        residuals_m = distances_m - np.linalg.norm(point_m - references_m, axis=1)
    if sigmas_m is None:
        return TapePosition(point_m, None, residuals_m, None)
    free = len(references_m) - 2
    chi2 = float(((residuals_m / sigmas_m) ** 2).sum()) / free if free else None
    return TapePosition(point_m, tape_covariance(point_m, references_m, sigmas_m), residuals_m, chi2)


def are_collinear(references_m: Array) -> bool:
    """Return whether reference points, (n, 2) in m, are so near to one line that a side is required.

    Examples
    --------
    >>> are_collinear(np.array([[0.0, 0.0], [2.0, 0.0]]))
    True
    >>> are_collinear(np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]]))
    False
    """
    if len(references_m) == 2:
        return True
    centred_m = references_m - references_m.mean(axis=0)
    beside_m = centred_m @ np.linalg.svd(centred_m, full_matrices=False)[2][1]
    return bool(np.abs(beside_m).max() <= _BESIDE_LINE_M)


def side_of(point_m: Array, references_m: Array) -> str:
    """Return the side of a point, (2,), relative to a line through reference points, (n, 2).

    The line goes from the first reference point to the next different one. The side of a point on the line is
    "left".

    Examples
    --------
    >>> side_of(np.array([0.0, 1.0]), np.array([[0.0, 0.0], [0.0, 0.0], [2.0, 0.0]]))
    'left'
    """
    onward_m = references_m - references_m[0]
    next_different = int(np.argmax(np.linalg.norm(onward_m, axis=1) > _NEAREST_M))
    return "left" if _cross(onward_m[next_different], point_m - references_m[0]) >= 0 else "right"


def tape_covariance(point_m: Array, references_m: Array, sigmas_m: Array) -> Array:
    """Return the covariance of a point from the standard deviations of its distances, to first order.

    It is (J' S^-1 J)^-1, with J of eq. (25). If the circles cross at a small angle, the point can move along
    them, and the first order gives no bound. The curvature of the circles gives a bound: a motion by s along
    a circle changes a distance d by sqrt(d^2 + s^2) - d. No sigma of the point is greater than the motion
    that changes the distances by one sigma in total. This bound applies below crossing angles of about
    3 degrees (at 2 m and 3 mm).

    Parameters
    ----------
    point_m : (2,), in m.
    references_m : (n, 2), in m.
    sigmas_m : (n,), standard deviations of the distances, in m.

    Returns
    -------
    (2, 2), in m^2; finite and positive definite for every point.

    Examples
    --------
    >>> at_right_angles = np.array([[0.0, 0.0], [2.0, 2.0]])
    >>> tape_covariance(np.array([2.0, 0.0]), at_right_angles, np.array([0.003, 0.004])).round(9).tolist()
    [[9e-06, 0.0], [0.0, 1.6e-05]]
    """
    ranges_m, units = _directions(point_m, references_m)
    weighted = units / sigmas_m[:, None]
    information, axes = np.linalg.eigh(weighted.T @ weighted)
    curved = np.sqrt(((1 / (sigmas_m * (2 * ranges_m + sigmas_m))) ** 2).sum())
    covariance: Array = (axes / np.maximum(information, curved)) @ axes.T
    return covariance


def crossing_angle(point_m: Array, references_m: Array) -> float:
    """Return the largest crossing angle of two tapes, in rad, 0 to pi/2.

    The tapes go from reference points, (n, 2) in m with n >= 2, to a point, (2,).

    Examples
    --------
    >>> angle = crossing_angle(np.array([1.0, 1.0]), np.array([[0.0, 0.0], [2.0, 0.0]]))
    >>> round(float(np.degrees(angle)), 9)
    90.0
    """
    _, units = _directions(point_m, references_m)
    pairs = combinations(units, 2)
    return max(float(np.arctan2(abs(_cross(unit, other)), abs(unit @ other))) for unit, other in pairs)


def _least_squares(
    references_m: Array, distances_m: Array, sigmas_m: Array | None, side: str | None
) -> Array:
    """Return the best solution from starts at circle intersections, on ``side`` if it fits equally well."""
    weights = 1 / (np.full_like(distances_m, USUAL_TAPE_SIGMA_M) if sigmas_m is None else sigmas_m)
    # Several distances from one reference point give no additional start.
    first = np.unique(references_m, axis=0, return_index=True)[1][:_STARTS]
    solutions = []
    for i, j in combinations(first.tolist(), 2):
        two_circles = references_m[i], references_m[j], float(distances_m[i]), float(distances_m[j])
        starts_m = [intersect_circles(*two_circles, start_side) for start_side in SIDES]
        solutions += [_descend(start_m, references_m, distances_m, weights) for start_m in starts_m]
    likely = min(cost for cost, _ in solutions) + _ALIKE
    on_side = [
        solution
        for solution in solutions
        if solution[0] <= likely and side_of(solution[1], references_m) == side
    ]
    # The solution for a point on the line may be on either side of the line.
    return min(on_side or solutions, key=lambda one: one[0])[1]


def _descend(point_m: Array, references_m: Array, distances_m: Array, weights: Array) -> tuple[float, Array]:
    """Minimize by damped Newton's method; return the least weighted sum of squares and its point."""

    def misfit(at_m: Array) -> tuple[float, Array, Array]:
        ranges_m, units = _directions(at_m, references_m)
        off = (distances_m - ranges_m) * weights
        outer = units[:, :, None] * units[:, None, :]
        # If the circles cross at a small angle, only their curvature determines the point.
        bend = (off * weights / ranges_m)[:, None, None] * (np.eye(2) - outer)
        hessian = (weights[:, None, None] ** 2 * outer - bend).sum(axis=0)
        return float(off @ off), (off * weights) @ units, hessian

    cost, downhill, hessian = misfit(point_m)
    damping = 1e-6
    for _ in range(_STEPS):
        # This makes the Hessian positive definite for every curvature.
        lift = damping * np.abs(hessian).max() - min(float(np.linalg.eigvalsh(hessian)[0]), 0.0) * 1.1
        step_m = np.linalg.solve(hessian + lift * np.eye(2), downhill)
        lower, *derivatives = misfit(point_m + step_m)
        if lower > cost:
            damping *= 10
        else:
            point_m, cost, (downhill, hessian) = point_m + step_m, lower, derivatives
            damping = max(damping / 10, 1e-12)
        if np.hypot(*step_m) < _STEP_M:
            break
    return cost, point_m


def _directions(point_m: Array, references_m: Array) -> tuple[Array, Array]:
    """Return distances (n,) in m from the references to a point, and unit vectors (n, 2) along them."""
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
            raise IpsysError("the reference points are identical; give them different coordinates")
        if not (np.isfinite(distances_m) & (distances_m > 0)).all():
            raise IpsysError(f"the distances {distances_m.tolist()} m are not all above 0; measure again")
    if sigmas_m is not None and not (np.isfinite(sigmas_m) & (sigmas_m > 0)).all():
        raise IpsysError(f"the sigmas {sigmas_m.tolist()} m of the tape are not all above 0; correct them")
