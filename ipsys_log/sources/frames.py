"""What a camera hands over, whatever it is attached by."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera

__all__ = ["Clock", "Frame", "Open", "Say", "SourceError"]


class SourceError(IpsysError):
    """A camera cannot be opened, or has gone; it may come back."""


class Frame(NamedTuple):
    """A frame as the camera sent it: ``format`` is jpeg, png, h264 or h265; ``time_ns`` is the driver's stamp
    in UTC, None where there is none."""

    data: bytes
    format: str
    time_ns: int | None


class Clock:
    """UTC that never jumps: the monotonic clock, anchored to UTC once."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        return self.of_monotonic_ns(time.monotonic_ns())

    def of_monotonic_ns(self, monotonic_ns: int) -> int:
        """A stamp of the monotonic clock, as V4L2's are, in UTC."""
        return monotonic_ns + self._offset_ns


# Tells the user what a camera refused, one line at a time.
Say = Callable[[str], None]
# Opens a camera as the rig wants it. While nothing comes it yields None, at least twice a second, so that its
# thread can end; it ends, or raises SourceError, when the camera has gone.
Open = Callable[[RigCamera, Clock, Say], AbstractContextManager[Iterator[Frame | None]]]
