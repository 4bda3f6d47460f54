"""Frames of cameras, their actual settings, and late frames after stalls of the recorder.

A program that is stopped, swapped out or asleep with its machine reads nothing. During this time, frames
wait in buffers. Afterwards they arrive in a burst. Frames with a capture stamp keep their time. The others
get the time of their arrival, which is wrong until the end of the burst.
"""

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from statistics import median
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.messages import RigCamera
from ipsys_log.units import NS_PER_S


class SourceError(IpsysError):
    """An error of a camera that cannot be opened, or that is disconnected; the camera may come back."""


class NodeRefusedError(SourceError):
    """An error of a node that answers, but whose frames are not recorded until a user changes it."""


class AccessRefusedError(SourceError):
    """An error of a camera that needs a user and a password, or refuses the present ones."""


class Frame(NamedTuple):
    """A frame as the camera sent it.

    ``format`` is jpeg, png, h264 or h265; or markers, if a node has detected them and sends no image.
    ``time_ns`` is the driver's stamp in UTC; None without a stamp. ``missed`` is the number of frames lost
    directly before this frame, by the count of the driver. ``received_ns`` is the arrival of a frame that
    has waited in a queue of the source; None for other frames. A frame of a node has the session of the node,
    and its number in it.
    """

    data: bytes
    format: str
    time_ns: int | None
    missed: int = 0
    session: str | None = None
    number: int | None = None
    received_ns: int | None = None


class SourceMessage(NamedTuple):
    """A message of a source other than a frame, such as an event; its ``timestamp`` is its time."""

    topic: str
    payload: Any


# Reading two clocks one after the other gives a smaller difference.
_LEAST_SLEEP_NS = NS_PER_S // 100


class Clock:
    """A clock of UTC that never jumps back: the monotonic clock plus an offset, which is read once.

    The monotonic clock stops while the machine sleeps. This clock adds the time of the sleep.
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
        self._read_ns = read_ns = time.monotonic_ns()
        return read_ns + self._offset_ns + self._sleeps_ns[-1][1]

    def to_utc_ns(self, monotonic_ns: int) -> int:
        """Convert a stamp of the monotonic clock, such as a stamp of V4L2, to UTC."""
        slept_ns = next(slept for since, slept in reversed(self._sleeps_ns) if since <= monotonic_ns)
        return monotonic_ns + self._offset_ns + slept_ns


def _asleep_ns() -> int:
    """Return the time that the machine has slept since its start; 0 if the system does not give it."""
    if not hasattr(time, "CLOCK_BOOTTIME"):
        return 0
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()


# The function shows one line of text to the user.
Say = Callable[[str], None]
# The function opens a camera with the settings of the rig, and returns an iterator of its frames. While no
# frame arrives, the iterator yields None at least twice a second, so that its thread can end. The iterator
# ends when no more frames can arrive, for example at the end of a file. When a camera is disconnected, the
# iterator raises SourceError. A source may also yield other messages.
Open = Callable[[RigCamera, Clock, Say], AbstractContextManager[Iterator[Frame | SourceMessage | None]]]


_TURN_S = 0.4


def sleep_until(time_ns: int, clock: Clock) -> Iterator[None]:
    """Sleep until a time; yield None twice a second, as the iterator of an :data:`Open` must."""
    while (left_s := (time_ns - clock.now_ns()) / NS_PER_S) > 0:
        time.sleep(min(left_s, _TURN_S))
        if left_s > _TURN_S:
            yield None


def mid_exposure_ns(stamp_ns: int, camera: RigCamera) -> int:
    """Return the time of the middle of the exposure of a frame's first row, from the driver's stamp.

    Parameters
    ----------
    stamp_ns : stamp of the frame.
    camera : its ``stamp`` gives the meaning of the stamp; None means the start of the exposure.

    Examples
    --------
    >>> camera = RigCamera("red", height=1080, row_time_ns=30_000, exposure_s=0.01, stamp="end")
    >>> mid_exposure_ns(100_000_000, camera)
    62630000
    >>> mid_exposure_ns(100_000_000, RigCamera("red", exposure_s=0.01, latency_ns=1_000_000))
    104000000
    """
    half_ns = round((camera.exposure_s or 0.0) * NS_PER_S / 2)
    stamp_ns -= camera.latency_ns or 0
    if camera.stamp == "end":
        rows_ns = ((camera.height or 1) - 1) * (camera.row_time_ns or 0)
        return stamp_ns - rows_ns - half_ns
    return stamp_ns + half_ns


# Largest relative difference of two equal settings: 30000/1001 frames/s count as 30.
_NEAR = 0.01


class ActualSettings(NamedTuple):
    """The actual settings of a camera.

    None means that the camera cannot set the value. For the rate, None means that it is not known.
    """

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    exposure_s: float | None = None
    focus: float | None = None
    gain: float | None = None


def report_refused_settings(camera: RigCamera, settings: ActualSettings, say: Say) -> None:
    """Report each setting of a camera that differs from the rig, in one line per setting.

    Parameters
    ----------
    camera : the requested settings; None means any value.
    settings : the actual settings.
    say : called with each difference.

    Examples
    --------
    >>> report_refused_settings(RigCamera("red", rate_hz=60.0), ActualSettings(1920, 1080, 30.0), print)
    camera red: asked for 60 frames/s, but the camera gives 30
    """
    size = (camera.width or settings.width, camera.height or settings.height)
    if settings.width and settings.height and size != (settings.width, settings.height):
        text = " x ".join(str(side) for side in size)
        say(
            f"camera {camera.name}: asked for {text} px, but the camera gives {settings.width} x "
            f"{settings.height}"
        )
    rows = (
        ("frames/s", camera.rate_hz, settings.rate_hz),
        ("s of exposure", camera.exposure_s, settings.exposure_s),
        ("of focus", camera.focus, settings.focus),
        ("of gain", camera.gain, settings.gain),
    )
    for unit, requested, actual in rows:
        if requested is None or (actual is None and unit == "frames/s"):
            continue
        if actual is None:
            say(f"camera {camera.name}: asked for {requested:g} {unit}, but the camera cannot set this")
        elif abs(requested - actual) > _NEAR * max(abs(requested), abs(actual)):
            say(f"camera {camera.name}: asked for {requested:g} {unit}, but the camera gives {actual:g}")


def device_path(source: str) -> str:
    """Return the path of the device that a source names.

    Examples
    --------
    >>> device_path("usb:2"), device_path("usb:/dev/v4l/by-id/red-camera")
    ('/dev/video2', '/dev/v4l/by-id/red-camera')
    """
    name = source.partition(":")[2]
    return f"/dev/video{name}" if name.isdecimal() else name


@dataclass(slots=True)
class CameraState:
    """The counts and the properties of the frames of a camera so far.

    ``dropped`` frames arrived, but the log does not hold them. ``missed`` frames were lost before they
    arrived, by the count of the camera's driver. ``format`` is the format of the frames, such as jpeg or
    h264. ``size_px`` is their width and height, as soon as a frame gives it. ``first_bytes`` is the size of
    the first frame, which the log of a node's camera does not hold. ``delay_s`` is the time from exposure to
    arrival of the last frame, if it has a capture stamp.
    """

    frames: int = 0
    bytes: int = 0
    dropped: int = 0
    missed: int = 0
    up: bool = False
    finished: bool = False
    format: str | None = None
    size_px: tuple[int, int] | None = None
    first_bytes: int = 0
    delay_s: float | None = None


# Threads of a busy machine wait for a shorter time. A robot at 1 m/s moves 25 cm in this time.
STALL_NS = NS_PER_S // 4
_BEAT_S = 0.05
# Number of intervals for the median, the usual interval of a camera; number of intervals after a stall whose
# median must be usual again.
_USUAL, _AGAIN = 60, 5
_LIKE_BEFORE = 0.7
_FASTEST_HZ = 60.0


class Stall(NamedTuple):
    """A time in which no thread of the recorder ran, by the log's clock."""

    start_ns: int
    end_ns: int


