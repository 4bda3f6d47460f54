"""The rate of the frames of a camera, and the gaps between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.units import NS_PER_S

__all__ = ["FrameGaps", "find_gaps"]

# A gap is this many times longer than the usual interval between frames.
_GAP_FACTOR = 3


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

    Parameters
    ----------
    times_ns : times of the frames in ns, shape (N,), ascending.
    longest_s : the longest interval that is no gap; None: three times the median interval.

    Examples
    --------
    >>> gaps = find_gaps(np.array([0, 1, 2, 3, 9, 10]) * NS_PER_S)
    >>> gaps.rate_hz, gaps.lengths_s
    (1.0, (6.0,))
    """
    if len(times_ns) < 2:
        return FrameGaps()
    steps_s = np.diff(times_ns) / NS_PER_S
    usual_s = float(np.median(steps_s))
    is_gap = steps_s > (_GAP_FACTOR * usual_s if longest_s is None else longest_s)
    steady_s = steps_s[~is_gap]
    return FrameGaps(
        float(1 / steady_s.mean()) if steady_s.any() else None,
        usual_s,
        tuple(times_ns[:-1][is_gap].tolist()),
        tuple(steps_s[is_gap].tolist()),
    )
