"""Explanations of contradicting tape readings: sides, exchanged distances, exchanged points, wrong readings.

The cameras alone give the shape of all calibration points, up to a motion over the floor. Each explanation is
such a motion, and says for each point which mistake makes its readings fit. The most probable one counts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.observations import CalibrationPoint
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array
from ipsys_log.vision.trilateration import SIDES, are_collinear, multilaterate, side_of

# Twice the negative logarithm of the probability of a mistake: one point in a hundred has a wrong side, or
# exchanged distances.
_MISTAKE = 2 * float(np.log(100.0))
# A wrong number is as frequent, but may be any of the 300 that a tape of 1 m has beside the right one.
WRONG_NUMBER = _MISTAKE + 2 * float(np.log(300.0))
# Two explanations are both possible if their probabilities differ by less than a factor of 100.
_AS_PROBABLE = _MISTAKE
# Explanations that move no point farther than this are the same.
_SAME_M = 0.02
# Error of a shape that is turned by two of its points alone: a length,
_ROUGH_M = 0.02
# and a share of it by its scale.
_ROUGH_SCALE = 0.01
# The farthest pairs of points are enough to find the right motion.
_MOST_PAIRS = 80
# Explanations that are fitted exactly.
_MOST_EXACT = 6
_ROUNDS = 3
# A side contradicts the cameras if the point is this far beyond the line,
_BEYOND_M = 0.005
# also in standard deviations.
_BEYOND = 4.5


@dataclass(frozen=True, slots=True, eq=False)
class PointShape:
    """Places of t calibration points as the cameras see them, without the tape.

    ``places_m`` (t, 2) are in any coordinates over the floor. ``covariance_m2`` (2 t, 2 t) is their joint
    covariance, which contains the unknown scale.
    """

    places_m: Array
    covariance_m2: Array


@dataclass(frozen=True, slots=True)
class Change:
    """A mistake that explains the readings of a point.

    ``kind`` is ``side``, ``exchanged``, ``swapped`` (with the point ``other``) or ``distance``.
    """

    point: str
    kind: str
    other: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """A motion of the shape over the floor, and the mistakes that make the readings fit.

    ``names`` are those of the t points, ``places_m`` (t, 2) their world coordinates. ``cost``
    is minus twice the logarithm of its probability, up to a constant.
    """

    names: tuple[str, ...]
    places_m: Array
    changes: tuple[Change, ...]
    cost: float


@dataclass(frozen=True, slots=True, eq=False)
class _Option:
    """One way to read a point: a mistake, its cost, the distances, and the side (0: no side)."""

    change: Change | None
    cost: float
    distances_m: Array


def explain_readings(points: Sequence[CalibrationPoint], shape: PointShape) -> list[Explanation]:
    """Return the possible explanations of the tape readings, the most probable one first.

    Others are in the list if they are nearly as probable, and place the points elsewhere.

    Parameters
    ----------
    points : the t calibration points with their readings.
    shape : their places without the tape.
    """
    motions = np.array(list(_motions(points, shape.places_m))).reshape(-1, 2)
    if not len(motions):
        return []
    flat = shape.places_m @ [1, 1j]
    turned = motions[:, :1] * flat + motions[:, 1:]
    places_m = np.stack([turned.real, turned.imag], axis=2)
    costs = _rough_costs(points, places_m)
    candidates: list[Array] = []
    for number in np.argsort(costs, kind="stable"):
        if all(_apart_m(places_m[number], other) > 3 * _ROUGH_M for other in candidates):
            candidates.append(places_m[number])
        if len(candidates) == _MOST_EXACT:
            break
    exact = sorted((_fit_motion(points, shape, start) for start in candidates), key=lambda one: one.cost)
    chosen: list[Explanation] = []
    for one in exact:
        near = one.cost < exact[0].cost + _AS_PROBABLE
        if near and all(_apart_m(one.places_m, other.places_m) > _SAME_M for other in chosen):
            chosen.append(one)
    return chosen


def side_contradicts(point: CalibrationPoint, place_m: Array, covariance_m2: Array) -> bool:
    """Return whether a place (2,) with its covariance (2, 2) is on the other side of the references."""
    side = _side(point)
    if side is None or side_of(place_m, point.references_m) == side:
        return False
    along = point.references_m[-1] - point.references_m[0]
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    beyond_m = abs(float(normal @ (place_m - point.references_m[0])))
    return beyond_m > max(_BEYOND_M, _BEYOND * float(np.sqrt(normal @ covariance_m2 @ normal)))


def _side(point: CalibrationPoint) -> str | None:
    """Return the stated side of a point; None if its readings need none."""
    if point.start_m is None or len(point.distances_m) < 2 or not are_collinear(point.references_m):
        return None
    return side_of(point.start_m, point.references_m)


def _apart_m(one: Array, other: Array) -> float:
    return float(np.linalg.norm(one - other, axis=1).max())


def _options(point: CalibrationPoint) -> list[_Option]:
    """Return the readings as they are, and with two of them exchanged."""
    options = [_Option(None, 0.0, point.distances_m)]
    for one, two in combinations(range(len(point.distances_m)), 2):
        distances_m = point.distances_m.copy()
        distances_m[[one, two]] = distances_m[[two, one]]
        options.append(_Option(Change(point.name, "exchanged"), _MISTAKE, distances_m))
    return options


def _possible_places(point: CalibrationPoint) -> list[Array]:
    """Return the places (2,) of a point by its readings: on both sides, and with exchanged distances."""
    if point.point_m is not None:
        return [point.point_m]
    places = []
    for option in _options(point):
        if len(option.distances_m) < 2:
            continue
        for side in SIDES if are_collinear(point.references_m) else (None,):
            try:
                found = multilaterate(point.references_m, option.distances_m, point.distance_sigmas_m, side)
            except IpsysError:
                continue
            places.append(found.point_m)
    return places


def _motions(points: Sequence[CalibrationPoint], shape_m: Array) -> Iterator[tuple[complex, complex]]:
    """Yield turns and shifts, as complex numbers, that place two points of the shape by their readings."""
    places = [_possible_places(point) for point in points]
    measured = [number for number, own in enumerate(places) if own]
    flat = shape_m @ [1, 1j]
    pairs = sorted(combinations(measured, 2), key=lambda pair: -abs(flat[pair[1]] - flat[pair[0]]))
    step = max(1, len(pairs) // (2 * _MOST_PAIRS))
    for one, two in pairs[: step * _MOST_PAIRS : step]:
        across = flat[two] - flat[one]
        for first in places[one]:
            for second in places[two]:
                start, end = complex(*first), complex(*second)
                apart_m = abs(end - start)
                # A pair that fits badly gives no motion; the readings of one of both are wrong.
                if abs(apart_m - abs(across)) > 2 * _ROUGH_M + 2 * _ROUGH_SCALE * apart_m or not apart_m:
                    continue
                turn = (end - start) / across
                turn /= abs(turn)
                yield turn, (start + end) / 2 - turn * (flat[one] + flat[two]) / 2


def _rough_costs(points: Sequence[CalibrationPoint], places_m: Array) -> Array:
    """Return the costs (m,) of m rough motions, which place the points at (m, t, 2)."""
    costs = np.zeros(len(places_m))
    for number, point in enumerate(points):
        own = places_m[:, number]
        if point.point_m is not None:
            away_m = np.linalg.norm(own - point.point_m, axis=1)
            costs += np.minimum((away_m / _ROUGH_M) ** 2, 2 * WRONG_NUMBER)
        elif len(point.distances_m):
            costs += np.min([_option_costs(point, option, own)[0] for option in _options(point)], axis=0)
    return costs


def _option_costs(
    point: CalibrationPoint, option: _Option, places_m: Array, spare_m: float = _ROUGH_M
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the costs (m,) of an option at places (m, 2), and which of them are on the other side."""
    ranges_m = np.linalg.norm(places_m[:, None] - point.references_m, axis=2)
    chi2 = (ranges_m - option.distances_m) ** 2 / (point.distance_sigmas_m**2 + spare_m**2)
    costs = option.cost + np.minimum(chi2, WRONG_NUMBER).sum(axis=1)
    side = _side(point)
    # Near the line, the uncertainty of the shape is larger than the distance from it.
    other = np.zeros(len(places_m), dtype=np.bool_)
    if side is not None:
        along = point.references_m[-1] - point.references_m[0]
        normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        beyond_m = (places_m - point.references_m[0]) @ normal * (1 if side == "left" else -1)
        other = beyond_m < -max(spare_m, _BEYOND_M)
    return costs + _MISTAKE * other, other


