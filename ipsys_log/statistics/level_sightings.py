"""Sightings of level markers and of reference markers, with their slopes by a motion of the camera."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.locate import edge_motion, linearise_corners, marker_arms, start_level
from ipsys_log.calibration.joint.locate_poses import locate_poses
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array, Times
from ipsys_log.vision.poses import level_turns

# The columns of x, y, the heading and the height among those of a motion and a turn.
_POSE_AND_HEIGHT = np.array([0, 1, 5, 2])
_TILT_SIGMA_RAD = 0.005
# With its height free, a level marker has four degrees of freedom left. A marker in a hand has larger
# residuals.
_MOST_CHI2 = 40.0
# A marker that is further from its height is no robot: it lies at a calibration point. A camera that turns by
# one degree shifts heights by up to 26 mm, and a zoom of 2 % by 42 mm.
_MOST_RISE_M = 0.06
_MOTION = 6


@dataclass(frozen=True, slots=True, eq=False)
class ImagedMarkers:
    """Markers in the images of one camera.

    Attributes
    ----------
    times_ns, ids : (n,), instants of the exposures, and marker ids.
    corners_px, covariances_px2 : (n, 4, 2) and (n, 8, 8).
    lengths_m : (n,), sides by the rig.
    """

    times_ns: Times
    ids: Times
    corners_px: Array
    covariances_px2: Array
    lengths_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class LevelSightings:
    """Level markers at the heights of the rig, as one camera sees them.

    Attributes
    ----------
    times_ns, ids : (n,), instants of the exposures, and marker ids.
    poses : (n, 3), x and y in m, and heading in rad.
    rises_m : (n,), the height by the size of the marker, minus that of the rig.
    by_motion : (n, 4, 6), slopes of pose and rise by a motion of the camera: a turn about its axes, and a
        shift in the world.
    by_height : (n, 2), slopes of x and y by the height of the marker.
    variances : (n, 4), of the noise of pose and rise.
    """

    times_ns: Times
    ids: Times
    poses: Array
    rises_m: Array
    by_motion: Array
    by_height: Array
    variances: Array

    def select(self, rows: NDArray[Any]) -> Self:
        """Return some rows, by a mask or by numbers."""
        return type(self)(*(getattr(self, one.name)[rows] for one in fields(self)))

    def join(self, other: Self) -> Self:
        """Return the rows of both, sorted by marker and time."""
        both = type(self)(
            *(np.concatenate([getattr(self, one.name), getattr(other, one.name)]) for one in fields(self))
        )
        return both.select(np.lexsort((both.times_ns, both.ids)))


def observe_level(model: JointModel, seen: ImagedMarkers, heights_m: Array) -> LevelSightings:
    """Return the level sightings of markers on robots; markers that are not level are left out.

    Parameters
    ----------
    model : the calibrated camera.
    seen : n markers.
    heights_m : (n,), by the rig.
    """
    inward = edge_motion(seen.corners_px)
    points_m, headings_rad, floor_slopes, _ = start_level(model, seen.corners_px, inward, heights_m)
    arms_m = marker_arms(level_turns(headings_rad), seen.lengths_m * model.scale)
    now = linearise_corners(model, seen.corners_px, inward, points_m, arms_m)
    tilts = now.by_pose[:, :, 3:5] * _TILT_SIGMA_RAD
    floor_px2 = model.corner_floor_px**2 * np.eye(8)
    weights = np.linalg.inv(seen.covariances_px2 + tilts @ tilts.swapaxes(1, 2) + floor_px2)
    by_pose, misses = now.by_pose[:, :, _POSE_AND_HEIGHT], now.residuals[:, :, None]
    by_pose[:, :, :2] += by_pose[:, :, 3:] * floor_slopes[:, None]
    across = by_pose.swapaxes(1, 2) @ weights
    information = across @ by_pose
    # The pose at the height of the rig, and the rise with a free pose.
    level, free = np.linalg.inv(information[:, :3, :3]), np.linalg.inv(information)
    gains = np.concatenate([level @ across[:, :3], (free @ across)[:, 3:]], axis=1)
    changes = (gains @ misses)[:, :, 0]
    left = misses - by_pose @ (free @ (across @ misses))
    chi2 = (left.swapaxes(1, 2) @ weights @ left)[:, 0, 0]
    variances = np.concatenate([level.diagonal(axis1=1, axis2=2), free[:, 3:, 3]], axis=1)
    everything = LevelSightings(
        seen.times_ns,
        seen.ids,
        np.column_stack([points_m[:, :2], headings_rad]) - changes[:, :3],
        -changes[:, 3],
        gains @ now.by_camera[:, :, :_MOTION],
        -(gains[:, :2] @ now.by_pose[:, :, 2:3])[:, :, 0],
        variances,
    )
    # False for NaN.
    return everything.select((chi2 < _MOST_CHI2) & (np.abs(everything.rises_m) < _MOST_RISE_M))


@dataclass(frozen=True, slots=True, eq=False)
class FixedMarker:
    """A reference marker as one camera saw it first: centre (3,), axes (3, 3) in the world, and its side."""

    point_m: Array
    turn: Array
    size_m: float

    @classmethod
    def find(cls, model: JointModel, seen: ImagedMarkers) -> FixedMarker | None:
        """Return the marker from n >= 1 sightings; None if the camera cannot see it by its model."""
        middle = np.median(seen.corners_px, axis=0, keepdims=True)
        poses = locate_poses(model, middle, seen.covariances_px2[:1], seen.lengths_m[:1])
        size_m = float(seen.lengths_m[0] * model.scale)
        return cls(poses.points_m[0], poses.turns[0], size_m) if np.isfinite(poses.turns).all() else None

    def compare(self, model: JointModel, corners_px: Array) -> tuple[Array, Array, Array]:
        """Return the deviation (8,) of corners (4, 2) from where the camera should see them, in px.

        The others are its slopes: (8, 6) by a motion of the camera, and (8, 6) by a motion and a turn of the
        marker.
        """
        arms_m = marker_arms(self.turn[None], np.array([self.size_m]))
        corners_px = corners_px[None]
        now = linearise_corners(model, corners_px, edge_motion(corners_px), self.point_m[None], arms_m)
        return -now.residuals[0], now.by_camera[0, :, :_MOTION], now.by_pose[0]
