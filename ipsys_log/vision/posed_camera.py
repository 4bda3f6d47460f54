"""A camera with intrinsics and a pose in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.messages import CameraCalibration
from ipsys_log.messages.arrays import Array
from ipsys_log.vision.poses import invert_pose, rotation


@dataclass(frozen=True, slots=True, eq=False)
class PosedCamera:
    """A camera with its intrinsics ``lens``, its rotation ``camera_from_world`` (3, 3) and its position."""

    name: str
    lens: CameraCalibration
    camera_from_world: Array
    origin_m: Array

    @classmethod
    def at_pose(cls, name: str, lens: CameraCalibration, camera_from_world: Array) -> PosedCamera:
        """Return a camera with the pose ``camera_from_world`` (4, 4)."""
        return cls(name, lens, camera_from_world[:3, :3], invert_pose(camera_from_world)[:3, 3])

    @property
    def foot_m(self) -> Array:
        """The point of the floor below the camera, (2,) in m."""
        return self.origin_m[:2]

    def transform(self, points_m: Array) -> Array:
        """Return world points (n, 3) in camera coordinates."""
        return np.asarray((points_m - self.origin_m) @ self.camera_from_world.T)

    def move(self, motion: Array) -> PosedCamera:
        """Return the camera after a motion (6,): a turn about its axes in rad, a shift in the world in m."""
        turned = rotation(motion[:3]) @ self.camera_from_world
        return replace(self, camera_from_world=turned, origin_m=self.origin_m + motion[3:])
