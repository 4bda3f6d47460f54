"""The step from the camera points of a frame to world positions, by the fitted model of their camera."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraPoint, CameraPoints, Message, Model, Position, Positions, Rig
from ipsys_log.models.contradicted_heights import ContradictedHeights, HeightSighting
from ipsys_log.models.table import AppliedModel, reads_height
from ipsys_log.models.uncertainty import HEIGHT_SIGMA_M
from ipsys_log.vision.square_pose import DEPTH_SHARE

# This step is long enough for the precision of the numbers, and short enough for a curved model.
_STEP_M = 0.01
# A ray that falls by less than this share of its length says nothing about a height.
_LEAST_FALL = 0.1


class LocatePoints:
    """The step from camera points to positions. A camera that is not in the model has no positions.

    Models that need the height of a marker get it from the rig. If the pose of a marker contradicts its
    height, they get the height of the pose, and an event names it. By eq. (3), a tilt looks like another
    height, so that such a position is only marked as not inside.
    """

    def __init__(self, model: Model) -> None:
        self._name = model.name
        self._cameras = {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}
        self._rig: Rig | None = None
        self._heights = ContradictedHeights(model)

    def __call__(self, message: Message) -> Iterator[Any]:
        if isinstance(message.payload, Rig):
            self._rig = message.payload
            return
        if not isinstance(message.payload, CameraPoints):  # the model, which it has already
            return
        applied = self._cameras.get(str(message.camera))
        if applied is not None:
            points = message.payload.points
            heights_m = np.array([self._height(point.id) for point in points])
            sigmas_m = np.array([self._height_sigma(point.id) for point in points])
            positions, contradicted = _positions(applied, points, heights_m, sigmas_m) if points else ((), [])
            yield from self._heights(message.publish_time_ns, message.camera, contradicted)
            yield Positions(message.publish_time_ns, positions)

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
