"""Calibration points: the valid measurements, their world points and camera points, and training and test."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraPoints, Measurement, Message, Model, Pair, Rig
from ipsys_log.messages.channels import CAMERA_POINTS, MEASUREMENTS, RIG
from ipsys_log.messages.stage import StageView
from ipsys_log.statistics.tape import RiggedMeasurement, world_point
from ipsys_log.units import NS_PER_S

# A marker is stationary if it stays within these distances from its position at the measurement. They are
# above the noise of plain sub-pixel corners (about 1 mm across and 5 mm along the view at 2 m).
STILL_ACROSS_M = 0.01
STILL_ALONG_M = 0.04
# The number of calibration points for errors of millimetres with a drive, and of a centimetre without one.
ENOUGH_DRIVE_POINTS = 4
ENOUGH_TAPE_POINTS = 15
ENOUGH_POINTS = (
    f"{ENOUGH_DRIVE_POINTS} with a drive, or {ENOUGH_TAPE_POINTS} for each camera with the tape alone"
)
# In a longer gap of the sightings, the marker may have moved.
LONGEST_GAP_NS = 2 * NS_PER_S
_FARTHEST_M = 10_000.0
# Heights with smaller differences are equal: the accuracy of a ruler and of uneven boards.
_ONE_HEIGHT_M = 0.005


@dataclass(frozen=True, slots=True, eq=False)
class TimedPoints:
    """The points of a marker, by camera or track: ``times_ns`` (n,), ascending, and ``points_m`` (n, 3)."""

    times_ns: NDArray[np.int64]
    points_m: NDArray[np.float64]


def gather_sightings(messages: Iterable[Message]) -> dict[tuple[str, int], TimedPoints]:
    """Return camera points by camera and marker, ordered by the time of exposure of the marker."""
    rows: dict[tuple[str, int], list[tuple[int, float, float, float]]] = {}
    for message in messages:
        if isinstance(message.payload, CameraPoints):
            for p in message.payload.points:
                key = (str(message.camera), p.id)
                time_ns = message.publish_time_ns + (p.time_offset_ns or 0)
                rows.setdefault(key, []).append((time_ns, p.x_m, p.y_m, p.z_m))
    sightings = {}
    for key, values in rows.items():
        values.sort()
        times_ns = np.array([row[0] for row in values], dtype=np.int64)
        points_m = np.array([row[1:] for row in values], dtype=np.float64)
        if not (np.abs(points_m) <= _FARTHEST_M).all():
            raise IpsysError(
                f"camera {key[0]}: a camera point of marker {key[1]} is impossible; run camera-frame again, "
                "with --run and another name"
            )
        sightings[key] = TimedPoints(times_ns, points_m)
    return sightings


def valid_measurements(messages: Iterable[Message], override: Rig | None) -> list[RiggedMeasurement]:
    """Return the measurements that are not withdrawn, each with its rig.

    Parameters
    ----------
    messages : rigs and measurements, in log order. The first rig is also valid for measurements before it.
    override : a rig that replaces the rigs of all measurements.
    """
    rigs: list[Rig] = [override] if override is not None else []
    numbered: list[tuple[Measurement, int]] = []
    for message in messages:
        if isinstance(message.payload, Rig) and override is None:
            rigs.append(message.payload)
        elif isinstance(message.payload, Measurement):
            numbered.append((message.payload, max(len(rigs) - 1, 0)))
    active = {measurement.id for measurement in active_measurements(m for m, _ in numbered)}
    if numbered and not rigs:
        raise IpsysError("the log has no rig (reference points, markers): give one with --rig lab.toml")
    # If an id was withdrawn and measured again, the last measurement counts.
    last = {m.id: RiggedMeasurement(m, rigs[number]) for m, number in numbered if m.is_point}
    return [place for name, place in last.items() if name in active]


def active_measurements(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return the measurements that are not withdrawn, in their order.

    A re-admitted measurement has its former place in the order.
    """
    points: dict[str, Measurement] = {}
    withdrawn: dict[str, Measurement] = {}
    repeated: set[str] = set()
    for measurement in measurements:
        if measurement.is_point:
            if measurement.id in points and measurement.id not in withdrawn:
                repeated.add(measurement.id)
            points.pop(measurement.id, None)
            points[measurement.id] = measurement
        _follow(withdrawn, measurement)
        repeated -= withdrawn.keys()
    active = [measurement for name, measurement in points.items() if name not in withdrawn]
    for measurement in active:
        if measurement.id in repeated:
            raise IpsysError(f"two measurements have the id {measurement.id!r}; withdraw one of them")
        if measurement.marker_id is None:
            raise IpsysError(f"measurement {measurement.id} has no marker; withdraw it and measure again")
    return active


