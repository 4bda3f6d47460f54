"""Plausibility check of a measurement before it is saved, and of a typed distance AB."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, count

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.survey import blunders
from ipsys_log.live_runs.survey.entry import Entry, Fault, check_references, parse_baseline
from ipsys_log.live_runs.survey.scene import MarkerObservations, Prediction, predict
from ipsys_log.messages import Array, Distance, Measurement, Model, Rig
from ipsys_log.statistics.calibration_points import active_baselines, active_measurements, withdrawals
from ipsys_log.statistics.tape import (
    TapePoint,
    is_on_reference,
    reference_points,
    with_usual_tape,
    world_point,
)
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.trilateration import SIDES

_NUMBERED = re.compile(r"p[0-9]{1,18}")  # the limit matters: an id in a log may have thousands of digits


@dataclass(frozen=True, slots=True, eq=False)
class EntryCheck:
    """The result of the check of an entry.

    An entry with ``faults`` is not written to the log. The user must confirm ``warnings`` first. Warnings in
    ``imprecise`` are no mistakes: the point only has a large uncertainty. ``point_m`` (3,) is the world
    point, and ``sigma_m`` its largest standard deviation by the tape. ``residuals_m`` are the residuals of
    the distances by reference point, if there are more than two distances. ``sides_m`` are both possible
    points (3,) if the side is not given yet. ``measurement`` is None if there are faults.
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
    imprecise: tuple[str, ...] = ()

    @property
    def contradictions(self) -> tuple[str, ...]:
        """The warnings that may be mistakes."""
        return tuple(text for text in self.warnings if text not in self.imprecise)


def next_id(history: Iterable[Measurement]) -> str:
    """Return the next free id: p001, p002 ... A withdrawn id is not used again.

    Examples
    --------
    >>> next_id([Measurement(0, "p001"), Measurement(0, "p001_withdrawn", withdraws="p001")])
    'p002'
    """
    numbers = [int(m.id[1:]) for m in history if _NUMBERED.fullmatch(m.id)]
    return f"p{max(numbers, default=0) + 1:03d}"


def free_id(history: Iterable[Measurement], name: str) -> str:
    """Return the id for a new withdrawal or re-admission: ``name``, or ``name_2``, ``name_3`` ...

    Examples
    --------
    >>> free_id([Measurement(0, "p001_withdrawn", withdraws="p001")], "p001_withdrawn")
    'p001_withdrawn_2'
    """
    taken = {measurement.id for measurement in history}
    numbered = (f"{name}_{number}" for number in count(2))
    return next(candidate for candidate in chain([name], numbered) if candidate not in taken)


def withdrawal_of(history: Sequence[Measurement], name: str, reason: str | None = None) -> Measurement:
    """Return the message that withdraws a measurement, perhaps with the reason; the log keeps it."""
    # A faulty measurement can be withdrawn, too.
    named = [one for one in history if one.refers_to is None and one.id == name]
    if named and name not in withdrawals(history):
        message_id = free_id(history, f"{name}_withdrawn")
        return Measurement(named[-1].timestamp, message_id, withdraws=name, reason=reason)
    raise IpsysError(f"measurement {name} cannot be withdrawn: it is withdrawn already, or does not exist")


def check_entry(
    entry: Entry,
    faults: Sequence[Fault],
    rig: Rig,
    observations: MarkerObservations | None,
    history: Sequence[Measurement],
    model: Model | None = None,
    model_name: str = blunders.MODEL_NAME,
) -> EntryCheck:
    """Check whether an entry is plausible, and create its measurement.

    Parameters
    ----------
    entry, faults : results of :func:`~ipsys_log.live_runs.survey.entry.parse_entry`.
    rig : the present rig.
    observations : observations of the marker; None if the marker is not known.
    history : measurements and withdrawals so far.
    model : the present model, for the comparison; None to skip it.
    model_name : name of the model in a warning.
    """
    name = entry.id or next_id(history)
    all_faults = [*faults, *_identity_faults(entry, observations, history)]
    warnings = list(entry.doubts)
    read = _measurement(entry, name, observations)
    faulty_fields = {fault.field for fault in all_faults}
    misfit = _apart(read, rig)
    if misfit is not None:
        # A distance in metres may be the reason; the doubts say so.
        return EntryCheck(name, (*all_faults, Fault("", "; ".join([misfit, *entry.doubts]))))
    missing = {"side", "height", ""} & faulty_fields or {f for f in faulty_fields if f.startswith("d_")}
    if missing == {"side"} and len(entry.distances) >= 2 and entry.height_m is not None:
        sides_m, fault = _both_sides(read, rig)
        return EntryCheck(name, tuple(all_faults + fault), tuple(warnings), sides_m=sides_m)
    placed = len(entry.distances) >= 2 or is_on_reference(entry.distances)
    if missing or not placed or entry.height_m is None:
        return EntryCheck(name, tuple(all_faults), tuple(warnings))
    try:
        # With the usual tape sigma, the covariance shows a flat crossing of the circles. The written
        # measurement has no sigma of its own.
        fixed = world_point(read, with_usual_tape(rig))
    except IpsysError as error:
        reason = "; ".join([_without_id(error, name), *entry.doubts])
        return EntryCheck(name, (*all_faults, Fault("", reason)))
    on_floor, remark = blunders.warn_floor(read, fixed, rig)
    flat = blunders.warn_crossing(read, rig)
    warnings += [*remark, *blunders.warn_tapes(read, fixed, rig), *flat]
    earlier = _here_before(read, observations, history)
    all_faults += _twin_faults(read, earlier)
    warnings += _repeat_warnings(read, fixed, rig, earlier) if read.still else []
    predictions = predict(model, observations.points_m, fixed.world_m) if model and observations else ()
    warnings += blunders.warn_model(read, fixed, rig, predictions, model_name)
    return EntryCheck(
        name,
        tuple(all_faults),
        tuple(dict.fromkeys(warnings)),
        fixed.world_m,
        blunders.floor_sigma_m(fixed),
        _residuals(read, fixed),
        on_floor,
        predictions,
        measurement=None if all_faults else read,
        imprecise=tuple(flat),
    )


