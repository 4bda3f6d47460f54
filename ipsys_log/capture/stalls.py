"""Detection of stalls of the recorder, and of the late frames that follow them.

A program that is stopped, swapped out or asleep with its machine reads nothing. During this time, frames
wait in buffers. Afterwards they arrive in a burst. Frames with a capture stamp keep their time. The others
get the time of their arrival, which is wrong until the end of the burst.
"""

from __future__ import annotations

import threading
from collections import deque
from statistics import median
from typing import NamedTuple

from ipsys_log.capture.frames import Clock
from ipsys_log.units import NS_PER_S

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

    Parameters
    ----------
    clock : clock that continues while the machine sleeps.
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
