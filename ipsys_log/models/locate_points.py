"""Positions of markers by models of camera points: the step of a frame, and reports of wrong heights."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from statistics import median
from typing import Any

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import (
    Array,
    CameraPoint,
    CameraPoints,
    Event,
    Message,
    Model,
    Position,
    Positions,
    Rig,
)
from ipsys_log.messages.events import CONTRADICTED_HEIGHT, FREE_BODY
from ipsys_log.models.table import AppliedModel, reads_height
from ipsys_log.models.uncertainty import HEIGHT_SIGMA_M
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.square_pose import DEPTH_SHARE

# A calibration point has its own height, which is not that of a marker on its robot.
_SAME_POINT_M = 0.05
# This many successive sightings must agree in the height. A marker that is carried by hand does not.
_LEAST_SIGHTINGS = 10
_MOST_SIGMAS = 4.0
# In a log with calibration points of the marker, further points may follow that are not in the model. There,
# only a marker in motion counts: this length of its path, in steps of a robot.
_LEAST_PATH_M = 0.3
_LONGEST_STEP_NS, _STEPS_M = NS_PER_S, (0.003, 0.5)
# In other logs, so many places, and their least distance.
_LEAST_PLACES, _OTHER_PLACE_M = 3, 0.2


@dataclass(frozen=True, slots=True, eq=False)
class HeightSighting:
    """A marker whose image contradicts its height ``stated_m``.

    ``point_m`` (3,) is its point by the image alone; ``above_m`` is the height of this point above the floor,
    with the standard deviation ``sigma_m``.
    """

    marker_id: int
    stated_m: float
    point_m: Array
    above_m: float
    sigma_m: float


@dataclass(slots=True, eq=False)
class _Evidence:
    """Sightings of a marker that agree: heights, places (2,), the length of the path, and the last place."""

    heights_m: list[float] = field(default_factory=list)
    places_m: list[Array] = field(default_factory=list)
    path_m: float = 0.0
    last: tuple[int, Array] | None = None

    def add(self, time_ns: int, sighting: HeightSighting) -> None:
        place_m = sighting.point_m[:2]
        if self.last is not None:
            step_m = float(np.linalg.norm(place_m - self.last[1]))
            is_step = time_ns - self.last[0] <= _LONGEST_STEP_NS and _STEPS_M[0] <= step_m <= _STEPS_M[1]
            self.path_m += step_m if is_step else 0.0
        self.last = time_ns, place_m
        self.heights_m.append(sighting.above_m)
        if all(np.linalg.norm(place_m - other_m) > _OTHER_PLACE_M for other_m in self.places_m):
            self.places_m.append(place_m)


class ContradictedHeights:
    """The memory of contradicted heights; it reports each marker once, when enough sightings agree.

    Parameters
    ----------
    model : its calibration points are not reported.
    """

    def __init__(self, model: Model) -> None:
        self._points_m: dict[int, list[Array]] = {}
        for camera in model.cameras:
            for pair in camera.pairs:
                self._points_m.setdefault(pair.marker_id, []).append(np.array(pair.world_m))
        self._at_points: set[int] = set()
        self._said: set[int] = set()
        self._evidence: dict[int, _Evidence] = {}

    def __call__(
        self, time_ns: int, camera: str | None, sightings: Iterable[HeightSighting]
    ) -> Iterator[Event]:
        """Yield an event for each marker whose contradicted height is certain with these sightings."""
        for sighting in sightings:
            marker_id = sighting.marker_id
            if marker_id in self._said:
                continue
            if self._is_at_point(sighting):
                self._at_points.add(marker_id)
                continue
            evidence = self._evidence.setdefault(marker_id, _Evidence())
            heights_m = evidence.heights_m
            if heights_m and abs(sighting.above_m - median(heights_m)) > _MOST_SIGMAS * sighting.sigma_m:
                evidence = self._evidence[marker_id] = _Evidence()
            evidence.add(time_ns, sighting)
            if self._is_certain(marker_id, evidence):
                self._said.add(marker_id)
                yield Event(time_ns, CONTRADICTED_HEIGHT, _text(sighting, evidence), camera, marker_id)

    def _is_at_point(self, sighting: HeightSighting) -> bool:
        points_m = self._points_m.get(sighting.marker_id, ())
        return any(np.abs(sighting.point_m - point_m).max() < _SAME_POINT_M for point_m in points_m)

    def _is_certain(self, marker_id: int, evidence: _Evidence) -> bool:
        if len(evidence.heights_m) < _LEAST_SIGHTINGS:
            return False
        if evidence.path_m >= _LEAST_PATH_M or marker_id not in self._points_m:
            return True
        return marker_id not in self._at_points and len(evidence.places_m) >= _LEAST_PLACES


def _text(sighting: HeightSighting, evidence: _Evidence) -> str:
    seen_m, stated_m = median(evidence.heights_m), sighting.stated_m
    return (
        f"marker {sighting.marker_id} is at {seen_m:.3f} m, not at {stated_m:.3f} m; its position is from "
        "its full pose. Correct its height_m in lab.toml, or measure its printed side"
    )


# This step is long enough for the precision of the numbers, and short enough for a curved model.
_STEP_M = 0.01
# A ray that falls by less than this share of its length says nothing about a height.
_LEAST_FALL = 0.1


class LocatePoints:
    """The step from camera points to positions. A camera that is not in the model has no positions.

    Models that need the height of a marker get it from the rig. If the pose of a marker contradicts its
    height, they get the height of the pose, and an event names it. By eq. (3), a tilt looks like another
    height, so that such a position is only marked as not inside. Bodies that are not level have no positions.
    """

    def __init__(self, model: Model) -> None:
        self._name = model.name
        self._cameras = {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}
        self._rig: Rig | None = None
        self._heights = ContradictedHeights(model)
        self._named: set[int] = set()

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._rig = message.payload
            return
        if not isinstance(message.payload, CameraPoints):  # the model, which it has already
            return
        applied = self._cameras.get(str(message.camera))
        if applied is not None:
            yield from self._free(message)
            points = tuple(
                p for p in message.payload.points if self._rig is None or not self._rig.is_free(p.id)
            )
            heights_m = np.array([self._height(point.id) for point in points])
            sigmas_m = np.array([self._height_sigma(point.id) for point in points])
            positions, contradicted = _positions(applied, points, heights_m, sigmas_m) if points else ((), [])
            yield from self._heights(message.publish_time_ns, message.camera, contradicted)
            yield Positions(message.publish_time_ns, positions)

    def _free(self, message: Message) -> Iterator[Event]:
        """Yield an event for each marker of a free body at its first sighting."""
        for point in message.payload.points:
            if self._rig is not None and self._rig.is_free(point.id) and point.id not in self._named:
                self._named.add(point.id)
                robot = self._rig.robot_of(point.id)
                text = f"{robot} is not level: {self._name} has no position of it; the model joint has"
                yield Event(message.publish_time_ns, FREE_BODY, text, message.camera, point.id)

    def _height(self, marker_id: int) -> float:
        return _height(self._name, self._rig, marker_id) if reads_height(self._name) else 0.0

    def _height_sigma(self, marker_id: int) -> float:
        sigma_m = self._rig.height_sigma_of(marker_id) if self._rig else None
        return HEIGHT_SIGMA_M if sigma_m is None else sigma_m


def _positions(
    applied: AppliedModel, points: tuple[CameraPoint, ...], heights_m: Array, height_sigmas_m: Array
) -> tuple[tuple[Position, ...], list[HeightSighting]]:
    """Return the positions of the markers, and the heights that contradict those of the rig.

    A marker whose ray does not meet its height has no position. A marker whose depth by eq. (3) contradicts
    its height is not inside: its position is valid at that height only. Nor is a marker whose camera has
    intrinsics that its markers contradict.
    """
    points_m = np.array([(p.x_m, p.y_m, p.z_m) for p in points])
    angles = np.array([-p.heading_rad if p.heading_rad is not None else 0.0 for p in points])
    world, headings_rad = _world_poses(applied, points_m, angles, heights_m)
    noise_m = _depth_noise_m(points)
    agrees = applied.at_height(points_m, world, height_sigmas_m, noise_m)
    by_pose = ~agrees & np.array([bool(point.poses) for point in points]) & np.isfinite(world).all(axis=1)
    contradicted: list[HeightSighting] = []
    if by_pose.any():
        rises_m, sigmas_m = applied.rises(points_m, world, noise_m)
        stated_m, heights_m = heights_m, np.where(by_pose, heights_m + rises_m, heights_m)
        height_sigmas_m = np.where(by_pose, sigmas_m, height_sigmas_m)
        world, headings_rad = _world_poses(applied, points_m, angles, heights_m)
        contradicted = [
            HeightSighting(points[n].id, stated_m[n], world[n], heights_m[n], sigmas_m[n])
            for n in np.flatnonzero(by_pose)
        ]
    headings = headings_rad.tolist()
    covariances = applied.covariances(points_m, heights_m, height_sigmas_m)
    sigmas_m = np.zeros(len(points)) if covariances is None else np.sqrt(covariances[:, 2, 2])
    inside = applied.inside(points_m, world, sigmas_m)
    if inside is not None:
        inside &= agrees | by_pose
    positions = tuple(
        Position(
            point.id,
            x_m,
            y_m,
            z_m,
            None if point.heading_rad is None else headings[n],
            None if covariances is None else covariances[n],
            False if point.contradicted else None if inside is None else bool(inside[n]),
            point.time_offset_ns,
        )
        for n, (point, (x_m, y_m, z_m)) in enumerate(zip(points, world.tolist(), strict=True))
        if np.isfinite(world[n]).all()
    )
    return positions, contradicted


def _depth_noise_m(points: tuple[CameraPoint, ...]) -> Array:
    """Return the standard deviations (n,) of the depths by the noise of an image, 0 if unknown.

    The covariance of a pose also has the error of its camera, which the calibration points have corrected.
    """
    variances_m2 = np.zeros(len(points))
    for n, point in enumerate(points):
        if point.covariance_m2 is not None:
            shared_m = DEPTH_SHARE * point.z_m if point.poses else 0.0
            variances_m2[n] = max(point.covariance_m2[2, 2] - shared_m**2, 0.0)
    return np.sqrt(variances_m2)


def _world_poses(
    applied: AppliedModel, points_m: Array, angles_rad: Array, heights_m: Array
) -> tuple[Array, Array]:
    """Return world points (n, 3) and headings (n,) of camera points (n, 3) with angles (n,).

    The model also maps a point a little ahead, at the same depth, and the point itself a little deeper. Under
    a tilted camera, the point ahead has another height. The vertical part of the step is removed along the
    ray, because markers are level.
    """
    units, moved = np.zeros(points_m.shape), np.empty((3, *points_m.shape))
    units[:, 0], units[:, 1] = np.cos(angles_rad), np.sin(angles_rad)
    moved[0], moved[1] = points_m, points_m + _STEP_M * units
    moved[2] = points_m * (1 + _STEP_M / points_m[:, 2:])
    heights = np.concatenate([heights_m] * 3)
    world, ahead, below = applied.predict(moved.reshape(-1, 3), heights).reshape(3, -1, 3)
    along, ray = ahead - world, below - world
    # A model with known heights has no vertical part, and its ray has no length.
    falls = np.abs(ray[:, 2]) > _LEAST_FALL * _STEP_M
    share = np.where(falls, along[:, 2] / np.where(falls, ray[:, 2], 1.0), 0.0)
    along = along - share[:, None] * ray
    return world, np.arctan2(along[:, 1], along[:, 0])


def _height(model: str, rig: Rig | None, marker_id: int) -> float:
    """Return the height of a marker above the floor, in m."""
    height_m = rig.height_of(marker_id) if rig else None
    if height_m is None:
        raise IpsysError(
            f"{model} needs the height of marker {marker_id} above the floor: write "
            "marker_height_m, or height_m of that marker, into lab.toml and give it with --rig lab.toml"
        )
    return height_m
