"""Sightings of the filter from the positions of one camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Position
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.filter import UNKNOWN_RAD2, Sightings

__all__ = ["read_sightings"]

Array = NDArray[np.float64]

# Noise below this is not resolved: it keeps covariances of known heights positive definite.
_LEAST_M, _LEAST_RAD = 1e-4, 1e-4
# The usual noise of positions and headings that have none: a few hundredths of a pixel.
_USUAL_M, _USUAL_RAD = 3e-4, 3e-3
# The error of a position whose covariance is unknown.
_UNKNOWN_M = 0.005


def read_sightings(camera: str, positions: Sequence[Position], modes: BiasModes) -> Sightings:
    """Return the sightings of positions of one camera.

    Parameters
    ----------
    camera : its name.
    positions : (k,), at least one.
    modes : the errors of the calibration.
    """
    count = len(positions)
    headings = np.array([0.0 if p.heading_rad is None else p.heading_rad for p in positions])
    poses = np.column_stack([[(p.x_m, p.y_m, p.z_m) for p in positions], headings])
    noise = np.zeros((count, 4, 4))
    noise[:, :3, :3] = _LEAST_M**2 * np.eye(3)
    for row, position in enumerate(positions):
        noise[row, :3, :3] += _position_noise(position, camera in modes.tables)
        noise[row, 3, 3] = _heading_variance(position)
    clock_s = np.broadcast_to(modes.clock_of(camera), (count, modes.count))
    return Sightings(poses, noise, modes.at(camera, poses, headings), clock_s)


def _position_noise(position: Position, has_modes: bool) -> Array:
    """Return the covariance (3, 3) of the noise. Without modes, all errors of a position count as noise."""
    if position.covariance_m2 is None:
        return _UNKNOWN_M**2 * np.eye(3)
    if not has_modes:
        return position.covariance_m2
    return _USUAL_M**2 * np.eye(3) if position.noise_m2 is None else position.noise_m2


def _heading_variance(position: Position) -> float:
    if position.heading_rad is None:
        return UNKNOWN_RAD2
    if position.heading_noise_rad is None:
        return _USUAL_RAD**2
    return position.heading_noise_rad**2 + _LEAST_RAD**2
