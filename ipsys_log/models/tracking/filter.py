"""Filter of the motion of robots, in which positions share calibration errors.

It is a Schmidt-Kalman filter: the m amplitudes of the calibration (``bias_modes.py``) stay
independent standard normal numbers. The filter knows how the error of a state depends on them, and does not
estimate them. All functions take k robots at once, each at its own time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array
from ipsys_log.models.tracking.motion import FREE, LEVEL, Layout, MotionNoise, transition
from ipsys_log.vision.poses import rotate, rotation_vectors

# The columns of the turn of a free body.
_TURN = slice(3, 6)
# The variance of a heading that was not measured: it has no weight in double precision.
UNKNOWN_RAD2 = 1e6
_START_HEADING_RAD2 = np.pi**2


@dataclass(frozen=True, slots=True, eq=False)
class States:
    """The motion of k robots, see :mod:`ipsys_log.models.tracking.filter`.

    Attributes
    ----------
    means : (k, s). Headings are continuous: they can be outside of one turn.
    covariances : (k, s, s), of all errors, those of the calibration included.
    cross : (k, s, m), errors (estimate minus truth) by the amplitudes of the calibration. The covariance of
        two states by their calibration is the product of their rows.
    fade_m : (m,), distance after which a robot meets other amplitudes, see
        :class:`ipsys_log.models.tracking.bias_modes.BiasModes`. None if all are constant.
    turns : (k, 3, 3), rotations from the axes of free bodies to those of the world; None for level robots.
    """

    means: Array
    covariances: Array
    cross: Array
    fade_m: Array | None = None
    turns: Array | None = None

    @property
    def layout(self) -> Layout:
        """The columns of the states."""
        return LEVEL if self.turns is None else FREE

    def take(self, rows: NDArray[np.intp]) -> States:
        """Return the states of some robots; themselves for all of them in their order."""
        if _are_all(rows, len(self.means)):
            return self
        turns = None if self.turns is None else self.turns[rows]
        return States(self.means[rows], self.covariances[rows], self.cross[rows], self.fade_m, turns)

    def replace(self, rows: NDArray[np.intp], states: States) -> States:
        """Return the states with those of some robots replaced."""
        means, covariances, cross = self.means.copy(), self.covariances.copy(), self.cross.copy()
        means[rows], covariances[rows], cross[rows] = states.means, states.covariances, states.cross
        turns = None
        if self.turns is not None:
            turns = self.turns.copy()
            turns[rows] = states.turns
        return States(means, covariances, cross, self.fade_m, turns)

    def turned(self) -> States:
        """Return the states with the turns of their means in their rotations."""
        if self.turns is None:
            return self
        turns, means = rotate(self.means[:, _TURN]) @ self.turns, self.means.copy()
        means[:, _TURN] = 0.0
        return States(means, self.covariances, self.cross, self.fade_m, turns)


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """The sightings of k robots, one of each.

    Attributes
    ----------
    poses : (k, p), x, y, z in m and heading in rad; a heading that was not measured is 0. Free bodies have x,
        y, z and 0 for the turn.
    noise : (k, p, p), covariance of the noise, without the calibration; :data:`UNKNOWN_RAD2` for a heading
        that was not measured.
    sensitivities : (k, p, m), errors of the poses by the amplitudes of the calibration.
    clock_s : (k, m), errors of the times by the amplitudes of the calibration.
    turns : (k, 3, 3), rotations of free bodies; None for level robots.
    by_rates : (k, p, p), errors of the poses of free bodies by the rates of their poses; None for no errors.
    """

    poses: Array
    noise: Array
    sensitivities: Array
    clock_s: Array
    turns: Array | None = None
    by_rates: Array | None = None

    def rows(self, values: Array, layout: Layout) -> Array:
        """Return rows (k, p, n) of poses, with their errors by the rates, from rows (k, s, n) of states."""
        own = values[:, layout.pose]
        return own if self.by_rates is None else own + self.by_rates @ values[:, layout.rates]

    def columns(self, values: Array, layout: Layout) -> Array:
        """Return columns (k, n, p) of poses, as :meth:`rows`, from columns (k, n, s) of states."""
        own = values[:, :, layout.pose]
        if self.by_rates is None:
            return own
        return own + values[:, :, layout.rates] @ self.by_rates.swapaxes(1, 2)

    def take(self, rows: NDArray[np.intp]) -> Sightings:
        """Return the sightings of some robots; themselves for all of them in their order."""
        if _are_all(rows, len(self.poses)):
            return self
        turns = None if self.turns is None else self.turns[rows]
        by_rates = None if self.by_rates is None else self.by_rates[rows]
        return Sightings(
            self.poses[rows], self.noise[rows], self.sensitivities[rows], self.clock_s[rows], turns, by_rates
        )


@dataclass(frozen=True, slots=True, eq=False)
class Innovations:
    """The differences of k sightings from predicted states.

    Attributes
    ----------
    differences : (k, p), sighting minus prediction, in m and rad; 0 for a heading that was not measured.
    covariances : (k, p, p), of the differences.
    modes : (k, p, m), sensitivities of the sightings with the errors of their times.
    across : (k, s, p), minus the covariance of the errors of the states and the differences.
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
    layout = LEVEL if sightings.turns is None else FREE
    means, covariances = np.zeros((count, layout.size)), np.zeros((count, layout.size, layout.size))
    cross = np.zeros((count, layout.size, modes.shape[2]))
    means[:, layout.pose], cross[:, layout.pose] = sightings.poses, modes
    covariances[:, layout.pose, layout.pose] = sightings.noise + modes @ modes.swapaxes(1, 2)
    if layout is LEVEL:
        unknown = sightings.noise[:, 3, 3] >= UNKNOWN_RAD2
        covariances[unknown, 3, 3] = _START_HEADING_RAD2
    sigmas = (
        [noise.start_m_s] * 2
        + [noise.start_climb_m_s]
        + [noise.start_rad_s] * (layout.columns - 3)
        + [noise.start_acceleration_m_s2] * layout.accelerated
    )
    rates = np.arange(layout.columns, layout.size)
    covariances[:, rates, rates] = np.square(sigmas)
    if sightings.by_rates is not None:
        # The rates begin with 0: their errors are minus the rates, which have changed the pose.
        own = covariances[:, layout.rates, layout.rates]
        covariances[:, layout.pose, layout.rates] = across = -sightings.by_rates @ own
        covariances[:, layout.rates, layout.pose] = across.swapaxes(1, 2)
        covariances[:, layout.pose, layout.pose] -= across @ sightings.by_rates.swapaxes(1, 2)
    return States(means, covariances, cross, fade_m, sightings.turns)


