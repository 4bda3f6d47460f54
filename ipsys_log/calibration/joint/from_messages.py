"""Observations for the joint calibration from the messages of a log."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.observations import (
    Body,
    CalibrationPoint,
    CameraPrior,
    Observations,
    Sightings,
    Tape,
    marker_body,
)
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.messages import Array, CameraCalibration, Markers, Measurement, Rig
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.trilateration import (
    ON_REFERENCE_SIGMA_M,
    USUAL_TAPE_SCALE_SIGMA,
    USUAL_TAPE_SIGMA_M,
    multilaterate,
)

_USUAL_RULER_M = 0.001
# A marker that lies on the floor needs no ruler. This is the thickness of its paper.
_ON_FLOOR_M = 0.0003
# Corners without a covariance come from a method whose errors repeat in all images.
_UNKNOWN_CORNER_PX = 0.25
# Without a stationary interval, a marker is stationary while its centre moves less than this.
_STILL_PX = 0.5
# In a longer gap of the sightings, the marker may have moved.
_GAP_NS = 2 * NS_PER_S
# A frame is left out of an average if a corner is this far from the median,
_FAR_PX = 0.3
# also in usual deviations.
_FAR = 6.0
# Share of the variance of a corner that repeats in all images of a stationary marker, because the pixels
# sample its print at the same places. Measured in rendered labs.
_REPEATABLE_SHARE = 0.35
# After its last point, a marker is put onto its robot.
_HANDLING_NS = 2 * NS_PER_S
# More sightings of a path per second cost time and give little, because its knots are 0.1 s apart.
_LEAST_STEP_NS = NS_PER_S // 12
# After so long without any sighting, the clocks may have other offsets: another recording may begin.
_RESTART_S = 10.0
# Longer drives are used in parts of this length, which are evenly spread in time.
_MOST_DRIVE_S, _DRIVE_PART_S = 600.0, 10.0


@dataclass(frozen=True, slots=True, eq=False)
class _Track:
    """All sightings of one marker by one camera, by time."""

    times_ns: NDArray[np.int64]
    pixels: Array
    covariances_px2: Array
    has_covariance: NDArray[np.bool_]


class _Row(NamedTuple):
    """A sighting: indices of body and point (-1: moving), time, corners (4, 2), covariance (8, 8)."""

    body: int
    point: int
    time_s: float
    pixels: Array
    covariance_px2: Array


def gather_observations(
    rig: Rig,
    calibrations: Mapping[str, CameraCalibration],
    markers: Mapping[str, Iterable[Markers]],
    measurements: Sequence[Measurement],
    nominal: Collection[str] = (),
    with_drives: bool = True,
    baselines: Sequence[Measurement] = (),
) -> Observations:
    """Return the observations of a session.

    Sightings within the stationary interval of a measurement are averaged for each camera. Sightings of a
    marker before its first and after its last stationary interval are those of a robot, if the rig has the
    height of the marker. In between, somebody carries the marker to its next point. The messages may be those
    of several recordings.

    Parameters
    ----------
    rig : markers, reference points, shutters.
    calibrations : intrinsics by camera.
    markers : detections by camera.
    measurements : the valid measurements, without withdrawals.
    nominal : cameras whose intrinsics are nominal, and not from a chessboard.
    with_drives : whether to use the sightings of moving robots.
    baselines : the valid readings of distances between reference points. They count if the rig says that
        another instrument has measured these points.

    Raises
    ------
    FitError
        A camera has no calibration, or a measurement names an unknown reference point.
    """
    missing = sorted(set(markers) - set(calibrations))
    if missing:
        raise FitError(f"camera {missing[0]}: the log has no calibration for it; add one with --calibration")
    tracks = {camera: _gather_tracks(messages) for camera, messages in sorted(markers.items())}
    valid = [measurement for measurement in measurements if measurement.marker_id is not None]
    ids = sorted({measurement.marker_id for measurement in valid if measurement.marker_id is not None})
    if with_drives:
        seen = {marker_id for own in tracks.values() for marker_id in own}
        robots = {marker_id for marker_id in seen if rig.knows(marker_id) and rig.height_of(marker_id)}
        ids = sorted({*ids, *robots})
    bodies = tuple(_body(rig, marker_id) for marker_id in ids)
    points = tuple(_point(one, rig, ids.index(one.marker_id)) for one in valid if one.marker_id is not None)
    epoch_ns = min((int(track.times_ns[0]) for own in tracks.values() for track in own.values()), default=0)
    stationary = [_stationary(own, valid, ids, epoch_ns) for own in tracks.values()]
    moving = [_moving(own, valid, ids, rig, epoch_ns) if with_drives else [] for own in tracks.values()]
    parts = _choose_parts(moving)
    chosen = [[row for row in rows if _part(row) in parts] for rows in moving]
    sightings = [_table(rest + rows) for rest, rows in zip(stationary, chosen, strict=True)]
    cameras = tuple(
        CameraPrior(camera, calibrations[camera], camera in nominal, *_row_times(rig, camera))
        for camera in tracks
    )
    restarts_s = _restarts_s(tracks, chosen, epoch_ns)
    return Observations(cameras, bodies, points, tuple(sightings), _tape(rig, baselines), restarts_s)


def _tape(rig: Rig, baselines: Sequence[Measurement]) -> Tape:
    known_m = {point.name: np.array([point.x_m, point.y_m]) for point in rig.reference_points}
    scale_sigma = rig.tape_scale_sigma or USUAL_TAPE_SCALE_SIGMA
    if not known_m:
        return Tape(scale_sigma, scale_sigma)
    places_m = np.array(list(known_m.values()))
    middle_m = places_m.mean(axis=0)
    longest_m = 2 * float(np.linalg.norm(places_m - middle_m, axis=1).max())
    if rig.ab_sigma_m is None or not longest_m:
        # This tape may have measured the reference points, too: then a baseline tells nothing of its scale.
        return Tape(scale_sigma, scale_sigma, middle_m)
    readings = [
        (known_m[reading.from_reference], known_m[d.reference], d.distance_m, d.sigma_m)
        for reading in baselines
        for d in reading.distances
        if reading.from_reference in known_m and d.reference in known_m
    ]
    return Tape(
        scale_sigma,
        rig.ab_sigma_m / longest_m,
        middle_m,
        np.array([np.linalg.norm(end_m - start_m) for start_m, end_m, _, _ in readings]),
        np.array([distance_m for _, _, distance_m, _ in readings], dtype=np.float64),
        np.array([sigma_m or rig.tape_sigma_m or USUAL_TAPE_SIGMA_M for _, _, _, sigma_m in readings]),
    )


def _row_times(rig: Rig, camera: str) -> tuple[float | None, float]:
    """Return the row time that the fit adds (None: it estimates it), and that of the detections."""
    row_time_ns = rig.camera(camera).row_time_ns
    # Detections of a camera with a known row time are those of one instant.
    return (None, 0.0) if row_time_ns is None else (0.0, row_time_ns / NS_PER_S)


def _gather_tracks(messages: Iterable[Markers]) -> dict[int, _Track]:
    rows: dict[int, list[tuple[int, Array, Array | None]]] = {}
    for message in messages:
        for marker in message.markers:
            time_ns = message.timestamp + (marker.time_offset_ns or 0)
            rows.setdefault(marker.id, []).append((time_ns, marker.corners_px, marker.covariance_px2))
    return {marker_id: _track(own) for marker_id, own in sorted(rows.items())}


def _track(rows: list[tuple[int, Array, Array | None]]) -> _Track:
    rows.sort(key=lambda row: row[0])
    unknown = _UNKNOWN_CORNER_PX**2 * np.eye(8)
    return _Track(
        np.array([row[0] for row in rows], dtype=np.int64),
        np.array([row[1] for row in rows], dtype=np.float64),
        np.array([unknown if row[2] is None else row[2] for row in rows], dtype=np.float64),
        np.array([row[2] is not None for row in rows]),
    )


def _body(rig: Rig, marker_id: int) -> Body:
    settings = JointSettings()
    return marker_body(
        str(marker_id),
        rig.length_of(marker_id),
        settings.scale_sigma,
        rig.height_of(marker_id),
        rig.height_sigma_of(marker_id) or settings.robot_height_sigma_m,
    )


def _point(measurement: Measurement, rig: Rig, body: int) -> CalibrationPoint:
    known = {point.name: (point.x_m, point.y_m) for point in rig.reference_points}
    usual_m = rig.tape_sigma_m or USUAL_TAPE_SIGMA_M
    entered = measurement.point
    distances = measurement.distances
    unknown = [d.reference for d in distances if d.reference not in known]
    if unknown and entered is None:
        raise FitError(
            f"measurement {measurement.id}: reference point {unknown[0]!r} is not in the rig; add it"
        )
    distances = () if unknown else distances
    references_m = np.array([known[d.reference] for d in distances], dtype=np.float64).reshape(-1, 2)
    ranges_m = np.array([d.distance_m for d in distances], dtype=np.float64)
    sigmas_m = np.array([d.sigma_m or usual_m for d in distances], dtype=np.float64)
    given = np.array([entered.x_m, entered.y_m]) if entered is not None else None
    given_m, on_reference = usual_m, False
    if given is None and len(distances) == 1 and distances[0].distance_m == 0:
        # At a distance of 0, only a point determines both coordinates: a distance has no direction there.
        given, given_m, on_reference = references_m[0], distances[0].sigma_m or ON_REFERENCE_SIGMA_M, True
        references_m, ranges_m, sigmas_m = references_m[:0], ranges_m[:0], sigmas_m[:0]
    start_m = given if given is not None else _start(references_m, ranges_m, sigmas_m, measurement.side)
    height_m = measurement.height_m if entered is None else entered.z_m
    placed = given is not None and len(ranges_m) < 2
    return CalibrationPoint(
        measurement.id,
        body,
        references_m,
        ranges_m,
        sigmas_m,
        start_m,
        given if placed else None,
        given_m**2 * np.eye(2) if placed else None,
        height_m,
        _ON_FLOOR_M if height_m == 0 else measurement.height_sigma_m or _USUAL_RULER_M,
        on_reference,
    )


def _start(references_m: Array, ranges_m: Array, sigmas_m: Array, side: str | None) -> Array | None:
    if len(ranges_m) < 2:
        return None
    try:
        return multilaterate(references_m, ranges_m, sigmas_m, side).point_m
    except IpsysError:
        # The circles do not meet: the fit shows which distance is wrong.
        return None


def _stationary(
    tracks: Mapping[int, _Track], measurements: Sequence[Measurement], ids: list[int], epoch_ns: int
) -> list[_Row]:
    """Return one averaged sighting for each measured point that a camera saw."""
    rows = []
    for number, measurement in enumerate(measurements):
        marker_id = measurement.marker_id
        track = tracks.get(marker_id) if marker_id is not None else None
        within = None if track is None else _interval(track, measurement)
        if marker_id is not None and track is not None and within is not None and within.any():
            time_s = float((track.times_ns[within] - epoch_ns).mean()) / NS_PER_S
            rows.append(_Row(ids.index(marker_id), number, time_s, *_average(track, within)))
    return rows


def _moving(
    tracks: Mapping[int, _Track], measurements: Sequence[Measurement], ids: list[int], rig: Rig, epoch_ns: int
) -> list[_Row]:
    """Return the sightings of markers on robots, at most one in each interval of time."""
    rows = []
    for marker_id, track in tracks.items():
        if marker_id not in ids or not rig.height_of(marker_id):
            continue
        own = [measurement for measurement in measurements if measurement.marker_id == marker_id]
        intervals = [_interval_ns(track, measurement) for measurement in own]
        free = np.ones(len(track.times_ns), dtype=np.bool_)
        if intervals:
            first_ns = min(start for start, _ in intervals) - _HANDLING_NS
            last_ns = max(end for _, end in intervals) + _HANDLING_NS
            free = (track.times_ns < first_ns) | (track.times_ns > last_ns)
        steps = (track.times_ns[free] - epoch_ns) // _LEAST_STEP_NS
        chosen = np.unique(steps, return_index=True)[1]
        for row in np.flatnonzero(free)[chosen].tolist():
            time_s = float(track.times_ns[row] - epoch_ns) / NS_PER_S
            rows.append(_Row(ids.index(marker_id), -1, time_s, track.pixels[row], track.covariances_px2[row]))
    return rows


def _part(row: _Row) -> int:
    return int(row.time_s // _DRIVE_PART_S)


def _choose_parts(moving: Sequence[Sequence[_Row]]) -> set[int]:
    """Return the numbers of the parts of drives that are used."""
    parts = sorted({_part(row) for rows in moving for row in rows})
    most = round(_MOST_DRIVE_S / _DRIVE_PART_S)
    if len(parts) <= most:
        return set(parts)
    return {parts[number] for number in np.linspace(0, len(parts) - 1, most).astype(np.intp).tolist()}


def _restarts_s(
    tracks: Mapping[str, Mapping[int, _Track]], moving: Sequence[Sequence[_Row]], epoch_ns: int
) -> Array:
    """Return the starts (r,) of all recordings of moving bodies but the first."""
    all_ns = [np.unique(track.times_ns) for own in tracks.values() for track in own.values()]
    times_s = (np.sort(np.concatenate([np.zeros(0, dtype=np.int64), *all_ns])) - epoch_ns) / NS_PER_S
    starts_s = times_s[1:][np.diff(times_s) > _RESTART_S]
    driven_s = np.array([row.time_s for rows in moving for row in rows])
    used = np.unique(np.searchsorted(starts_s, driven_s, side="right"))
    return np.asarray(starts_s[used[1:] - 1])


def _interval_ns(track: _Track, measurement: Measurement) -> tuple[int, int]:
    """Return the time in which a marker is at a calibration point."""
    within = _interval(track, measurement)
    times_ns = [measurement.timestamp]
    if measurement.still is not None:
        times_ns += [measurement.still.start, measurement.still.end]
    if within is not None and within.any():
        times_ns += track.times_ns[within].tolist()
    return min(times_ns), max(times_ns)


def _table(rows: list[_Row]) -> Sightings:
    return Sightings(
        np.array([row.body for row in rows], dtype=np.intp),
        np.array([row.point for row in rows], dtype=np.intp),
        np.array([row.time_s for row in rows], dtype=np.float64),
        np.array([row.pixels for row in rows], dtype=np.float64).reshape(-1, 4, 2),
        np.array([row.covariance_px2 for row in rows], dtype=np.float64).reshape(-1, 8, 8),
    )


def _interval(track: _Track, measurement: Measurement) -> NDArray[np.bool_] | None:
    """Return a mask of the sightings in the stationary interval of a measurement."""
    if measurement.still is not None:
        start_ns, end_ns = measurement.still.start, measurement.still.end
        return np.asarray((track.times_ns >= start_ns) & (track.times_ns <= end_ns))
    anchor = int(np.abs(track.times_ns - measurement.timestamp).argmin())
    if abs(int(track.times_ns[anchor]) - measurement.timestamp) > _GAP_NS:
        return None
    centres = track.pixels.mean(axis=1)
    moved = np.linalg.norm(centres - centres[anchor], axis=1) > _STILL_PX
    joined = np.diff(track.times_ns) <= _GAP_NS
    first = last = anchor
    while first > 0 and not moved[first - 1] and joined[first - 1]:
        first -= 1
    while last + 1 < len(moved) and not moved[last + 1] and joined[last]:
        last += 1
    mask = np.zeros(len(moved), dtype=np.bool_)
    mask[first : last + 1] = True
    return mask


def _average(track: _Track, within: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Return mean corners (4, 2), without frames that are far from the median, and their covariance."""
    pixels, covariances = track.pixels[within], track.covariances_px2[within]
    deviations = np.abs(pixels - np.median(pixels, axis=0)).max(axis=(1, 2))
    near = deviations <= max(_FAR_PX, _FAR * float(np.median(deviations)))
    frames = int(near.sum()) if track.has_covariance[within].all() else 1
    share = _REPEATABLE_SHARE + (1 - _REPEATABLE_SHARE) / frames
    return pixels[near].mean(axis=0), covariances[near].mean(axis=0) * share
