"""Typical blunders with tape, ruler and pencil, and the measurement without each of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Distance, Measurement, Rig, WorldPoint
from ipsys_log.messages.arrays import Array
from ipsys_log.statistics.tape import reference_points
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
