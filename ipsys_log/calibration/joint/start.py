"""Start of the joint fit: camera poses and places of markers, from single markers and the tape."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.marker_views import MarkerViews, guess_distortion, view_markers
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.errors import FitError
from ipsys_log.messages import Array, CameraCalibration

# Errors of a place above this get less weight: that of a depth from the size of a marker.
_USUAL_M = 0.05
_ROUNDS = 20
# Two points nearer together than this do not define a direction. Shared markers define a better one than two
# points that are nearer together than the second limit.
_NEAR_M = 0.3
_WIDE_M = 1.0
# A moving marker is interpolated between two sightings that are not farther apart than this.
_GAP_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class PlacedCamera:
    """A camera with a rough pose, and the markers in world coordinates as the camera sees them.

    ``lens`` are its intrinsics; nominal ones have a guessed distortion. ``camera_from_world`` is a rotation
    (3, 3), ``origin_m`` (3,) the position. ``points_m`` is (n, 3), ``headings_rad`` (n,), ``rays`` (n, 3).
    """

    lens: CameraCalibration
    camera_from_world: Array
    origin_m: Array
    points_m: Array
    headings_rad: Array
    rays: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Matches:
    """Places of n markers in level camera coordinates and in the world; a heading may be NaN."""

    points_m: Array
    headings_rad: Array
    world_m: Array
    world_headings_rad: Array

    @property
    def sufficient(self) -> bool:
        """True if the matches determine position and direction of the camera."""
        return bool(np.isfinite(self.world_headings_rad).any()) or self.reach_m > _NEAR_M

    @property
    def reach_m(self) -> float:
        """The largest distance of a place from the first one."""
        apart_m = np.linalg.norm(self.world_m[:, :2] - self.world_m[:1, :2], axis=1)
        return float(apart_m.max(initial=0.0))


class UnplacedError(FitError):
    """Cameras that no point and no marker connects with the others; ``cameras`` are their indices."""

    def __init__(self, observations: Observations, cameras: list[int]) -> None:
        names = ", ".join(observations.cameras[camera].name for camera in cameras)
        super().__init__(
            f"camera {names}: it sees fewer than two measured points, and no marker at the same time as the "
            "other cameras; measure points in its field of view, or drive a robot through the overlap"
        )
        self.cameras = cameras


def place_cameras(observations: Observations) -> list[PlacedCamera]:
    """Return a rough pose of each camera.

    A camera that sees measured points far from each other is placed by them. Other cameras follow from their
    points, and from markers that they share with a placed camera. If no camera sees two measured points, the
    first camera defines the frame, and the measured points that all cameras see place the whole group.

    Raises
    ------
    UnplacedError
        A camera has no measured points and shares no marker with a placed camera.
    FitError
        The cameras see fewer than two measured points.
    """
    views = _view(observations)
    known = _measured_places(observations)
    taped = [_tape_matches(observations, camera, view, known) for camera, view in enumerate(views)]
    least_m = min(_WIDE_M, max(matches.reach_m for matches in taped))
    placed = {
        camera: _place(views[camera], matches)
        for camera, matches in enumerate(taped)
        if matches.sufficient and matches.reach_m >= least_m
    }
    if not placed:
        return _anchor(observations, place_freely(observations, views), known)
    return _chain(observations, views, taped, placed)


def place_freely(observations: Observations, views: list[MarkerViews] | None = None) -> list[PlacedCamera]:
    """Return rough poses of the cameras to each other, without the tape: one of them is above the origin.

    Raises
    ------
    UnplacedError
        A camera shares no marker with the others.
    """
    views = _view(observations) if views is None else views
    root = max(range(len(views)), key=lambda camera: len(observations.sightings[camera]))
    shift_m = np.array([0.0, 0.0, _camera_height_m(observations, root, views[root])])
    placed = {root: _moved(views[root], shift_m, 0.0)}
    return _chain(observations, views, [], placed)


def _camera_height_m(observations: Observations, camera: int, view: MarkerViews) -> float:
    """Return the height of a camera above the floor by the markers of known height; 0 without one."""
    sightings, bodies, points = observations.sightings[camera], observations.bodies, observations.points
    known = [
        points[point].height_m if point >= 0 else bodies[body].height_m
        for body, point in zip(sightings.body.tolist(), sightings.point.tolist(), strict=True)
    ]
    heights_m = np.array(known, dtype=np.float64) - view.points_m[:, 2]
    heights_m = heights_m[np.isfinite(heights_m)]
    return float(np.median(heights_m)) if len(heights_m) else 0.0


def rough_points(observations: Observations, placed: list[PlacedCamera]) -> tuple[Array, Array]:
    """Return positions (t, 3) and headings (t,) of the calibration points, as the cameras see them."""
    count = len(observations.points)
    sums, turns, seen = np.zeros((count, 3)), np.zeros(count, dtype=complex), np.zeros(count)
    for camera, sightings in zip(placed, observations.sightings, strict=True):
        for row in np.flatnonzero(sightings.point >= 0).tolist():
            point = observations.points[int(sightings.point[row])]
            place_m = camera.points_m[row]
            if point.height_m is not None:
                along = (point.height_m - camera.origin_m[2]) / camera.rays[row, 2]
                place_m = camera.origin_m + along * camera.rays[row]
            if np.isfinite(place_m).all():
                sums[sightings.point[row]] += place_m
                turns[sightings.point[row]] += np.exp(1j * camera.headings_rad[row])
                seen[sightings.point[row]] += 1
    return sums / np.maximum(seen, 1)[:, None], np.angle(turns)


def _view(observations: Observations) -> list[MarkerViews]:
    return [
        view_markers(
            sightings,
            observations.bodies,
            guess_distortion(sightings, camera.lens) if camera.nominal else camera.lens,
        )
        for sightings, camera in zip(observations.sightings, observations.cameras, strict=True)
    ]


def _chain(
    observations: Observations,
    views: list[MarkerViews],
    taped: list[_Matches],
    placed: dict[int, PlacedCamera],
) -> list[PlacedCamera]:
    """Place all other cameras, the one with the most shared markers first."""
    shared = {camera: taped[camera : camera + 1] for camera in range(len(views)) if camera not in placed}
    fresh = list(placed)
    while shared:
        for camera, parts in shared.items():
            for other in fresh:
                parts.extend(_shared_matches(observations, camera, views[camera], other, placed[other]))
        camera = max(shared, key=lambda one: sum(len(part.points_m) for part in shared[one]))
        matches = _join(shared[camera])
        if not matches.sufficient:
            # The most matches may be measured points near together.
            ready = [one for one, parts in shared.items() if _join(parts).sufficient]
            if not ready:
                raise UnplacedError(observations, sorted(shared))
            camera, matches = ready[0], _join(shared[ready[0]])
        del shared[camera]
        placed[camera] = _place(views[camera], matches)
        fresh = [camera]
    return [placed[camera] for camera in range(len(views))]


def _measured_places(observations: Observations) -> Array:
    """Return the measured positions of the calibration points, (t, 3) in m; NaN if unknown."""
    places = np.full((len(observations.points), 3), np.nan)
    for number, point in enumerate(observations.points):
        flat = point.point_m if point.point_m is not None else point.start_m
        if flat is not None:
            places[number] = [*flat, point.height_m or 0.0]
    return places


def _tape_matches(observations: Observations, camera: int, view: MarkerViews, known: Array) -> _Matches:
    sightings = observations.sightings[camera]
    world_m = np.where(
        (sightings.point >= 0)[:, None],
        known[np.maximum(sightings.point, 0)] if len(known) else np.nan,
        np.nan,
    )
    good = np.isfinite(world_m).all(axis=1) & np.isfinite(view.points_m).all(axis=1)
    none = np.full(int(good.sum()), np.nan)
    return _Matches(view.points_m[good], view.headings_rad[good], world_m[good], none)


def _shared_matches(
    observations: Observations, camera: int, view: MarkerViews, other: int, other_camera: PlacedCamera
) -> list[_Matches]:
    """Return the markers that a placed camera sees too: at the same point, or at the same time."""
    sightings, known = observations.sightings[camera], observations.sightings[other]
    seen, known_seen = (
        np.isfinite(points_m).all(axis=1) for points_m in (view.points_m, other_camera.points_m)
    )
    parts = []
    for body in np.intersect1d(sightings.body, known.body).tolist():
        own, theirs = (
            np.flatnonzero((sightings.body == body) & seen),
            np.flatnonzero((known.body == body) & known_seen),
        )
        at_points = [
            (one, int(two))
            for one in own[sightings.point[own] >= 0].tolist()
            for two in theirs[known.point[theirs] == sightings.point[one]]
        ]
        if at_points:
            first, second = np.array(at_points).T
            world = other_camera.points_m[second], other_camera.headings_rad[second]
            parts.append(_Matches(view.points_m[first], view.headings_rad[first], *world))
        moving, theirs = own[sightings.point[own] < 0], theirs[known.point[theirs] < 0]
        if len(moving) and len(theirs) > 1:
            world_m, headings_rad, near = _interpolate(
                sightings.times_s[moving],
                known.times_s[theirs],
                other_camera.points_m[theirs],
                other_camera.headings_rad[theirs],
            )
            first = moving[near]
            parts.append(
                _Matches(view.points_m[first], view.headings_rad[first], world_m[near], headings_rad[near])
            )
    return parts


def _join(parts: list[_Matches]) -> _Matches:
    columns = [[getattr(part, name) for part in parts] for name in _Matches.__slots__]
    empty = (np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    return _Matches(*(np.concatenate([e, *c]) for e, c in zip(empty, columns, strict=True)))


def _interpolate(
    times_s: Array, known_s: Array, points_m: Array, headings_rad: Array
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return points and headings at times between known ones, and a mask of the times in no gap."""
    order = np.argsort(known_s, kind="stable")
    known_s, points_m, headings_rad = known_s[order], points_m[order], np.unwrap(headings_rad[order])
    after = np.clip(np.searchsorted(known_s, times_s), 1, len(known_s) - 1)
    near = (np.abs(times_s - known_s[after]) < _GAP_S) & (np.abs(times_s - known_s[after - 1]) < _GAP_S)
    columns = [np.interp(times_s, known_s, column) for column in (*points_m.T, headings_rad)]
    return np.stack(columns[:3], axis=1), columns[3], near