def _measurement(entry: Entry, name: str, observations: MarkerObservations | None) -> Measurement:
    still = observations.still if observations else None
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


def _apart(read: Measurement, rig: Rig) -> str | None:
    """Return the reason why two distances do not meet, else None; side and height are not needed."""
    if len(read.distances) != 2:
        return None
    first_m, second_m = reference_points(read, rig)
    base_m = float(np.hypot(*(second_m - first_m)))
    first, second = read.distances
    if abs(first.distance_m - second.distance_m) <= base_m <= first.distance_m + second.distance_m:
        return None
    tapes = (f"distance to {d.reference} = {d.distance_m * CM_PER_M:g} cm" for d in (first, second))
    return (
        f"{' and '.join(tapes)} do not meet, because {first.reference} to {second.reference} is "
        f"{base_m * CM_PER_M:.1f} cm; read both again"
    )


def _without_id(error: IpsysError, name: str) -> str:
    return str(error).removeprefix(f"measurement {name}").removeprefix(": ").strip()


def _identity_faults(
    entry: Entry, observations: MarkerObservations | None, history: Sequence[Measurement]
) -> list[Fault]:
    faults = []
    if entry.id is not None and any(entry.id in (m.id, m.refers_to) for m in history):
        faults.append(Fault("id", f"id {entry.id} is already used; leave it out to get the next free id"))
    if observations is not None and observations.still is None:
        faults.append(Fault("marker", observations.text))
    return faults


def _here_before(
    read: Measurement, observations: MarkerObservations | None, history: Sequence[Measurement]
) -> list[Measurement]:
    """Return the earlier measurements of this marker at this point: in the same interval, or seen there."""
    seen = observations.measured_as if observations else ()
    same_marker = [m for m in active_measurements(history) if m.marker_id == read.marker_id]
    return [m for m in same_marker if _overlap(m, read) or m.id in seen]


def _twin_faults(read: Measurement, earlier: Sequence[Measurement]) -> list[Fault]:
    """Return a fault if an earlier measurement has exactly the same numbers."""
    for other in earlier:
        same = (other.side, other.height_m) == (read.side, read.height_m)
        if same and _tapes(other) == _tapes(read):
            return [Fault("", f"this point is saved already as {other.id}, with the same numbers")]
    return []


def _repeat_warnings(
    read: Measurement, fixed: TapePoint, rig: Rig, earlier: Sequence[Measurement]
) -> list[str]:
    if not earlier:
        return []
    names = ", ".join(f"{m.id}{_apart_from(m, fixed, rig)}" for m in earlier)
    return [
        f"marker {read.marker_id} is already measured here, as {names}; if the new one is better, undo "
        "the old one"
    ]


def _apart_from(other: Measurement, fixed: TapePoint, rig: Rig) -> str:
    """Return the distance to another measurement as text; "" if the other measurement forms no point."""
    try:
        other_m = world_point(other, rig).world_m
    except IpsysError:
        return ""
    return f" ({float(np.linalg.norm(other_m - fixed.world_m)) * CM_PER_M:.1f} cm from here)"


def _tapes(measurement: Measurement) -> list[tuple[str, float]]:
    return [(tape.reference, tape.distance_m) for tape in measurement.distances]


def _overlap(one: Measurement, other: Measurement) -> bool:
    spans = [(m.still.start, m.still.end) if m.still else (m.timestamp, m.timestamp) for m in (one, other)]
    (start, end), (first, last) = spans
    return start <= last and first <= end


def _both_sides(read: Measurement, rig: Rig) -> tuple[tuple[tuple[str, Array], ...], list[Fault]]:
    """Return the points on both sides, or the reason why the tape distances do not meet."""
    try:
        points = tuple((side, world_point(replace(read, side=side), rig).world_m) for side in SIDES)
    except IpsysError as error:
        return (), [Fault("", _without_id(error, read.id))]
    return points, []


def _residuals(read: Measurement, fixed: TapePoint) -> tuple[tuple[str, float], ...]:
    if len(read.distances) < 3:
        return ()
    names = (tape.reference for tape in read.distances)
    return tuple(zip(names, fixed.residuals_m.tolist(), strict=True))


def baseline_names(rig: Rig) -> tuple[str, str]:
    """Return the names of the first two reference points."""
    first, second, *_ = rig.reference_points
    return first.name, second.name


def needs_baseline(rig: Rig, history: Sequence[Measurement]) -> bool:
    """Return whether a reading of AB would count, and there is none yet."""
    return rig.ab_sigma_m is not None and not active_baselines(history)


def read_baseline(text: str, rig: Rig, history: Sequence[Measurement], time_ns: int) -> Measurement:
    """Return the measurement of a typed distance AB in cm.

    Examples
    --------
    >>> from ipsys_log.messages import ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points)
    >>> reading = read_baseline("200,3", rig, [], 0)
    >>> reading.id, reading.from_reference, reading.distances[0].distance_m
    ('ab', 'A', 2.003)
    """
    check_references(rig)
    distance_m, fault = parse_baseline(text, rig)
    if fault is not None:
        raise IpsysError(fault.text)
    first, second = baseline_names(rig)
    name = free_id(history, "ab")
    return Measurement(time_ns, name, distances=(Distance(second, distance_m),), from_reference=first)
