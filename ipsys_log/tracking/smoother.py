"""Smoothing of a whole track: the state at each instant, by the sightings before and after it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.tracking.filter import States, predict
from ipsys_log.tracking.motion import MOTION, MotionNoise, transition

__all__ = ["smooth"]

Array = NDArray[np.float64]

_HEADING = 3


def smooth(filtered: States, durations_s: Array, noise: MotionNoise) -> States:
    """Return the states of one track by all its sightings.

    The amplitudes of the calibration are constant over the track. Smoothing therefore reduces their
    uncertainty only by the differences between cameras. The error that all cameras share stays.

    Parameters
    ----------
    filtered : n states of one robot in order of time, each after the sightings of its instant.
    durations_s : (n - 1,), times between the states, more than 0.
    noise : the usual motion, as in the filter.

    Returns
    -------
    States : n.

    References
    ----------
    Rauch, Tung and Striebel, AIAA Journal 1965. The covariance is in the form of Joseph, a sum of squares.
    """
    before = States(filtered.means[:-1], filtered.covariances[:-1])
    ahead = predict(before, durations_s, noise)
    gains, spread = _gains(before, ahead, durations_s, noise)
    means, covariances = filtered.means.copy(), filtered.covariances.copy()
    for n in range(len(durations_s) - 1, -1, -1):
        change = means[n + 1] - ahead.means[n]
        change[_HEADING] = (change[_HEADING] + np.pi) % (2 * np.pi) - np.pi
        means[n] += gains[n] @ change
        covariances[n] = spread[n] + gains[n] @ covariances[n + 1] @ gains[n].T
    return States(means, (covariances + covariances.swapaxes(1, 2)) / 2)


def _gains(before: States, ahead: States, durations_s: Array, noise: MotionNoise) -> tuple[Array, Array]:
    """Return the gains (n, s, s) of each state by the next one, and its covariance if that one is known."""
    forward, motion = transition(durations_s, noise)
    cross = before.covariances.copy()
    cross[:, :, :MOTION] = before.covariances[:, :, :MOTION] @ forward.swapaxes(1, 2)
    # Units differ by many orders of magnitude: with a diagonal of 1, the inverse loses no digits.
    units = np.sqrt(np.diagonal(ahead.covariances, axis1=1, axis2=2))
    scaled = ahead.covariances / units[:, :, None] / units[:, None]
    gains = np.linalg.solve(scaled, (cross / units[:, None]).swapaxes(1, 2)).swapaxes(1, 2) / units[:, None]
    kept = -gains
    kept[:, :, :MOTION] = -gains[:, :, :MOTION] @ forward
    diagonal = np.arange(kept.shape[1])
    kept[:, diagonal, diagonal] += 1.0
    own = gains[:, :, :MOTION]
    spread = kept @ before.covariances @ kept.swapaxes(1, 2) + own @ motion @ own.swapaxes(1, 2)
    return gains, spread