def _place(view: MarkerViews, matches: _Matches) -> PlacedCamera:
    """Place a camera by a turn about the vertical and a translation, robust against wrong matches."""
    turn_rad, shift_m = _align(matches)
    return _moved(view, shift_m, turn_rad)


def _align(matches: _Matches) -> tuple[float, Array]:
    own, world = matches.points_m, matches.world_m
    flat, target = own[:, 0] + 1j * own[:, 1], world[:, 0] + 1j * world[:, 1]
    turned = matches.world_headings_rad - matches.headings_rad
    has = np.isfinite(turned)
    weights = np.ones(len(flat))
    turn, shift = 1.0 + 0j, 0j
    for _ in range(_ROUNDS):
        middle, target_middle = (np.sum(weights * one) / weights.sum() for one in (flat, target))
        directions = np.sum(weights * np.conj(flat - middle) * (target - target_middle))
        # A heading of a marker counts as much as two points at the usual distance.
        directions += _NEAR_M**2 * np.sum((weights * np.exp(1j * turned))[has])
        turn = directions / max(abs(directions), 1e-12)
        shift = target_middle - turn * middle
        errors = np.abs(turn * flat + shift - target)
        scale = max(_USUAL_M, float(np.median(errors)))
        weights = 1 / (1 + (errors / scale) ** 2)
    height_m = float(np.median(world[:, 2] - own[:, 2]))
    return float(np.angle(turn)), np.array([shift.real, shift.imag, height_m])


