"""The known times around other times, and values between them, except in gaps."""

from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Array, Indices, Mask, Times


class TimeBrackets(NamedTuple):
    """The known times around k wanted ones.

    ``before`` and ``after`` (k,) are indices of known times; they are equal at a known time. ``share`` (k,)
    is the part of the way between them. ``is_known`` (k,) is False beyond the ends and in a gap.
    """

    before: Indices
    after: Indices
    share: Array
    is_known: Mask

    def mix(self, values: Array) -> Array:
        """Return values (k, ...) on the straight lines between known ones (n, ...); exact at known times."""
        start = values[self.before]
        share = self.share.reshape(-1, *(1,) * (values.ndim - 1))
        return np.asarray(start + share * (values[self.after] - start))


def bracket_times(known: Times | Array, wanted: Times | Array, longest: float) -> TimeBrackets:
    """Find the known times around wanted ones.

    Parameters
    ----------
    known : (n,), ascending, n > 0. If a time occurs twice, the first one counts.
    wanted : (k,), in the same unit.
    longest : the longest gap between two known times over which values are interpolated.

    Examples
    --------
    >>> brackets = bracket_times(np.array([0, 10, 50]), np.array([-1, 0, 4, 30, 50]), 20)
    >>> brackets.is_known.tolist()
    [False, True, True, False, True]
    >>> brackets.mix(np.array([0.0, 1.0, 2.0]))[brackets.is_known].tolist()
    [0.0, 0.4, 2.0]
    """
    after: Indices = np.searchsorted(known, wanted).clip(max=len(known) - 1)
    before = np.where(known[after] > wanted, after - 1, after).clip(min=0)
    start, end = known[before], known[after]
    span = end - start
    is_known = (start <= wanted) & (wanted <= end) & (span <= longest)
    return TimeBrackets(before, after, (wanted - start) / np.where(span > 0, span, 1), is_known)
