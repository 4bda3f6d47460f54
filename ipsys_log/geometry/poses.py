"""Rigid poses as (4, 4) matrices, named so that chains cancel: ``a_from_b @ b_from_c``."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["invert_pose", "lay_flat", "look_down", "make_pose", "rotation", "rotation_vector", "transform"]

Array = NDArray[np.float64]


def make_pose(rotation_matrix: Array, origin_m: Array) -> Array:
    """``a_from_b`` from the axes of b, as columns in a, and the origin of b in a, in m.

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
    """``b_from_a``, (4, 4), by the transpose of the rotation."""
    b_axes = a_from_b[:3, :3].T
    return make_pose(b_axes, -b_axes @ a_from_b[:3, 3])


def transform(a_from_b: Array, points_b_m: Array) -> Array:
    """Points of frame b in frame a, both (n, 3) in m.

    Examples
    --------
    >>> transform(make_pose(np.eye(3), np.array([1.0, 2.0, 3.0])), np.zeros((1, 3))).tolist()
    [[1.0, 2.0, 3.0]]
    """
    moved: Array = points_b_m @ a_from_b[:3, :3].T + a_from_b[:3, 3]
    return moved


def rotation(vector_rad: Array) -> Array:
    """Rotation matrix (3, 3) of a rotation vector (3,): axis times angle in rad."""
    return np.asarray(cv2.Rodrigues(np.asarray(vector_rad, dtype=np.float64))[0], dtype=np.float64)


def rotation_vector(rotation_matrix: Array) -> Array:
    """Axis times angle in rad, (3,), of a rotation matrix (3, 3)."""
    return np.asarray(cv2.Rodrigues(rotation_matrix)[0], dtype=np.float64).ravel()


def lay_flat(x_m: float, y_m: float, z_m: float, heading_rad: float) -> Array:
    """``world_from_marker`` of a marker that faces up, (4, 4).

    The heading is the angle, from world x to world y, of the marker's side from corner 3 to corner 0,
    which is the marker's y axis.

    Examples
    --------
    >>> world_from_marker = lay_flat(1.0, 2.0, 0.1, np.pi / 2)
    >>> transform(world_from_marker, np.array([[0.1, 0.0, 0.0]])).round(9).tolist()
    [[1.1, 2.0, 0.1]]
    """
    turn = rotation(np.array([0.0, 0.0, heading_rad - np.pi / 2]))
    return make_pose(turn, np.array([x_m, y_m, z_m]))


def look_down(origin_m: Array, tilt_rad: Array | None = None) -> Array:
    """``camera_from_world`` of a camera that looks at the floor, (4, 4).

    Its x axis is the world's, its y axis minus the world's, so that its image shows the floor as seen
    from above, with y up.

    Parameters
    ----------
    origin_m : (3,), where it hangs, in the world.
    tilt_rad : (3,), rotation vector in the frame of the camera that takes it from the plumb line.
    """
    camera_from_plumb = np.eye(3) if tilt_rad is None else rotation(tilt_rad)
    axes = camera_from_plumb @ np.diag([1.0, -1.0, -1.0])
    return make_pose(axes, -axes @ np.asarray(origin_m, dtype=np.float64))
