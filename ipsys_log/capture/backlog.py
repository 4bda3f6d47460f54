"""Recorded frames that wait: for the stages, with those that are skipped, or for a measurement."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Self

from ipsys_log.capture.recorder import Recording, Source, write_each
from ipsys_log.errors import WriteError
from ipsys_log.messages import (
    EVENTS_TOPIC,
    FRAME_SKIPPED,
    STAMP_UNRELIABLE,
    CompressedImage,
    CompressedVideo,
    Event,
    Measurement,
    Message,
    SkippedVideo,
)
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.video import is_keyframe

# Number of frames of a camera that may wait for the search; older frames are skipped.
_SEARCHED = 3
# Number of frames of a video that may wait, most of them only for decoding; this is a second or two.
_DECODED = 30


class Waiting:
    """A queue of frames, with a limit for each camera. For one thread, or under a lock.

    For JPEG images, the oldest is skipped. Later frames of a video need the earlier ones: the oldest frame is
    still decoded, which takes half of the time, and not searched. If this is too slow as well, all frames up
    to the next keyframe are skipped.
    """

    def __init__(self) -> None:
        self._frames: deque[Message] = deque()
        # Cameras whose next frames cannot be decoded, because an earlier frame was skipped.
        self._broken: set[str | None] = set()

    def __len__(self) -> int:
        return len(self._frames)

    def take(self) -> list[Message]:
        """Return all waiting frames; video frames that are only decoded are :class:`SkippedVideo`."""
        taken = list(self._frames)
        self._frames.clear()
        return taken

    def put(self, message: Message) -> list[Message]:
        """Enqueue a frame; return the frames skipped to make room, possibly the new one."""
        if isinstance(message.payload, CompressedVideo):
            return self._put_video(message)
        self._frames.append(message)
        if not isinstance(message.payload, CompressedImage):
            return []
        mine = self._of(message.camera)
        if len(mine) <= _SEARCHED:
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
        searched = [queued for queued in mine if isinstance(queued.payload, CompressedVideo)]
        if len(searched) <= _SEARCHED:
            return gone
        late, following = searched[:2]
        if is_keyframe(following.payload):
            self._leave_out(mine[: mine.index(following)])
        else:
            self._frames[self._frames.index(late)] = replace(late, payload=SkippedVideo(late.payload))
        return [*gone, late]

    def _jump(self, camera: str | None) -> list[Message]:
        """Skip frames up to the newest or the next keyframe, if too many wait; return them."""
        mine = self._of(camera)
        if len(mine) <= _DECODED:
            return []
        keys = [n for n, queued in enumerate(mine) if n and is_keyframe(_frame(queued))]
        gone = mine[: keys[-1]] if keys else mine
        if not keys:
            self._broken.add(camera)
        self._leave_out(gone)
        return [skipped for skipped in gone if isinstance(skipped.payload, CompressedVideo)]

    def _of(self, camera: str | None) -> list[Message]:
        return [queued for queued in self._frames if queued.camera == camera]

    def _leave_out(self, gone: list[Message]) -> None:
        times_ns = {skipped.log_time_ns for skipped in gone}
        self._frames = deque(queued for queued in self._frames if queued.log_time_ns not in times_ns)


def _frame(message: Message) -> CompressedVideo:
    payload: CompressedVideo | SkippedVideo = message.payload
    return payload.frame if isinstance(payload, SkippedVideo) else payload


# A tick between two messages of a source: no more messages have come so far. It is not in the log.
TICK = Message("", 0, 0, None)
# After an interrupt, the backlog waits no longer than this for a recorder that hangs.
_LAST_S = 1.0


class Backlog:
    """The frames that are in the log and that the stages have not seen. A context manager; iterate once.

    A separate thread writes the messages of a source and passes the frames on. If the stages are slower than
    the cameras, frames are skipped as in :class:`~ipsys_log.capture.backlog.Waiting`. The recording loses no
    frame, and an event names each skipped frame. After all waiting messages, and after an event, comes a
    :data:`TICK`. The events that no stage reads do not pass the stages: :meth:`take_events` returns them.

    Parameters
    ----------
    source : messages, and None if no message came.
    log : the log for all messages.
    now_ns : returns a log time for an event; called by the thread that reads the source.
    put : takes the messages for the log; None: the log itself does.
    """

    def __init__(
        self,
        source: Source,
        log: Recording,
        now_ns: Callable[[], int],
        put: Callable[[Message], None] | None = None,
    ) -> None:
        self.skipped: Counter[str] = Counter()
        self._source, self._log, self._now_ns, self._put = source, log, now_ns, put or log.put
        self._waiting = Waiting()
        self._events: list[Message] = []
        self._ended = False
        self._fault: BaseException | None = None
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._record, name="recorder", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._source.stop()
        self._thread.join(_LAST_S if isinstance(error, KeyboardInterrupt) else None)

    def __iter__(self) -> Iterator[Message]:
        while True:
            with self._changed:
                while not self._waiting and not self._events and not self._ended:
                    self._changed.wait()
                taken, has_ended = self._waiting.take(), self._ended
            if not taken and has_ended:
                if self._fault is not None:
                    raise self._fault
                return
            yield from taken
            yield TICK

    def take_events(self) -> list[Message]:
        """Return the written events since the last call, without those that a stage reads."""
        with self._changed:
            taken, self._events = self._events, []
            return taken

    def _record(self) -> None:
        try:
            for message in write_each(self._source, self._log, self._put):
                if message.camera is not None or _is_read(message):
                    self._hand_on(message)
                elif isinstance(message.payload, Event):
                    self._note(message)
        except BaseException as fault:  # raised again in the thread that takes the messages
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
            text = f"a frame of camera {camera} is skipped: processing cannot keep up. The frame is recorded"
            event = Event(late.log_time_ns, FRAME_SKIPPED, text, camera)
            report = Message(EVENTS_TOPIC, self._now_ns(), event.timestamp, event)
            self._put(report)
            self._note(report)

    def _note(self, event: Message) -> None:
        with self._changed:
            self._events.append(event)
            self._changed.notify()


def _is_read(message: Message) -> bool:
    """Return whether a stage reads an event."""
    return isinstance(message.payload, Event) and message.payload.kind == STAMP_UNRELIABLE


# Longer than the stationary interval of a measurement and the delay of the stages.
BUFFER_NS = 5 * NS_PER_S
# Eight cameras at 60 frames/s send less in two seconds. Beyond this limit, a calibration point gets only the
# frames that the buffer still holds.
_LIMIT_BYTES = 256 << 20
# Longest time from the time of a frame to the exposure of a marker in it (rolling shutter).
_ROLLING_NS = NS_PER_S // 10


class RecentFrames:
    """A buffer of the last messages of a recording. A context manager: on leaving, it writes the rest.

    Messages enter and leave in the order of log times. A frame is discarded after some seconds, or earlier
    if the buffer is full. Any other message is written then. A measurement is written at once. Before it,
    the buffer writes the frames since the start of the marker's stationary interval. Their order is the same
    as in a full recording.

    Parameters
    ----------
    log : recording that gets the messages.
    limit_bytes : most bytes of frames in the buffer.
    """

    def __init__(self, log: Recording, limit_bytes: int = _LIMIT_BYTES) -> None:
        self._log = log
        self._limit_bytes, self._buffer_bytes = limit_bytes, 0
        self._buffer: deque[Message] = deque()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if not isinstance(error, (WriteError, KeyboardInterrupt)):
            self._write()

    def put(self, message: Message) -> None:
        """Append the next message of a recording."""
        payload = message.payload
        # The event tells a replay which frames have no live results. This log holds no live results.
        if isinstance(payload, Event) and payload.kind == FRAME_SKIPPED:
            return
        self._buffer.append(message)
        self._buffer_bytes += _bytes_of(message)
        if isinstance(payload, Measurement):
            self._write(None if payload.still is None else payload.still.start - _ROLLING_NS)
        while _is_frame(message) and (
            self._buffer[0].log_time_ns < message.log_time_ns - BUFFER_NS
            or self._buffer_bytes > self._limit_bytes
        ):
            oldest = self._take()
            if not _is_frame(oldest):
                self._log.put(oldest)

    def _write(self, since_ns: int | None = None) -> None:
        """Write all messages of the buffer; of the frames, only those since ``since_ns`` (None: no frame)."""
        while self._buffer:
            message = self._take()
            if not _is_frame(message) or (since_ns is not None and message.publish_time_ns >= since_ns):
                self._log.put(message)

    def _take(self) -> Message:
        message = self._buffer.popleft()
        self._buffer_bytes -= _bytes_of(message)
        return message


def _bytes_of(message: Message) -> int:
    return len(message.payload.data) if _is_frame(message) else 0


def _is_frame(message: Message) -> bool:
    return isinstance(message.payload, CompressedImage)