def _fit_motion(points: Sequence[CalibrationPoint], shape: PointShape, start_m: Array) -> Explanation:
    """Fit the shape to the readings that a start (t, 2) explains, and explain them again."""
    places_m, chi2 = start_m, 0.0
    spare_m = _ROUGH_M
    for _ in range(_ROUNDS):
        rows, _, _ = _read(points, places_m, spare_m)
        places_m, chi2 = _adjust(points, shape, rows, places_m)
        spare_m = 0.0
    _, changes, cost = _read(points, places_m, 0.0)
    return Explanation(tuple(point.name for point in points), places_m, changes, cost + chi2)


# A distance that fits: the point, the reference, the distance and its standard deviation.
_Row = tuple[int, Array, float, float]


def _read(
    points: Sequence[CalibrationPoint], places_m: Array, spare_m: float
) -> tuple[list[_Row], tuple[Change, ...], float]:
    """Return the readings that fit to places (t, 2), the changes of the points, and their cost."""
    rows: list[_Row] = []
    found: dict[int, tuple[float, Change | None, list[_Row]]] = {}
    for number, point in enumerate(points):
        if point.point_m is not None:
            away_m = float(np.linalg.norm(places_m[number] - point.point_m))
            assert point.covariance_m2 is not None
            chi2 = away_m**2 / (float(point.covariance_m2[0, 0]) + spare_m**2)
            wrong = chi2 > 2 * WRONG_NUMBER
            change = Change(point.name, "place") if wrong else None
            found[number] = min(chi2, 2 * WRONG_NUMBER), change, []
        elif len(point.distances_m):
            found[number] = min(
                (
                    _read_option(number, point, option, places_m[number], spare_m)
                    for option in _options(point)
                ),
                key=lambda one: one[0],
            )
    _swap(points, places_m, spare_m, found)
    for _, _, own in found.values():
        rows += own
    changes = tuple(change for _, change, _ in found.values() if change is not None)
    return rows, changes, sum(cost for cost, _, _ in found.values())


