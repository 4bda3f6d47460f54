"""Time line of a playback: the time in the log, as a function of a clock; with a rate, and pauses."""

from __future__ import annotations

from math import inf

from ipsys_log.units import NS_PER_S


class Timeline:
    """The time in a log. All times are in ns; ``now_ns`` is the time of the clock.

    Attributes
    ----------
    rate : seconds of the log in a second of the clock.
    is_paused : the time in the log stands still.
    """

    def __init__(self, time_ns: int, now_ns: int, rate: float = 1.0, is_paused: bool = False) -> None:
        self.rate, self.is_paused = rate, is_paused
        # One instant of the log, and its time by the clock.
        self._time_ns, self._clock_ns = time_ns, now_ns

    def time_ns(self, now_ns: int) -> int:
        """Return the time in the log."""
        if self.is_paused:
            return self._time_ns
        return self._time_ns + round((now_ns - self._clock_ns) * self.rate)

    def clock_ns(self, time_ns: int, now_ns: int) -> int:
        """Return the time of the clock at a time in the log; during a pause, this is now."""
        if self.is_paused:
            return now_ns
        return self._clock_ns + round((time_ns - self._time_ns) / self.rate)

    def delay_s(self, time_ns: int, now_ns: int) -> float:
        """Return how long the clock takes to a time in the log, in s; infinite during a pause."""
        if self.is_paused:
            return inf
        return max(0.0, (self.clock_ns(time_ns, now_ns) - now_ns) / NS_PER_S)

    def jump(self, time_ns: int, now_ns: int) -> None:
        """Set the time in the log."""
        self._time_ns, self._clock_ns = time_ns, now_ns

    def change(self, now_ns: int, rate: float | None = None, is_paused: bool | None = None) -> None:
        """Set the rate, or begin or end a pause, from now on."""
        self.jump(self.time_ns(now_ns), now_ns)
        self.rate = self.rate if rate is None else rate
        self.is_paused = self.is_paused if is_paused is None else is_paused
