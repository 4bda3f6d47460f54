"""Playback of a log in real time: the messages at the spacing of their capture times, under control."""

import heapq
import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from math import inf, isfinite
from typing import Any

from ipsys_log.capture.frames import Clock
from ipsys_log.errors import IpsysError
from ipsys_log.messages import FrameTransforms, Latency, Message
from ipsys_log.sinks.streams.poses import NewSession, first_session
from ipsys_log.units import NS_PER_S

# A message is logged at most so long after its capture; a later one is played late.
_LOGGED_AFTER_NS = NS_PER_S
SLOWEST, FASTEST = 0.01, 100.0

Wait = Callable[[threading.Condition, float | None], object]


@dataclass(frozen=True, slots=True)
class PlaybackOptions:
    """The options of a playback.

    Attributes
    ----------
    rate : seconds of the log in a second.
    loop : begin again at the end.
    start_paused : wait for :meth:`Playback.resume` or :meth:`Playback.step`.
    start_offset_s : begin so long after the first message.
    restamp : replace the capture times with the times of the playback.
    """

    rate: float = 1.0
    loop: bool = False
    start_paused: bool = False
    start_offset_s: float = 0.0
    restamp: bool = False

    def __post_init__(self) -> None:
        check_rate(self.rate)
        if not (isfinite(self.start_offset_s) and self.start_offset_s >= 0):
            raise IpsysError(f"start offset {self.start_offset_s} s: give a time of at least 0 s")


def check_rate(rate: float) -> None:
    """Check the rate of a playback."""
    if not SLOWEST <= rate <= FASTEST:
        raise IpsysError(f"rate {rate:g}: give a number from {SLOWEST:g} to {FASTEST:g}")


