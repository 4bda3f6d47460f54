"""Frames of cameras, and the differences between the requested and the actual settings."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S

__all__ = ["Clock", "Frame", "Given", "Open", "Say", "SourceError", "device_of", "instant_ns", "say_refused"]


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


# By so much may a number differ, relatively: 30000/1001 frames/s are 30.
_NEAR = 0.01


class Given(NamedTuple):
    """What a camera gives; None where it cannot be set, or of the rate, where it cannot be told."""

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    exposure_s: float | None = None
    focus: float | None = None
    gain: float | None = None


def say_refused(camera: RigCamera, given: Given, say: Say) -> None:
    """Say, a line for each, what a camera gives other than the rig asks for.

    Parameters
    ----------
    camera : what is asked for; None stands for whatever the camera likes.
    given : what it gives.
    say : told of each difference.

    Examples
    --------
    >>> say_refused(RigCamera("red", rate_hz=60.0), Given(1920, 1080, 30.0), print)
    camera red: asked for 60 frames/s, gives 30
    """
    size = (camera.width or given.width, camera.height or given.height)
    if given.width and given.height and size != (given.width, given.height):
        text = " x ".join(str(side) for side in size)
        say(f"camera {camera.name}: asked for {text} px, gives {given.width} x {given.height}")
    rows = (
        ("frames/s", camera.rate_hz, given.rate_hz),
        ("s of exposure", camera.exposure_s, given.exposure_s),
        ("of focus", camera.focus, given.focus),
        ("of gain", camera.gain, given.gain),
    )
    for unit, asked, has in rows:
        if asked is None or (has is None and unit == "frames/s"):
            continue
        if has is None:
            say(f"camera {camera.name}: asked for {asked:g} {unit}, which it does not let us set")
        elif abs(asked - has) > _NEAR * max(abs(asked), abs(has)):
            say(f"camera {camera.name}: asked for {asked:g} {unit}, gives {has:g}")


def device_of(source: str) -> str:
    """The device that a source names.

    Examples
    --------
    >>> device_of("usb:2"), device_of("usb:/dev/v4l/by-id/red-camera")
    ('/dev/video2', '/dev/v4l/by-id/red-camera')
    """
    name = source.partition(":")[2]
    return f"/dev/video{name}" if name.isdecimal() else name
