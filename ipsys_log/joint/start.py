"""Start of the joint fit: camera poses and places of markers, from single markers and the tape."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError
from ipsys_log.joint.marker_views import MarkerViews, guess_distortion, view_markers
from ipsys_log.joint.observations import Observations
from ipsys_log.messages import CameraCalibration

__all__ = ["PlacedCamera", "place_cameras"]

Array = NDArray[np.float64]

# Errors of a place above this get less weight: that of a depth from the size of a marker.
_USUAL_M = 0.05
_ROUNDS = 20
# Two points nearer together than this do not define a direction.
_NEAR_M = 0.3
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
        if np.isfinite(self.world_headings_rad).any():
            return True
        spread_m = np.linalg.norm(self.world_m[:, :2] - self.world_m[:1, :2], axis=1)
        return bool(len(spread_m) > 1 and spread_m.max() > _NEAR_M)


def place_cameras(observations: Observations) -> list[PlacedCamera]:
    """Return a rough pose of each camera.

    A camera that sees two or more measured points is placed by them. Other cameras follow from markers that
    they share with a placed camera. If no camera sees two measured points, the first camera defines the
    frame, and the measured points that all cameras see place the whole group.

    Raises
    ------
    FitError
        A camera has no measured points and shares no marker with a placed camera.
    """
    views = [
        view_markers(
            sightings,
            observations.bodies,
            guess_distortion(sightings, camera.lens) if camera.nominal else camera.lens,
        )
        for sightings, camera in zip(observations.sightings, observations.cameras, strict=True)
    ]
    known = _measured_places(observations)
    placed: dict[int, PlacedCamera] = {}
    for camera, view in enumerate(views):
        matches = _tape_matches(observations, camera, view, known)
        if matches.sufficient:
            placed[camera] = _place(view, matches)
    free = not placed
    if free:
        root = max(range(len(views)), key=lambda camera: len(observations.sightings[camera]))
        placed[root] = _moved(views[root], np.zeros(3), 0.0)
    _chain(observations, views, placed)
    cameras = [placed[camera] for camera in range(len(views))]
    return _anchor(observations, cameras, known) if free else cameras


def _chain(observations: Observations, views: list[MarkerViews], placed: dict[int, PlacedCamera]) -> None:
    """Place all other cameras, the one with the most shared markers first."""
    shared: dict[int, list[_Matches]] = {camera: [] for camera in range(len(views)) if camera not in placed}
    fresh = list(placed)
    while shared:
        for camera, parts in shared.items():
            for other in fresh:
                parts.extend(_shared_matches(observations, camera, views[camera], other, placed[other]))
        camera = max(shared, key=lambda one: sum(len(part.points_m) for part in shared[one]))
        matches = _join(shared.pop(camera))
        if not len(matches.points_m):
            raise FitError(_lonely(observations, sorted([camera, *shared])))
        placed[camera] = _place(views[camera], matches)
        fresh = [camera]


def _lonely(observations: Observations, cameras: list[int]) -> str:
    names = ", ".join(observations.cameras[camera].name for camera in cameras)
    return (
        f"camera {names}: it sees fewer than two measured points, and no marker at the same time as the "
        "other cameras; measure points in its field of view, or drive a robot through the overlap"
    )


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
