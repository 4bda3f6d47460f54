"""What a camera hands over, whatever it is attached by."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S

__all__ = ["Clock", "Frame", "Open", "Say", "SourceError", "instant_ns"]


class SourceError(IpsysError):
    """A camera cannot be opened, or has gone; it may come back."""


class Frame(NamedTuple):
    """A frame as the camera sent it: ``format`` is jpeg, png, h264 or h265; ``time_ns`` is the driver's stamp
    in UTC, None where there is none; ``missed`` frames before it were lost, as the driver counts."""

    data: bytes
    format: str
    time_ns: int | None
    missed: int = 0


# More than the difference of two clocks that are read one after the other.
_LEAST_SLEEP_NS = NS_PER_S // 100


class Clock:
    """UTC that never jumps back: the monotonic clock, anchored to UTC once.

    The monotonic clock stops while the machine sleeps; the time of the sleep is added.
    """

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()
        self._asleep_ns = _asleep_ns()
        # Start time on the monotonic clock, and the offset from then on.
        self._sleeps_ns = [(0, 0)]
        self._read_ns = time.monotonic_ns()

    def now_ns(self) -> int:
        read_ns, slept_ns = self._read_ns, _asleep_ns() - self._asleep_ns
        if slept_ns - self._sleeps_ns[-1][1] > _LEAST_SLEEP_NS:
            self._sleeps_ns.append((read_ns + 1, slept_ns))
        self._read_ns = time.monotonic_ns()
        return self.of_monotonic_ns(self._read_ns)

    def of_monotonic_ns(self, monotonic_ns: int) -> int:
        """Return a stamp of the monotonic clock, such as V4L2's, in UTC."""
        slept_ns = next(slept for since, slept in reversed(self._sleeps_ns) if since <= monotonic_ns)
        return monotonic_ns + self._offset_ns + slept_ns


def _asleep_ns() -> int:
    """Return the time that the machine has slept since its start; 0 if the system does not tell."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return 0
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()


# Tells the user what a camera refused, one line at a time.
Say = Callable[[str], None]
# Opens a camera as the rig wants it. While nothing comes it yields None, at least twice a second, so that its
# thread can end. It ends when there will never be more, as of a file; when a camera has gone it raises
# SourceError.
Open = Callable[[RigCamera, Clock, Say], AbstractContextManager[Iterator[Frame | None]]]


def instant_ns(stamp_ns: int, camera: RigCamera) -> int:
    """The middle of the exposure of a frame's first row, from the driver's stamp.

    Parameters
    ----------
    stamp_ns : of the frame.
    camera : ``stamp`` says what it means, the start where it says nothing.

    Examples
    --------
    >>> camera = RigCamera("red", height=1080, row_time_ns=30_000, exposure_s=0.01, stamp="end")
    >>> instant_ns(100_000_000, camera)
    62630000
    >>> instant_ns(100_000_000, RigCamera("red", exposure_s=0.01, latency_ns=1_000_000))
    104000000
    """
    half_ns = round((camera.exposure_s or 0.0) * NS_PER_S / 2)
    stamp_ns -= camera.latency_ns or 0
    if camera.stamp == "end":
        rows_ns = ((camera.height or 1) - 1) * (camera.row_time_ns or 0)
        return stamp_ns - rows_ns - half_ns
    return stamp_ns + half_ns