def active_baselines(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return the readings of distances between reference points that are not withdrawn."""
    measurements = list(measurements)
    withdrawn = withdrawals(measurements)
    return [one for one in measurements if one.from_reference is not None and one.id not in withdrawn]


def withdrawals(measurements: Iterable[Measurement]) -> dict[str, Measurement]:
    """Return the withdrawals in force by the id of their measurement.

    Examples
    --------
    >>> gone = Measurement(0, "w", withdraws="p001", reason="the tape sagged")
    >>> withdrawals([Measurement(0, "p001"), gone])["p001"].reason
    'the tape sagged'
    >>> withdrawals([Measurement(0, "p001"), gone, Measurement(0, "r", readmits="p001")])
    {}
    """
    withdrawn: dict[str, Measurement] = {}
    for measurement in measurements:
        _follow(withdrawn, measurement)
    return withdrawn


def _follow(withdrawn: dict[str, Measurement], message: Measurement) -> None:
    """Update the withdrawals in force by the next message; a new measurement ends that of its id."""
    if message.withdraws is not None:
        withdrawn[message.withdraws] = message
    else:
        withdrawn.pop(message.readmits or message.id, None)


def still_interval(sightings: TimedPoints, time_ns: int) -> tuple[int, int] | None:
    """Return the stationary interval of a marker around a time.

    Returns
    -------
    First and last time in ns, both included; None if the camera did not see the marker within two seconds of
    ``time_ns``.
    """
    if len(sightings.times_ns) == 0:
        return None
    anchor = int(np.abs(sightings.times_ns - time_ns).argmin())
    if abs(int(sightings.times_ns[anchor]) - time_ns) > LONGEST_GAP_NS:
        return None
    moved = np.abs(sightings.points_m - sightings.points_m[anchor])
    still = (np.hypot(moved[:, 0], moved[:, 1]) <= STILL_ACROSS_M) & (moved[:, 2] <= STILL_ALONG_M)
    joined = np.diff(sightings.times_ns) <= LONGEST_GAP_NS
    first = last = anchor
    while first > 0 and still[first - 1] and joined[first - 1]:
        first -= 1
    while last + 1 < len(still) and still[last + 1] and joined[last]:
        last += 1
    return int(sightings.times_ns[first]), int(sightings.times_ns[last])


def build_pairs(
    sightings: Mapping[tuple[str, int], TimedPoints], places: Iterable[RiggedMeasurement]
) -> dict[str, list[Pair]]:
    """Return the calibration points that each camera saw.

    Parameters
    ----------
    sightings : sightings by camera and marker, from :func:`gather_sightings`.
    places : the valid measurements, from :func:`valid_measurements`.

    Returns
    -------
    dict from camera to pairs: the mean camera point over the stationary interval, and the world point with
    its covariance if that is known.

    Raises
    ------
    IpsysError
        A marker is not in the rig or never visible, a measurement gives no point, or a pair occurs twice.
    """
    cameras = sorted({camera for camera, _ in sightings})
    seen_ids = sorted({marker_id for _, marker_id in sightings})
    pairs: dict[str, list[Pair]] = {camera: [] for camera in cameras}
    for place in places:
        measurement, rig = place.measurement, place.rig
        marker_id = measurement.marker_id
        assert marker_id is not None  # active_measurements has checked it
        if not rig.knows(marker_id) or marker_id not in seen_ids:
            raise IpsysError(
                f"measurement {measurement.id} is of marker {marker_id}, which "
                f"{'no camera saw' if rig.knows(marker_id) else 'is not in the rig'} "
                f"(seen: {', '.join(map(str, seen_ids)) or 'none'}); correct the id or the rig"
            )
        fixed = world_point(measurement, rig)
        for camera in cameras:
            camera_point = _mean_point(sightings.get((camera, marker_id)), measurement)
            if camera_point is not None:
                mean_m, frames = camera_point
                row = (measurement.id, marker_id, mean_m, fixed.world_m, frames, fixed.covariance_m2)
                pairs[camera].append(Pair(*row, calibration_point=measurement.calibration_point))
    for camera, entered in pairs.items():
        _check_duplicates(camera, entered)
    return pairs


def _check_duplicates(camera: str, pairs: Iterable[Pair]) -> None:
    """Check that no pair occurs twice: when one copy is held out, the other would stay in the fit."""
    seen: dict[bytes, str] = {}
    for pair in pairs:
        twin = seen.setdefault(pair.camera_m.tobytes() + pair.world_m.tobytes(), pair.measurement)
        if twin != pair.measurement:
            raise IpsysError(
                f"camera {camera}: measurements {twin} and {pair.measurement} are the same pair, to "
                "the last digit; withdraw one of them"
            )


def _mean_point(
    sightings: TimedPoints | None, measurement: Measurement
) -> tuple[NDArray[np.float64], int] | None:
    if sightings is None:
        return None
    if measurement.still is not None:
        interval: tuple[int, int] | None = (measurement.still.start, measurement.still.end)
    else:
        interval = still_interval(sightings, measurement.timestamp)
    if interval is None:
        return None
    within = (sightings.times_ns >= interval[0]) & (sightings.times_ns <= interval[1])
    if not within.any():
        return None
    return sightings.points_m[within].mean(axis=0), int(within.sum())


def split(measurements: Iterable[Measurement], train: str, seed: int) -> tuple[set[str], set[str]]:
    """Return the ids of the measurements for the fit, and the ids of the held-out measurements.

    Parameters
    ----------
    measurements : the valid measurements.
    train : the label of the subset for the fit; ``test`` is the label of held-out measurements.
    seed : random seed. If no measurement has a label, a random fifth of them is held out.
    """
    measurements = list(measurements)
    labels = sorted({label for m in measurements for label in m.splits} - {"test"})
    if train == "test":
        raise IpsysError(
            "--train test: these points are held out for the evaluation; fit to points with another label"
        )
    if not any(m.splits for m in measurements):
        ids = np.array(sorted(m.id for m in measurements))
        shuffled = np.random.default_rng(seed).permutation(ids).tolist()
        held_out = len(shuffled) // 5
        return set(shuffled[held_out:]), set(shuffled[:held_out])
    if train not in labels:
        known = f"use --train with one of {', '.join(labels)}" if labels else "label some for the fit"
        raise IpsysError(f"no measurement has the label {train!r}; {known}")
    fitted = {m.id for m in measurements if train in m.splits}
    return fitted, {m.id for m in measurements if "test" in m.splits} - fitted


def level_cameras(model: Model) -> dict[str, float]:
    """Return the cameras whose calibration points all have one height, with this height in m.

    A fit to such points cannot determine heights.
    """
    heights = {c.camera: np.array([pair.world_m[2] for pair in c.pairs]) for c in model.cameras}
    return {name: float(h.mean()) for name, h in heights.items() if np.ptp(h) < _ONE_HEIGHT_M}


KINDS = ("training", "test", "measured")


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """A calibration point: ``point_m`` (3,) in the world; ``kind`` is ``measured`` without a label."""

    id: str
    point_m: NDArray[np.float64]
    kind: str


def locate_measurements(
    measurements: Iterable[Measurement], rig: Rig | None
) -> tuple[list[Place], list[str]]:
    """Return the valid calibration points, and the faults of those without a position.

    A user must be able to view a log with faults. This function therefore skips measurements that the stages
    refuse, and returns their faults.

    Parameters
    ----------
    measurements : measurements in their order.
    rig : rig with the reference points; without a rig, only measurements with a world point have a position.
    """
    try:
        active = active_measurements(measurements)
    except IpsysError as error:
        return [], [str(error)]
    places, faults = [], []
    for measurement in active:
        if rig is None and measurement.point is None:
            faults.append(f"measurement {measurement.id} has no position: the log has no rig")
            continue
        try:
            # The rig is not used if the measurement has a world point.
            point_m = world_point(measurement, rig or Rig("", "", 1.0)).world_m
        except IpsysError as error:
            faults.append(str(error))
            continue
        places.append(Place(measurement.id, point_m, _kind(measurement)))
    return places, faults


def _kind(measurement: Measurement) -> str:
    if "test" in measurement.splits:
        return "test"
    return "training" if measurement.splits else "measured"


def measured(view: StageView) -> list[RiggedMeasurement]:
    """Return the valid measurements, each with the rig in force when it was measured, or with the view's."""
    return valid_measurements(view.messages(RIG, MEASUREMENTS), view.rig)


def find_pairs(view: StageView, points: list[RiggedMeasurement]) -> dict[str, list[Pair]]:
    """Return the observations of the calibration points by camera."""
    return build_pairs(gather_sightings(view.messages(CAMERA_POINTS)), points)


def training_pairs(view: StageView, train: Collection[str]) -> dict[str, list[Pair]]:
    """Return the observations of some calibration points by camera."""
    pairs = find_pairs(view, measured(view))
    return {camera: [pair for pair in seen if pair.measurement in train] for camera, seen in pairs.items()}


def has_measurements(view: StageView) -> bool:
    """Return whether a measurement was entered and not withdrawn."""
    entered: list[Measurement] = view.payloads(MEASUREMENTS)
    withdrawn = withdrawals(entered)
    return any(m.is_point and m.id not in withdrawn for m in entered)


def split_ids(measurements: Iterable[Measurement], options: Mapping[str, str]) -> tuple[set[str], set[str]]:
    """Return the ids of the measurements to fit on, and of those to test on."""
    return split(list(measurements), options.get("train", "train"), int(options.get("seed", "0")))


def held_out_ids(measurements: Iterable[Measurement], options: Mapping[str, str]) -> set[str]:
    """Return the ids of the measurements that models are evaluated on."""
    measurements = list(measurements)
    if "model_from" not in options:
        return split_ids(measurements, options)[1] if measurements else set()
    # A model of another log was not fitted to these points; if it was, evaluate_model notices it.
    labelled = any(m.splits for m in measurements)
    return {m.id for m in measurements if "test" in m.splits or not labelled}


def split_parameters(view: StageView, options: Mapping[str, str]) -> dict[str, str]:
    """Return the parameters of the split: the label, or the seed if nothing is labelled."""
    labelled = any(m.splits for m in view.payloads(MEASUREMENTS))
    return {"train": options.get("train", "train")} if labelled else {"seed": options.get("seed", "0")}
