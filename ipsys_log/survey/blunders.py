"""Warnings on a measurement: off the floor, flat tapes, another prediction by the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.blunders import possible_slips
from ipsys_log.analysis.tape import Measured, TapePoint, flat_places, reference_points, world_point
from ipsys_log.errors import IpsysError
from ipsys_log.geometry.trilateration import SIDES, sides_alike
from ipsys_log.messages import Measurement, Rig
from ipsys_log.survey.scene import Prediction
from ipsys_log.units import CM_PER_M

__all__ = [
    "THE_MODEL",
    "doubt_crossing",
    "doubt_floor",
    "doubt_model",
    "doubt_tapes",
    "floor_sigma_m",
    "with_tape",
]

Array = NDArray[np.float64]

# The name of a model from a log, in a warning.
THE_MODEL = "the model"
# Without a sigma in the rig, only to tell how well a place is known.
_USUAL_TAPE_M = 0.003
# Distances that contradict one another by more than this, or three sigmas, were not read well.
_MISFIT_M = 0.01
_OUTSIDE_M = 0.02
# A model is not off by more than this, or four sigmas, among the places that it was fitted to; beyond them
# it may be.
_ASTRAY_M, _ASTRAY_OUTSIDE_M = 0.05, 0.15
_SIGMAS = 4.0


def with_tape(rig: Rig) -> Rig:
    """The rig with a usual tape if it names none."""
    return replace(rig, tape_sigma_m=_USUAL_TAPE_M) if rig.tape_sigma_m is None else rig


def _outside_m(point_m: Array, rig: Rig) -> float:
    """Return how far a point lies outside of the floor, 0 inside."""
    if rig.floor is None:
        return 0.0
    size_m = np.array([rig.floor.width_m, rig.floor.depth_m])
    beyond_m = np.maximum(np.maximum(-point_m[:2], point_m[:2] - size_m), 0.0)
    return float(np.hypot(*beyond_m))


def doubt_floor(read: Measurement, fixed: TapePoint, rig: Rig) -> tuple[bool | None, list[str]]:
    """Return whether a point lies on the floor (None without a floor in the rig), and a warning."""
    if rig.floor is None:
        return None, []
    outside_m = _outside_m(fixed.world_m, rig)
    if outside_m <= _OUTSIDE_M:
        return True, []
    text = f"{_tapes(read)} put the point {outside_m * CM_PER_M:.0f} cm outside of the floor"
    if read.side is not None and sides_alike(reference_points(read, rig)):
        other = SIDES[1 - SIDES.index(read.side)]
        there_m = world_point(replace(read, side=other), rig).world_m
        if _outside_m(there_m, rig) <= _OUTSIDE_M:
            text += f"; on the {other} it would lie on it"
    return False, [text]


def doubt_tapes(read: Measurement, fixed: TapePoint, rig: Rig) -> list[str]:
    """Return a warning if distances contradict one another."""
    sigma_m = with_tape(rig).tape_sigma_m or _USUAL_TAPE_M
    worst = int(np.abs(fixed.residuals_m).argmax())
    off_m = float(abs(fixed.residuals_m[worst]))
    if len(read.distances) > 2 and off_m > max(_MISFIT_M, 3 * sigma_m):
        return [f"{_tapes(read)} contradict one another by {off_m * CM_PER_M:.1f} cm: read them again"]
    return []


def doubt_crossing(read: Measurement, rig: Rig) -> list[str]:
    """Return a warning if the tapes cross at an angle that is too flat."""
    return [
        f"{_tapes(read)}: the tapes cross at {flat.angle_deg:.0f} degrees only, so that the point is known "
        f"to {(flat.sigma_m or 0.0) * CM_PER_M:.1f} cm; another place, or a third reference point, is better"
        for flat in flat_places([Measured(read, with_tape(rig))])
    ]


def floor_sigma_m(fixed: TapePoint) -> float | None:
    """Return how well the tape knows a place in the direction in which it knows it least, in m."""
    if fixed.covariance_m2 is None:
        return None
    return float(np.sqrt(np.linalg.eigvalsh(fixed.covariance_m2[:2, :2])[-1]))


def doubt_model(
    read: Measurement,
    fixed: TapePoint,
    rig: Rig,
    predictions: Sequence[Prediction],
    model_name: str = THE_MODEL,
) -> list[str]:
    """Return a warning if the model predicts another point, with the mistake that explains it."""
    if not predictions:
        return []
    predicted_m = np.mean([one.world_m for one in predictions], axis=0)
    off_m = float(np.linalg.norm(predicted_m - fixed.world_m))
    known = [one for one in predictions if one.inside is not False]
    sigma_m = max((one.sigma_m or 0.0 for one in predictions), default=0.0)
    bound_m = max(
        _ASTRAY_M if known else _ASTRAY_OUTSIDE_M,
        _SIGMAS * float(np.hypot(sigma_m, floor_sigma_m(fixed) or 0.0)),
    )
    if off_m <= bound_m:
        return []
    text = f"the point is {off_m * CM_PER_M:.0f} cm away from the prediction of {model_name}"
    for group in possible_slips(read, rig, predicted_m):
        left = []
        for slip in group:
            try:
                there_m = world_point(slip.corrected, rig).world_m
            except IpsysError:
                continue  # without this slip it would be nowhere
            left.append((float(np.linalg.norm(there_m - predicted_m)), slip.text))
        if left and min(left)[0] <= bound_m:
            why = min(left)[1]
            return [f"{text}: {why}{'' if why.endswith('fit') else '?'}"]
    return [f"{text}: read {_tapes(read)}, the height and the marker again"]


def _tapes(read: Measurement) -> str:
    """Return the distances of a measurement by name: ``the distances to A and B``."""
    *names, last = (tape.reference for tape in read.distances)
    return f"the distances to {', '.join(names)} and {last}"
