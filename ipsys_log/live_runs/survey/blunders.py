"""Warnings on a measurement: a point outside of the floor, a flat crossing angle, a contradicting model."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey.scene import Prediction
from ipsys_log.messages import Array, Measurement, Rig
from ipsys_log.statistics.outliers import Blunder, possible_blunders
from ipsys_log.statistics.tape import (
    RiggedMeasurement,
    TapePoint,
    find_weak_points,
    reference_points,
    with_usual_tape,
    world_point,
)
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.trilateration import SIDES, USUAL_TAPE_SIGMA_M, are_collinear

# The name of a model from a log, in a warning.
MODEL_NAME = "the model"
# A residual of a distance above this value, and above three sigmas, is a reading error.
_MISFIT_M = 0.01
_OUTSIDE_M = 0.02
# Largest error of a model, or four sigmas if they are larger: between the points of its fit, and outside of
# these points.
_ASTRAY_M, _ASTRAY_OUTSIDE_M = 0.05, 0.15
_SIGMAS = 4.0
# A smaller correction is given in mm.
_FINE_M = 0.02


def _outside_m(point_m: Array, rig: Rig) -> float:
    """Return the distance of a point from the floor area, in m; 0 inside."""
    if rig.floor is None:
        return 0.0
    size_m = np.array([rig.floor.width_m, rig.floor.depth_m])
    beyond_m = np.maximum(np.maximum(-point_m[:2], point_m[:2] - size_m), 0.0)
    return float(np.hypot(*beyond_m))


def warn_floor(read: Measurement, fixed: TapePoint, rig: Rig) -> tuple[bool | None, list[str]]:
    """Return whether a point lies on the floor (None without a floor in the rig), and a warning."""
    if rig.floor is None:
        return None, []
    outside_m = _outside_m(fixed.world_m, rig)
    if outside_m <= _OUTSIDE_M:
        return True, []
    text = f"with {_tapes(read)}, the point is {outside_m * CM_PER_M:.0f} cm outside of the floor"
    if read.side is not None and are_collinear(reference_points(read, rig)):
        other = SIDES[1 - SIDES.index(read.side)]
        other_m = world_point(replace(read, side=other), rig).world_m
        if _outside_m(other_m, rig) <= _OUTSIDE_M:
            text += f"; with side {other}, it is on the floor"
    return False, [text]


def warn_tapes(read: Measurement, fixed: TapePoint, rig: Rig) -> list[str]:
    """Return a warning if the distances of a measurement contradict one another."""
    sigma_m = rig.tape_sigma_m or USUAL_TAPE_SIGMA_M
    worst = int(np.abs(fixed.residuals_m).argmax())
    off_m = float(abs(fixed.residuals_m[worst]))
    if len(read.distances) > 2 and off_m > max(_MISFIT_M, 3 * sigma_m):
        return [f"{_tapes(read)} contradict each other by {off_m * CM_PER_M:.1f} cm: read them again"]
    return []


def warn_crossing(read: Measurement, rig: Rig) -> list[str]:
    """Return a warning if the tapes cross at an angle that is too flat."""
    return [
        f"{_tapes(read)}: the tapes cross at only {flat.angle_deg:.0f} degrees, so the standard deviation of "
        f"the point is {(flat.sigma_m or 0.0) * CM_PER_M:.1f} cm; use another point or a third "
        "reference point"
        for flat in find_weak_points([RiggedMeasurement(read, with_usual_tape(rig))])
    ]


def floor_sigma_m(fixed: TapePoint) -> float | None:
    """Return the largest standard deviation of a tape point on the floor plane, in m."""
    if fixed.covariance_m2 is None:
        return None
    return float(np.sqrt(np.linalg.eigvalsh(fixed.covariance_m2[:2, :2])[-1]))


def warn_model(
    read: Measurement,
    fixed: TapePoint,
    rig: Rig,
    predictions: Sequence[Prediction],
    model_name: str = MODEL_NAME,
) -> list[str]:
    """Return a warning if the model predicts another point, with the measuring mistake that explains it."""
    if not predictions:
        return []
    predicted_m = np.mean([prediction.world_m for prediction in predictions], axis=0)
    off_m = float(np.linalg.norm(predicted_m - fixed.world_m))
    inside = [prediction for prediction in predictions if prediction.inside is not False]
    sigma_m = max((prediction.sigma_m or 0.0 for prediction in predictions), default=0.0)
    bound_m = max(
        _ASTRAY_M if inside else _ASTRAY_OUTSIDE_M,
        _SIGMAS * float(np.hypot(sigma_m, floor_sigma_m(fixed) or 0.0)),
    )
    if off_m <= bound_m:
        return []
    text = f"the point is {off_m * CM_PER_M:.0f} cm away from the prediction of {model_name}"
    for group in possible_blunders(read, rig, predicted_m):
        explanations = []
        for slip in group:
            try:
                corrected_m = world_point(slip.corrected, rig).world_m
            except IpsysError:
                continue  # the corrected distances form no point
            explanations.append((float(np.linalg.norm(corrected_m - predicted_m)), _explanation(read, slip)))
        if explanations and min(explanations)[0] <= bound_m:
            return [f"{text}: {min(explanations)[1]}"]
    return [f"{text}: read {_tapes(read)}, the height and the marker again"]


def _explanation(read: Measurement, blunder: Blunder) -> str:
    """Return the text of a possible blunder in cm, the unit of the entry; its own text is in m."""
    corrected = blunder.corrected
    side = f"side {corrected.side} would fit" if corrected.side != read.side else ""
    if blunder.kind == "side":
        return f"{side}, not {read.side}"
    if blunder.kind == "height":
        return f"the height reads {_correction(read.height_m or 0.0, corrected.height_m or 0.0)}"
    changed = [(old, new) for old, new in zip(read.distances, corrected.distances, strict=True) if old != new]
    if blunder.kind == "distance" and changed:
        old, new = changed[0]
        return f"the distance to {old.reference} reads {_correction(old.distance_m, new.distance_m)}"
    tapes = [f"{new.distance_m * CM_PER_M:.1f} cm to {new.reference}" for _, new in changed]
    names = " and ".join(new.reference for _, new in changed)
    return f"the distances to {names} look exchanged: {' and '.join([*tapes, *([side] if side else [])])}"


def _correction(read_m: float, right_m: float) -> str:
    digits = 0 if abs(right_m - read_m) >= _FINE_M else 1
    return f"{read_m * CM_PER_M:.1f} cm; {right_m * CM_PER_M:.{digits}f} cm would fit"


def _tapes(read: Measurement) -> str:
    """Return the distances of a measurement by name: ``the distances to A and B``."""
    *names, last = (tape.reference for tape in read.distances)
    return f"the distances to {', '.join(names)} and {last}"
