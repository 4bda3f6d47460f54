"""Rigid poses as (4, 4) matrices, rotations of many bodies at once, and cameras with a pose in the world."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, hypot, sin

import cv2
import numpy as np

from ipsys_log.messages import Array, CameraCalibration


def make_pose(rotation_matrix: Array, origin_m: Array) -> Array:
    """Return ``a_from_b`` from the axes of b, as columns in a, and the origin of b in a, in m.

    Parameters
    ----------
    rotation_matrix : (3, 3).
    origin_m : (3,).

    Returns
    -------
    (4, 4).
    """
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix
    pose[:3, 3] = origin_m
    return pose


def invert_pose(a_from_b: Array) -> Array:
    """Return ``b_from_a``, (4, 4), by the transpose of the rotation."""
    b_axes = a_from_b[:3, :3].T
    return make_pose(b_axes, -b_axes @ a_from_b[:3, 3])


def transform(a_from_b: Array, points_b_m: Array) -> Array:
    """Return points given in coordinates b in coordinates a, both (n, 3) in m.

    Examples
    --------
    >>> transform(make_pose(np.eye(3), np.array([1.0, 2.0, 3.0])), np.zeros((1, 3))).tolist()
    [[1.0, 2.0, 3.0]]
    """
    moved: Array = points_b_m @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved


def rotation(vector_rad: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), which is axis times angle in rad."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector_rad, dtype=np.float64))[0], dtype=np.float64)


def rotation_vector(rotation_matrix: Array) -> Array:
    """Return the rotation vector (3,), axis times angle in rad, of a rotation matrix (3, 3)."""
    return np.asarray(cv2.Rodrigues(rotation_matrix)[0], dtype=np.float64).ravel()


def rotation_between(from_m: Array, to_m: Array) -> tuple[Array, float]:
    """Return the best rotation (d, d) and scale from points (n, d) to others, both around 0.

    References
    ----------
    Umeyama, IEEE PAMI 1991, eq. (40) to (42).
    """
    left, sizes, right = np.linalg.svd(to_m.T @ from_m)
    signs = np.ones(len(sizes))
    signs[-1] = np.sign(np.linalg.det(left) * np.linalg.det(right))
    return (left * signs) @ right, float((sizes * signs).sum() / (from_m**2).sum())


def pose_facing_up(x_m: float, y_m: float, z_m: float, heading_rad: float) -> Array:
    """Return ``world_from_marker``, (4, 4), of a marker that faces up.

    The marker's y axis is the side from corner 3 to corner 0. The heading is the angle of this axis, from
    world x towards world y.

    Examples
    --------
    >>> world_from_marker = pose_facing_up(1.0, 2.0, 0.1, np.pi / 2)
    >>> transform(world_from_marker, np.array([[0.1, 0.0, 0.0]])).round(9).tolist()
    [[1.1, 2.0, 0.1]]
    """
    turn = rotation(np.array([0.0, 0.0, heading_rad - np.pi / 2]))
    return make_pose(turn, np.array([x_m, y_m, z_m]))


def look_down(origin_m: Array, tilt_rad: Array | None = None) -> Array:
    """Return ``camera_from_world``, (4, 4), of a camera that looks down at the floor.

    The camera's x axis is the world's x axis, and its y axis is minus the world's y axis. Its image shows the
    floor from above, with world y up.

    Parameters
    ----------
    origin_m : (3,), camera position in the world.
    tilt_rad : (3,), rotation vector in camera coordinates that turns the camera away from the plumb line.
    """
    camera_from_plumb = np.eye(3) if tilt_rad is None else rotation(tilt_rad)
    axes = camera_from_plumb @ np.diag([1.0, -1.0, -1.0])
    return make_pose(axes, -axes @ np.asarray(origin_m, dtype=np.float64))


def rotate(vectors_rad: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    # Late: most commands rotate nothing, and scipy takes long to load.
    from scipy.spatial.transform import Rotation

    if not len(vectors_rad):
        return np.zeros((0, 3, 3))
    return np.asarray(Rotation.from_rotvec(vectors_rad).as_matrix(), dtype=np.float64)


def rotation_vectors(rotations: Array) -> Array:
    """Return rotation vectors (n, 3) of rotation matrices (n, 3, 3): the inverse of :func:`rotate`."""
    # Late: most commands rotate nothing, and scipy takes long to load.
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_rotvec(), dtype=np.float64)


def quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a rotation matrix (3, 3)."""
    # Late: most commands rotate nothing, and scipy takes long to load.
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return x, y, z, w


def vector_quaternion(vector_rad: Array) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a rotation vector (3,)."""
    # A turn about one axis keeps every digit of its sine and cosine.
    x, y, z = np.asarray(vector_rad, dtype=np.float64).tolist()
    angle_rad = hypot(x, y, z)
    size = angle_rad or 1.0
    half = sin(angle_rad / 2)
    return x / size * half, y / size * half, z / size * half, cos(angle_rad / 2)


def turn_about_z(angle_rad: float) -> Array:
    """Return the rotation (3, 3) about the z axis; its zeros and ones are exact."""
    c, s = cos(angle_rad), sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def turns_about_z(angles_rad: Array) -> Array:
    """Return rotations (n, 3, 3) about the z axis by angles (n,); NaN for an angle that is NaN."""
    c, s, none = np.cos(angles_rad), np.sin(angles_rad), 0.0 * angles_rad
    return np.moveaxis(np.array([[c, -s, none], [s, c, none], [none, none, none + 1.0]]), 2, 0)


def level_turns(headings_rad: Array) -> Array:
    """Return ``world_from_marker`` rotations (n, 3, 3) of markers that face up, with headings (n,).

    The heading is the direction of the marker's y axis, as in
    :func:`ipsys_log.vision.poses.pose_facing_up`.
    """
    cos, sin = np.sin(headings_rad), -np.cos(headings_rad)
    turns = np.zeros((len(headings_rad), 3, 3))
    turns[:, 0, 0] = turns[:, 1, 1] = cos
    turns[:, 1, 0], turns[:, 0, 1] = sin, -sin
    turns[:, 2, 2] = 1.0
    return turns


def cross(first: Array, second: Array) -> Array:
    """Return cross products (..., 3). numpy's own function takes three times as long for few vectors."""
    a, b, c = first[..., 0], first[..., 1], first[..., 2]
    x, y, z = second[..., 0], second[..., 1], second[..., 2]
    product = np.empty(np.broadcast_shapes(first.shape, second.shape))
    product[..., 0], product[..., 1], product[..., 2] = b * z - c * y, c * x - a * z, a * y - b * x
    return product


def skew_matrices(vectors: Array) -> Array:
    """Return the matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    skew = np.zeros((*vectors.shape, 3))
    x, y, z = vectors[..., 0], vectors[..., 1], vectors[..., 2]
    skew[..., 0, 1], skew[..., 0, 2], skew[..., 1, 2] = -z, y, -x
    skew[..., 1, 0], skew[..., 2, 0], skew[..., 2, 1] = z, -y, x
    return skew


def left_jacobians(vectors_rad: Array) -> Array:
    """Return matrices (n, 3, 3) from a change of rotation vectors (n, 3) to the turn in fixed axes.

    References
    ----------
    Barfoot, State estimation for robotics, 2017, eq. (7.77).
    """
    angles = np.sqrt((vectors_rad * vectors_rad).sum(axis=1))
    small = angles < 1e-4
    safe = np.where(small, 1.0, angles)
    first = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    second = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    skew = skew_matrices(vectors_rad)
    return np.asarray(np.eye(3) + first[:, None, None] * skew + second[:, None, None] * skew @ skew)


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
