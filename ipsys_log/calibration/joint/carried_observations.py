"""Observations of a carried body or board from a log, and known poses of stationary markers."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting
from ipsys_log.calibration.joint.fit import without_unseen
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.lab_frame import Target
from ipsys_log.calibration.joint.observations import (
    Body,
    CalibrationPoint,
    CameraPrior,
    Observations,
    Sightings,
)
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration, Interval, Marker, Markers, Measurement, Rig
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.bodies import BodyShape, body_shapes
from ipsys_log.vision.poses import level_turns

# A body is at rest while the centres of its markers move less than this, for at least this time. At its ends,
# a marker may still move in the images of other cameras.
_STILL_PX, _STILL_NS, _END_NS = 0.5, 2 * NS_PER_S, NS_PER_S // 5
_GAP_NS = NS_PER_S // 2
# More frames per second cost time and give little: the path has knots some 0.1 s apart.
_LEAST_STEP_NS = NS_PER_S // 16
_UNKNOWN_CORNER_PX = 0.25
# A pose of a marker on its body is exact beside the errors of the cameras.
_EXACT = np.repeat([1e-5, 1e-4], 3)
_REST = "rest"
# The z axis of a board goes into it, that of a lab goes up.
_FACE_UP = np.diag([1.0, -1.0, -1.0])
# The name of the only body of the sightings of a board.
BOARD = "board"
# Before the fit shows the errors of the corners of a board.
_BOARD_CORNER_PX = 0.3


def gather_carried(
    rig: Rig,
    lenses: Mapping[str, CameraCalibration],
    nominal: Collection[str],
    markers: Mapping[str, Sequence[Markers]],
    robot: str,
    measurements: Sequence[Measurement],
    left_out: Collection[int] = (),
) -> tuple[Observations, list[Target], Interval | None]:
    """Return the sightings of a carried body, the known poses of stationary markers, and the body's rest.

    Markers at measured points define the lab's coordinates. If fewer than two are seen, the body at rest
    defines them: its origin and its axes.

    Parameters
    ----------
    rig : the bodies, the markers, the reference points.
    lenses, nominal : intrinsics by camera, and those cameras whose intrinsics are nominal.
    markers : the detections of each camera, in order of time.
    robot : the body.
    measurements : the valid measurements.
    left_out : markers of the body that contradict the others.

    Raises
    ------
    IpsysError
        The rig has no such body, the poses of its markers are not known, or no camera sees it.
    """
    shape = _without_markers(_shape(rig, robot), left_out)
    markers = {camera: markers[camera] for camera in sorted(markers)}
    rest, resting = None, list[Measurement]()
    ids = {f"{_REST} {marker_id}": marker_id for marker_id in shape.markers}
    taped = [one for one in measurements if one.marker_id is not None and _is_seen(one, markers)]
    if len(taped) < 2:
        taped, rest = [], _find_rest(shape, markers)
        if rest is not None:
            resting = [
                Measurement(rest.start, name, marker_id=marker_id, still=rest)
                for name, marker_id in ids.items()
            ]
    measured = [*taped, *resting]
    stationary = without_unseen(
        gather_observations(rig, lenses, markers, measured, nominal, with_drives=False)
    )
    targets = [
        _on_body(shape.markers[ids[point.name]], number) if resting else _on_floor(point, number)
        for number, point in enumerate(stationary.points)
    ]
    observations = _with_body(stationary, shape, markers, measured)
    return observations, [target for target in targets if target is not None], rest


def gather_board(
    lenses: Mapping[str, CameraCalibration],
    nominal: Collection[str],
    sightings: Mapping[str, Sequence[tuple[int, BoardSighting]]],
    board: Board,
) -> tuple[Observations, list[Target], Interval | None]:
    """Return the sightings of a carried board, its pose at rest, and the time of the rest.

    At rest, the x axis of the lab goes along the rows of the board, and the z axis out of it.

    Parameters
    ----------
    lenses, nominal : as for :func:`gather_carried`.
    sightings : by camera, times in ns and the corners of the board in the frames at these times.
    board : the board.
    """
    missing = sorted(set(sightings) - set(lenses))
    if missing:
        raise IpsysError(
            f"camera {missing[0]}: has no intrinsics; give --calibration, or --field-of-view for nominal ones"
        )
    rest = _longest_rest([[(t, seen.outline.mean(axis=0)) for t, seen in own] for own in sightings.values()])
    epoch_ns = min((own[0][0] for own in sightings.values()), default=0)
    points_m = board.points_m(np.arange(board.grid[0] * board.grid[1]))
    parts = tuple(_board_table(own, rest, epoch_ns, len(points_m)) for own in sightings.values())
    cameras = tuple(CameraPrior(name, lenses[name], name in nominal, None) for name in sightings)
    points = () if rest is None else (CalibrationPoint(_REST, 0),)
    targets = [] if rest is None else [Target(0, _REST, np.zeros(3), _FACE_UP, _EXACT)]
    return Observations(cameras, (Body(BOARD, points_m, 0.0),), points, parts), targets, rest


def _board_table(
    own: Sequence[tuple[int, BoardSighting]], rest: Interval | None, epoch_ns: int, count: int
) -> Sightings:
    pixels = np.full((len(own), count, 2), np.nan)
    for row, (_, seen) in enumerate(own):
        pixels[row, seen.ids] = seen.pixels
    times_ns = np.array([time_ns for time_ns, _ in own], dtype=np.int64)
    resting = np.zeros(len(own), dtype=np.bool_)
    if rest is not None:
        resting = (times_ns >= rest.start) & (times_ns <= rest.end)
    return Sightings(
        np.zeros(len(own), dtype=np.intp),
        np.where(resting, 0, -1),
        (times_ns - epoch_ns) / NS_PER_S,
        pixels,
        np.tile(_BOARD_CORNER_PX**2 * np.eye(2 * count), (len(own), 1, 1)),
    )


def _shape(rig: Rig, robot: str) -> BodyShape:
    shapes = {shape.robot: shape for shape in body_shapes(rig)}
    if robot not in shapes:
        known = ", ".join(shapes) or "none"
        raise IpsysError(f"{robot}: is no body of the rig, which has {known}; add it to [[bodies]]")
    return shapes[robot]


def _without_markers(shape: BodyShape, ids: Collection[int]) -> BodyShape:
    """Return a body without some of its markers."""
    corners_m = {marker_id: own for marker_id, own in shape.corners_m.items() if marker_id not in ids}
    return replace(shape, markers={i: shape.markers[i] for i in corners_m}, corners_m=corners_m)


def _is_seen(measurement: Measurement, markers: Mapping[str, Sequence[Markers]]) -> bool:
    still = measurement.still
    times_ns = (still.start, still.end) if still is not None else (measurement.timestamp,) * 2
    return any(
        times_ns[0] <= message.timestamp <= times_ns[1]
        and any(marker.id == measurement.marker_id for marker in message.markers)
        for own in markers.values()
        for message in own
    )


def _find_rest(shape: BodyShape, markers: Mapping[str, Sequence[Markers]]) -> Interval | None:
    return _longest_rest(
        [
            (message.timestamp, marker.corners_px.mean(axis=0))
            for message in own
            for marker in message.markers
            if marker.id == marker_id
        ]
        for own in markers.values()
        for marker_id in shape.markers
    )


def _longest_rest(tracks: Iterable[Sequence[tuple[int, Array]]]) -> Interval | None:
    """Return the longest time in which a place in an image does not move; None without a rest."""
    best = None
    for rows in tracks:
        start = 0
        for row, (time_ns, centre_px) in enumerate(rows):
            apart = np.linalg.norm(centre_px - rows[start][1]) > _STILL_PX
            if apart or (row and time_ns - rows[row - 1][0] > _GAP_NS):
                start = row
                continue
            length_ns = time_ns - rows[start][0]
            if length_ns >= _STILL_NS and (best is None or length_ns > best.end - best.start):
                best = Interval(rows[start][0], time_ns)
    return None if best is None else Interval(best.start + _END_NS, best.end - _END_NS)


def _on_floor(point: CalibrationPoint, number: int) -> Target | None:
    """Return the pose of a level marker at a measured point, with an unknown heading."""
    place = point.point_m if point.point_m is not None else point.start_m
    if place is None:
        return None
    sigma_m = point.distance_sigmas_m.max() if len(point.distance_sigmas_m) else JointSettings().floor_sigma_m
    if point.covariance_m2 is not None:
        sigma_m = float(np.sqrt(point.covariance_m2.diagonal().max()))
    tilt_rad = JointSettings().point_tilt_sigma_rad
    # A marker without a height is somewhere above its point.
    height_sigma_m = np.inf
    if point.height_m is not None:
        height_sigma_m = float(np.hypot(point.height_sigma_m, JointSettings().floor_sigma_m))
    sigmas = np.array([sigma_m, sigma_m, height_sigma_m, tilt_rad, tilt_rad, np.inf])
    return Target(number, point.name, np.array([*place, point.height_m or 0.0]), np.eye(3), sigmas)


def _on_body(pose: Array, number: int) -> Target:
    return Target(number, _REST, pose[:3, 3], pose[:3, :3] @ level_turns(np.zeros(1))[0], _EXACT)


def _with_body(
    stationary: Observations,
    shape: BodyShape,
    markers: Mapping[str, Sequence[Markers]],
    measured: Sequence[Measurement],
) -> Observations:
    """Return observations without readings of the tape, and with the sightings of the moving body."""
    first = len(stationary.bodies)
    # The size of the body is the unit of length: its error is added after the fit.
    bodies = [replace(body, scale_sigma=0.0, height_m=None) for body in stationary.bodies]
    bodies += [Body(str(marker_id), corners_m, 0.0) for marker_id, corners_m in shape.corners_m.items()]
    numbers = {marker_id: first + n for n, marker_id in enumerate(shape.corners_m)}
    epoch_ns = min(
        (
            message.timestamp + (marker.time_offset_ns or 0)
            for own in markers.values()
            for message in own
            for marker in message.markers
        ),
        default=0,
    )
    sightings = []
    for own, messages in zip(stationary.sightings, markers.values(), strict=True):
        rows = [
            (numbers[marker.id], message.timestamp + (marker.time_offset_ns or 0), marker)
            for message in _thin(messages)
            for marker in message.markers
            if marker.id in numbers and not _is_measured(message, marker, measured)
        ]
        sightings.append(_join(own, rows, epoch_ns))
    if not any((own.point < 0).any() for own in sightings):
        ids = ", ".join(map(str, shape.corners_m))
        raise IpsysError(f"{shape.robot}: no frame shows its markers {ids} in motion; carry it in the lab")
    points = tuple(CalibrationPoint(point.name, point.body) for point in stationary.points)
    return replace(stationary, bodies=tuple(bodies), points=points, sightings=tuple(sightings))


def _is_measured(message: Markers, marker: Marker, measured: Sequence[Measurement]) -> bool:
    return any(
        one.marker_id == marker.id
        and one.still is not None
        and one.still.start <= message.timestamp <= one.still.end
        for one in measured
    )


def _thin(messages: Sequence[Markers]) -> list[Markers]:
    """Return at most one message in each interval of time."""
    steps = np.array([message.timestamp // _LEAST_STEP_NS for message in messages])
    return [messages[n] for n in np.unique(steps, return_index=True)[1].tolist()]


def _join(stationary: Sightings, rows: Sequence[tuple[int, int, Marker]], epoch_ns: int) -> Sightings:
    unknown = _UNKNOWN_CORNER_PX**2 * np.eye(8)
    covariances = [unknown if m.covariance_px2 is None else m.covariance_px2 for _, _, m in rows]
    times_s = np.array([time_ns - epoch_ns for _, time_ns, _ in rows], dtype=np.int64) / NS_PER_S
    pixels: Array = np.array([marker.corners_px for _, _, marker in rows], dtype=np.float64).reshape(-1, 4, 2)
    return Sightings(
        np.concatenate([stationary.body, np.array([body for body, _, _ in rows], dtype=np.intp)]),
        np.concatenate([stationary.point, np.full(len(rows), -1, dtype=np.intp)]),
        np.concatenate([stationary.times_s, times_s]),
        np.concatenate([stationary.pixels, pixels]),
        np.concatenate([stationary.covariances_px2, np.array(covariances).reshape(-1, 8, 8)]),
    )
