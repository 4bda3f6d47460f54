"""Sightings of the filter from the positions of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Position
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.filter import UNKNOWN_RAD2, Sightings

__all__ = ["has_covariance", "is_usable", "read_sightings"]

Array = NDArray[np.float64]

# Noise below this is not resolved: it keeps covariances of known heights positive definite.
_LEAST_M, _LEAST_RAD = 1e-4, 1e-4
# The usual noise of positions and headings that have none: a few hundredths of a pixel.
_USUAL_M, _USUAL_RAD = 3e-4, 3e-3
# The error of a position whose covariance is unknown.
_UNKNOWN_M = 0.005
# No lab is larger, and no heading has a larger error.
_FARTHEST_M, _LARGEST_RAD = 1e6, 10.0
_PLACE = np.arange(3)


def is_usable(position: Position) -> bool:
    """Return whether a position is a place; the log of another program may hold other numbers."""
    return all(abs(value_m) < _FARTHEST_M for value_m in (position.x_m, position.y_m, position.z_m))


def has_covariance(position: Position) -> bool:
    """Return whether the covariance of a position is known and positive definite."""
    return position.covariance_m2 is not None and _is_covariance(position.covariance_m2)


def read_sightings(camera: str, positions: Sequence[Position], modes: BiasModes) -> Sightings:
    """Return the sightings of positions of one camera.

    Parameters
    ----------
    camera : its name.
    positions : (k,), at least one, all of them usable.
    modes : the errors of the calibration.
    """
    count = len(positions)
    noise = np.zeros((count, 4, 4))
    headings = np.zeros(count)
    for row, position in enumerate(positions):
        noise[row, :3, :3] = _position_noise(position, camera in modes.tables)
        headings[row], noise[row, 3, 3] = _heading(position)
    noise[:, _PLACE, _PLACE] += _LEAST_M**2
    poses = np.column_stack([[(p.x_m, p.y_m, p.z_m) for p in positions], headings])
    clock_s = np.broadcast_to(modes.clock_of(camera), (count, modes.count))
    return Sightings(poses, noise, modes.at(camera, poses, headings), clock_s)


def _position_noise(position: Position, has_modes: bool) -> Array:
    """Return the covariance (3, 3) of the noise. Without modes, all errors of a position count as noise."""
    covariance_m2, noise_m2 = position.covariance_m2, position.noise_m2
    if covariance_m2 is None or not _is_covariance(covariance_m2):
        return _UNKNOWN_M**2 * np.eye(3)
    if not has_modes:
        return covariance_m2
    # The noise of a marker on a flat floor has no vertical part.
    if noise_m2 is None or not _is_covariance(noise_m2 + _LEAST_M**2 * np.eye(3)):
        return _USUAL_M**2 * np.eye(3)
    return noise_m2


def _is_covariance(covariance_m2: Array) -> bool:
    (xx, xy, xz), (_, yy, yz), (_, _, zz) = covariance_m2.tolist()
    minor = xx * yy - xy * xy
    determinant = zz * minor - yz * (xx * yz - xy * xz) + xz * (xy * yz - yy * xz)
    return (
        0 < xx < _FARTHEST_M
        and 0 < yy < _FARTHEST_M
        and 0 < zz < _FARTHEST_M
        and minor > 0
        and determinant > 0
    )


def _heading(position: Position) -> tuple[float, float]:
    """Return the heading of a position, and the variance of its noise."""
    heading_rad, noise_rad = position.heading_rad, position.heading_noise_rad
    if heading_rad is None or not isfinite(heading_rad):
        return 0.0, UNKNOWN_RAD2
    if noise_rad is None or not 0 <= noise_rad < _LARGEST_RAD:
        return heading_rad, _USUAL_RAD**2
    return heading_rad, noise_rad**2 + _LEAST_RAD**2
