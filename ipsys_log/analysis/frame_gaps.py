"""The rate of the frames of a camera, and the gaps between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.units import NS_PER_S

# A gap is this many times longer than the usual interval between frames.
_GAP_FACTOR = 3
# Frames that have waited, as in a stalled recorder, come at intervals below this share of the usual one.
_WAITED_SHARE = 0.5


class FrameGaps(NamedTuple):
    """The rate in Hz without the gaps (None: unknown), the usual interval in s, and the gaps.

    ``starts_ns`` are the times of the last frames before the gaps, ``lengths_s`` their lengths.
    """

    rate_hz: float | None = None
    usual_s: float = 0.0
    starts_ns: tuple[int, ...] = ()
    lengths_s: tuple[float, ...] = ()


def find_gaps(times_ns: NDArray[np.int64], longest_s: float | None = None) -> FrameGaps:
    """Return the rate and the gaps of ascending times.

    Frames that have waited while no frame came follow at short intervals. They are late and not missing, so
    their time is no part of a gap.

    Parameters
    ----------
    times_ns : times of the frames in ns, shape (N,), ascending.
    longest_s : the longest interval that is no gap; None: three times the median interval.

    Examples
    --------
    >>> gaps = find_gaps(np.array([0, 1, 2, 3, 9, 10]) * NS_PER_S)
    >>> gaps.rate_hz, gaps.lengths_s
    (1.0, (6.0,))
    >>> find_gaps(np.array([0, 1, 2, 3, 4, 8, 8.1, 8.2, 8.3, 9, 10, 11]) * NS_PER_S).rate_hz
    1.0
    """
    if len(times_ns) < 2:
        return FrameGaps()
    steps_s = np.diff(times_ns) / NS_PER_S
    usual_s = float(np.median(steps_s))
    limit_s = _GAP_FACTOR * usual_s if longest_s is None else longest_s
    missing_s = {
        place: steps_s[place] - _waited_s(steps_s[place + 1 :], usual_s)
        for place in np.flatnonzero(steps_s > limit_s).tolist()
    }
    gaps_s = {place: float(length_s) for place, length_s in missing_s.items() if length_s > limit_s}
    steady_s = float(np.delete(steps_s, [*gaps_s]).sum())
    steady_s += sum(float(steps_s[place]) - length_s for place, length_s in gaps_s.items())
    count = len(steps_s) - len(gaps_s)
    return FrameGaps(
        count / steady_s if steady_s > 0 else None,
        usual_s,
        tuple(times_ns[[*gaps_s]].tolist()),
        tuple(gaps_s.values()),
    )


def _waited_s(steps_s: NDArray[np.float64], usual_s: float) -> float:
    """Return the time in s for which the first frames have waited, by their intervals (N,) in s."""
    usual_again = np.flatnonzero(steps_s >= _WAITED_SHARE * usual_s)
    short_s = steps_s[: usual_again[0]] if len(usual_again) else steps_s
    return float(np.sum(usual_s - short_s))
