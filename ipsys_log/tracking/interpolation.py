"""Poses of a track at any instants between its rows, with covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.tracking.motion import MotionNoise

__all__ = ["TrackRows", "TrackSamples", "interpolate"]

Array = NDArray[np.float64]
Times = NDArray[np.int64]

# Columns of the state of the motion, for each axis and the heading: value, rate and acceleration.
_ON_FLOOR, _UP, _TURN = (0, 4, 8), (2, 6), (3, 7)


@dataclass(frozen=True, slots=True, eq=False)
class TrackRows:
    """The rows of a robot in order of time; NaN for missing values.

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

    Between two rows, positions and headings are cubic polynomials with the velocities of both rows (Hermite).
    They are the most probable motion with white noise of the acceleration. Without velocities, positions are
    linear. The covariance has two parts: the mixture of the covariances of both rows, because their errors
    have nearly the same causes, and the unknown motion between them.

    Parameters
    ----------
    rows : of one robot.
    times_ns : (k,).
    noise : the usual motion of a robot; None: that of the filter.

    Returns
    -------
    TrackSamples : exactly those of a row at its instant.
    """
    usual = noise or MotionNoise()
    if not len(rows.times_ns):
        return _samples(np.full((len(times_ns), 3), np.nan), *_unknown(len(times_ns)))
    last = np.clip(np.searchsorted(rows.times_ns, times_ns, side="right") - 1, 0, len(rows.times_ns) - 1)
    after = np.minimum(last + 1, len(rows.times_ns) - 1)
    after = np.where(rows.times_ns[last] == times_ns, last, after)
    inside = (times_ns >= rows.times_ns[0]) & (times_ns <= rows.times_ns[-1])
    inside &= rows.numbers[last] == rows.numbers[after]
    gap = _Gap.between(rows.times_ns[last], rows.times_ns[after], times_ns)
    moving = np.isfinite(rows.velocities_m_s[last] + rows.velocities_m_s[after]).all(axis=1)
    ends, rates = (
        (rows.points_m[last], rows.points_m[after]),
        (
            rows.velocities_m_s[last],
            rows.velocities_m_s[after],
        ),
    )
    points_m, velocities_m_s = gap.mix(ends, rates, moving)
    covariances_m2 = gap.mix_covariances(
        rows.covariances_m2[last],
        rows.covariances_m2[after],
        rows.velocity_covariances_m2_s2[last],
        rows.velocity_covariances_m2_s2[after],
        moving,
    )
    floor_m2, up_m2 = gap.spread(_ON_FLOOR, usual, moving), gap.spread(_UP, usual, moving)
    covariances_m2 += np.stack([floor_m2, floor_m2, up_m2], axis=1)[:, :, None] * np.eye(3)
    headings = _headings(rows, last, after, gap, usual)
    samples = _samples(points_m, covariances_m2, velocities_m_s, *headings)
    for values in (
        samples.points_m,
        samples.covariances_m2,
        samples.velocities_m_s,
        samples.headings_rad,
        samples.heading_sigmas_rad,
        samples.turn_rates_rad_s,
    ):
        values[~inside] = np.nan
    return samples
