"""Where a measured place is, by tape and ruler, and how well they know it (eq. 25)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.trilateration import crossing_angle, multilaterate, tape_covariance
from ipsys_log.messages import Measurement, Rig

__all__ = ["FlatPlace", "Measured", "TapePoint", "flat_places", "reference_points", "world_point"]

Array = NDArray[np.float64]

# A height without a sigma of its own, where the tape has one.
_RULER_SIGMA_M = 0.001
# Nothing is read better by hand; a simulated tape may be perfect, and its weight must stay finite.
_FINEST_M = 0.0001
# The tape of a place that names none, only to tell how flatly its circles cross.
_USUAL_TAPE_M = 0.003
_FLAT_RATIO = 3.0
_FARTHEST_M = 10_000.0


@dataclass(frozen=True, slots=True)
class Measured:
    """A measurement that counts, and the rig in force when it was made."""

    measurement: Measurement
    rig: Rig


@dataclass(frozen=True, slots=True, eq=False)
class TapePoint:
    """A measured place: ``world_m`` (3,).

    ``covariance_m2`` (3, 3) follows from the sigmas of tape and ruler, None where no tape sigma is
    known. ``residuals_m`` (n,) has each tape distance as measured minus as it is from the point; empty
    for a world point that came without distances to known reference points.
    """

    world_m: Array
    covariance_m2: Array | None
    residuals_m: Array


@dataclass(frozen=True, slots=True)
class FlatPlace:
    """A place whose tape circles cross flatly.

    ``sigma_m`` is that of the place in the direction in which the tapes know it least, None where the
    tape's own is not known; ``angle_deg`` the angle at which they cross.
    """

    id: str
    sigma_m: float | None
    angle_deg: float


def world_point(measurement: Measurement, rig: Rig) -> TapePoint:
    """Return the world point of a measurement, as given or by eq. (25), and its covariance.

    The sigma of a distance is its own, else the rig's; that of the height its own, else 1 mm.

    Parameters
    ----------
    measurement : with a world point, or two or more distances, the height, and the side if the reference
        points lie on one line.
    rig : for the reference points and the tape; not used if there is only a world point.

    Returns
    -------
    TapePoint : the world point, its covariance, and the residuals of the distances.

    Raises
    ------
    IpsysError
        The measurement forms no point, or names unknown reference points.

    References
    ----------
    Ou et al., Robotica 2023, eq. (25).

    Examples
    --------
    >>> from ipsys_log.messages import Distance, ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 2.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points, tape_sigma_m=0.003)
    >>> tape = (Distance("A", 2.0), Distance("B", 2.0, sigma_m=0.004))
    >>> found = world_point(Measurement(0, "a", distances=tape, side="right", height_m=0.1), rig)
    >>> found.world_m.round(6).tolist()
    [2.0, 0.0, 0.1]
    >>> np.sqrt(found.covariance_m2.diagonal()).round(6).tolist()
    [0.003, 0.004, 0.001]
    """
    where = f"measurement {measurement.id}"
    given = measurement.point
    if given is None:
        return _solved(measurement, rig, where)
    world_m = np.array([given.x_m, given.y_m, given.z_m])
    _check_point(world_m, where)
    _check_lengths(measurement, where)
    known = {point.name for point in rig.reference_points}
    if not measurement.distances or any(d.reference not in known for d in measurement.distances):
        return TapePoint(world_m, None, np.zeros(0))
    references_m = reference_points(measurement, rig)
    ranges_m = np.linalg.norm(world_m[:2] - references_m, axis=1)
    sigmas_m = _tape_sigmas(measurement, rig, where)
    floor_m2 = None if sigmas_m is None else tape_covariance(world_m[:2], references_m, sigmas_m)
    residuals_m = np.array([d.distance_m for d in measurement.distances]) - ranges_m
    return TapePoint(world_m, _with_height(floor_m2, measurement, where), residuals_m)


def reference_points(measurement: Measurement, rig: Rig) -> Array:
    """The reference point of each tape distance, (n, 2) in m.

    Raises
    ------
    IpsysError
        Where the rig lacks one.

    Examples
    --------
    >>> from ipsys_log.messages import Distance, ReferencePoint
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=(ReferencePoint("A", 1.0, 2.0),))
    >>> reference_points(Measurement(0, "a", distances=(Distance("A", 0.5),)), rig).tolist()
    [[1.0, 2.0]]
    """
    known = {p.name: (p.x_m, p.y_m) for p in rig.reference_points}
    for distance in measurement.distances:
        if distance.reference not in known:
            raise IpsysError(
                f"measurement {measurement.id}: reference point {distance.reference!r} is not in the rig "
                f"(known: {', '.join(known) or 'none'}); add it to lab.toml and give that with --rig"
            )
    return np.array([known[distance.reference] for distance in measurement.distances]).reshape(-1, 2)


def flat_places(places: Iterable[Measured]) -> list[FlatPlace]:
    """The places that the tape knows much worse than its own sigma, more than three times; worst first.

    Circles that cross at a right angle know a place as well as the tape is read; at 27 degrees, or near
    the line through the reference points, three times worse. What came as a world point alone is not
    looked at.

    Raises
    ------
    IpsysError
        See :func:`world_point`.

    Examples
    --------
    >>> from ipsys_log.messages import Distance, ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points, tape_sigma_m=0.003)
    >>> tape = (Distance("A", 1.02), Distance("B", 1.02))
    >>> place = Measured(Measurement(0, "a", distances=tape, side="left", height_m=0.0), rig)
    >>> [(flat.id, round(flat.sigma_m, 4), round(flat.angle_deg, 1)) for flat in flat_places([place])]
    [('a', 0.0108, 22.7)]
    """
    found = []
    for place in places:
        measurement, rig = place.measurement, place.rig
        if len(measurement.distances) < 2:
            continue
        world_m = world_point(measurement, rig).world_m
        references_m = reference_points(measurement, rig)
        known_m = _tape_sigmas(measurement, rig, f"measurement {measurement.id}")
        sigmas_m = np.full(len(references_m), _USUAL_TAPE_M) if known_m is None else known_m
        spread_m2 = np.linalg.eigvalsh(tape_covariance(world_m[:2], references_m, sigmas_m))
        ratio = float(np.sqrt(spread_m2[-1])) / float(sigmas_m.max())
        if ratio > _FLAT_RATIO:
            angle_deg = float(np.degrees(crossing_angle(world_m[:2], references_m)))
            sigma_m = None if known_m is None else float(np.sqrt(spread_m2[-1]))
            found.append((ratio, FlatPlace(measurement.id, sigma_m, angle_deg)))
    return [flat for _, flat in sorted(found, key=lambda one: -one[0])]


def _solved(measurement: Measurement, rig: Rig, where: str) -> TapePoint:
    if len(measurement.distances) < 2 or measurement.height_m is None:
        raise IpsysError(
            f"{where} has neither a world point nor two distances, or more, and a height; measure it again"
        )
    _check_lengths(measurement, where)
    references_m = reference_points(measurement, rig)
    if len({distance.reference for distance in measurement.distances}) < 2:
        raise IpsysError(f"{where}: all its distances are from one reference point; measure from another too")
    distances_m = np.array([distance.distance_m for distance in measurement.distances])
    sigmas_m = _tape_sigmas(measurement, rig, where)
    try:
        floor = multilaterate(references_m, distances_m, sigmas_m, measurement.side)
    except IpsysError as error:
        raise IpsysError(f"{where}: {error}") from error
    world_m = np.array([*floor.point_m, measurement.height_m])
    _check_point(world_m, where)
    return TapePoint(world_m, _with_height(floor.covariance_m2, measurement, where), floor.residuals_m)


def _tape_sigmas(measurement: Measurement, rig: Rig, where: str) -> Array | None:
    """Of each distance, (n,) in m; None where one is not known."""
    named = [rig.tape_sigma_m if d.sigma_m is None else d.sigma_m for d in measurement.distances]
    known = [_check_sigma(sigma_m, where) for sigma_m in named if sigma_m is not None]
    return np.array(known) if len(known) == len(named) else None


def _with_height(floor_m2: Array | None, measurement: Measurement, where: str) -> Array | None:
    if floor_m2 is None:
        return None
    named = measurement.height_sigma_m
    covariance = np.zeros((3, 3))
    covariance[:2, :2] = floor_m2
    covariance[2, 2] = (_RULER_SIGMA_M if named is None else _check_sigma(named, where)) ** 2
    return covariance


def _check_lengths(measurement: Measurement, where: str) -> None:
    for distance in measurement.distances:
        if not abs(distance.distance_m) <= _FARTHEST_M:
            raise IpsysError(
                f"{where}: a tape of {distance.distance_m:g} m is too long; withdraw it and measure again"
            )


def _check_point(world_m: Array, where: str) -> None:
    if not (np.abs(world_m) <= _FARTHEST_M).all():
        raise IpsysError(f"{where}: its world point {world_m.tolist()} m is impossible; withdraw it")


def _check_sigma(sigma_m: float, where: str) -> float:
    if not 0 <= sigma_m <= _FARTHEST_M:
        raise IpsysError(f"{where}: {sigma_m} m is no standard deviation; withdraw it and measure it again")
    return max(sigma_m, _FINEST_M)
