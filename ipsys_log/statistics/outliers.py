"""Outliers among measurements, and the typical blunder with tape and pencil that explains each."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Array, Distance, Measurement, Rig, Suspect, WorldPoint
from ipsys_log.statistics.consistency import FEWEST_POINTS, score, usual_covariances
from ipsys_log.statistics.tape import (
    RiggedMeasurement,
    TapePoint,
    reference_points,
    with_usual_tape,
    world_point,
)
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.trilateration import SIDES, are_collinear, multilaterate, side_of

# A lower predicted height is impossible for a marker. Noise can move a prediction slightly below the floor.
_LOWEST_M = -0.03
# The text of a smaller correction has a resolution of 1 mm.
_FINE_M = 0.02


@dataclass(frozen=True, slots=True)
class Blunder:
    """A possible blunder: ``kind`` as in a Suspect, its ``text``, and the ``corrected`` measurement."""

    kind: str
    text: str
    corrected: Measurement


def possible_blunders(measurement: Measurement, rig: Rig, predicted_m: Array) -> list[list[Blunder]]:
    """Return the possible blunders of a measurement, the simplest first.

    Parameters
    ----------
    measurement : measurement of an outlier. Without tape distances, the function computes the distances from
        its world point to the first two reference points.
    rig : the rig that was valid at the measurement.
    predicted_m : (3,), predicted world point from all other measurements.

    Returns
    -------
    Groups of blunders; all blunders of a group are equally simple. The first group contains a wrong side, and
    two exchanged distances. The second group contains both at once. The third group contains one wrong
    distance or height, with the correction that fits the prediction best.

    Examples
    --------
    >>> from ipsys_log.messages import ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points)
    >>> tape = (Distance("A", 1.600), Distance("B", 1.414))
    >>> read = Measurement(0, "a", distances=tape, side="left", height_m=0.0)
    >>> blunders = possible_blunders(read, rig, np.array([1.0, 1.0, 0.0]))
    >>> [[blunder.kind for blunder in group] for group in blunders]
    [['side', 'swapped'], ['swapped'], ['distance', 'distance', 'height']]
    >>> blunders[2][0].text
    'the distance to A reads 1.600 m; 1.41 m, 19 cm less, would fit'
    """
    taped = _as_taped(measurement, rig)
    if taped is None:
        return [_height_blunders(measurement, predicted_m)]
    references_m = reference_points(taped, rig)
    sides = list(_side_blunders(taped, references_m))
    swaps = list(_swaps(taped))
    both = [
        replace(side, kind=swap.kind, text=f"{swap.text}, and {side.text}")
        for swap in swaps
        for side in _side_blunders(swap.corrected, references_m)
    ]
    # Without a tape reading, the distance comes from the world point.
    says = "reads" if measurement.distances else "comes to"
    distances = list(_distance_blunders(taped, references_m, predicted_m, says))
    return [sides + swaps, both, distances + _height_blunders(taped, predicted_m)]


def _as_taped(measurement: Measurement, rig: Rig) -> Measurement | None:
    """Return the measurement with distances only; None without distances and without reference points."""
    known = {point.name for point in rig.reference_points}
    point = measurement.point
    if point is None:
        return measurement
    height_m = point.z_m if measurement.height_m is None else measurement.height_m
    world_m = np.array([point.x_m, point.y_m])
    taped = measurement
    named = {distance.reference for distance in measurement.distances}
    if len(named) < 2 or not named <= known:
        if len(rig.reference_points) < 2:
            return None
        tapes = tuple(
            Distance(p.name, float(np.hypot(*(world_m - [p.x_m, p.y_m])))) for p in rig.reference_points[:2]
        )
        taped = replace(measurement, distances=tapes, side=None)
    side = taped.side or side_of(world_m, reference_points(taped, rig))
    return replace(taped, point=None, side=side, height_m=height_m)


def _side_blunders(taped: Measurement, references_m: Array) -> Iterator[Blunder]:
    if taped.side in SIDES and are_collinear(references_m):
        other = "right" if taped.side == "left" else "left"
        first = taped.distances[0].reference
        second = next(tape.reference for tape in taped.distances if tape.reference != first)
        text = f"it lies {other} of the line from {first} to {second}, not {taped.side}"
        yield Blunder("side", text, replace(taped, side=other))


def _swaps(taped: Measurement) -> Iterator[Blunder]:
    tapes = taped.distances
    for i, j in combinations(range(len(tapes)), 2):
        own = replace(tapes[i], distance_m=tapes[j].distance_m)
        other = replace(tapes[j], distance_m=tapes[i].distance_m)
        swapped = [*tapes]
        swapped[i], swapped[j] = own, other
        text = (
            f"the distances to {own.reference} and {other.reference} look exchanged: "
            f"{own.distance_m:.3f} m to {own.reference} and {other.distance_m:.3f} m to {other.reference} fit"
        )
        yield Blunder("swapped", text, replace(taped, distances=tuple(swapped)))


def _distance_blunders(
    taped: Measurement, references_m: Array, predicted_m: Array, says: str
) -> Iterator[Blunder]:
    for wrong, tape in enumerate(taped.distances):
        rest = [n for n in range(len(references_m)) if n != wrong]
        rest_m = np.array([taped.distances[n].distance_m for n in rest])
        try:
            point_m = _nearest(references_m[rest], rest_m, predicted_m[:2])
        except IpsysError:
            continue
        right_m = float(np.hypot(*(point_m - references_m[wrong])))
        text = f"the distance to {tape.reference} {says} {_correction(tape.distance_m, right_m)}"
        tapes = [*taped.distances]
        tapes[wrong] = replace(tape, distance_m=right_m)
        yield Blunder("distance", text, replace(taped, distances=tuple(tapes)))


def _nearest(references_m: Array, distances_m: Array, predicted_m: Array) -> Array:
    """Return the point at the given distances from the reference points that is nearest to a prediction."""
    if len(references_m) == 1:
        towards_m = predicted_m - references_m[0]
        point_m: Array = references_m[0] + towards_m * (distances_m[0] / max(np.hypot(*towards_m), 1e-9))
        return point_m
    sides = SIDES if are_collinear(references_m) else (None,)
    solutions = [multilaterate(references_m, distances_m, None, side).point_m for side in sides]
    return min(solutions, key=lambda point_m: float(np.hypot(*(point_m - predicted_m))))


def _height_blunders(measurement: Measurement, predicted_m: Array) -> list[Blunder]:
    height_m, right_m = measurement.height_m, float(predicted_m[2])
    point = measurement.point
    if point is None:
        corrected = replace(measurement, height_m=right_m)
    else:
        height_m = point.z_m
        corrected = replace(measurement, point=WorldPoint(point.x_m, point.y_m, right_m))
    if height_m is None or right_m < _LOWEST_M:
        return []
    return [Blunder("height", f"the height reads {_correction(height_m, right_m)}", corrected)]


def _correction(read_m: float, right_m: float) -> str:
    """Return the text of a correction: in cm, the accuracy of cameras; in mm for small corrections.

    A small correction can be important if the tapes amplify it.
    """
    off_m = right_m - read_m
    digits = 0 if abs(off_m) >= _FINE_M else 1
    change = f"{abs(off_m) * CM_PER_M:.{digits}f} cm {'more' if off_m > 0 else 'less'}"
    return f"{read_m:.3f} m; {right_m:.{digits + 2}f} m, {change}, would fit"


# A function from ids that no fit may use to predictions by camera and id. Each prediction is a world point
# (3,) of a model that is fitted without this point.
LeaveOneOut = Callable[[frozenset[str]], Mapping[str, Mapping[str, Array]]]

# A calibration point with a larger error, in units of the usual error, is an outlier. In simulated labs, one
# of 150 good points is an outlier in 1 to 5 of 100 sessions.
_SUSPECT = 3.7
# A blunder explains an outlier if the error of the corrected point is at most _EXPLAINED. A larger error is
# also sufficient if it is at most _SHARE_LEFT times the original error and below _SUSPECT.
_EXPLAINED = 2.5
_SHARE_LEFT = 0.2
# An error that is greater than both this length and this multiple of the median is gross: it is no error of a
# camera or a model.
_GROSS_M = 0.3
_GROSS = 3.0
_MOST_SHARE = 0.2


# An outlier with a larger error, in units of the usual error, is gross. In simulated labs, an exchanged pair
# of distances has a score above 10, and no good point is an outlier. On the paper's points, no score of the
# polynomial is above 6.
_GROSS_SCORE = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class _Finding:
    """The prediction for a calibration point from all other points, and the score of its error."""

    cameras: tuple[str, ...]
    predicted_m: Array
    residual_m: Array
    usual_m2: Array
    score: float


_Judge = Callable[[frozenset[str]], dict[str, _Finding]]


def find_outliers(leave_one_out: LeaveOneOut, places: Sequence[RiggedMeasurement]) -> tuple[Suspect, ...]:
    """Return the outliers: calibration points that disagree with models that are fitted without them.

    The function removes the worst point and repeats the test of the other points, until no point is an
    outlier. The repetition is necessary, because a gross error affects the fits to its neighbours, hides
    smaller errors, and makes good points look bad. Finally, the function tests the removed points against the
    fits without outliers, and restores points that agree with them.

    Parameters
    ----------
    leave_one_out : function of ids that no fit may use. It returns, by camera and by point that the camera
        saw, the world point (3,) in m of a model without this point. Points with those ids are included.
    places : the valid measurements. Measurements that no camera saw are skipped, and also cameras that saw
        fewer than 15 of them.

    Returns
    -------
    The outliers, at most a fifth of the points, the outlier with the largest error first.

    Raises
    ------
    FitError
        ``leave_one_out`` has too few points at the start.
    IpsysError
        A measurement forms no world point.

    Examples
    --------
    >>> from ipsys_log.messages import Distance, Measurement, ReferencePoint, Rig
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points, tape_sigma_m=0.003)
    >>> seen, places = {}, []
    >>> for n, (x, y) in enumerate(np.ndindex(5, 5)):
    ...     seen[f"m{n}"] = np.array([x - 1.0, y + 1.0, 0.0])
    ...     tape = Distance("A", np.hypot(x - 1, y + 1)), Distance("B", np.hypot(x - 3, y + 1))
    ...     side = "right" if n == 12 else "left"
    ...     read = Measurement(0, f"m{n}", distances=tape, side=side, height_m=0.0)
    ...     places.append(RiggedMeasurement(read, rig))
    >>> (outlier,) = find_outliers(lambda unused: {"red": seen}, places)
    >>> outlier.measurement, outlier.kind, outlier.text, outlier.corrected_m.round(3).tolist()
    ('m12', 'side', 'it lies left of the line from A to B, not right', [1.0, 3.0, 0.0])
    """
    places = [replace(place, rig=with_usual_tape(place.rig)) for place in places]
    fixed = {place.measurement.id: world_point(place.measurement, place.rig) for place in places}
    taken, findings = _search(lambda names: _judge(leave_one_out(names), fixed, names))
    by_id = {place.measurement.id: place for place in places}
    outliers = [_suspect(by_id[name], findings[name]) for name in taken]
    return tuple(sorted(outliers, key=lambda suspect: -float(np.linalg.norm(suspect.residual_m))))


def describe_outlier(
    place: RiggedMeasurement, cameras: tuple[str, ...], predicted_m: Array, usual_m2: Array, score: float
) -> Suspect:
    """Return an outlier with the simplest mistake that explains it.

    Parameters
    ----------
    place : the measurement, and the rig in force.
    cameras : those that saw the point.
    predicted_m : (3,), the point by all other observations.
    usual_m2 : (3, 3), covariance of the prediction.
    score : size of its error in units of the usual error.
    """
    place = replace(place, rig=with_usual_tape(place.rig))
    residual_m = predicted_m - world_point(place.measurement, place.rig).world_m
    return _suspect(place, _Finding(cameras, predicted_m, residual_m, usual_m2, score))


def is_gross(suspect: Suspect) -> bool:
    """Return whether an outlier is a gross error, which no tape, camera or model explains."""
    return suspect.score >= _GROSS_SCORE


def _search(judge: _Judge) -> tuple[list[str], dict[str, _Finding]]:
    """Return the names of the outliers, and the findings of all calibration points."""
    findings = judge(frozenset())
    taken: list[str] = []
    with suppress(FitError):  # too few calibration points remain for the test of the others
        while len(taken) < _MOST_SHARE * len(findings) and (worst := _worst(findings, taken)):
            taken.append(worst)
            findings |= judge(frozenset(taken))
    with suppress(FitError):
        while taken and findings[least := min(taken, key=lambda n: findings[n].score)].score < _SUSPECT:
            taken.remove(least)
            findings |= judge(frozenset(taken))
    return [name for name in taken if findings[name].score >= _SUSPECT], findings


def _worst(findings: Mapping[str, _Finding], taken: Collection[str]) -> str | None:
    """Return the worst outlier of the remaining points; None if there is no outlier.

    Errors of metres also affect the usual error, but their length identifies them. The fit without a point is
    independent of the point's error, while the fits for the other points contain a part of it.
    """
    lengths = {name: float(np.linalg.norm(finding.residual_m)) for name, finding in findings.items()}
    left = [name for name in findings if name not in taken]
    longest = max(left, key=lambda name: lengths[name])
    if lengths[longest] > max(_GROSS_M, _GROSS * float(np.median([lengths[name] for name in left]))):
        return longest
    worst = max(left, key=lambda name: findings[name].score)
    return worst if findings[worst].score >= _SUSPECT else None


def _judge(
    predicted: Mapping[str, Mapping[str, Array]], fixed: Mapping[str, TapePoint], taken: Collection[str]
) -> dict[str, _Finding]:
    """Return the findings of all points that a camera with enough calibration points saw."""
    rows: dict[str, list[tuple[str, Array, Array]]] = {}
    for camera, points in sorted(predicted.items()):
        names = [name for name in fixed if name in points and np.isfinite(points[name]).all()]
        fitted = np.array([name not in taken for name in names], dtype=bool)
        if fitted.sum() < FEWEST_POINTS:
            continue
        predicted_m = np.array([points[name] for name in names])
        residuals_m = predicted_m - [fixed[name].world_m for name in names]
        tape_m2 = np.array([_tape_m2(fixed[name]) for name in names])
        usual_m2 = usual_covariances(predicted_m, residuals_m, fitted, tape_m2)
        for name, *row in zip(names, predicted_m, usual_m2, strict=True):
            rows.setdefault(name, []).append((camera, *row))
    return {name: _finding(row, fixed[name]) for name, row in rows.items()}


def _finding(seen: Sequence[tuple[str, Array, Array]], fixed: TapePoint) -> _Finding:
    """Return the mean finding of several cameras.

    The mean does not reduce the common errors of the cameras, mainly the error of the tape. The usual error
    of the mean is therefore that of one camera.
    """
    cameras, points_m, usual_m2 = zip(*seen, strict=True)
    predicted_m = np.mean(points_m, axis=0)
    usual = np.mean(usual_m2, axis=0)
    residual_m = predicted_m - fixed.world_m
    return _Finding(cameras, predicted_m, residual_m, usual, _score(predicted_m, usual, fixed))


def _score(predicted_m: Array, usual_m2: Array, fixed: TapePoint) -> float:
    residual_m = predicted_m - fixed.world_m
    return float(score(residual_m[None], (usual_m2 + _tape_m2(fixed))[None])[0])


def _tape_m2(fixed: TapePoint) -> Array:
    return np.zeros((3, 3)) if fixed.covariance_m2 is None else fixed.covariance_m2


def _suspect(place: RiggedMeasurement, finding: _Finding) -> Suspect:
    blunder, corrected_m = _explain(place, finding) or (None, None)
    return Suspect(
        measurement=place.measurement.id,
        cameras=finding.cameras,
        residual_m=finding.residual_m,
        score=finding.score,
        kind=blunder.kind if blunder else None,
        text=blunder.text if blunder else None,
        corrected_m=corrected_m,
    )


def _explain(place: RiggedMeasurement, finding: _Finding) -> tuple[Blunder, Array] | None:
    """Return the simplest blunder whose correction gives a usual error, and the corrected world point."""
    usual = min(max(_EXPLAINED, _SHARE_LEFT * finding.score), _SUSPECT)
    for group in possible_blunders(place.measurement, place.rig, finding.predicted_m):
        left = []
        for blunder in group:
            try:
                fixed = world_point(blunder.corrected, place.rig)
            except IpsysError:
                continue  # the corrected measurement forms no world point
            left.append((_score(finding.predicted_m, finding.usual_m2, fixed), blunder, fixed.world_m))
        if left and (best := min(left, key=lambda row: row[0]))[0] <= usual:
            return best[1:]
    return None
