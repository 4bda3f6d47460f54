"""Paths in two recordings, and their positions at common instants."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages.arrays import Array, Mask
from ipsys_log.vision.time_brackets import bracket_times

# Longest gap for an interpolation, in usual intervals: one missing frame is no gap.
_USUAL_INTERVALS = 2.5
# A gap is never shorter than the first, at high rates, and never longer than the second, at low ones.
_SHORTEST_GAP_S = 0.1
_LONGEST_GAP_S = 1.0
# Neighbouring errors of tracks are alike. Errors further apart than this count as independent.
_BLOCK_S = 2.0
# A jump is this many times longer than the usual distance of a position from its neighbours,
_JUMP = 10.0
# longer than this,
_LEAST_JUMP_M = 0.01
# and needs a larger acceleration than a robot has.
_LARGEST_ACCELERATION_M_S2 = 10.0
# Each pass removes only the largest of neighbouring jumps.
_PASSES = 4


class PathPair(NamedTuple):
    """The same path in two recordings: times (n,) and (m,) in s, points (n, 3) and (m, 3) in m.

    Each recording has its own zero of time.
    """

    true_s: Array
    true_m: Array
    track_s: Array
    track_m: Array


def gap_limit_s(times_s: Array) -> float:
    """Return the longest gap between times (n,) over which a position is interpolated, in s."""
    usual_s = float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0
    return float(np.clip(_USUAL_INTERVALS * usual_s, _SHORTEST_GAP_S, _LONGEST_GAP_S))


class CommonInstants(NamedTuple):
    """Positions of tracks and truth at common instants, (n, 3), and the velocity of the truth.

    ``block`` (n,) numbers the intervals of 2 s of each path.
    """

    track_m: Array
    true_m: Array
    velocity_m_s: Array
    block: NDArray[np.int64]


def without_jumps(pair: PathPair) -> PathPair:
    """Return a pair without the true positions that jump away from both neighbours and back.

    An interpolation beside a jump has a wrong velocity, which a time offset would follow.
    """
    times_s, points_m = pair.true_s, pair.true_m
    limit_s = gap_limit_s(times_s)
    for _ in range(_PASSES):
        if len(times_s) < 5:
            break
        steps_s = np.diff(times_s)
        beside = (steps_s[:-1] <= limit_s) & (steps_s[1:] <= limit_s)
        between_m = points_m[:-2] + (steps_s[:-1] / (steps_s[:-1] + steps_s[1:]))[:, None] * (
            points_m[2:] - points_m[:-2]
        )
        apart_m = np.zeros(len(times_s))
        apart_m[1:-1] = np.where(beside, np.linalg.norm(points_m[1:-1] - between_m, axis=1), 0.0)
        # A jump moves the middle of its neighbours, too: only the largest of three is removed.
        largest = apart_m >= np.maximum(np.append(apart_m[1:], 0.0), np.append(0.0, apart_m[:-1]))
        kept = ~(largest & (apart_m > _longest_step_m(apart_m, steps_s)))
        if kept.all():
            break
        times_s, points_m = times_s[kept], points_m[kept]
    return pair._replace(true_s=times_s, true_m=points_m)


def _longest_step_m(apart_m: Array, steps_s: Array) -> float:
    """Return the largest distance of a position from the middle of its neighbours that is no jump."""
    turning_m = _LARGEST_ACCELERATION_M_S2 * float(np.median(steps_s)) ** 2 / 2
    return max(_JUMP * float(np.median(apart_m)), _LEAST_JUMP_M, turning_m)


def common_instants(pairs: Sequence[PathPair], offset_s: float) -> CommonInstants:
    """Return the positions of all pairs at the instants of their tracks, without gaps of the truth.

    ``offset_s`` is added to the times of the truth.
    """
    parts: list[tuple[Array, Array, Array, Array]] = []
    for number, pair in enumerate(pairs):
        true_m, velocity_m_s, known = _interpolate(pair.true_s, pair.true_m, pair.track_s - offset_s)
        blocks = np.floor(pair.track_s[known] / _BLOCK_S) * len(pairs) + number
        parts.append((pair.track_m[known], true_m[known], velocity_m_s[known], blocks))
    track_m, true_m, velocity_m_s, block = (np.concatenate(part) for part in zip(*parts, strict=True))
    return CommonInstants(track_m, true_m, velocity_m_s, block.astype(np.int64))


def _interpolate(times_s: Array, points_m: Array, at_s: Array) -> tuple[Array, Array, Mask]:
    """Return points and velocities (k, 3) at times (k,) by cubic Hermite splines, and a mask of the known."""
    if len(times_s) < 2:
        return np.zeros((len(at_s), 3)), np.zeros((len(at_s), 3)), np.zeros(len(at_s), dtype=np.bool_)
    limit_s = gap_limit_s(times_s)
    brackets = bracket_times(times_s, at_s, limit_s)
    after = brackets.before.clip(max=len(times_s) - 2) + 1
    start_s, step_s = times_s[after - 1], times_s[after] - times_s[after - 1]
    velocities = _velocities(times_s, points_m, limit_s)
    u, h = ((at_s - start_s) / step_s)[:, None], step_s[:, None]
    p, q, v, w = points_m[after - 1], points_m[after], velocities[after - 1] * h, velocities[after] * h
    # The cubic with these ends p, q and slopes v, w, by powers of u.
    second, third = 3 * (q - p) - 2 * v - w, 2 * (p - q) + v + w
    value_m = p + u * (v + u * (second + u * third))
    return value_m, (v + u * (2 * second + 3 * u * third)) / h, brackets.is_known & (step_s <= limit_s)


def _velocities(times_s: Array, points_m: Array, limit_s: float) -> Array:
    """Return central differences (n, 3) in m/s; at the border of a gap, the difference on its other side."""
    steps_s = np.diff(times_s)
    slopes = np.diff(points_m, axis=0) / steps_s[:, None]
    weights = np.where(steps_s <= limit_s, steps_s, 1e-12)[:, None]
    rows = np.concatenate([slopes[:1] * 0, slopes * weights]) + np.concatenate(
        [slopes * weights, slopes[:1] * 0]
    )
    total = np.concatenate([[[0.0]], weights]) + np.concatenate([weights, [[0.0]]])
    return np.asarray(rows / total)
