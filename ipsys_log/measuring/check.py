"""Whether a place can be right, before it is written down: triangle, floor, cameras, model."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.multilateration import sides_alike
from ipsys_log.geometry.trilateration import SIDES
from ipsys_log.measuring.entry import Entry, Fault
from ipsys_log.measuring.predict import Prediction, predict
from ipsys_log.measuring.scene import Sight
from ipsys_log.messages import Measurement, Model, Rig
from ipsys_log.offline.pairs import active_measurements
from ipsys_log.offline.slips import possible_slips
from ipsys_log.offline.tape import Measured, TapePoint, flat_places, reference_points, world_point
from ipsys_log.units import CM_PER_M

__all__ = ["Checked", "check_entry", "next_id", "withdraw"]

Array = NDArray[np.float64]

# Without a sigma in the rig, only to tell how well a place is known.
_USUAL_TAPE_M = 0.003
# Distances that contradict one another by more than this, or three sigmas, were not read well.
_MISFIT_M = 0.01
_OUTSIDE_M = 0.02
# A model is not off by more than this, or four sigmas, among the places that it was fitted to; beyond them it is.
_ASTRAY_M, _ASTRAY_OUTSIDE_M = 0.05, 0.15
_SIGMAS = 4.0
_ALIKE_M = 0.0005


@dataclass(frozen=True, slots=True, eq=False)
class Checked:
    """What follows from an entry.

    ``faults`` keep it out of the log, ``warnings`` are to be looked at first. ``point_m`` (3,) is the world
    point, ``sigma_m`` how well the tape knows it where it knows it least, ``residuals_m`` by reference
    point where there are more than two. ``sides_m`` are both places (3,) where the side is not told yet.
    ``measurement`` is None where there are faults.
    """

    id: str
    faults: tuple[Fault, ...] = ()
    warnings: tuple[str, ...] = ()
    point_m: Array | None = None
    sigma_m: float | None = None
    residuals_m: tuple[tuple[str, float], ...] = ()
    on_floor: bool | None = None
    predictions: tuple[Prediction, ...] = ()
    sides_m: tuple[tuple[str, Array], ...] = ()
    measurement: Measurement | None = None


def next_id(history: Iterable[Measurement]) -> str:
    """The next free id: p001, p002 ... One that was withdrawn is not used again.

    Examples
    --------
    >>> next_id([Measurement(0, "p001"), Measurement(0, "p001_withdrawn", withdraws="p001")])
    'p002'
    """
    numbers = [int(m.id[1:]) for m in history if m.id[:1] == "p" and m.id[1:].isdecimal()]
    return f"p{max(numbers, default=0) + 1:03d}"


def withdraw(history: Sequence[Measurement], name: str) -> Measurement:
    """The message that withdraws a measurement; nothing is erased.

    Raises
    ------
    IpsysError
        Where there is none of that id, or it is withdrawn already.
    """
    for measurement in active_measurements(history):
        if measurement.id == name:
            return Measurement(measurement.timestamp, f"{name}_withdrawn", withdraws=name)
    raise IpsysError(f"there is no measurement {name} to withdraw; it is withdrawn already, or never was")


def check_entry(
    entry: Entry,
    faults: Sequence[Fault],
    rig: Rig,
    sight: Sight | None,
    history: Sequence[Measurement],
    model: Model | None = None,
) -> Checked:
    """Whether a place can be right, and the measurement that it makes.

    Parameters
    ----------
    entry, faults : from :func:`~ipsys_log.measuring.entry.read_typed`.
    rig : that holds now.
    sight : what the cameras say of the marker, None where it is not known which.
    history : what was measured and withdrawn so far.
    model : the present one, to compare with.
    """
    name = entry.id or next_id(history)
    found = [*faults, *_identity_faults(entry, sight, history)]
    warnings = list(entry.doubts)
    read = _measurement(entry, name, sight)
    given = {fault.field for fault in found}
    missing = {"side", "height", ""} & given or {f for f in given if f.startswith("d_")}
    if missing == {"side"} and len(entry.distances) >= 2 and entry.height_m is not None:
        sides_m, fault = _both_sides(read, rig)
        return Checked(name, tuple(found + fault), tuple(warnings), sides_m=sides_m)
    if missing or len(entry.distances) < 2 or entry.height_m is None:
        return Checked(name, tuple(found), tuple(warnings))
    try:
        # A usual tape tells how flatly the circles cross; what is written down has no sigma of its own.
        fixed = world_point(read, _with_tape(rig))
    except IpsysError as error:
        return Checked(name, (*found, Fault("", _without_id(error, name))), tuple(warnings))
    on_floor, remark = _on_floor(read, fixed, rig)
    warnings += [*remark, *_tape_warnings(read, fixed, rig)]
    found += _twin_faults(read, history)
    if sight is not None:
        warnings += _repeat_warnings(read, history)
    predictions = predict(model, sight.points_m, fixed.world_m) if model and sight else ()
    warnings += _model_warnings(read, fixed, rig, predictions)
    return Checked(
        name,
        tuple(found),
        tuple(dict.fromkeys(warnings)),
        fixed.world_m,
        _sigma_m(fixed),
        _residuals(read, fixed),
        on_floor,
        predictions,
        measurement=None if found else read,
    )


def _with_tape(rig: Rig) -> Rig:
    return replace(rig, tape_sigma_m=_USUAL_TAPE_M) if rig.tape_sigma_m is None else rig


def _measurement(entry: Entry, name: str, sight: Sight | None) -> Measurement:
    still = sight.still if sight else None
    time_ns = 0 if still is None else still.start + (still.end - still.start) // 2
    return Measurement(
        time_ns,
        name,
        marker_id=entry.marker_id,
        distances=entry.distances,
        side=entry.side,
        height_m=entry.height_m,
        still=still,
        splits=entry.splits,
    )


def _without_id(error: IpsysError, name: str) -> str:
    return str(error).removeprefix(f"measurement {name}").removeprefix(": ").strip()


def _identity_faults(
    entry: Entry, sight: Sight | None, history: Sequence[Measurement]
) -> list[Fault]:
    found = []
    if entry.id is not None and any(entry.id in (m.id, m.withdraws) for m in history):
        found.append(Fault("id", f"id {entry.id} was used before; leave it out for the next free one"))
    if sight is not None and sight.still is None:
        found.append(Fault("marker", sight.text))
    return found


def _twin_faults(read: Measurement, history: Sequence[Measurement]) -> list[Fault]:
    """The same place typed twice, to the last digit."""
    for other in active_measurements(history):
        same = (other.marker_id, other.side, other.height_m) == (read.marker_id, read.side, read.height_m)
        if same and _overlap(other, read) and _tapes(other) == _tapes(read):
            return [Fault("", f"this is {other.id} once more, with the very same numbers")]
    return []


def _repeat_warnings(read: Measurement, history: Sequence[Measurement]) -> list[str]:
    names = [
        m.id for m in active_measurements(history) if m.marker_id == read.marker_id and _overlap(m, read)
    ]
    return [f"marker {read.marker_id} is measured here already, as {', '.join(names)}"] if names else []


def _tapes(measurement: Measurement) -> list[tuple[str, float]]:
    return [(tape.reference, tape.distance_m) for tape in measurement.distances]


def _overlap(one: Measurement, other: Measurement) -> bool:
    spans = [(m.still.start, m.still.end) if m.still else (m.timestamp, m.timestamp) for m in (one, other)]
    (start, end), (first, last) = spans
    return start <= last and first <= end


def _both_sides(
    read: Measurement, rig: Rig
) -> tuple[tuple[tuple[str, Array], ...], list[Fault]]:
    """Where it would be on either side; or why the tapes do not meet."""
    try:
        places = tuple((side, world_point(replace(read, side=side), rig).world_m) for side in SIDES)
    except IpsysError as error:
        return (), [Fault("", _without_id(error, read.id))]
    return places, []


def _outside_m(point_m: Array, rig: Rig) -> float:
    """How far a point lies outside of the floor, 0 inside."""
    if rig.floor is None:
        return 0.0
    size_m = np.array([rig.floor.width_m, rig.floor.depth_m])
    beyond_m = np.maximum(np.maximum(-point_m[:2], point_m[:2] - size_m), 0.0)
    return float(np.hypot(*beyond_m))


def _on_floor(read: Measurement, fixed: TapePoint, rig: Rig) -> tuple[bool | None, list[str]]:
    if rig.floor is None:
        return None, []
    outside_m = _outside_m(fixed.world_m, rig)
    if outside_m <= _OUTSIDE_M:
        return True, []
    text = f"the place lies {outside_m * CM_PER_M:.0f} cm outside of the floor"
    if read.side is not None and sides_alike(reference_points(read, rig)):
        other = SIDES[1 - SIDES.index(read.side)]
        there_m = world_point(replace(read, side=other), rig).world_m
        if _outside_m(there_m, rig) <= _OUTSIDE_M:
            text += f"; on the {other} it would lie on it"
    return False, [text]


def _tape_warnings(read: Measurement, fixed: TapePoint, rig: Rig) -> list[str]:
    warnings = []
    sigma_m = _with_tape(rig).tape_sigma_m or _USUAL_TAPE_M
    worst = int(np.abs(fixed.residuals_m).argmax())
    off_m = float(abs(fixed.residuals_m[worst]))
    if len(read.distances) > 2 and off_m > max(_MISFIT_M, 3 * sigma_m):
        text = f"the distances contradict one another by {off_m * CM_PER_M:.1f} cm: read them again"
        warnings.append(text)
    for flat in flat_places([Measured(read, _with_tape(rig))]):
        warnings.append(
            f"the tapes cross at {flat.angle_deg:.0f} degrees only: the place is known to "
            f"{(flat.sigma_m or 0.0) * CM_PER_M:.1f} cm; another place, or a third reference point, is better"
        )
    return warnings


def _sigma_m(fixed: TapePoint) -> float | None:
    if fixed.covariance_m2 is None:
        return None
    return float(np.sqrt(np.linalg.eigvalsh(fixed.covariance_m2[:2, :2])[-1]))


def _residuals(read: Measurement, fixed: TapePoint) -> tuple[tuple[str, float], ...]:
    if len(read.distances) < 3:
        return ()
    names = (tape.reference for tape in read.distances)
    return tuple(zip(names, fixed.residuals_m.tolist(), strict=True))


def _model_warnings(
    read: Measurement, fixed: TapePoint, rig: Rig, predictions: Sequence[Prediction]
) -> list[str]:
    """Whether the model has it elsewhere, and the slip that would explain it."""
    if not predictions:
        return []
    predicted_m = np.mean([one.world_m for one in predictions], axis=0)
    off_m = float(np.linalg.norm(predicted_m - fixed.world_m))
    known = [one for one in predictions if one.inside is not False]
    sigma_m = max((one.sigma_m or 0.0 for one in predictions), default=0.0)
    bound_m = max(_ASTRAY_M if known else _ASTRAY_OUTSIDE_M, _SIGMAS * float(np.hypot(sigma_m, _sigma_m(fixed) or 0.0)))
    if off_m <= bound_m:
        return []
    text = f"the model has it {off_m * CM_PER_M:.0f} cm away"
    for group in possible_slips(read, rig, predicted_m):
        left = []
        for slip in group:
            try:
                there_m = world_point(slip.corrected, rig).world_m
            except IpsysError:
                continue  # without this slip it would be nowhere
            left.append((float(np.linalg.norm(there_m - predicted_m)), slip.text))
        if left and min(left)[0] <= bound_m:
            return [f"{text}: {min(left)[1]}?"]
    return [f"{text}: read tape, ruler and marker again"]
