"""Measurements that the others contradict: found one by one, and explained where one slip explains them."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.blunders import Slip, possible_slips
from ipsys_log.analysis.consistency import FEWEST_POINTS, score, usual_covariances
from ipsys_log.analysis.tape import Measured, TapePoint, world_point
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Rig, Suspect

__all__ = ["LeaveOneOut", "find_suspects"]

Array = NDArray[np.float64]

# Ids that no fit may use -> camera -> id -> world point (3,) predicted by a model fitted without that place.
LeaveOneOut = Callable[[frozenset[str]], Mapping[str, Mapping[str, Array]]]

# In units of the usual error: a place that is further off is a suspect (in simulated labs one of 150 good
# places is, in 1 to 5 sessions of 100).
_SUSPECT = 3.7
# A slip explains it if without it the place is no further off than the first; or than the second share of
# what it was, and no suspect.
_EXPLAINED = 2.5
_SHARE_LEFT = 0.2
# So much, and so many times the median, is no error of a camera or a model.
_GROSS_M = 0.3
_GROSS = 3.0
_MOST_SHARE = 0.2
_USUAL_TAPE_M = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class _Finding:
    """A place in the light of the others: what they predict, and how unusual the error is."""

    cameras: tuple[str, ...]
    predicted_m: Array
    residual_m: Array
    usual_m2: Array
    score: float


_Judge = Callable[[frozenset[str]], dict[str, _Finding]]


def find_suspects(leave_one_out: LeaveOneOut, places: Sequence[Measured]) -> tuple[Suspect, ...]:
    """Measured places that disagree with models fitted without them.

    The worst place is taken out and the others are judged afresh, until none stands out: a gross error
    spoils the fits to its neighbours, hides smaller errors, and makes good places look bad. What was
    taken out is judged once more by the clean fits, and put back where they agree with it.

    Parameters
    ----------
    leave_one_out : given ids that no fit may use, for each camera and each place that it saw, those
        ids included, the world point (3,) in m predicted by a model fitted without that place.
    places : the measurements that count; those that no camera saw are passed over, and so are cameras
        that saw fewer than 15.

    Returns
    -------
    The suspects, at most a fifth of the places, the one that is off by most first.

    Raises
    ------
    FitError
        Where ``leave_one_out`` has too few places to begin with.
    IpsysError
        Where a place forms no world point.

    Examples
    --------
    >>> from ipsys_log.messages import Distance, Measurement, ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points, tape_sigma_m=0.003)
    >>> seen, places = {}, []
    >>> for n, (x, y) in enumerate(np.ndindex(5, 5)):
    ...     seen[f"m{n}"] = np.array([x - 1.0, y + 1.0, 0.0])
    ...     tape = Distance("A", np.hypot(x - 1, y + 1)), Distance("B", np.hypot(x - 3, y + 1))
    ...     side = "right" if n == 12 else "left"
    ...     read = Measurement(0, f"m{n}", distances=tape, side=side, height_m=0.0)
    ...     places.append(Measured(read, rig))
    >>> (suspect,) = find_suspects(lambda unused: {"red": seen}, places)
    >>> suspect.measurement, suspect.kind, suspect.text, suspect.corrected_m.round(3).tolist()
    ('m12', 'side', 'it lies left of the line from A to B, not right', [1.0, 3.0, 0.0])
    """
    places = [replace(place, rig=_with_tape(place.rig)) for place in places]
    fixed = {place.measurement.id: world_point(place.measurement, place.rig) for place in places}
    taken, findings = _search(lambda names: _judge(leave_one_out(names), fixed, names))
    by_id = {place.measurement.id: place for place in places}
    suspects = [_suspect(by_id[name], findings[name]) for name in taken]
    return tuple(sorted(suspects, key=lambda suspect: -float(np.linalg.norm(suspect.residual_m))))


def _with_tape(rig: Rig) -> Rig:
    """The rig with a usual tape if it names none: a flat crossing is to excuse an error all the same."""
    return replace(rig, tape_sigma_m=_USUAL_TAPE_M) if rig.tape_sigma_m is None else rig


def _search(judge: _Judge) -> tuple[list[str], dict[str, _Finding]]:
    """The places that contradict the others, and all places in the light of the others."""
    findings = judge(frozenset())
    taken: list[str] = []
    with suppress(FitError):  # too few places are left to judge the others by
        while len(taken) < _MOST_SHARE * len(findings) and (worst := _worst(findings, taken)):
            taken.append(worst)
            findings |= judge(frozenset(taken))
    with suppress(FitError):
        while taken and findings[least := min(taken, key=lambda n: findings[n].score)].score < _SUSPECT:
            taken.remove(least)
            findings |= judge(frozenset(taken))
    return [name for name in taken if findings[name].score >= _SUSPECT], findings


def _worst(findings: Mapping[str, _Finding], taken: Collection[str]) -> str | None:
    """The place that stands out most of those that are still in; None where none does.

    Errors of metres spoil the very yardstick, but by length they stand out all the more: a fit without a
    place owes nothing to its error, the fits to the others owe a part of it.
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
    """Each place that a camera with enough places saw."""
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
    """What the cameras have in common, the tape's error above all, does not average out: neither is the
    mean of several taken for better than one."""
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


def _suspect(place: Measured, finding: _Finding) -> Suspect:
    slip, corrected_m = _explain(place, finding) or (None, None)
    return Suspect(
        measurement=place.measurement.id,
        cameras=finding.cameras,
        residual_m=finding.residual_m,
        score=finding.score,
        kind=slip.kind if slip else None,
        text=slip.text if slip else None,
        corrected_m=corrected_m,
    )


def _explain(place: Measured, finding: _Finding) -> tuple[Slip, Array] | None:
    """The simplest slip without which the error is a usual one, and the world point then."""
    usual = min(max(_EXPLAINED, _SHARE_LEFT * finding.score), _SUSPECT)
    for group in possible_slips(place.measurement, place.rig, finding.predicted_m):
        left = []
        for slip in group:
            try:
                fixed = world_point(slip.corrected, place.rig)
            except IpsysError:
                continue  # without this slip it would be nowhere
            left.append((_score(finding.predicted_m, finding.usual_m2, fixed), slip, fixed.world_m))
        if left and (best := min(left, key=lambda row: row[0]))[0] <= usual:
            return best[1:]
    return None
