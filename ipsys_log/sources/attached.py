"""Cameras that send now, as one source of messages.

Each camera has a thread that puts what comes into one queue and does nothing else. Messages get their log
time at one place, where they are taken out of it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from types import TracebackType
from typing import Any, NamedTuple

from ipsys_log.messages import (
    EVENTS_TOPIC,
    Event,
    Message,
    RigCamera,
    image_topic,
)
from ipsys_log.rig import hide_password
from ipsys_log.sources.frames import Clock, Frame, Open, Say, SourceError, instant_ns
from ipsys_log.sources.packets import find_size
from ipsys_log.sources.videos import frame_payload
from ipsys_log.units import NS_PER_S

__all__ = ["Attached", "CameraState"]

# What may wait to be written: some seconds of three cameras, and no more of the memory than that.
_LIMIT_BYTES = 256 << 20
_TICK_S = 0.1
# A camera that opens and then sends nothing is not there.
_FIRST_FRAME_S = 10.0
_REMEMBERED = 20_000
_RETRY_S, _LONGEST_RETRY_S = 0.5, 8.0


@dataclass(slots=True)
class CameraState:
    """What has come of a camera so far: ``size_px`` is the width and height of its frames, as soon as one
    tells; ``dropped`` frames never reached the log."""

    frames: int = 0
    bytes: int = 0
    dropped: int = 0
    up: bool = False
    finished: bool = False
    size_px: tuple[int, int] | None = None
    lost_ns: int | None = None
    failure: BaseException | None = None
    opened: threading.Event = field(default_factory=threading.Event)
    begun: threading.Event = field(default_factory=threading.Event)
    unsaid: int = 0


class _Arrival(NamedTuple):
    received_ns: int
    camera: RigCamera | None
    content: Frame | tuple[str, Any]


class Attached:
    """Cameras of a rig that send frames now. A context manager; iterate over it once.

    Yields messages in the order of their log times, which strictly increase, and None ten times a second
    while nothing comes. It ends when all cameras have (files do), or after :meth:`stop`.

    Parameters
    ----------
    cameras : each with a source.
    open_source : opens any of them.
    clock : the one that all stamps are of.
    say : is told at once what becomes an event too: settings refused, a camera lost or back, frames dropped.
    limit_bytes : what may wait in memory; frames beyond that are dropped, counted and named by an event.

    Attributes
    ----------
    states : by the name of a camera.
    received_ns : when the last frames came, by log time.

    Raises
    ------
    SourceError
        On entering, where a camera cannot be opened or sends nothing.
    """

    def __init__(
        self,
        cameras: Sequence[RigCamera],
        open_source: Open,
        clock: Clock,
        say: Say = lambda text: None,
        limit_bytes: int = _LIMIT_BYTES,
    ) -> None:
        self.states = {camera.name: CameraState() for camera in cameras}
        self.received_ns: dict[int, int] = {}
        self._cameras = list(cameras)
        self.clock = clock
        self._open, self.say, self._limit_bytes = open_source, say, limit_bytes
        self._said: set[str] = set()
        self._closed = False
        self._started = threading.Event()
        self._waiting: deque[_Arrival] = deque()
        self._waiting_bytes = 0
        self._last_ns = 0
        self._fault: BaseException | None = None
        self._arrived = threading.Condition()
        self._stopped = threading.Event()
        self._threads = [
            threading.Thread(target=self._attend, args=(camera,), name=camera.name, daemon=True)
            for camera in cameras
        ]

    def __enter__(self) -> Attached:
        for thread in self._threads:
            thread.start()
        try:
            for camera in self._cameras:
                self._wait_for(camera)
        except BaseException:
            self._end()
            raise
        self._started.set()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()

    def stop(self) -> None:
        """Take no more frames; what has come is still given out. A signal handler may call it."""
        self._stopped.set()

    def __iter__(self) -> Iterator[Message | None]:
        while True:
            with self._arrived:
                if not self._waiting and not self._done():
                    self._arrived.wait(_TICK_S)
                arrival = self._waiting.popleft() if self._waiting else None
                ended = arrival is None and self._done()
                self._closed = self._closed or ended
                if arrival is not None and isinstance(arrival.content, Frame):
                    self._waiting_bytes -= len(arrival.content.data)
            if arrival is not None:
                yield from self._messages(arrival)
            elif self._fault is not None:
                raise self._fault
            elif ended:
                return
            else:
                yield None

    def add(self, topic: str, payload: Any) -> None:
        """Take something else into the stream, such as a measurement: it gets its log time as frames do.

        Raises
        ------
        SourceError
            Where the stream has ended: nobody would write it down.
        """
        with self._arrived:
            if self._closed:
                raise SourceError("the recording has ended")
            self._waiting.append(_Arrival(self.clock.now_ns(), None, (topic, payload)))
            self._arrived.notify()

    def warn(self, kind: str, text: str) -> None:
        """An event of no camera, said at once too; only said where the stream has ended."""
        with suppress(SourceError):
            self.add(EVENTS_TOPIC, Event(self.clock.now_ns(), kind, text))
        self.say(text)

    def now_ns(self) -> int:
        """A log time for what is not of a camera: later than all before."""
        self._last_ns = max(self.clock.now_ns(), self._last_ns + 1)
        return self._last_ns

    def _end(self) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()

    def _done(self) -> bool:
        return all(state.finished for state in self.states.values())

    def _wait_for(self, camera: RigCamera) -> None:
        state = self.states[camera.name]
        state.opened.wait()
        begun = state.begun.wait(_FIRST_FRAME_S)
        if state.failure is not None:
            raise state.failure
        if not begun:
            raise SourceError(
                f"camera {camera.name}: {hide_password(camera.source or '')} sends no frames; look whether "
                "another program uses it"
            )

    # --- the threads ----------------------------------------------------------------------------

    def _attend(self, camera: RigCamera) -> None:
        """Take what a camera sends, for as long as it does, and again when it is back."""
        state = self.states[camera.name]
        retry_s = _RETRY_S
        try:
            while not self._stopped.is_set():
                before = state.frames
                lost = self._take_all(camera, state)
                if lost is None:
                    break
                if not state.begun.is_set():
                    state.failure = lost
                    break
                retry_s = _RETRY_S if state.frames > before else min(2 * retry_s, _LONGEST_RETRY_S)
                self._stopped.wait(retry_s)
        except BaseException as fault:  # whoever opens the cameras, or takes the messages, is to see it
            if state.begun.is_set():
                self._fault = fault
            else:
                state.failure = fault
        finally:
            with self._arrived:
                dropped = self._name_dropped(camera, state)
            state.up, state.finished = False, True
            state.opened.set()
            state.begun.set()
            if dropped is not None:
                self.say(dropped)

    def _take_all(self, camera: RigCamera, state: CameraState) -> SourceError | None:
        """Frames until the source has ended (None), or the camera has gone."""
        try:
            with self._open(camera, self.clock, partial(self._say_setting, camera)) as frames:
                state.opened.set()
                for frame in frames:
                    if self._stopped.is_set():
                        break
                    if frame is not None:
                        self._take(camera, state, frame)
        except SourceError as error:
            if state.up:
                state.up, state.lost_ns = False, self.clock.now_ns()
                self._say("camera_lost", f"{error}; trying again", camera)
            return error
        return None

    def _take(self, camera: RigCamera, state: CameraState, frame: Frame) -> None:
        now_ns = self.clock.now_ns()
        if state.lost_ns is not None:
            gone_s = (now_ns - state.lost_ns) / NS_PER_S
            state.lost_ns = None
            self._say("camera_back", f"camera {camera.name} is back after {gone_s:.1f} s", camera)
        state.up = True
        if state.size_px is None:
            state.size_px = find_size(frame)
        with self._arrived:
            if self._waiting_bytes + len(frame.data) > self._limit_bytes:
                state.dropped += 1
                state.unsaid += 1
                return
            state.frames += 1
            state.bytes += len(frame.data)
            self._waiting_bytes += len(frame.data)
            said = self._name_dropped(camera, state)
            self._waiting.append(_Arrival(now_ns, camera, frame))
            self._arrived.notify()
        if said is not None:  # not while others wait: a terminal may stand still
            self.say(said)
        state.begun.set()
        # What came before the slowest camera would only be late.
        while not self._started.wait(_TICK_S) and not self._stopped.is_set():
            pass

    def _name_dropped(self, camera: RigCamera, state: CameraState) -> str | None:
        if not state.unsaid:
            return None
        text = f"{state.unsaid} frames of camera {camera.name} dropped: the disk is too slow"
        state.unsaid = 0
        self._waiting.append(_event(self.clock.now_ns(), "frames_dropped", text, camera))
        return text

    def _say(self, kind: str, text: str, camera: RigCamera) -> None:
        now_ns = self.clock.now_ns()
        with self._arrived:
            self._waiting.append(_event(now_ns, kind, text, camera))
            self._arrived.notify()
        self.say(text)

    def _say_setting(self, camera: RigCamera, text: str) -> None:
        """What a camera refused, once, however often it is opened."""
        if text not in self._said:
            self._said.add(text)
            self._say("camera_setting", text, camera)

    # --- their messages -------------------------------------------------------------------------

    def _messages(self, arrival: _Arrival) -> Iterator[Message]:
        log_time_ns = self.now_ns()
        camera, content = arrival.camera, arrival.content
        if not isinstance(content, Frame):
            topic, payload = content
            yield Message(topic, log_time_ns, payload.timestamp, payload)
            return
        assert camera is not None
        time_ns = log_time_ns if content.time_ns is None else instant_ns(content.time_ns, camera)
        payload = frame_payload(time_ns, camera.name, content.data, content.format)
        self.received_ns[log_time_ns] = arrival.received_ns
        if len(self.received_ns) > _REMEMBERED:
            del self.received_ns[next(iter(self.received_ns))]
        yield Message(image_topic(camera.name), log_time_ns, time_ns, payload, camera.name)


def _event(time_ns: int, kind: str, text: str, camera: RigCamera) -> _Arrival:
    return _Arrival(time_ns, None, (EVENTS_TOPIC, Event(time_ns, kind, text, camera.name)))
