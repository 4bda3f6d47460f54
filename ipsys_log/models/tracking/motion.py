"""Motion of a robot between two instants: the transition of its state, and the noise of its accelerations."""

from __future__ import annotations

from dataclasses import dataclass
from math import exp

import numpy as np

from ipsys_log.messages.arrays import Array

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
