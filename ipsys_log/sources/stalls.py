"""Times at which the recorder stood still, and the frames that came late because of that.

A program that is stopped, swapped out or asleep with its machine reads nothing. What cameras send meanwhile
waits in buffers and comes in a burst afterwards. Frames with a capture stamp keep their time; others get that
of their arrival, which is wrong until the burst is over.
"""

from __future__ import annotations

import threading
from collections import deque
from statistics import median
from typing import NamedTuple

from ipsys_log.sources.frames import Clock
from ipsys_log.units import NS_PER_S

__all__ = ["STALL_NS", "Heartbeat", "LateFrames", "Stall"]

# Threads of a busy machine wait less long. Robots are slow: at 1 m/s that is 25 cm.
STALL_NS = NS_PER_S // 4
_BEAT_S = 0.05
# The camera's usual pace is the median of so many intervals; it is back when so many in a row are as long.
_USUAL, _AGAIN = 60, 5
_LIKE_BEFORE = 0.7
_FASTEST_HZ = 60.0


class Stall(NamedTuple):
    """A time in which no thread of the recorder ran, by the log's clock."""

    start_ns: int
    end_ns: int


class Heartbeat:
    """Notes the time again and again; where it was not noted for long, the recorder stood still.

    Parameters
    ----------
    clock : goes on while the machine sleeps.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._last_ns: int | None = None
        self._newest: Stall | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        """Beat from a thread of its own."""
        self._thread.start()

    def stop(self) -> None:
        self._stopped.set()

    def beat(self, now_ns: int) -> Stall | None:
        """Note a time, and return the newest stall. Any thread may: the first that runs again finds it."""
        with self._lock:
            if self._last_ns is not None and now_ns - self._last_ns > STALL_NS:
                self._newest = Stall(self._last_ns, now_ns)
            self._last_ns = max(now_ns, self._last_ns or now_ns)
            return self._newest

    def _run(self) -> None:
        while not self._stopped.wait(_BEAT_S):
            self.beat(self._clock.now_ns())


class LateFrames:
    """Tells for one camera without capture stamps which of its frames come late after a stall.

    From a stall on they do, until frames come at the camera's usual pace again.

    Parameters
    ----------
    rate_hz : of the camera, for as long as no pace is known.

    Attributes
    ----------
    since_ns : when the stall began that frames are late from, None while they are in time.
    last_ns : arrival of the last frame.
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
        """Take the arrival of a frame; returns a stall that it is the first to be late from."""
        stall, before_ns = self._heartbeat.beat(now_ns), self.last_ns
        self.last_ns = now_ns
        if before_ns is None:  # what was before the first frame is over
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

    def caught_up(self) -> bool:
        """Return whether the frames that were late have all come; then the next ones are in time."""
        usual_ns = median(self._usual_ns) if len(self._usual_ns) >= _AGAIN else self._least_ns
        if (
            self.since_ns is None
            or len(self._after_ns) < _AGAIN
            or median(self._after_ns) < _LIKE_BEFORE * usual_ns
        ):
            return False
        self.since_ns = None
        return True
