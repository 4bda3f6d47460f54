"""Motion of robots between two instants, and its filter, in which positions share calibration errors.

It is a Schmidt-Kalman filter: the m amplitudes of the calibration (``bias_modes.py``) stay
independent standard normal numbers. The filter knows how the error of a state depends on them, and does not
estimate them. All functions take k robots at once, each at its own time.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array

# Columns of the state: x, y, z in m and heading in rad; their rates; the acceleration in x and y.
POSE, RATES, ACCELERATION = slice(0, 4), slice(4, 8), slice(8, 10)
MOTION = 10
# Gauss-Legendre nodes on 0 to 1: the integrals of the noise are exact to 1e-9 for up to 1 s.
_NODES, _WEIGHTS = (values / 2 for values in np.polynomial.legendre.leggauss(7))
_NODES_AND_END = np.append(_NODES + 0.5, 1.0)


@dataclass(frozen=True, slots=True)
class MotionNoise:
    """The usual motion of a robot.

    Attributes
    ----------
    acceleration_m_s2, bend_rad_s, hold_s : standard deviation of the acceleration along each axis of the
        floor, for a robot that stands; its growth with the speed, because the acceleration in a bend is the
        product of speed and turn rate; its correlation time.
    turn_rad_s2, climb_m_s2 : changes of the turn rate and of the vertical speed: square root of the density
        of white noise, as their standard deviation after one second.
    start_m_s, start_climb_m_s, start_rad_s, start_acceleration_m_s2 : standard deviations of a new track: of
        the velocity on the floor, the vertical speed, the turn rate, and the acceleration.
    """

    acceleration_m_s2: float = 0.3
    bend_rad_s: float = 1.5
    hold_s: float = 0.4
    turn_rad_s2: float = 2.0
    climb_m_s2: float = 0.05
    start_m_s: float = 0.5
    start_climb_m_s: float = 0.05
    start_rad_s: float = 2.0
    start_acceleration_m_s2: float = 1.5


def transition(
    durations_s: Array, speeds_m_s: Array, noise: MotionNoise, scales: Array | None = None
) -> tuple[Array, Array]:
    """Return the transitions of the state and the covariances of its noise.

    The acceleration is an Ornstein-Uhlenbeck process (Singer's model), so it fades while a track coasts.

    Parameters
    ----------
    durations_s : (k,), at least 0.
    speeds_m_s : (k,), speeds on the floor.
    noise : the usual motion.
    scales : (k,), factors of the variance of the acceleration; None for the usual one.

    Returns
    -------
    transitions : (k, 10, 10).
    covariances : (k, 10, 10).

    References
    ----------
    Singer, IEEE Trans. AES 1970.
    """
    count = len(durations_s)
    variances = (noise.acceleration_m_s2**2 + (noise.bend_rad_s * speeds_m_s) ** 2)[:, None, None]
    if scales is not None:
        variances = variances * scales[:, None, None]
    if count and (durations_s == durations_s[0]).all():  # mostly, for the robots of one message
        forward, other, by_acceleration = _steps(durations_s[:1], noise)
        return np.broadcast_to(forward, (count, MOTION, MOTION)), other + variances * by_acceleration
    durations_s, places = np.unique(durations_s, return_inverse=True)
    forward, other, by_acceleration = _steps(durations_s, noise)
    return forward[places], other[places] + variances * by_acceleration[places]


def displacement(duration_s: float, hold_s: float) -> tuple[float, float]:
    """Return the displacement by an acceleration of 1 m/s^2 that fades, and the variance by its noise.

    They are the terms of :func:`transition` for one axis, as scalars: for few robots, arrays are slower.

    Parameters
    ----------
    duration_s : at least 0.
    hold_s : correlation time of the acceleration.

    Returns
    -------
    by_acceleration_m : after the duration.
    variance_m2 : for an acceleration with a standard deviation of 1 m/s^2.

    References
    ----------
    Singer, IEEE Trans. AES 1970, eq. for q11.
    """
    share = duration_s / hold_s
    kept = exp(-share)
    by_acceleration_m = hold_s**2 * (share - 1 + kept)
    parts = 1 - kept**2 + 2 * share + 2 * share**3 / 3 - 2 * share**2 - 4 * share * kept
    return by_acceleration_m, hold_s**4 * parts


def _steps(durations_s: Array, noise: MotionNoise) -> tuple[Array, Array, Array]:
    """Return transitions, and covariances: of turn rate and climb, and of an acceleration of 1 m/s^2.

    All are (k, 10, 10).
    """
    forward, other, by_acceleration = np.zeros((3, len(durations_s), MOTION, MOTION))
    # Flat, because slices are faster than pairs of indexes: the diagonal, and the poses by their rates.
    flat = forward.reshape(-1, MOTION**2)
    flat[:, : 8 * (MOTION + 1) : MOTION + 1] = 1.0
    flat[:, 4 : 4 * (MOTION + 1) : MOTION + 1] = durations_s[:, None]
    effects = _of_acceleration(durations_s[:, None] * _NODES_AND_END, noise.hold_s)
    by_position, by_velocity, rest = effects[:, :, -1].T
    weights = (2 / noise.hold_s * durations_s)[:, None] * _WEIGHTS
    unit = (effects[:, :, :-1] * weights[:, None]) @ effects[:, :, :-1].swapaxes(1, 2)
    for axis in (0, 1):
        own = 8 + axis
        forward[:, axis, own], forward[:, 4 + axis, own] = by_position, by_velocity
        forward[:, own, own] = rest
        by_acceleration[:, axis : own + 1 : 4, axis : own + 1 : 4] = unit
    for axis, density in ((2, noise.climb_m_s2**2), (3, noise.turn_rad_s2**2)):
        other[:, axis, axis] = density * durations_s**3 / 3
        other[:, axis, 4 + axis] = other[:, 4 + axis, axis] = density * durations_s**2 / 2
        other[:, 4 + axis, 4 + axis] = density * durations_s
    return forward, other, by_acceleration


def _of_acceleration(durations_s: Array, hold_s: float) -> Array:
    """Return the effects (k, 3, n) of a unit acceleration on position, velocity and acceleration.

    They are the effects after durations (k, n). The integral of their products over a duration is the
    covariance of the noise.
    """
    share = durations_s / hold_s
    lost = -np.expm1(-share)
    effects = np.empty((len(share), 3, share.shape[1]))
    effects[:, 0], effects[:, 1], effects[:, 2] = hold_s**2 * (share - lost), hold_s * lost, 1.0 - lost
    return effects


# The variance of a heading that was not measured: it has no weight in double precision.
UNKNOWN_RAD2 = 1e6
_START_HEADING_RAD2 = np.pi**2
# The velocity and the acceleration on the floor.
_MOVING = [4, 5, 8, 9]


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """The motion of k robots, see :mod:`ipsys_log.models.tracking.filter`.

    Attributes
    ----------
    means : (k, 10). Headings are continuous: they can be outside of one turn.
    covariances : (k, 10, 10), of all errors, those of the calibration included.
    cross : (k, 10, m), errors (estimate minus truth) by the amplitudes of the calibration. The covariance of
        two states by their calibration is the product of their rows.
    fade_m : (m,), distance after which a robot meets other amplitudes, see
        :class:`ipsys_log.models.tracking.bias_modes.BiasModes`. None if all are constant.
    """

    means: Array
    covariances: Array
    cross: Array
    fade_m: Array | None = None

    def take(self, rows: NDArray[np.intp]) -> States:
        """Return the states of some robots; themselves for all of them in their order."""
        if _are_all(rows, len(self.means)):
            return self
        return States(self.means[rows], self.covariances[rows], self.cross[rows], self.fade_m)

    def replace(self, rows: NDArray[np.intp], states: States) -> States:
        """Return the states with those of some robots replaced."""
        means, covariances, cross = self.means.copy(), self.covariances.copy(), self.cross.copy()
        means[rows], covariances[rows], cross[rows] = states.means, states.covariances, states.cross
        return States(means, covariances, cross, self.fade_m)


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
        """Return the sightings of some robots; themselves for all of them in their order."""
        if _are_all(rows, len(self.poses)):
            return self
        return Sightings(self.poses[rows], self.noise[rows], self.sensitivities[rows], self.clock_s[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """The differences of k sightings from predicted states.

    Attributes
    ----------
    differences : (k, 4), sighting minus prediction, in m and rad; 0 for a heading that was not measured.
    covariances : (k, 4, 4), of the differences.
    modes : (k, 4, m), sensitivities of the sightings with the errors of their times.
    across : (k, 10, 4), minus the covariance of the errors of the states and the differences.
    """

    differences: Array
    covariances: Array
    modes: Array
    across: Array

    def chi2(self, more: Array | None = None) -> Array:
        """Return the squared differences (k,) in units of their covariances, to which ``more`` is added."""
        covariances = self.covariances if more is None else self.covariances + more
        solved = np.linalg.solve(covariances, self.differences[:, :, None])
        return np.asarray((self.differences[:, None] @ solved)[:, 0, 0])


def _are_all(rows: NDArray[np.intp], count: int) -> bool:
    return len(rows) == count and rows.tolist() == list(range(count))  # faster than arrays, for few robots


def start(sightings: Sightings, noise: MotionNoise, fade_m: Array | None = None) -> States:
    """Return the states of new tracks, after their first sightings; ``fade_m`` as in :class:`States`."""
    count, modes = len(sightings.poses), sightings.sensitivities
    means, covariances = np.zeros((count, MOTION)), np.zeros((count, MOTION, MOTION))
    cross = np.zeros((count, MOTION, modes.shape[2]))
    means[:, POSE], cross[:, POSE] = sightings.poses, modes
    covariances[:, POSE, POSE] = sightings.noise + modes @ modes.swapaxes(1, 2)
    unknown = sightings.noise[:, 3, 3] >= UNKNOWN_RAD2
    covariances[unknown, 3, 3] = _START_HEADING_RAD2
    sigmas = (
        [noise.start_m_s] * 2
        + [noise.start_climb_m_s, noise.start_rad_s]
        + [noise.start_acceleration_m_s2] * 2
    )
    rates = np.arange(RATES.start, ACCELERATION.stop)
    covariances[:, rates, rates] = np.square(sigmas)
    return States(means, covariances, cross, fade_m)


def predict(states: States, durations_s: Array, noise: MotionNoise, scales: Array | None = None) -> States:
    """Return the states after durations (k,) in s, which are at least 0.

    ``scales`` (k,) are factors of the variances of the velocities and accelerations on the floor, and so of
    the growth of the covariance.
    """
    if scales is not None:
        states = _scale_moving(states, scales)
    speeds_m_s = np.hypot(states.means[:, 4], states.means[:, 5])
    forward, spread = transition(durations_s, speeds_m_s, noise, scales)
    means = (forward @ states.means[:, :, None])[:, :, 0]
    covariances = forward @ states.covariances @ forward.swapaxes(1, 2) + spread
    cross = forward @ states.cross
    if states.fade_m is not None:
        cross *= np.exp(-(speeds_m_s * durations_s)[:, None, None] / states.fade_m)
    return States(means, covariances, cross, states.fade_m)


def _scale_moving(states: States, scales: Array) -> States:
    roots = np.ones(states.means.shape)
    roots[:, _MOVING] = np.sqrt(scales)[:, None]
    covariances = roots[:, :, None] * states.covariances * roots[:, None]
    return States(states.means, covariances, roots[:, :, None] * states.cross, states.fade_m)


def compare(states: States, sightings: Sightings) -> Innovations:
    """Return the differences of sightings from states that are predicted to the times of the sightings."""
    # A camera whose clock is late by d shows the robot v d behind.
    modes = sightings.sensitivities - states.means[:, RATES, None] * sightings.clock_s[:, None]
    differences = sightings.poses - states.means[:, POSE]
    known = sightings.noise[:, 3, 3] < UNKNOWN_RAD2
    differences[:, 3] = np.where(known, (differences[:, 3] + np.pi) % (2 * np.pi) - np.pi, 0.0)
    turned = modes.swapaxes(1, 2)
    # Errors are estimate minus truth. The difference is modes b + noise - error, so a common error cancels.
    across = states.covariances[:, :, POSE] - states.cross @ turned
    covariances = across[:, POSE] + modes @ (turned - states.cross[:, POSE].swapaxes(1, 2)) + sightings.noise
    return Innovations(differences, covariances, modes, across)


def update(states: States, sightings: Sightings, innovations: Innovations) -> States:
    """Return the states after their sightings.

    The covariance has the Joseph form, so rounding cannot make it indefinite.

    Parameters
    ----------
    states : predicted to the times of the sightings.
    sightings : of the same k robots.
    innovations : from :func:`compare`.

    References
    ----------
    Schmidt, Advances in Control Systems 3, 1966. Bucy and Joseph, Filtering for Stochastic Processes, 1968.
    """
    across, modes = innovations.across, innovations.modes
    gains = np.linalg.solve(innovations.covariances, across.swapaxes(1, 2)).swapaxes(1, 2)
    means = states.means + (gains @ innovations.differences[:, :, None])[:, :, 0]
    # (1 - K H) P (1 - K H)' + K R K', one factor after the other, because H has only four rows.
    left = states.covariances - gains @ across.swapaxes(1, 2)
    cross = states.cross - gains @ (states.cross[:, POSE] - modes)
    observed = left[:, :, POSE] - cross @ modes.swapaxes(1, 2)
    covariances = left + (gains @ sightings.noise - observed) @ gains.swapaxes(1, 2)
    return States(means, (covariances + covariances.swapaxes(1, 2)) / 2, cross, states.fade_m)
