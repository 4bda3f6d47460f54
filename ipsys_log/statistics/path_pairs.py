"""Paths in two recordings: a coarse search of their time offset, and their positions at common instants.

The speed of a body does not depend on the coordinates. So the time offset is found before the alignment.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Self

import numpy as np

from ipsys_log.messages import Array, Mask
from ipsys_log.vision.time_brackets import bracket_times

# Longest gap for an interpolation, in usual intervals: one missing frame is no gap.
_USUAL_INTERVALS = 2.5
# A gap is never shorter than the first, at high rates, and never longer than the second, at low ones.
_SHORTEST_GAP_S = 0.1
_LONGEST_GAP_S = 1.0
# A jump is this many times longer than the usual distance of a position from its neighbours,
_JUMP = 10.0
# longer than this,
_LEAST_JUMP_M = 0.01
# and needs a larger acceleration than a robot has.
_LARGEST_ACCELERATION_M_S2 = 10.0
# A single jump bends each of its neighbours by half. This share of it is asked for.
_BEND_BACK = 0.25
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
    """Positions of tracks and truth at common instants, (n, 3), and the velocity of the truth."""

    track_m: Array
    true_m: Array
    velocity_m_s: Array


def jumps(times_s: Array, points_m: Array) -> Mask:
    """Return the positions (n,) that jump away from both neighbours and back.

    An interpolation beside a jump has a wrong velocity, which a time offset would follow.
    """
    kept = np.arange(len(times_s))
    limit_s = gap_limit_s(times_s)
    for _ in range(_PASSES):
        if len(kept) < 5:
            break
        steps_s, points = np.diff(times_s[kept]), points_m[kept]
        beside = (steps_s[:-1] <= limit_s) & (steps_s[1:] <= limit_s)
        between_m = points[:-2] + (steps_s[:-1] / (steps_s[:-1] + steps_s[1:]))[:, None] * (
            points[2:] - points[:-2]
        )
        bends_m = np.zeros_like(points)
        bends_m[1:-1] = np.where(beside[:, None], points[1:-1] - between_m, 0.0)
        apart_m = np.linalg.norm(bends_m, axis=1)
        # Beside a jump, the path bends back on both sides. At a step, it does so on one side; where a robot
        # starts or stops, on none.
        none_m = np.zeros((1, bends_m.shape[1]))
        beside_m = np.concatenate([bends_m[1:], none_m]), np.concatenate([none_m, bends_m[:-1]])
        limits_m2 = -_BEND_BACK * apart_m**2
        bends_back = np.logical_and.reduce([(one * bends_m).sum(axis=1) < limits_m2 for one in beside_m])
        # A jump moves the middle of its neighbours, too: only the largest of three is removed.
        largest = apart_m >= np.maximum(np.append(apart_m[1:], 0.0), np.append(0.0, apart_m[:-1]))
        good = ~(largest & bends_back & (apart_m > _longest_step_m(apart_m, steps_s)))
        if good.all():
            break
        kept = kept[good]
    found = np.ones(len(times_s), dtype=np.bool_)
    found[kept] = False
    return found


def _longest_step_m(apart_m: Array, steps_s: Array) -> float:
    """Return the largest distance of a position from the middle of its neighbours that is no jump."""
    turning_m = _LARGEST_ACCELERATION_M_S2 * float(np.median(steps_s)) ** 2 / 2
    return max(_JUMP * float(np.median(apart_m)), _LEAST_JUMP_M, turning_m)


def common_instants(pairs: Sequence[PathPair], offset_s: float) -> CommonInstants:
    """Return the positions of all pairs at the instants of their tracks, without gaps of the truth.

    ``offset_s`` is added to the times of the truth.
    """
    parts: list[tuple[Array, Array, Array]] = []
    for pair in pairs:
        true_m, velocity_m_s, known = Spline.through(pair.true_s, pair.true_m).at(pair.track_s - offset_s)
        parts.append((pair.track_m[known], true_m[known], velocity_m_s[known]))
    return CommonInstants(*(np.concatenate(part) for part in zip(*parts, strict=True)))


class Spline(NamedTuple):
    """A path as a cubic Hermite spline: times (n,) in s, values (n, c), and their slopes (n, c)."""

    times_s: Array
    values: Array
    slopes: Array
    limit_s: float

    @classmethod
    def through(cls, times_s: Array, values: Array) -> Self:
        """Return the spline through values (n, c), with gaps where times are far apart."""
        limit_s = gap_limit_s(times_s)
        return cls(times_s, values, _velocities(times_s, values, limit_s), limit_s)

    def at(self, at_s: Array) -> tuple[Array, Array, Mask]:
        """Return values and slopes (k, c) at times (k,), and a mask of the known ones."""
        times_s, values, slopes, limit_s = self
        if len(times_s) < 2:
            nothing = np.zeros((len(at_s), values.shape[1]))
            return nothing, nothing, np.zeros(len(at_s), dtype=np.bool_)
        brackets = bracket_times(times_s, at_s, limit_s)
        after = brackets.before.clip(max=len(times_s) - 2) + 1
        start_s, step_s = times_s[after - 1], times_s[after] - times_s[after - 1]
        u, h = ((at_s - start_s) / step_s)[:, None], step_s[:, None]
        p, q, v, w = values[after - 1], values[after], slopes[after - 1] * h, slopes[after] * h
        # The cubic with these ends p, q and slopes v, w, by powers of u.
        second, third = 3 * (q - p) - 2 * v - w, 2 * (p - q) + v + w
        value = p + u * (v + u * (second + u * third))
        return value, (v + u * (2 * second + 3 * u * third)) / h, brackets.is_known & (step_s <= limit_s)


def _velocities(times_s: Array, points_m: Array, limit_s: float) -> Array:
    """Return central differences (n, c) per s; at the border of a gap, the difference on its other side."""
    if len(times_s) < 2:
        return np.zeros_like(points_m)
    steps_s = np.diff(times_s)
    slopes = np.diff(points_m, axis=0) / steps_s[:, None]
    weights = np.where(steps_s <= limit_s, steps_s, 1e-12)[:, None]
    rows = np.concatenate([slopes[:1] * 0, slopes * weights]) + np.concatenate(
        [slopes * weights, slopes[:1] * 0]
    )
    total = np.concatenate([[[0.0]], weights]) + np.concatenate([weights, [[0.0]]])
    return np.asarray(rows / total)


# The other path is smoothed over 4 steps: its noise would be taken for motion. A cubic stays as it is.
_SMOOTH_STEP_S = 0.025


class Body(NamedTuple):
    """A robot in both systems, each in s since an own zero.

    Attributes
    ----------
    track_s, track_m, heading_rad : (n,), (n, 3), (n,) of the marker in the lab; NaN without a heading.
    other_s, other_m : (k,), (k, 3) of the other body.
    axes : (k, 3, 3), rotations from the other body to its coordinates; NaN where they are unknown.
    spline : positions and rotations of the other body, (k, 12).
    """

    track_s: Array
    track_m: Array
    heading_rad: Array
    other_s: Array
    other_m: Array
    axes: Array
    spline: Spline

    @classmethod
    def of(cls, track: tuple[Array, Array, Array], other_s: Array, other_m: Array, axes: Array) -> Self:
        """Return a body from the three arrays of its track, and those of the other system."""
        spline = Spline.through(other_s, np.concatenate([other_m, axes.reshape(-1, 9)], axis=1))
        return cls(*track, other_s, other_m, axes, spline)

    def with_axes(self, axes: Array) -> Self:
        """Return the body with other rotations (k, 3, 3)."""
        return self.of((self.track_s, self.track_m, self.heading_rad), self.other_s, self.other_m, axes)


def thin(bodies: Sequence[Body], most: int) -> list[Body]:
    """Return bodies with at most so many instants of their tracks, together."""
    every = -(-sum(len(body.track_s) for body in bodies) // most)
    return [
        body._replace(
            track_s=body.track_s[::every],
            track_m=body.track_m[::every],
            heading_rad=body.heading_rad[::every],
        )
        for body in bodies
    ]


def smooth_values(spline: Spline, at_s: Array) -> tuple[Array, Array, Mask]:
    """Return smoothed values (n, c), their exact slopes, and which are known.

    References
    ----------
    Weights of a cubic over five points: Savitzky and Golay, Analytical Chemistry 1964, table I.
    """
    places_s = at_s[None] + _SMOOTH_STEP_S * np.arange(-2.0, 3.0)[:, None]
    value, slope, known = spline.at(places_s.ravel())
    weights = np.array([-3.0, 12.0, 17.0, 12.0, -3.0]) / 35
    shape = (5, len(at_s), -1)
    value, slope = (np.tensordot(weights, rows.reshape(shape), 1) for rows in (value, slope))
    return value, slope, np.asarray(known.reshape(5, -1).all(axis=0))


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


def search_speeds(pairs: Sequence[PathPair]) -> list[tuple[float, float]]:
    """Return time offsets to add to the true times, in s, and correlations: the best agreement first.

    The agreement is the correlation of the speeds on the floor over all instants that both recordings have.
    It is searched over all offsets by the Fourier transform. Neighbours within 1 s count as one offset.

    References
    ----------
    Masked correlation: Padfield, "Masked object registration in the Fourier domain", IEEE Transactions on
    Image Processing 2012, eq. (23).
    """
    return _search([(pair.true_s, pair.true_m, pair.track_s, pair.track_m) for pair in pairs], _speeds)


def search_turns(pairs: Sequence[tuple[Array, Array, Array, Array]]) -> list[tuple[float, float]]:
    """Return offsets and correlations like :func:`search_speeds`, by the agreement of turn rates.

    Turn rates depend neither on the coordinates nor on the place of the marker on its robot, and a
    dead-reckoned path has them right.

    Parameters
    ----------
    pairs : by robot the times (n,) in s and continuous headings (n,) in rad of the other recording, and those
        of the track, (m,) and (m,).
    """
    return _search([(a_s, a[:, None], b_s, b[:, None]) for a_s, a, b_s, b in pairs], _turn_rates)


_Signal = Callable[[Array, Array, float], tuple[Array, Array]]


def _search(pairs: Sequence[tuple[Array, Array, Array, Array]], signal: _Signal) -> list[tuple[float, float]]:
    steps = [float(np.median(np.diff(t))) for pair in pairs for t in (pair[0], pair[2]) if len(t) > 1]
    if not steps:
        return []
    longest_s = max(float(times[-1]) for pair in pairs for times in (pair[0], pair[2]))
    step_s = float(np.clip(max(steps), _SHORTEST_STEP_S, _LONGEST_STEP_S))
    step_s = max(step_s, longest_s / _MOST_STEPS)
    size = 2 * (int(longest_s / step_s) + 2)
    sums = np.zeros((6, size))
    for true_s, true, track_s, track in pairs:
        sums += _correlation_sums(signal(true_s, true, step_s), signal(track_s, track, step_s), size)
    return _peaks(_scores(sums), sums[0], step_s)


def _speeds(times_s: Array, points_m: Array, step_s: float) -> tuple[Array, Array]:
    """Return speeds on the floor at the steps of a grid, with 0 where they are unknown, and a mask 0 or 1."""
    changes_m, known, span_s = _changes(times_s, points_m[:, :2], step_s)
    speeds = np.linalg.norm(changes_m, axis=1) / span_s
    if known.any():
        speeds = np.minimum(speeds, _CLIPPED_ABOVE * np.quantile(speeds[known], 0.9))
    return np.where(known, speeds, 0.0), known.astype(np.float64)


def _turn_rates(times_s: Array, headings_rad: Array, step_s: float) -> tuple[Array, Array]:
    """Return turn rates like :func:`_speeds`."""
    changes, known, span_s = _changes(times_s, headings_rad, step_s)
    rates = changes[:, 0] / span_s
    if known.any():
        limit = _CLIPPED_ABOVE * float(np.quantile(np.abs(rates[known]), 0.95))
        rates = np.clip(rates, -limit, limit)
    return np.where(known, rates, 0.0), known.astype(np.float64)


def _changes(times_s: Array, values: Array, step_s: float) -> tuple[Array, Mask, float]:
    half_s = max(_HALF_WINDOW_S, step_s)
    grid_s: Array = np.arange(int(times_s[-1] / step_s) + 1, dtype=np.float64) * step_s
    ends = [bracket_times(times_s, grid_s + sign * half_s, gap_limit_s(times_s)) for sign in (-1, 1)]
    before, after = (end.mix(values) for end in ends)
    return after - before, ends[0].is_known & ends[1].is_known, 2 * half_s


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


def _peaks(scores: Array, counts: Array, step_s: float) -> list[tuple[float, float]]:
    """Return the lags in s with the best scores, and the correlations there."""
    lags = np.arange(len(scores))
    lags = np.where(lags < len(scores) // 2, lags, lags - len(scores))
    waiting, apart = scores.copy(), _APART_S / step_s
    found: list[tuple[float, float]] = []
    while len(found) < _CANDIDATES and np.isfinite(waiting).any():
        best = int(waiting.argmax())
        found.append((float(lags[best]) * step_s, float(np.tanh(scores[best] / np.sqrt(counts[best])))))
        waiting[np.abs(lags - lags[best]) < apart] = -np.inf
    return found
