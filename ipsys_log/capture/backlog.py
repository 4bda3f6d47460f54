"""Recorded frames that wait for the stages, and the frames that are skipped where too many wait."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import TracebackType

from ipsys_log.capture.recorder import Source, Target, write_each
from ipsys_log.images.video import is_keyframe
from ipsys_log.messages import (
    EVENTS_TOPIC,
    FRAME_SKIPPED,
    STAMP_UNRELIABLE,
    CompressedImage,
    CompressedVideo,
    Event,
    Message,
    SkippedVideo,
)

__all__ = ["TICK", "Backlog", "Waiting"]

# Frames of a camera that may wait to be searched; older ones are skipped.
_SEARCHED = 3
# Frames of a video that may wait at all, most of them only to be decoded; that is a second or two.
_DECODED = 30


class Waiting:
    """Frames in the order they came, at most so many of each camera. For one thread, or under a lock.

    Of JPEG pictures the oldest is skipped. A frame of a video is needed by those after it: the oldest is
    still decoded, which takes half of the time, and not searched. Where that is too much as well, all
    frames up to the next keyframe are skipped.
    """

    def __init__(self) -> None:
        self._frames: deque[Message] = deque()
        # Cameras whose next frames are nothing without one that was skipped.
        self._broken: set[str | None] = set()

    def __len__(self) -> int:
        return len(self._frames)

    def take(self) -> list[Message]:
        """All that wait; those of a video that are not to be searched as :class:`SkippedVideo`."""
        taken = list(self._frames)
        self._frames.clear()
        return taken

    def put(self, message: Message) -> list[Message]:
        """Let a frame wait; returns those that are skipped for it, maybe itself."""
        if isinstance(message.payload, CompressedVideo):
            return self._put_video(message)
        self._frames.append(message)
        mine = self._of(message.camera)
        if not isinstance(message.payload, CompressedImage) or len(mine) <= _SEARCHED:
            return []
        self._frames.remove(mine[0])
        return [mine[0]]

    def _put_video(self, message: Message) -> list[Message]:
        if message.camera in self._broken:
            if not is_keyframe(message.payload):
                return [message]
            self._broken.remove(message.camera)
        self._frames.append(message)
        gone = self._jump(message.camera)
        mine = self._of(message.camera)
        searched = [one for one in mine if isinstance(one.payload, CompressedVideo)]
        if len(searched) <= _SEARCHED:
            return gone
        late, following = searched[:2]
        if is_keyframe(following.payload):
            self._leave_out(mine[: mine.index(following)])
        else:
            self._frames[self._frames.index(late)] = replace(late, payload=SkippedVideo(late.payload))
        return [*gone, late]

    def _jump(self, camera: str | None) -> list[Message]:
        """Where too many wait, go on with the newest keyframe, or with the next one; what is skipped."""
        mine = self._of(camera)
        if len(mine) <= _DECODED:
            return []
        keys = [n for n, one in enumerate(mine) if n and is_keyframe(_frame(one))]
        gone = mine[: keys[-1]] if keys else mine
        if not keys:
            self._broken.add(camera)
        self._leave_out(gone)
        return [one for one in gone if isinstance(one.payload, CompressedVideo)]

    def _of(self, camera: str | None) -> list[Message]:
        return [one for one in self._frames if one.camera == camera]

    def _leave_out(self, gone: list[Message]) -> None:
        times_ns = {one.log_time_ns for one in gone}
        self._frames = deque(one for one in self._frames if one.log_time_ns not in times_ns)


def _frame(message: Message) -> CompressedVideo:
    payload: CompressedVideo | SkippedVideo = message.payload
    return payload.frame if isinstance(payload, SkippedVideo) else payload


# Between two messages of a source: nothing more has come so far. It is not in the log.
TICK = Message("", 0, 0, None)
# Whoever interrupts does not wait longer for a recorder that hangs.
_LAST_S = 1.0


class Backlog:
    """Frames that are in the log and that the stages have not seen. A context manager; iterate once.

    A thread of its own writes what a source gives and hands the frames on. Where the stages are slower than
    the cameras, frames are skipped as :class:`~ipsys_log.capture.backlog.Waiting` does, never the recording
    of them, and an event names each. After everything that waits comes a :data:`TICK`.

    Parameters
    ----------
    source : messages, None where nothing comes.
    log : where all of them go.
    now_ns : a log time for an event, called by the thread that takes from the source.
    """

    def __init__(self, source: Source, log: Target, now_ns: Callable[[], int]) -> None:
        self.skipped: Counter[str] = Counter()
        self._source, self._log, self._now_ns = source, log, now_ns
        self._waiting = Waiting()
        self._ended = False
        self._fault: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._record, name="recorder", daemon=True)

    def __enter__(self) -> Backlog:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._source.stop()
        self._thread.join(_LAST_S if isinstance(error, KeyboardInterrupt) else None)

    def __iter__(self) -> Iterator[Message]:
        while True:
            with self._changed:
                while not self._waiting and not self._ended:
                    self._changed.wait()
                taken = self._waiting.take()
            if not taken:
                if self._fault is not None:
                    raise self._fault
                return
            yield from taken
            yield TICK

    def _record(self) -> None:
        try:
            for message in write_each(self._source, self._log):
                if message is not None and (message.camera is not None or _is_read(message)):
                    self._hand_on(message)
        except BaseException as fault:  # raised again where the messages are taken
            self._fault = fault
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()

    def _hand_on(self, message: Message) -> None:
        with self._changed:
            skipped = self._waiting.put(message)
            self._changed.notify()
        for late in skipped:
            camera = str(late.camera)
            self.skipped[camera] += 1
            text = f"a frame of camera {camera} is recorded but was not looked at: the stages are too slow"
            event = Event(late.log_time_ns, FRAME_SKIPPED, text, camera)
            self._log.put(Message(EVENTS_TOPIC, self._now_ns(), event.timestamp, event))


def _is_read(message: Message) -> bool:
    """Return whether a stage reads an event."""
    return isinstance(message.payload, Event) and message.payload.kind == STAMP_UNRELIABLE
