"""Detection of outliers among measurements, one by one, and their explanation by a single blunder."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Suspect
from ipsys_log.messages.arrays import Array
from ipsys_log.statistics.blunders import Blunder, possible_blunders
from ipsys_log.statistics.consistency import FEWEST_POINTS, score, usual_covariances
from ipsys_log.statistics.tape import RiggedMeasurement, TapePoint, with_usual_tape, world_point

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

    Raises
    ------
    IpsysError
        The measurement forms no world point.
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
