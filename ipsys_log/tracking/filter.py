"""Filter of the motion of robots, whose positions share the errors of the calibration.

The state of a robot is its motion (see :mod:`ipsys_log.tracking.motion`) and m amplitudes of the calibration
(see :mod:`ipsys_log.tracking.bias_modes`). The amplitudes are standard normal numbers before the first sighting.
All functions take k robots at once, each at its own time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.tracking.motion import MOTION, POSE, RATES, MotionNoise, transition

__all__ = ["UNKNOWN_RAD2", "Innovations", "Sightings", "States", "compare", "predict", "start", "update"]

Array = NDArray[np.float64]

# The variance of a heading that was not measured: its weight is 0 in double precision.
UNKNOWN_RAD2 = 1e6
_START_HEADING_RAD2 = np.pi**2


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """The states of k robots: ``means`` (k, n) and ``covariances`` (k, n, n), with n = 10 + m."""

    means: Array
    covariances: Array

    def take(self, rows: NDArray[np.intp]) -> States:
        """Return the states of some robots."""
        return States(self.means[rows], self.covariances[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The sightings of k robots, one of each.

    Attributes
    ----------
    poses : (k, 4), x, y, z in m and heading in rad; a heading that was not measured is 0.
    noise : (k, 4, 4), covariance of the noise, without the calibration; :data:`UNKNOWN_RAD2` for a heading
        that was not measured.
    sensitivities : (k, 4, m), errors of the poses by the amplitudes of the calibration.
    clock_s : (k, m), errors of the times by the amplitudes of the calibration.
    """

    poses: Array
    noise: Array
    sensitivities: Array
    clock_s: Array

    def take(self, rows: NDArray[np.intp]) -> Sightings:
        """Return the sightings of some robots."""
        return Sightings(self.poses[rows], self.noise[rows], self.sensitivities[rows], self.clock_s[rows])


def start(sightings: Sightings, noise: MotionNoise) -> States:
    """Return the states of new tracks, after their first sightings."""
    count, m = len(sightings.poses), sightings.sensitivities.shape[2]
    means, covariances = np.zeros((count, MOTION + m)), np.zeros((count, MOTION + m, MOTION + m))
    means[:, POSE] = sightings.poses
    modes = sightings.sensitivities
    covariances[:, POSE, POSE] = sightings.noise + modes @ modes.swapaxes(1, 2)
    # A sighting is the pose plus the errors, so that the pose is the sighting minus the errors.
    covariances[:, POSE, MOTION:] = -modes
    covariances[:, MOTION:, POSE] = -modes.swapaxes(1, 2)
    unknown = sightings.noise[:, 3, 3] >= UNKNOWN_RAD2
    covariances[unknown, 3, 3] = _START_HEADING_RAD2
    rates = [noise.start_m_s**2, noise.start_m_s**2, noise.climb_m_s2**2, noise.start_rad_s**2]
    other = np.arange(4, MOTION + m)
    covariances[:, other, other] = [*rates, *[noise.acceleration_m_s2**2] * 2, *[1.0] * m]
    return States(means, covariances)


def predict(states: States, durations_s: Array, noise: MotionNoise) -> States:
    """Return the states after durations (k,) in s, which are at least 0."""
    forward, spread = transition(durations_s, noise)
    means, old = states.means.copy(), states.covariances
    means[:, :MOTION] = (forward @ means[:, :MOTION, None])[:, :, 0]
    covariances = old.copy()
    moved = forward @ old[:, :MOTION, :MOTION] @ forward.swapaxes(1, 2) + spread
    covariances[:, :MOTION, :MOTION] = (moved + moved.swapaxes(1, 2)) / 2
    covariances[:, :MOTION, MOTION:] = across = forward @ old[:, :MOTION, MOTION:]
    covariances[:, MOTION:, :MOTION] = across.swapaxes(1, 2)
    return States(means, covariances)


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """The differences of k sightings from predicted states.

    Attributes
    ----------
    differences : (k, 4), sighting minus prediction, in m and rad; 0 for a heading that was not measured.
    covariances : (k, 4, 4), of the differences.
    modes : (k, 4, m), sensitivities of the sightings with the errors of their times.
    cross : (k, n, 4), covariance of the state and the prediction of the sighting.
    """

    differences: Array
    covariances: Array
    modes: Array
    cross: Array

    @property
    def chi2(self) -> Array:
        """The squared differences (k,) in units of their covariances: with 4 degrees of freedom, or 3."""
        solved = np.linalg.solve(self.covariances, self.differences[:, :, None])
        return np.asarray((self.differences[:, None] @ solved)[:, 0, 0])


def compare(states: States, sightings: Sightings) -> Innovations:
    """Return the differences of sightings from states that are predicted to the times of the sightings."""
    # A camera whose clock is late by d shows the robot v d behind.
    modes = sightings.sensitivities - states.means[:, RATES, None] * sightings.clock_s[:, None]
    differences = sightings.poses - states.means[:, POSE]
    differences -= (modes @ states.means[:, MOTION:, None])[:, :, 0]
    known = sightings.noise[:, 3, 3] < UNKNOWN_RAD2
    differences[:, 3] = np.where(known, (differences[:, 3] + np.pi) % (2 * np.pi) - np.pi, 0.0)
    cross = states.covariances[:, :, POSE] + states.covariances[:, :, MOTION:] @ modes.swapaxes(1, 2)
    covariances = cross[:, POSE] + modes @ cross[:, MOTION:] + sightings.noise
    return Innovations(differences, covariances, modes, cross)


def update(states: States, sightings: Sightings, innovations: Innovations, consider: bool = False) -> States:
    """Return the states after their sightings, by the Joseph form.

    Parameters
    ----------
    states : predicted to the times of the sightings.
    sightings : of the same k robots.
    innovations : from :func:`compare`.
    consider : keep the amplitudes of the calibration as they are (Schmidt-Kalman filter), and only take their
        uncertainty into account.

    References
    ----------
    Schmidt, Advances in Control Systems 1966. Bucy and Joseph, Filtering for Stochastic Processes, 1968.
    """
    gains = innovations.cross @ np.linalg.inv(innovations.covariances)
    if consider:
        gains[:, MOTION:] = 0.0
    across = gains.swapaxes(1, 2)
    means = states.means + (gains @ innovations.differences[:, :, None])[:, :, 0]
    # (1 - K H) P (1 - K H)' + K R K', with one factor after the other: H has only four rows.
    left = states.covariances - gains @ innovations.cross.swapaxes(1, 2)
    observed = left[:, :, POSE] + left[:, :, MOTION:] @ innovations.modes.swapaxes(1, 2)
    covariances = left + (gains @ sightings.noise - observed) @ across
    return States(means, (covariances + covariances.swapaxes(1, 2)) / 2)
