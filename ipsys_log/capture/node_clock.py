"""Offset and drift between the clocks of two hosts, from exchanges of messages.

The centre sends a message at `sent_ns` by its clock. The node receives it at `received_ns` and answers at
`replied_ns`, both by the clock of the node; the answer arrives at `back_ns` by the clock of the centre. No
message arrives before it was sent. So each exchange bounds the offset (centre minus node) from below and from
above::

    sent_ns - received_ns  <=  offset  <=  back_ns - replied_ns

A line in the time of the node must separate the lower bounds from the upper ones. The estimate is the middle
of two parallel lines that touch the bounds: jitter moves most bounds away from the lines, and the exchanges
with the least delay decide. With an exponential distribution of the jitter, the likelihood of a drift is
exp(n distance / mean): n exchanges, the distance of the lines, and the mean jitter. The drift is the most
probable one with the normal prior of crystals, so it is near 0 at first. A constant difference between the
delays of both directions cannot be observed. Half of it is an error of the offset; it is always less than
the bound of the estimate.

References: F. Cristian, Probabilistic clock synchronization, Distributed Computing 3 (1989) 146-158; S. B.
Moon, P. Skelly, D. Towsley, Estimation and removal of clock skew from network delay measurements, INFOCOM
1999.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.units import NS_PER_S

# Crystals of computers differ by less, also at extreme temperatures.
_MOST_DRIFT = 500e-6
# The drift of most computers: the standard deviation of the prior.
_DRIFT_SIGMA = 50e-6
# The temperature changes the drift within minutes.
_WINDOW_NS = 60 * NS_PER_S
# Each step of the search leaves two thirds of the range: 1e-9 in the end.
_STEPS = 34
# The round trip is never shorter, in s; the mean jitter is not 0.
_LEAST_JITTER_S = 1e-6
# Each of the first exchanges gives an estimate. Later ones change slowly: they are made after this factor of
# exchanges, or after this time.
_FEW = 10
_GROWTH = 1.1
_REFIT_NS = 5 * NS_PER_S


class Exchange(NamedTuple):
    """The times of one exchange, in ns: the first and the last by the centre, the others by the node."""

    sent_ns: int
    received_ns: int
    replied_ns: int
    back_ns: int

    @property
    def round_trip_ns(self) -> int:
        """The time on the way, in both directions."""
        return (self.back_ns - self.sent_ns) - (self.replied_ns - self.received_ns)


class ClockLine(NamedTuple):
    """The clock of the centre as a line in the time of the node.

    ``offset_ns`` holds at ``node_ns``; ``drift`` is its change in s/s. The offset there lies within
    ``bound_ns``, whatever the delays are, if the drift is at most 500e-6.
    """

    node_ns: int
    offset_ns: int
    drift: float
    bound_ns: int
    exchanges: int

    def to_centre_ns(self, node_ns: int) -> int:
        """Convert a time of the node to the time of the centre.

        Examples
        --------
        >>> ClockLine(1_000, 50, 1e-3, 5, 2).to_centre_ns(3_000)
        3052
        """
        return node_ns + self.offset_ns + round(self.drift * (node_ns - self.node_ns))


def fit_clock(exchanges: list[Exchange]) -> ClockLine:
    """Return the clock of the centre from exchanges with a node.

    Parameters
    ----------
    exchanges : at least one.

    Examples
    --------
    >>> line = fit_clock([Exchange(100, 1010, 1020, 130), Exchange(200, 1104, 1106, 214)])
    >>> line.node_ns, line.offset_ns, line.bound_ns
    (1105, -898, 6)
    """
    reference = exchanges[-1]
    node_ns = (reference.received_ns + reference.replied_ns) // 2
    base_ns = reference.sent_ns - reference.received_ns
    lower_s, upper_s = (
        np.array([(at_ns - node_ns, bound_ns - base_ns) for at_ns, bound_ns in bounds]) / NS_PER_S
        for bounds in (
            [(row.received_ns, row.sent_ns - row.received_ns) for row in exchanges],
            [(row.replied_ns, row.back_ns - row.replied_ns) for row in exchanges],
        )
    )
    drift = _find_drift(lower_s, upper_s, _mean_jitter_s(exchanges))
    offset_s = float(np.mean(_offsets(lower_s, upper_s, drift)))
    bound_ns = round(_bound_s(lower_s, upper_s, offset_s) * NS_PER_S)
    return ClockLine(node_ns, base_ns + round(offset_s * NS_PER_S), drift, bound_ns, len(exchanges))


def _bound_s(lower_s: NDArray[np.float64], upper_s: NDArray[np.float64], offset_s: float) -> float:
    """Return the greatest possible error of an offset, for all delays and for all drifts of computers."""
    least_s = np.max(lower_s[:, 1] - _MOST_DRIFT * np.abs(lower_s[:, 0]))
    most_s = np.min(upper_s[:, 1] + _MOST_DRIFT * np.abs(upper_s[:, 0]))
    return float(max(most_s - offset_s, offset_s - least_s))


def _offsets(lower_s: NDArray[np.float64], upper_s: NDArray[np.float64], drift: float) -> tuple[float, float]:
    """Return the offsets of the highest lower line and of the lowest upper line, in s, for a drift."""
    return (
        float(np.max(lower_s[:, 1] - drift * lower_s[:, 0])),
        float(np.min(upper_s[:, 1] - drift * upper_s[:, 0])),
    )


def _mean_jitter_s(exchanges: list[Exchange]) -> float:
    """Return the mean jitter of a direction, in s; one whole round trip is added, for few exchanges."""
    trips_ns = [exchange.round_trip_ns for exchange in exchanges]
    least_ns, count = min(trips_ns), len(trips_ns)
    return max((sum(trips_ns) - (count - 1) * least_ns) / (2 * count * NS_PER_S), _LEAST_JITTER_S)


def _find_drift(lower_s: NDArray[np.float64], upper_s: NDArray[np.float64], jitter_s: float) -> float:
    """Return the most probable drift: the logarithm of its probability is a concave function."""
    scale = len(lower_s) / jitter_s

    def log_probability(drift: float) -> float:
        low_s, high_s = _offsets(lower_s, upper_s, drift)
        return scale * (high_s - low_s) - (drift / _DRIFT_SIGMA) ** 2 / 2

    low, high = -_MOST_DRIFT, _MOST_DRIFT
    for _ in range(_STEPS):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        is_left = log_probability(left) > log_probability(right)
        low, high = (low, right) if is_left else (left, high)
    return (low + high) / 2


class _Limits(NamedTuple):
    """The limits of the offset at a time of the node, for all delays and for all drifts of computers."""

    node_ns: int
    least_ns: int
    most_ns: int

    @classmethod
    def of(cls, exchange: Exchange) -> "_Limits":
        """Return the limits by an exchange."""
        low_ns, high_ns = exchange.sent_ns - exchange.received_ns, exchange.back_ns - exchange.replied_ns
        room_ns = _drift_ns(exchange.replied_ns - exchange.received_ns)
        return cls(exchange.replied_ns, low_ns - room_ns, high_ns)

    def combine(self, later: "_Limits") -> "_Limits":
        """Return the limits at a later time; the least is above the most if the clock has jumped between."""
        room_ns = _drift_ns(later.node_ns - self.node_ns)
        least_ns, most_ns = self.least_ns - room_ns, self.most_ns + room_ns
        return _Limits(later.node_ns, max(least_ns, later.least_ns), min(most_ns, later.most_ns))


def _drift_ns(span_ns: int) -> int:
    """Return the greatest change of an offset in a time."""
    return math.ceil(_MOST_DRIFT * abs(span_ns))


class ClockHistory:
    """The clock of one session of a node, with its jumps.

    ``line`` is the newest estimate; None before the first exchange.
    """

    def __init__(self) -> None:
        self.line: ClockLine | None = None
        self._limits: _Limits | None = None
        self._exchanges: deque[Exchange] = deque()
        # The lines before each jump, with the range of node times in which they held.
        self._former: list[tuple[int, int, ClockLine]] = []
        self._start_ns = 0

    def add(self, exchange: Exchange) -> int | None:
        """Add an exchange; return the size of a jump of the node's clock before it, in ns, or None."""
        jump_ns = self._take_limits(_Limits.of(exchange))
        if self.line is None or jump_ns is not None:
            if self.line is not None:
                self._former.append((self._start_ns, self._exchanges[-1].replied_ns, self.line))
            self.line = None
            self._exchanges.clear()
            self._start_ns = exchange.received_ns
        self._exchanges.append(exchange)
        while exchange.received_ns - self._exchanges[0].received_ns > _WINDOW_NS:
            self._exchanges.popleft()
        if self._is_fit_due(exchange.received_ns):
            self.line = fit_clock(list(self._exchanges))
        return jump_ns

    def _is_fit_due(self, node_ns: int) -> bool:
        line, count = self.line, len(self._exchanges)
        if line is None or count <= _FEW or count >= _GROWTH * line.exchanges:
            return True
        return node_ns - line.node_ns >= _REFIT_NS

    def to_centre_ns(self, node_ns: int) -> int | None:
        """Convert a time of the node by the estimate that held then; None before the first exchange."""
        if self.line is None:
            return None
        rows = [*self._former, (self._start_ns, self._exchanges[-1].replied_ns, self.line)]
        *_, line = min(rows, key=lambda row: max(row[0] - node_ns, node_ns - row[1], 0))
        return line.to_centre_ns(node_ns)

    def _take_limits(self, limits: _Limits) -> int | None:
        """Take the limits by an exchange; return the size of a jump if they contradict the earlier ones."""
        before, self._limits = self._limits, limits
        if before is None or self.line is None:
            return None
        combined = before.combine(limits)
        if combined.least_ns <= combined.most_ns:
            self._limits = combined
            return None
        expected_ns = self.line.to_centre_ns(limits.node_ns) - limits.node_ns
        return expected_ns - (limits.least_ns + limits.most_ns) // 2