class Playback:
    """The messages of logs, each at its time; other threads may control them.

    Each start, seek and loop begins with a message of `NewSession`: the receivers forget earlier poses.

    Parameters
    ----------
    read : returns the messages from a log time on, in log order.
    first_ns, last_ns : the capture times of the first and the last message.
    clock : the clock of the playback.
    wait : waits for a change, at most some seconds; a test replaces it.

    Attributes
    ----------
    session : the number of the session; a start, a seek and a loop increase it.
    loop : begin again at the end; it can be set.

    Raises
    ------
    IpsysError
        The start lies after the end of the log.
    """

    def __init__(
        self,
        read: Callable[[int], Iterable[Message]],
        first_ns: int,
        last_ns: int,
        options: PlaybackOptions | None = None,
        clock: Clock | None = None,
        wait: Wait = threading.Condition.wait,
    ) -> None:
        self._read, self._first_ns, self._last_ns = read, first_ns, last_ns
        self._options, self._clock, self._wait = options or PlaybackOptions(), clock or Clock(), wait
        self._start_ns = first_ns + round(self._options.start_offset_s * NS_PER_S)
        if self._start_ns > last_ns:
            raise IpsysError(
                f"start offset {self._options.start_offset_s:g} s: the log ends after {self.duration_s:.3f} s"
            )
        now_ns = self._clock.now_ns()
        self.loop = self._options.loop
        self.session = first_session(now_ns)
        self._changed = threading.Condition()
        self._timeline = _Timeline(self._start_ns, now_ns, self._options.rate, self._options.start_paused)
        self._target_ns: int | None = self._start_ns
        self._steps = self._lead_ns = 0
        # The capture time of the last message: during a pause, others of the same time follow it.
        self._played_ns: int | None = None
        self._stopped = False

    @property
    def duration_s(self) -> float:
        """The time from the first to the last message, in s."""
        return (self._last_ns - self._first_ns) / NS_PER_S

    @property
    def position_s(self) -> float:
        """The time since the first message, in s."""
        return (self._time_ns() - self._first_ns) / NS_PER_S

    @property
    def is_paused(self) -> bool:
        """True while the playback waits for :meth:`resume` or :meth:`step`."""
        return self._timeline.is_paused

    @property
    def rate(self) -> float:
        """The seconds of the log in a second; set it to play faster or slower."""
        return self._timeline.rate

    @rate.setter
    def rate(self, rate: float) -> None:
        check_rate(rate)
        with self._changed:
            self._timeline.change(self._clock.now_ns(), rate=rate)
            self._changed.notify_all()

    def pause(self) -> None:
        """Hold the playback."""
        self._set_paused(True)

    def resume(self) -> None:
        """Continue after a pause."""
        self._set_paused(False)

    def step(self) -> None:
        """Pause, and play the messages of the next capture time."""
        with self._changed:
            self._timeline.change(self._clock.now_ns(), is_paused=True)
            self._steps += 1
            self._changed.notify_all()

    def seek(self, position_s: float, lead_s: float = 0.0) -> None:
        """Continue at a time since the first message, in s; a time outside the log is moved to its end.

        In a pause, the messages of the last ``lead_s`` before it are played at once.
        """
        with self._changed:
            self._lead_ns = round(lead_s * NS_PER_S) if self.is_paused else 0
            time_ns = self._first_ns + round(position_s * NS_PER_S)
            self._target_ns = min(max(time_ns, self._first_ns), self._last_ns)
            self._timeline.jump(self._target_ns, self._clock.now_ns())
            self._changed.notify_all()

    def stop(self) -> None:
        """End the playback. This method takes no lock, so a signal handler may call it."""
        self._stopped = True

    def now_ns(self) -> int:
        """Return the time by which the age of a played message is computed."""
        return self._clock.now_ns() if self._options.restamp else self._time_ns()

    def messages(self) -> Iterator[Message]:
        """Yield the messages, each at its time."""
        while (start_ns := self._begin()) is not None:
            yield Message("", start_ns, start_ns, NewSession(self.session))
            begin_ns = start_ns - self._lead_ns
            for message in in_capture_order(self._read(begin_ns)):
                if message.publish_time_ns >= begin_ns:
                    is_before = message.publish_time_ns < start_ns
                    if not self._wait_until(message.publish_time_ns, is_before):
                        break
                    yield self._stamped(message)
            else:
                self._rewind()

    def _begin(self) -> int | None:
        """Begin the next session; return its start in the log, or None at the end of the playback."""
        with self._changed:
            start_ns, self._target_ns = self._target_ns, None
            self._played_ns = None
            if start_ns is None or self._stopped:
                return None
            self._timeline.jump(start_ns, self._clock.now_ns())
            self.session += 1
            return start_ns

    def _rewind(self) -> None:
        with self._changed:
            if self._target_ns is None and self.loop:
                self._target_ns, self._lead_ns = self._first_ns, 0

    def _wait_until(self, time_ns: int, is_before: bool) -> bool:
        """Wait for the time of a message, unless it is of the lead; return False if another one is next."""
        with self._changed:
            while not self._stopped and self._target_ns is None:
                now_ns = self._clock.now_ns()
                delay_s = self._timeline.delay_s(time_ns, now_ns)
                if self._timeline.is_paused and self._steps and time_ns != self._played_ns:
                    self._steps -= 1
                    self._timeline.jump(time_ns, now_ns)
                    self._played_ns = time_ns
                if is_before or delay_s == 0 or time_ns == self._played_ns:
                    self._played_ns = time_ns
                    return True
                self._wait(self._changed, min(delay_s, _TURN_S))
        return False

    def _set_paused(self, is_paused: bool) -> None:
        with self._changed:
            self._timeline.change(self._clock.now_ns(), is_paused=is_paused)
            self._steps = 0
            self._changed.notify_all()

    def _time_ns(self) -> int:
        return min(self._timeline.time_ns(self._clock.now_ns()), self._last_ns)

    def _stamped(self, message: Message) -> Message:
        if not self._options.restamp:
            return message
        with self._changed:
            clock_ns = self._timeline.clock_ns(message.publish_time_ns, self._clock.now_ns())
        return _restamp(message, clock_ns)


# A call of `stop` takes effect within this time: it takes no lock, and so wakes no thread.
_TURN_S = 0.1


def in_capture_order(messages: Iterable[Message]) -> Iterator[Message]:
    """Yield messages in log order in the order of their capture times."""
    waiting: list[tuple[int, int, Message]] = []
    for number, message in enumerate(messages):
        heapq.heappush(waiting, (message.publish_time_ns, number, message))
        while waiting and waiting[0][0] + _LOGGED_AFTER_NS <= message.log_time_ns:
            yield heapq.heappop(waiting)[-1]
    while waiting:
        yield heapq.heappop(waiting)[-1]


def _restamp(message: Message, time_ns: int) -> Message:
    shift_ns = time_ns - message.publish_time_ns
    payload: Any = message.payload
    if isinstance(payload, FrameTransforms):
        moved = (replace(row, timestamp=row.timestamp + shift_ns) for row in payload.transforms)
        payload = replace(payload, transforms=tuple(moved))
    elif isinstance(payload, Latency):
        times = (field.name for field in fields(payload) if field.name != "camera")
        payload = replace(payload, **{name: getattr(payload, name) + shift_ns for name in times})
    elif hasattr(payload, "timestamp"):
        payload = replace(payload, timestamp=payload.timestamp + shift_ns)
    log_time_ns = message.log_time_ns + shift_ns
    return replace(message, log_time_ns=log_time_ns, publish_time_ns=time_ns, payload=payload)


class _Timeline:
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
