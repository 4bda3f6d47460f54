"""Rotations of many bodies at once."""

from __future__ import annotations

import numpy as np

from ipsys_log.messages.arrays import Array


def rotate(vectors_rad: Array) -> Array:
    """Return rotation matrices (n, 3, 3) of rotation vectors (n, 3)."""
    # Late: most commands rotate nothing, and scipy takes long to load.
    from scipy.spatial.transform import Rotation

    if not len(vectors_rad):
        return np.zeros((0, 3, 3))
    return np.asarray(Rotation.from_rotvec(vectors_rad).as_matrix(), dtype=np.float64)


def quaternion(rotation: Array) -> tuple[float, float, float, float]:
    """Return the quaternion (x, y, z, w) of a rotation matrix (3, 3)."""
    # Late: most commands rotate nothing, and scipy takes long to load.
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return x, y, z, w


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
    """Return the matrices (n, 3, 3) of the cross product with each vector (n, 3)."""
    skew = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -z, y, -x
    skew[:, 1, 0], skew[:, 2, 0], skew[:, 2, 1] = z, -y, x
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