def _read_option(
    number: int, point: CalibrationPoint, option: _Option, place_m: Array, spare_m: float
) -> tuple[float, Change | None, list[_Row]]:
    costs, other = _option_costs(point, option, place_m[None], spare_m)
    ranges_m = np.linalg.norm(place_m - point.references_m, axis=1)
    fits = (ranges_m - option.distances_m) ** 2 < WRONG_NUMBER * (point.distance_sigmas_m**2 + spare_m**2)
    change = option.change
    if not fits.all():
        change = Change(point.name, "distance")
    elif other[0]:
        change = Change(point.name, "side" if change is None else "side and exchanged")
    columns = zip(
        point.references_m, option.distances_m.tolist(), point.distance_sigmas_m.tolist(), strict=True
    )
    rows = [(number, *column) for column, good in zip(columns, fits.tolist(), strict=True) if good]
    return float(costs[0]), change, rows


def _swap(
    points: Sequence[CalibrationPoint],
    places_m: Array,
    spare_m: float,
    found: dict[int, tuple[float, Change | None, list[_Row]]],
) -> None:
    """Exchange the readings of two points where both then fit."""
    wrong = [
        n for n, (_, change, _) in found.items() if change is not None and len(points[n].distances_m) > 1
    ]
    for one, two in combinations(wrong, 2):
        crossed = []
        for number, other in ((one, two), (two, one)):
            point = points[other]
            read = _read_option(number, point, _options(point)[0], places_m[number], spare_m)
            crossed.append((read[0] + _MISTAKE / 2, Change(points[number].name, "swapped", point.name), read))
        if sum(cost for cost, _, _ in crossed) >= found[one][0] + found[two][0]:
            continue
        if all(read[1] is None for _, _, read in crossed):
            for number, (cost, change, read) in zip((one, two), crossed, strict=True):
                found[number] = cost, change, read[2]


def _adjust(
    points: Sequence[CalibrationPoint], shape: PointShape, rows: list[_Row], start_m: Array
) -> tuple[Array, float]:
    """Return the most probable places (t, 2) for readings that fit, and the chi2 of the shape alone.

    The unknowns are a motion of the shape, and the errors of its points in units of their covariance.
    """
    from scipy.optimize import least_squares

    count = len(points)
    root = np.linalg.cholesky(shape.covariance_m2)
    numbers = np.array([row[0] for row in rows], dtype=np.intp)
    references_m = np.array([row[1] for row in rows]).reshape(-1, 2)
    distances_m, sigmas_m = (np.array([row[k] for row in rows], dtype=np.float64) for k in (2, 3))
    placed = [n for n, point in enumerate(points) if point.point_m is not None]
    given_m = np.array([points[n].point_m for n in placed]).reshape(-1, 2)
    given_sigma_m = np.sqrt([float(points[n].covariance_m2[0, 0]) for n in placed])  # type: ignore[index]
    flat, target = (one @ [1, 1j] for one in (shape.places_m, start_m))
    turn = np.sum(np.conj(flat - flat.mean()) * (target - target.mean()))
    turn /= max(abs(turn), 1e-12)

    def place(values: Array) -> Array:
        own = flat + (root @ values[3:]).reshape(count, 2) @ [1, 1j]
        moved = (
            turn * np.exp(1j * values[0]) * (own - flat.mean()) + target.mean() + values[1] + 1j * values[2]
        )
        return np.stack([moved.real, moved.imag], axis=1)

    def residuals(values: Array) -> Array:
        places_m = place(values)
        ranges_m = np.linalg.norm(places_m[numbers] - references_m, axis=1)
        given = (places_m[placed] - given_m) / given_sigma_m[:, None]
        limit = np.sqrt(2 * WRONG_NUMBER)
        return np.concatenate(
            [values[3:], (ranges_m - distances_m) / sigmas_m, np.clip(given, -limit, limit).ravel()]
        )

    best = least_squares(residuals, np.zeros(3 + 2 * count), method="trf", max_nfev=15)
    return place(best.x), float((best.x[3:] ** 2).sum())
