"""Rigid bodies with markers: the poses of their markers, their pivots, and the poses of tracks.

Axes of a marker: x to the top of its print (the direction of its heading), y to its left, z out of it. A body
has those of its first marker, if this one has no pose of its own.
"""

from dataclasses import dataclass
from math import atan2, hypot

import numpy as np

from ipsys_log.messages import Array, Rig, Track
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import (
    level_turns,
    make_pose,
    rotation,
    transform,
    turn_about_z,
    vector_quaternion,
)

# Relative error of a printed side, and of a distance that is measured by hand.
_SCALE_SIGMA = 0.001


@dataclass(frozen=True, slots=True, eq=False)
class BodyShape:
    """The markers of a body whose poses are known.

    Attributes
    ----------
    robot : its name.
    id : the id of its first marker, also if the pose of that one is unknown.
    is_level : it stays level.
    is_measured : the poses of its markers are known. Otherwise it has one marker of the nominal size.
    scale_sigma : relative standard deviation of its size.
    markers : by marker id, the poses (4, 4) of the markers in the coordinates of the body.
    corners_m : by marker id, their corners (4, 3) in these coordinates, in the order of OpenCV.
    body_from_pivot : (4, 4).
    """

    robot: str
    id: int
    is_level: bool
    is_measured: bool
    scale_sigma: float
    markers: dict[int, Array]
    corners_m: dict[int, Array]
    body_from_pivot: Array


def body_shapes(rig: Rig) -> tuple[BodyShape, ...]:
    """Return the bodies of a rig, in its order."""
    shapes = []
    for body in rig.bodies:
        own = [marker for marker in rig.markers if marker.robot == body.robot]
        markers = {
            marker.id: pose_from_rpy(marker.xyz_m, marker.rpy_rad)
            for number, marker in enumerate(own)
            if not number or marker.xyz_m
        }
        corners_m = {
            marker_id: transform(pose, marker_corners_m(rig.length_of(marker_id)))
            for marker_id, pose in markers.items()
        }
        pivot = pose_from_rpy(body.pivot_m, body.pivot_rpy_rad)
        measured = any(marker.xyz_m for marker in own)
        sigma = _SCALE_SIGMA if body.scale_sigma is None else body.scale_sigma
        shapes.append(
            BodyShape(body.robot, own[0].id, body.level, measured, sigma, markers, corners_m, pivot)
        )
    return tuple(shapes)


def marker_corners_m(length_m: float) -> Array:
    """Return the corners (4, 3) of a marker in its own axes, in the order of OpenCV."""
    return np.asarray(marker_corners(length_m) @ level_turns(np.zeros(1))[0].T)


def pose_from_rpy(origin_m: tuple[float, ...], rpy_rad: tuple[float, ...]) -> Array:
    """Return a pose (4, 4) from an origin, and from roll, pitch and yaw about fixed axes; empty: none.

    Examples
    --------
    >>> pose_from_rpy((1.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2))[:3, 0].round(9).tolist()
    [0.0, 1.0, 0.0]
    """
    roll, pitch, yaw = (
        rotation(angle * axis) for angle, axis in zip(rpy_rad or (0.0,) * 3, np.eye(3), strict=True)
    )
    return make_pose(yaw @ pitch @ roll, np.array(origin_m or (0.0,) * 3))


def rpy_from_rotation(rotation_matrix: Array) -> tuple[float, float, float]:
    """Return roll, pitch and yaw about fixed axes from a rotation (3, 3): the inverse of `pose_from_rpy`."""
    r = rotation_matrix
    roll, yaw = np.arctan2(r[2, 1], r[2, 2]), np.arctan2(r[1, 0], r[0, 0])
    return float(roll), float(np.arctan2(-r[2, 0], np.hypot(r[0, 0], r[1, 0]))), float(yaw)


def track_rotation(track: Track) -> Array:
    """Return the rotation (3, 3) from the axes of a robot to those of the world.

    A level robot turns about the vertical by its heading; without a heading, its axes are those of the world.
    """
    if track.rotation_rad is not None:
        return rotation(track.rotation_rad)
    return turn_about_z(track.heading_rad or 0.0)


def track_tilt_rad(track: Track) -> float:
    """Return the angle between the vertical and the z axis of a robot."""
    x, y, z = track_rotation(track)[:, 2].tolist()
    return atan2(hypot(x, y), z)


def track_quaternion(track: Track) -> tuple[float, float, float, float]:
    """Return the same as a quaternion (x, y, z, w)."""
    level_rad = np.array([0.0, 0.0, track.heading_rad or 0.0])
    return vector_quaternion(level_rad if track.rotation_rad is None else track.rotation_rad)
