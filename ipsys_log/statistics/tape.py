"""World points of calibration points by tape and ruler (eq. 25), and their covariances."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Distance, Measurement, Rig
from ipsys_log.units import CM_PER_M
from ipsys_log.vision.trilateration import (
    ON_REFERENCE_SIGMA_M,
    USUAL_TAPE_SIGMA_M,
    crossing_angle,
    multilaterate,
    tape_covariance,
)

# Sigma of a height without its own sigma, if the tape has a sigma.
_RULER_SIGMA_M = 0.001
# Least sigma of a manual reading. A simulated tape may have no error, but its weight must be finite.
_FINEST_M = 0.0001
_FLAT_RATIO = 3.0
_FARTHEST_M = 10_000.0

# A function from points (n, 2) to the covariances (n, 2, 2) of their positions by tape.
TapeCovariances = Callable[[Array], Array]


@dataclass(frozen=True, slots=True)
class RiggedMeasurement:
    """A valid measurement, and the rig that was valid at its time."""

    measurement: Measurement
    rig: Rig


def with_usual_tape(rig: Rig) -> Rig:
    """Return the rig; if it has no standard deviation of the tape, with the usual one.

    A small crossing angle of the tapes then excuses an error.
    """
    return replace(rig, tape_sigma_m=USUAL_TAPE_SIGMA_M) if rig.tape_sigma_m is None else rig


def expected_tape_covariances(
    rig: Rig, usual_sigma_m: float = USUAL_TAPE_SIGMA_M, scale_sigma: float = 0.0
) -> TapeCovariances:
    """Return the covariances of points that are measured from all reference points of a rig.

    With fewer than two reference points, a point is known as well as a tape measures a distance.

    Parameters
    ----------
    usual_sigma_m : sigma of a distance, if the rig has none.
    scale_sigma : relative sigma of the scale of the tape, about the middle of the reference points.
    """
    known_m = np.array([(p.x_m, p.y_m) for p in rig.reference_points]).reshape(-1, 2)
    sigma_m = rig.tape_sigma_m or usual_sigma_m
    sigmas_m = np.full(len(known_m), sigma_m)

    def covariances(points_m: Array) -> Array:
        if len(known_m) < 2:
            return np.broadcast_to(sigma_m**2 * np.eye(2), (len(points_m), 2, 2))
        read_m2 = [tape_covariance(point_m, known_m, sigmas_m) for point_m in points_m]
        by_scale_m = scale_sigma * (points_m - known_m.mean(axis=0))
        spread_m2: Array = by_scale_m[:, :, None] * by_scale_m[:, None]
        return spread_m2 + np.array(read_m2).reshape(-1, 2, 2)

    return covariances


@dataclass(frozen=True, slots=True, eq=False)
class TapePoint:
    """The world point ``world_m`` (3,) of a measurement.

    ``covariance_m2`` (3, 3) follows from the sigmas of tape and ruler; None if the tape sigma is unknown.
    ``residuals_m`` (n,) are the measured tape distances minus those from the point. They are empty for a
    world point without distances to known reference points.
    """

    world_m: Array
    covariance_m2: Array | None
    residuals_m: Array


@dataclass(frozen=True, slots=True)
class WeakPoint:
    """A calibration point whose tape circles cross at a small angle.

    ``sigma_m`` is the standard deviation of the point in its least accurate direction; None if the sigma of
    the tape is unknown. ``angle_deg`` is the crossing angle.
    """

    id: str
    sigma_m: float | None
    angle_deg: float


def world_point(measurement: Measurement, rig: Rig) -> TapePoint:
    """Return the world point of a measurement, as entered or by eq. (25), and its covariance.

    The sigma of a distance is its own, otherwise that of the rig. The sigma of the height is its own,
    otherwise 1 mm.

    Parameters
    ----------
    measurement : measurement with a world point; or with two or more distances, the height, and the side if
        the reference points are on one line; or with a height and one distance of 0, for a marker that was
        laid onto a reference point.
    rig : rig with the reference points and the tape; not used if there is only a world point.

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
    context = f"measurement {measurement.id}"
    entered = measurement.point
    if entered is None:
        return _solved(measurement, rig, context)
    world_m = np.array([entered.x_m, entered.y_m, entered.z_m])
    _check_point(world_m, context)
    _check_lengths(measurement, context)
    known = {point.name for point in rig.reference_points}
    if not measurement.distances or any(d.reference not in known for d in measurement.distances):
        return TapePoint(world_m, None, np.zeros(0))
    references_m = reference_points(measurement, rig)
    ranges_m = np.linalg.norm(world_m[:2] - references_m, axis=1)
    sigmas_m = _tape_sigmas(measurement, rig, context)
    floor_m2 = None if sigmas_m is None else tape_covariance(world_m[:2], references_m, sigmas_m)
    residuals_m = np.array([d.distance_m for d in measurement.distances]) - ranges_m
    return TapePoint(world_m, _with_height(floor_m2, measurement, context), residuals_m)


