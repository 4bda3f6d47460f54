"""Poses of single markers in level camera coordinates: the raw material of the start of the fit."""

from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.observations import Body, Sightings
from ipsys_log.messages import Array, CameraCalibration
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.square_pose import solve_squares

# Normals of markers that lie on one floor agree within this angle, in one of the two poses of each marker.
_ALIKE_RAD = np.radians(8.0)
_CANDIDATES = 200
# First coefficients of the distortion of nominal intrinsics, and the number of markers that are compared.
_COEFFICIENTS = np.linspace(-0.4, 0.2, 13)
_FEW = 60
_ROUNDS = 5


@dataclass(frozen=True, slots=True, eq=False)
class MarkerViews:
    """Markers as one camera sees them, in coordinates with the camera's position and z up.

    ``lens`` are the intrinsics of the camera. ``level_from_camera`` is (3, 3). ``points_m`` (n, 3) are the
    centres, ``headings_rad`` (n,) the headings, ``rays`` (n, 3) the directions to the centres. A marker that
    the lens model cannot reach is NaN.
    """

    lens: CameraCalibration
    level_from_camera: Array
    points_m: Array
    headings_rad: Array
    rays: Array


def view_markers(sightings: Sightings, bodies: tuple[Body, ...], lens: CameraCalibration) -> MarkerViews:
    """Return the markers in level coordinates; the normals of the markers define the vertical."""
    count = len(sightings)
    uv = undistort(sightings.pixels.reshape(-1, 2), lens).reshape(count, 4, 2)
    valid = np.isfinite(uv).all(axis=(1, 2))
    sides_m = np.array([body.length_m for body in bodies])
    rotations = np.full((count, 2, 3, 3), np.nan)
    centres_m = np.full((count, 2, 3), np.nan)
    rotations[valid], centres_m[valid] = solve_squares(uv[valid], sides_m[sightings.body[valid]])
    up, _ = _common_normal(rotations[valid][..., 2])
    level = _level_from_up(up)
    best = (rotations[..., 2] @ up).argmax(axis=1)
    row = np.arange(count)
    sides = rotations[row, best][:, :, 1] @ level.T
    rays = np.concatenate([uv.mean(axis=1), np.ones((count, 1))], axis=1) @ level.T
    return MarkerViews(
        lens, level, centres_m[row, best] @ level.T, np.arctan2(sides[:, 1], sides[:, 0]), rays
    )


def guess_distortion(sightings: Sightings, lens: CameraCalibration) -> CameraCalibration:
    """Return a nominal calibration with the first coefficient of the distortion for which normals agree best.

    With a wrong distortion, the markers on a flat floor seem to lie on a bowl.
    """
    few = sightings.select(np.arange(0, len(sightings), max(1, len(sightings) // _FEW)))
    sides_m = np.ones(len(few))
    costs = []
    for coefficient in _COEFFICIENTS:
        curved = _with_coefficient(lens, coefficient)
        uv = undistort(few.pixels.reshape(-1, 2), curved).reshape(len(few), 4, 2)
        valid = np.isfinite(uv).all(axis=(1, 2))
        rotations, _ = solve_squares(uv[valid], sides_m[valid])
        costs.append(_common_normal(rotations[..., 2])[1] + int((~valid).sum()))
    return _with_coefficient(lens, float(_COEFFICIENTS[int(np.argmin(costs))]))


def _with_coefficient(lens: CameraCalibration, coefficient: float) -> CameraCalibration:
    return replace(lens, D=np.r_[coefficient, lens.D[1:]])


def _common_normal(normals: Array) -> tuple[Array, float]:
    """Return the direction (3,) that most markers share, from two candidates each (n, 2, 3), and its cost."""
    if not len(normals):
        return np.array([0.0, 0.0, -1.0]), 0.0
    candidates = normals[:: max(1, len(normals) // _CANDIDATES)].reshape(-1, 3)
    angles = np.arccos(np.clip(np.einsum("nkd,cd->cnk", normals, candidates), -1, 1)).min(axis=2)
    losses = np.minimum(angles / _ALIKE_RAD, 1.0) ** 2
    up = candidates[losses.sum(axis=1).argmin()]
    for _ in range(_ROUNDS):
        cosines = normals @ up
        own = normals[np.arange(len(normals)), cosines.argmax(axis=1)]
        near = cosines.max(axis=1) > np.cos(_ALIKE_RAD)
        up = own[near].sum(axis=0) if near.any() else up
        up = up / np.linalg.norm(up)
    angles = np.arccos(np.clip(normals @ up, -1, 1)).min(axis=1)
    return np.asarray(up), float((np.minimum(angles / _ALIKE_RAD, 1.0) ** 2).sum())


def _level_from_up(up: Array) -> Array:
    """Return a rotation (3, 3) that turns the direction ``up`` to z."""
    across = np.eye(3)[np.abs(up).argmin()]
    x = np.cross(across, up)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])
