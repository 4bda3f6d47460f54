"""Motion of robots between two instants: the columns of a state, the usual motion, and its transitions.

Level robots and free bodies have the same equations and other columns, see :class:`Layout`.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np

from ipsys_log.messages import Array


@dataclass(frozen=True, slots=True)
class Layout:
    """The columns of a state: the pose, its rates, and the acceleration along the first ``accelerated`` axes.

    The pose of a level robot is x, y, z in m and the heading in rad. That of a free body is x, y, z and a
    turn about the axes of the world, which is 0: the rotation itself is in ``States.turns``.
    """

    columns: int
    accelerated: int

    @property
    def pose(self) -> slice:
        return slice(0, self.columns)

    @property
    def rates(self) -> slice:
        return slice(self.columns, 2 * self.columns)

    @property
    def acceleration(self) -> slice:
        return slice(2 * self.columns, self.size)

    @property
    def size(self) -> int:
        return 2 * self.columns + self.accelerated


LEVEL, FREE = Layout(4, 2), Layout(6, 3)
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
    turn_rad_s2, climb_m_s2 : changes of the turn rate and, for a level robot, of the vertical speed: square
        root of the density of white noise, as their standard deviation after one second.
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


# A body that is carried or that flies.
FREE_MOTION = MotionNoise(1.5, 1.5, 0.3, 4.0, 0.0, 1.0, 1.0, 2.0, 3.0)


def transition(
    durations_s: Array,
    speeds_m_s: Array,
    noise: MotionNoise,
    scales: Array | None = None,
    layout: Layout = LEVEL,
) -> tuple[Array, Array]:
    """Return the transitions of the state and the covariances of its noise.

    The acceleration is an Ornstein-Uhlenbeck process (Singer's model), so it fades while a track coasts.

    Parameters
    ----------
    durations_s : (k,), at least 0.
    speeds_m_s : (k,), speeds on the floor, or of a free body.
    noise : the usual motion.
    scales : (k,), factors of the variance of the acceleration; None for the usual one.
    layout : the s columns of the state.

    Returns
    -------
    transitions : (k, s, s).
    covariances : (k, s, s).

    References
    ----------
    Singer, IEEE Trans. AES 1970.
    """
    count = len(durations_s)
    variances = (noise.acceleration_m_s2**2 + (noise.bend_rad_s * speeds_m_s) ** 2)[:, None, None]
    if scales is not None:
        variances = variances * scales[:, None, None]
    if count and (durations_s == durations_s[0]).all():  # mostly, for the robots of one message
        forward, other, by_acceleration = _steps(durations_s[:1], noise, layout)
        return np.broadcast_to(
            forward, (count, layout.size, layout.size)
        ), other + variances * by_acceleration
    durations_s, places = np.unique(durations_s, return_inverse=True)
    forward, other, by_acceleration = _steps(durations_s, noise, layout)
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


def _steps(durations_s: Array, noise: MotionNoise, layout: Layout) -> tuple[Array, Array, Array]:
    """Return transitions, and covariances: of turn rate and climb, and of an acceleration of 1 m/s^2.

    All are (k, s, s).
    """
    size, rates = layout.size, layout.columns
    forward, other, by_acceleration = np.zeros((3, len(durations_s), size, size))
    # Flat, because slices are faster than pairs of indexes: the diagonal, and the poses by their rates.
    flat = forward.reshape(-1, size**2)
    flat[:, : 2 * rates * (size + 1) : size + 1] = 1.0
    flat[:, rates : rates * (size + 1) : size + 1] = durations_s[:, None]
    effects = _of_acceleration(durations_s[:, None] * _NODES_AND_END, noise.hold_s)
    by_position, by_velocity, rest = effects[:, :, -1].T
    weights = (2 / noise.hold_s * durations_s)[:, None] * _WEIGHTS
    unit = (effects[:, :, :-1] * weights[:, None]) @ effects[:, :, :-1].swapaxes(1, 2)
    for axis in range(layout.accelerated):
        own = 2 * rates + axis
        forward[:, axis, own], forward[:, rates + axis, own] = by_position, by_velocity
        forward[:, own, own] = rest
        by_acceleration[:, axis : own + 1 : rates, axis : own + 1 : rates] = unit
    climb = [(2, noise.climb_m_s2**2)] if layout is LEVEL else []
    turns = [(axis, noise.turn_rad_s2**2) for axis in range(3, rates)]
    for axis, density in (*climb, *turns):
        other[:, axis, axis] = density * durations_s**3 / 3
        other[:, axis, rates + axis] = other[:, rates + axis, axis] = density * durations_s**2 / 2
        other[:, rates + axis, rates + axis] = density * durations_s
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
