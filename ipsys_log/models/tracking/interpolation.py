"""Poses of a track at any instants between its rows, with covariances."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages.arrays import Array, Indices, Times
from ipsys_log.models.tracking.motion import MotionNoise, transition
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.time_brackets import bracket_times

# Columns of the motion in the state: value, rate and acceleration; the last two have white acceleration.
_ON_FLOOR, _UP, _TURN = (0, 4, 8), (2, 6), (3, 7)


@dataclass(frozen=True, slots=True, eq=False)
class TrackRows:
    """The n rows of a robot in order of time; NaN for missing values.

    Attributes
    ----------
    times_ns : (n,), strictly increasing.
    numbers : (n,), number of the track of each row: a robot that was carried away begins a new track.
    points_m, velocities_m_s : (n, 3).
    covariances_m2, velocity_covariances_m2_s2 : (n, 3, 3).
    headings_rad, heading_sigmas_rad, turn_rates_rad_s, turn_rate_sigmas_rad_s : (n,).
    """

    times_ns: Times
    numbers: NDArray[np.int64]
    points_m: Array
    covariances_m2: Array
    velocities_m_s: Array
    velocity_covariances_m2_s2: Array
    headings_rad: Array
    heading_sigmas_rad: Array
    turn_rates_rad_s: Array
    turn_rate_sigmas_rad_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class TrackSamples:
    """Poses at k instants; NaN outside of tracks, and for missing values.

    Attributes
    ----------
    points_m, velocities_m_s : (k, 3).
    covariances_m2 : (k, 3, 3).
    headings_rad, heading_sigmas_rad, turn_rates_rad_s : (k,).
    """

    points_m: Array
    covariances_m2: Array
    velocities_m_s: Array
    headings_rad: Array
    heading_sigmas_rad: Array
    turn_rates_rad_s: Array


def interpolate(rows: TrackRows, times_ns: Times, noise: MotionNoise | None = None) -> TrackSamples:
    """Return the poses of a track at any instants.

    Between two rows, positions and headings are cubic polynomials with the rates of both rows (Hermite): the
    most probable motion with white noise of the acceleration. Without rates, they are linear. The covariance
    has two parts. One is the mixture of the covariances of both rows, because their errors have nearly the
    same causes. The other is the unknown motion between them.

    Parameters
    ----------
    rows : of one robot.
    times_ns : (k,).
    noise : the usual motion of a robot; None: that of the filter.

    Returns
    -------
    TrackSamples : at the instant of a row, those of the row.
    """
    if not len(rows.times_ns):
        return _outside(len(times_ns))
    before, after, _, inside = bracket_times(rows.times_ns, times_ns, np.inf)
    inside &= rows.numbers[before] == rows.numbers[after]
    samples = _between(rows, before, after, times_ns, noise or MotionNoise())
    for one in fields(samples):
        getattr(samples, one.name)[~inside] = np.nan
    return samples


def _outside(count: int) -> TrackSamples:
    vectors, numbers = np.full((count, 3), np.nan), np.full(count, np.nan)
    return TrackSamples(vectors, np.full((count, 3, 3), np.nan), vectors, numbers, numbers, numbers)


def _between(
    rows: TrackRows, before: Indices, after: Indices, times_ns: Times, noise: MotionNoise
) -> TrackSamples:
    """Return the poses between rows ``before`` (k,) and ``after`` (k,)."""
    elapsed_s = (times_ns - rows.times_ns[before]) / NS_PER_S
    whole_s = (rows.times_ns[after] - rows.times_ns[before]) / NS_PER_S
    moving = np.isfinite(rows.velocities_m_s[before] + rows.velocities_m_s[after]).all(axis=1)
    weights = _Weights.of(elapsed_s, whole_s, moving)
    ends_m, rates_m_s = rows.points_m[[before, after]], rows.velocities_m_s[[before, after]]
    points_m, velocities_m_s = weights.mix(ends_m, rates_m_s)
    covariances_m2 = weights.mix_variances(
        rows.covariances_m2[[before, after]], rows.velocity_covariances_m2_s2[[before, after]]
    )
    # The chord between both rows, if they have no velocities.
    speeds_m_s = np.linalg.norm((ends_m[1] - ends_m[0])[:, :2], axis=1) / np.where(whole_s > 0, whole_s, 1.0)
    on_floor_m2, up_m2 = (weights.unknown_motion(columns, speeds_m_s, noise) for columns in (_ON_FLOOR, _UP))
    unknown_m2 = np.stack([on_floor_m2, on_floor_m2, up_m2], axis=1)
    turning = np.isfinite(_rates(rows, before, after)).all(axis=0)
    turns = _Weights.of(elapsed_s, whole_s, turning)
    headings_rad, turn_rates_rad_s = turns.mix(
        _unwrap(rows, before, after, whole_s), _rates(rows, before, after)
    )
    variances_rad2 = turns.mix_variances(
        rows.heading_sigmas_rad[[before, after]] ** 2, rows.turn_rate_sigmas_rad_s[[before, after]] ** 2
    )
    return TrackSamples(
        points_m,
        covariances_m2 + unknown_m2[:, :, None] * np.eye(3),
        velocities_m_s,
        (headings_rad + np.pi) % (2 * np.pi) - np.pi,
        np.sqrt(variances_rad2 + turns.unknown_motion(_TURN, speeds_m_s, noise)),
        turn_rates_rad_s,
    )


def _rates(rows: TrackRows, before: Indices, after: Indices) -> Array:
    return rows.turn_rates_rad_s[[before, after]]


def _unwrap(rows: TrackRows, before: Indices, after: Indices, whole_s: Array) -> Array:
    """Return the headings (2, k) of both rows, the second one without jumps by its turn rate."""
    first, second = rows.headings_rad[[before, after]]
    expected_rad = np.nan_to_num(_rates(rows, before, after).mean(axis=0) * whole_s)
    turned_rad = second - first - expected_rad
    return np.stack([first, first + expected_rad + (turned_rad + np.pi) % (2 * np.pi) - np.pi])


@dataclass(frozen=True, slots=True, eq=False)
class _Weights:
    """Weights (k,) of the values and of the rates of two rows, for a value between them and for its rate.

    ``elapsed_s`` and ``whole_s`` (k,) are the times from the first row to the instant and to the second row.
    """

    elapsed_s: Array
    whole_s: Array
    values: Array
    rates: Array
    slope_values: Array
    slope_rates: Array

    @classmethod
    def of(cls, elapsed_s: Array, whole_s: Array, with_rates: np.bool_ | NDArray[np.bool_]) -> _Weights:
        length_s = np.where(whole_s > 0, whole_s, 1.0)
        u = elapsed_s / length_s
        later = np.where(with_rates, u**2 * (3 - 2 * u), u)
        first, second = length_s * u * (1 - u) ** 2, length_s * u**2 * (u - 1)
        steep = np.where(with_rates, 6 * u * (1 - u), 1.0) / length_s
        return cls(
            elapsed_s,
            whole_s,
            np.stack([1 - later, later]),
            np.where(with_rates, np.stack([first, second]), 0.0),
            np.stack([-steep, steep]),
            np.where(with_rates, np.stack([(1 - u) * (1 - 3 * u), u * (3 * u - 2)]), np.nan),
        )

    def mix(self, values: Array, rates: Array) -> tuple[Array, Array]:
        """Return values (k, ...) and rates (k, ...) from those of both rows, (2, k, ...)."""
        known = np.nan_to_num(rates)
        return (
            _sum(self.values, values) + _sum(self.rates, known),
            _sum(self.slope_values, values) + _sum(self.slope_rates, rates),
        )

    def mix_variances(self, of_values: Array, of_rates: Array) -> Array:
        """Return variances (k, ...) of values from the variances of both rows, (2, k, ...)."""
        return _sum(self.values, of_values) + _sum(self.rates**2, np.nan_to_num(of_rates))

    def unknown_motion(self, columns: tuple[int, ...], speeds_m_s: Array, noise: MotionNoise) -> Array:
        """Return the variance (k,) of the motion between the rows, along some columns of the state.

        The rows are exact. The acceleration of the first row, if it is a column, has its usual deviation.
        """
        own = np.ix_(np.arange(len(speeds_m_s)), np.array(columns), np.array(columns))
        rest_s = np.maximum(self.whole_s - self.elapsed_s, 0.0)
        forward, spread = (one[own] for one in transition(self.elapsed_s, speeds_m_s, noise))
        onward, more = (one[own] for one in transition(rest_s, speeds_m_s, noise))
        if len(columns) == 3:
            usual_m_s2 = np.hypot(noise.acceleration_m_s2, noise.bend_rad_s * speeds_m_s)
            effect = forward[:, :, 2] * usual_m_s2[:, None]
            spread = spread + effect[:, :, None] * effect[:, None]
        cross = spread @ onward.swapaxes(1, 2)
        end = onward @ cross + more
        later = np.stack([self.values[1], self.rates[1]], axis=1)
        shared = (cross[:, 0, :2] * later).sum(axis=1)
        known = (later[:, None] @ end[:, :2, :2] @ later[:, :, None])[:, 0, 0]
        variances: Array = np.maximum(spread[:, 0, 0] - 2 * shared + known, 0.0)
        return variances


def _sum(weights: Array, values: Array) -> Array:
    shape = (2, -1) + (1,) * (values.ndim - 2)
    total: Array = (weights.reshape(shape) * values).sum(axis=0)
    return total
