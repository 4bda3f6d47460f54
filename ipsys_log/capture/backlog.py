"""Recorded frames that wait for the stages, which may be slower."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from types import TracebackType

from ipsys_log.capture.recorder import Source, Target, written
from ipsys_log.capture.waiting import Waiting
from ipsys_log.messages import EVENTS_TOPIC, FRAME_SKIPPED, STAMP_UNRELIABLE, Event, Message

__all__ = ["TICK", "Backlog"]

# Between two messages of a source: nothing more has come so far. It is not in the log.
TICK = Message("", 0, 0, None)
# Whoever interrupts does not wait longer for a recorder that hangs.
_LAST_S = 1.0


class Backlog:
    """Frames that are in the log and that the stages have not seen. A context manager; iterate once.

    A thread of its own writes what a source gives and hands the frames on. Where the stages are slower than
    the cameras, frames are skipped as :class:`~ipsys_log.capture.waiting.Waiting` does, never the recording
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
            for message in written(self._source, self._log):
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