def _moved(view: MarkerViews, shift_m: Array, turn_rad: float) -> PlacedCamera:
    turn = _about_vertical(turn_rad)
    return PlacedCamera(
        view.lens,
        (turn @ view.level_from_camera).T,
        shift_m,
        view.points_m @ turn.T + shift_m,
        view.headings_rad + turn_rad,
        view.rays @ turn.T,
    )


def _about_vertical(turn_rad: float) -> Array:
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _anchor(observations: Observations, cameras: list[PlacedCamera], known: Array) -> list[PlacedCamera]:
    """Place a group of cameras by the measured points that they see together."""
    own, world = [], []
    for placed, sightings in zip(cameras, observations.sightings, strict=True):
        for row in np.flatnonzero(sightings.point >= 0).tolist():
            if np.isfinite(known[sightings.point[row]]).all() and np.isfinite(placed.points_m[row]).all():
                own.append(placed.points_m[row])
                world.append(known[sightings.point[row]])
    none = np.full(len(own), np.nan)
    matches = _Matches(np.array(own).reshape(-1, 3), none, np.array(world).reshape(-1, 3), none)
    if not matches.sufficient:
        raise FitError(
            "the cameras see fewer than two measured points; measure at least two points with the tape, some "
            "metres apart"
        )
    turn_rad, shift_m = _align(matches)
    turn = _about_vertical(turn_rad)
    return [
        PlacedCamera(
            placed.lens,
            placed.camera_from_world @ turn.T,
            turn @ placed.origin_m + shift_m,
            placed.points_m @ turn.T + shift_m,
            placed.headings_rad + turn_rad,
            placed.rays @ turn.T,
        )
        for placed in cameras
    ]