def predict(states: States, durations_s: Array, noise: MotionNoise, scales: Array | None = None) -> States:
    """Return the states after durations (k,) in s, which are at least 0.

    ``scales`` (k,) are factors of the variances of the velocities and accelerations on the floor, and so of
    the growth of the covariance.
    """
    if scales is not None:
        states = _scale_moving(states, scales)
    layout = states.layout
    speeds_m_s = speeds(states.means[:, layout.rates], layout)
    forward, spread = transition(durations_s, speeds_m_s, noise, scales, layout)
    means = (forward @ states.means[:, :, None])[:, :, 0]
    covariances = forward @ states.covariances @ forward.swapaxes(1, 2) + spread
    cross = forward @ states.cross
    if states.fade_m is not None:
        cross *= np.exp(-(speeds_m_s * durations_s)[:, None, None] / states.fade_m)
    return States(means, covariances, cross, states.fade_m, states.turns).turned()


def speeds(velocities_m_s: Array, layout: Layout) -> Array:
    """Return the speeds (k,) of velocities (k, 2 or more): of level robots only those on the floor."""
    if layout is LEVEL:
        return np.asarray(np.hypot(velocities_m_s[:, 0], velocities_m_s[:, 1]))
    return np.asarray(np.linalg.norm(velocities_m_s[:, :3], axis=1))


def _scale_moving(states: States, scales: Array) -> States:
    layout, roots = states.layout, np.ones(states.means.shape)
    # The velocity along the axes with an acceleration, and the acceleration.
    for first in (layout.columns, 2 * layout.columns):
        roots[:, first : first + layout.accelerated] = np.sqrt(scales)[:, None]
    covariances = roots[:, :, None] * states.covariances * roots[:, None]
    return States(states.means, covariances, roots[:, :, None] * states.cross, states.fade_m, states.turns)


def compare(states: States, sightings: Sightings) -> Innovations:
    """Return the differences of sightings from states that are predicted to the times of the sightings."""
    # A camera whose clock is late by d shows the robot v d behind.
    layout = states.layout
    modes = sightings.sensitivities - states.means[:, layout.rates, None] * sightings.clock_s[:, None]
    differences = sightings.poses - sightings.rows(states.means[:, :, None], layout)[:, :, 0]
    if states.turns is not None and sightings.turns is not None:
        # The turn of the mean is 0: its row has only the error by the rates.
        turned = rotate(-differences[:, _TURN]) @ states.turns
        differences[:, _TURN] = rotation_vectors(sightings.turns @ turned.swapaxes(1, 2))
    else:
        known = sightings.noise[:, 3, 3] < UNKNOWN_RAD2
        differences[:, 3] = np.where(known, (differences[:, 3] + np.pi) % (2 * np.pi) - np.pi, 0.0)
    transposed = modes.swapaxes(1, 2)
    # Errors are estimate minus truth. The difference is modes b + noise - error, so a common error cancels.
    across = sightings.columns(states.covariances, layout) - states.cross @ transposed
    rest = transposed - sightings.rows(states.cross, layout).swapaxes(1, 2)
    covariances = sightings.rows(across, layout) + modes @ rest + sightings.noise
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
    across, modes, layout = innovations.across, innovations.modes, states.layout
    gains = np.linalg.solve(innovations.covariances, across.swapaxes(1, 2)).swapaxes(1, 2)
    means = states.means + (gains @ innovations.differences[:, :, None])[:, :, 0]
    # (1 - K H) P (1 - K H)' + K R K', one factor after the other, because H has few rows.
    left = states.covariances - gains @ across.swapaxes(1, 2)
    cross = states.cross - gains @ (sightings.rows(states.cross, layout) - modes)
    observed = sightings.columns(left, layout) - cross @ modes.swapaxes(1, 2)
    covariances = left + (gains @ sightings.noise - observed) @ gains.swapaxes(1, 2)
    both = (covariances + covariances.swapaxes(1, 2)) / 2
    return States(means, both, cross, states.fade_m, states.turns).turned()
