"""Sightings of the filter from the positions of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ipsys_log.arrays import Array
from ipsys_log.messages import Position
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.filter import UNKNOWN_RAD2, Sightings

# Noise below this is not resolved: it keeps covariances of known heights positive definite.
_LEAST_M, _LEAST_RAD = 1e-4, 1e-4
# The usual noise of positions and headings that have none: a few hundredths of a pixel.
_USUAL_M, _USUAL_RAD = 3e-4, 3e-3
# The error of a position whose covariance is unknown.
_UNKNOWN_M = 0.005
# No lab is larger, and no heading has a larger error.
_FARTHEST_M, _LARGEST_RAD = 1e6, 10.0
_PLACE, _UNKNOWN = np.arange(3), np.full((3, 3), np.nan)
_LEAST_EYE_M2, _USUAL_EYE_M2, _UNKNOWN_EYE_M2 = (
    sigma_m**2 * np.eye(3) for sigma_m in (_LEAST_M, _USUAL_M, _UNKNOWN_M)
)


def is_usable(position: Position) -> bool:
    """Return whether a position is a place; the log of another program may hold other numbers."""
    return (
        -_FARTHEST_M < position.x_m < _FARTHEST_M
        and -_FARTHEST_M < position.y_m < _FARTHEST_M
        and -_FARTHEST_M < position.z_m < _FARTHEST_M
    )


def read_sightings(
    camera: str, positions: Sequence[Position], modes: BiasModes
) -> tuple[Sightings, NDArray[np.bool_]]:
    """Return the sightings of positions of one camera.

    Parameters
    ----------
    camera : its name.
    positions : (k,), at least one, all of them usable.
    modes : the errors of the calibration.

    Returns
    -------
    sightings : (k,).
    has_covariance : (k,), whether the covariance of a position is known and positive definite.
    """
    count = len(positions)
    noise, measured = np.zeros((count, 4, 4)), np.array([_heading(position) for position in positions])
    headings, noise[:, 3, 3] = measured[:, 0], measured[:, 1]
    noise[:, :3, :3], has_covariance = _position_noise(positions, camera in modes.tables)
    noise[:, _PLACE, _PLACE] += _LEAST_M**2
    poses = np.empty((count, 4))
    poses[:, :3], poses[:, 3] = [(p.x_m, p.y_m, p.z_m) for p in positions], headings
    clock_s = np.broadcast_to(modes.clock_of(camera), (count, modes.count))
    return Sightings(poses, noise, modes.at(camera, poses, headings), clock_s), has_covariance


def _position_noise(positions: Sequence[Position], has_modes: bool) -> tuple[Array, NDArray[np.bool_]]:
    """Return the covariances (k, 3, 3) of the noise, and a mask of the positions with a covariance.

    Without modes, all errors of a position count as noise.
    """
    covariances_m2 = [_UNKNOWN if p.covariance_m2 is None else p.covariance_m2 for p in positions]
    if not has_modes:
        noise_m2 = np.array(covariances_m2)
        known = _are_covariances(noise_m2)
    else:
        noises_m2 = [_UNKNOWN if p.noise_m2 is None else p.noise_m2 for p in positions]
        both_m2 = np.array([covariances_m2, noises_m2])
        noise_m2 = both_m2[1].copy()
        # The noise of a marker on a flat floor has no vertical part.
        both_m2[1] += _LEAST_EYE_M2
        known, stated = _are_covariances(both_m2)
        noise_m2 = np.where(stated[:, None, None], noise_m2, _USUAL_EYE_M2)
    return np.where(known[:, None, None], noise_m2, _UNKNOWN_EYE_M2), known


def _are_covariances(matrices_m2: Array) -> NDArray[np.bool_]:
    """Return a mask (...) of the positive definite ones of matrices (..., 3, 3), by their minors."""
    rows = matrices_m2.reshape(*matrices_m2.shape[:-2], 9)
    xx, xy, xz, _, yy, yz, _, _, zz = rows.transpose(-1, *range(rows.ndim - 1))  # faster than np.moveaxis
    usable = (np.abs(rows) < _FARTHEST_M).all(axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        minor = xx * yy - xy * xy
        determinant = zz * minor - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
    return np.asarray(usable & (xx > 0) & (yy > 0) & (zz > 0) & (minor > 0) & (determinant > 0))


def _heading(position: Position) -> tuple[float, float]:
    """Return the heading of a position, and the variance of its noise."""
    heading_rad, noise_rad = position.heading_rad, position.heading_noise_rad
    if heading_rad is None or not isfinite(heading_rad):
        return 0.0, UNKNOWN_RAD2
    if noise_rad is None or not 0 <= noise_rad < _LARGEST_RAD:
        return heading_rad, _USUAL_RAD**2
    return heading_rad, noise_rad**2 + _LEAST_RAD**2
