"""Rigid poses as (4, 4) matrices. Their names show valid products: ``a_from_b @ b_from_c`` is a_from_c."""

from __future__ import annotations

import cv2
import numpy as np

from ipsys_log.messages.arrays import Array


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
