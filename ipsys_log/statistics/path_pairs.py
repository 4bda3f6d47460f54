"""Paths in two recordings: a coarse search of their time offset, and their positions at common instants.

The speed of a body does not depend on the coordinates. So the time offset is found before the alignment.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Mask
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


# Half the time over which a speed is measured. Noise of 5 mm then is a speed of 0.035 m/s.
_HALF_WINDOW_S = 0.1
# The step is the longest usual interval of the recordings, within these limits.
_SHORTEST_STEP_S = 0.02
_LONGEST_STEP_S = 0.25
# A longer recording has longer steps: this bounds the Fourier transform.
_MOST_STEPS = 1 << 20
# Offsets with a shorter common time than this share of the longest one are not tried: a short piece of a path
# looks like many others.
_LEAST_SHARE = 0.3
_LEAST_INSTANTS = 8
# Outliers of positions are jumps. Speeds above this multiple of the 90th percentile are clipped.
_CLIPPED_ABOVE = 1.5
# So many offsets are returned. Each is refined, which takes longer than the search.
_CANDIDATES = 5
# Offsets nearer together are one.
_APART_S = 1.0


def search_offsets_s(pairs: Sequence[PathPair]) -> list[float]:
    """Return time offsets to add to the true times, in s: those with the best agreement of speeds first.

    The agreement is the correlation of the speeds on the floor over all instants that both recordings have.
    It is searched over all offsets by the Fourier transform. Neighbours within 1 s count as one offset.

    References
    ----------
    Masked correlation: Padfield, "Masked object registration in the Fourier domain", IEEE Transactions on
    Image Processing 2012, eq. (23).
    """
    steps = [
        float(np.median(np.diff(t))) for pair in pairs for t in (pair.true_s, pair.track_s) if len(t) > 1
    ]
    if not steps:
        return []
    longest_s = max(float(times[-1]) for pair in pairs for times in (pair.true_s, pair.track_s))
    step_s = float(np.clip(max(steps), _SHORTEST_STEP_S, _LONGEST_STEP_S))
    step_s = max(step_s, longest_s / _MOST_STEPS)
    size = 2 * (int(longest_s / step_s) + 2)
    sums = np.zeros((6, size))
    for pair in pairs:
        sums += _correlation_sums(
            _speeds(pair.true_s, pair.true_m, step_s), _speeds(pair.track_s, pair.track_m, step_s), size
        )
    return _peaks_s(_scores(sums), step_s)


def _speeds(times_s: Array, points_m: Array, step_s: float) -> tuple[Array, Array]:
    """Return speeds on the floor at the steps of a grid, with 0 where they are unknown, and a mask 0 or 1."""
    half_s = max(_HALF_WINDOW_S, step_s)
    grid_s: Array = np.arange(int(times_s[-1] / step_s) + 1, dtype=np.float64) * step_s
    ends = [bracket_times(times_s, grid_s + sign * half_s, gap_limit_s(times_s)) for sign in (-1, 1)]
    before_m, after_m = (end.mix(points_m[:, :2]) for end in ends)
    speeds = np.linalg.norm(after_m - before_m, axis=1) / (2 * half_s)
    known = ends[0].is_known & ends[1].is_known
    if known.any():
        speeds = np.minimum(speeds, _CLIPPED_ABOVE * np.quantile(speeds[known], 0.9))
    return np.where(known, speeds, 0.0), known.astype(np.float64)


def _correlation_sums(true: tuple[Array, Array], track: tuple[Array, Array], size: int) -> Array:
    """Return sums over the common instants at each lag, (6, size): count, a, b, a a, b b, a b."""
    (a, has_a), (b, has_b) = true, track
    spectra = [np.conj(np.fft.rfft(row, size)) for row in (has_a, a, a * a)]
    ones, firsts, squares = spectra
    other_ones, other_firsts, other_squares = (np.fft.rfft(row, size) for row in (has_b, b, b * b))
    products = [
        ones * other_ones,
        firsts * other_ones,
        ones * other_firsts,
        squares * other_ones,
        ones * other_squares,
        firsts * other_firsts,
    ]
    return np.array([np.fft.irfft(product, size) for product in products])


def _scores(sums: Array) -> Array:
    """Return the agreement at each lag, (size,): the correlation with the weight of its instants."""
    count, a, b, aa, bb, ab = sums
    most = float(count.max())
    enough = count >= max(_LEAST_INSTANTS, _LEAST_SHARE * most) - 0.5
    divisor = np.where(enough, count, 1.0)
    spreads = np.maximum(aa - a * a / divisor, 0) * np.maximum(bb - b * b / divisor, 0)
    # A constant speed has no correlation; rounding leaves a small spread.
    varies = enough & (spreads > 1e-12 * np.maximum(aa * bb, 1e-300))
    correlation = np.where(varies, (ab - a * b / divisor) / np.sqrt(np.where(varies, spreads, 1.0)), 0.0)
    # Fisher's z of a correlation has the standard deviation 1 / sqrt(n).
    z = np.arctanh(np.clip(correlation, -0.999, 0.999)) * np.sqrt(divisor)
    return np.where(enough, z, -np.inf)


def _peaks_s(scores: Array, step_s: float) -> list[float]:
    lags = np.arange(len(scores))
    lags = np.where(lags < len(scores) // 2, lags, lags - len(scores))
    waiting, apart = scores.copy(), _APART_S / step_s
    found: list[float] = []
    while len(found) < _CANDIDATES and np.isfinite(waiting).any():
        best = int(waiting.argmax())
        found.append(float(lags[best]) * step_s)
        waiting[np.abs(lags - lags[best]) < apart] = -np.inf
    return found