def reference_points(measurement: Measurement, rig: Rig) -> Array:
    """Return the reference point of each tape distance, (n, 2) in m.

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
                f"(known: {', '.join(known) or 'none'}); add it to lab.toml, and give the file with --rig"
            )
    return np.array([known[distance.reference] for distance in measurement.distances]).reshape(-1, 2)


def find_weak_points(places: Iterable[RiggedMeasurement]) -> list[WeakPoint]:
    """Return the points whose standard deviation exceeds three times the sigma of the tape, largest first.

    If the circles cross at a right angle, a point is as accurate as the tape. At 27 degrees, or near the line
    through the reference points, the standard deviation is three times larger. Measurements with a world
    point alone are skipped.

    Examples
    --------
    >>> from ipsys_log.messages import Distance, ReferencePoint
    >>> points = (ReferencePoint("A", 0.0, 0.0), ReferencePoint("B", 2.0, 0.0))
    >>> rig = Rig("lab", "DICT_4X4_100", 0.2, reference_points=points, tape_sigma_m=0.003)
    >>> tape = (Distance("A", 1.02), Distance("B", 1.02))
    >>> place = RiggedMeasurement(Measurement(0, "a", distances=tape, side="left", height_m=0.0), rig)
    >>> [(flat.id, round(flat.sigma_m, 4), round(flat.angle_deg, 1)) for flat in find_weak_points([place])]
    [('a', 0.0108, 22.7)]
    """
    ranked = []
    for place in places:
        measurement, rig = place.measurement, place.rig
        if len(measurement.distances) < 2:
            continue
        world_m = world_point(measurement, rig).world_m
        references_m = reference_points(measurement, rig)
        known_m = _tape_sigmas(measurement, rig, f"measurement {measurement.id}")
        # Without a sigma, the usual one serves only to determine the crossing angle of the circles.
        sigmas_m = np.full(len(references_m), USUAL_TAPE_SIGMA_M) if known_m is None else known_m
        spread_m2 = np.linalg.eigvalsh(tape_covariance(world_m[:2], references_m, sigmas_m))
        ratio = float(np.sqrt(spread_m2[-1])) / float(sigmas_m.max())
        if ratio > _FLAT_RATIO:
            angle_deg = float(np.degrees(crossing_angle(world_m[:2], references_m)))
            sigma_m = None if known_m is None else float(np.sqrt(spread_m2[-1]))
            ranked.append((ratio, WeakPoint(measurement.id, sigma_m, angle_deg)))
    return [place for _, place in sorted(ranked, key=lambda one: -one[0])]


def _solved(measurement: Measurement, rig: Rig, where: str) -> TapePoint:
    if is_on_reference(measurement.distances) and measurement.height_m is not None:
        return _on_reference(measurement, rig, where)
    if len(measurement.distances) < 2 or measurement.height_m is None:
        raise IpsysError(
            f"{where} needs a world point, or two or more distances and a height; measure it again"
        )
    _check_lengths(measurement, where)
    references_m = reference_points(measurement, rig)
    if len({distance.reference for distance in measurement.distances}) < 2:
        raise IpsysError(
            f"{where}: all its distances are from one reference point; measure from another one, too"
        )
    distances_m = np.array([distance.distance_m for distance in measurement.distances])
    sigmas_m = _tape_sigmas(measurement, rig, where)
    try:
        floor = multilaterate(references_m, distances_m, sigmas_m, measurement.side)
    except IpsysError as error:
        raise IpsysError(f"{where}: {error}") from error
    world_m = np.array([*floor.point_m, measurement.height_m])
    _check_point(world_m, where)
    return TapePoint(world_m, _with_height(floor.covariance_m2, measurement, where), floor.residuals_m)


def is_on_reference(distances: Sequence[Distance]) -> bool:
    """Return whether a marker was laid onto a reference point: its only distance is 0."""
    return len(distances) == 1 and distances[0].distance_m == 0


def _on_reference(measurement: Measurement, rig: Rig, where: str) -> TapePoint:
    (distance,) = measurement.distances
    (reference_m,) = reference_points(measurement, rig)
    sigma_m = ON_REFERENCE_SIGMA_M if distance.sigma_m is None else _check_sigma(distance.sigma_m, where)
    world_m = np.array([*reference_m, measurement.height_m])
    _check_point(world_m, where)
    return TapePoint(world_m, _with_height(sigma_m**2 * np.eye(2), measurement, where), np.zeros(0))


def _tape_sigmas(measurement: Measurement, rig: Rig, where: str) -> Array | None:
    """Return the sigma of each distance, (n,) in m; None if one of them is unknown."""
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
                f"{where}: a tape of {distance.distance_m * CM_PER_M:g} cm is too long; withdraw it and "
                "measure again"
            )


def _check_point(world_m: Array, where: str) -> None:
    if not (np.abs(world_m) <= _FARTHEST_M).all():
        raise IpsysError(f"{where}: its world point {world_m.tolist()} m is impossible; withdraw it")


def _check_sigma(sigma_m: float, where: str) -> float:
    if not 0 <= sigma_m <= _FARTHEST_M:
        raise IpsysError(
            f"{where}: {sigma_m} m is not a standard deviation; withdraw it and measure it again"
        )
    return max(sigma_m, _FINEST_M)
