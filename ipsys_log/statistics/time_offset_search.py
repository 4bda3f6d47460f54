"""Coarse search of the time offset between two recordings of the same paths, by their speeds.

The speed of a body does not depend on the coordinates. So the time offset is found before the alignment.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ipsys_log.messages.arrays import Array
from ipsys_log.statistics.path_pairs import PathPair, gap_limit_s
from ipsys_log.vision.time_brackets import bracket_times

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