class Heartbeat:
    """A thread that notes the time periodically; a long gap means that the recorder stood still.

    The clock continues while the machine sleeps.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._last_ns: int | None = None
        self._newest: Stall | None = None
        self._stopped = threading.Event()

    def start(self) -> None:
        """Start the thread that notes the time."""
        self._stopped.clear()
        threading.Thread(target=self._run, name="heartbeat", daemon=True).start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stopped.set()

    def beat(self, now_ns: int) -> Stall | None:
        """Note a time, and return the newest stall.

        After a stall, the first thread that runs again detects it.
        """
        with self._lock:
            if self._last_ns is not None and now_ns - self._last_ns > STALL_NS:
                self._newest = Stall(self._last_ns + 1, now_ns)  # a frame may have arrived at the last time
            self._last_ns = max(now_ns, self._last_ns or now_ns)
            return self._newest

    def _run(self) -> None:
        while not self._stopped.wait(_BEAT_S):
            self.beat(self._clock.now_ns())


class LateFrameDetector:
    """A detector of the late frames after a stall, for one camera without capture stamps.

    Frames are late from a stall on, until they arrive at the camera's usual rate again.

    Parameters
    ----------
    rate_hz : rate of the camera, used until its usual rate is known.

    Attributes
    ----------
    since_ns : start of the stall that made frames late; None while frames arrive in time.
    last_ns : arrival time of the last frame.
    """

    def __init__(self, heartbeat: Heartbeat, rate_hz: float | None) -> None:
        self.since_ns: int | None = None
        self.last_ns: int | None = None
        self._heartbeat = heartbeat
        self._least_ns = NS_PER_S / (rate_hz or _FASTEST_HZ)
        self._stall: Stall | None = None
        self._usual_ns: deque[int] = deque(maxlen=_USUAL)
        self._after_ns: deque[int] = deque(maxlen=_AGAIN)

    def take(self, now_ns: int) -> Stall | None:
        """Note the arrival of a frame; return a stall if this is its first late frame."""
        stall, before_ns = self._heartbeat.beat(now_ns), self.last_ns
        self.last_ns = now_ns
        if before_ns is None:  # a stall before the first frame does not matter
            self._stall = stall
            return None
        if stall is not None and stall != self._stall:
            self._stall = stall
            self._after_ns.clear()
            if self.since_ns is None:
                self.since_ns = stall.start_ns
                return stall
        elif self.since_ns is not None:
            self._after_ns.append(now_ns - before_ns)
        else:
            self._usual_ns.append(now_ns - before_ns)
        return None

    def has_caught_up(self) -> bool:
        """Return whether all late frames have arrived; then the next frames are in time."""
        usual_ns = median(self._usual_ns) if len(self._usual_ns) >= _AGAIN else self._least_ns
        if (
            self.since_ns is None
            or len(self._after_ns) < _AGAIN
            or median(self._after_ns) < _LIKE_BEFORE * usual_ns
        ):
            return False
        self.since_ns = None
        return True
