"""Sinks: consumers of messages, and the fan-out that hands messages to them. No sink delays a recording."""

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import NoneType
from typing import Protocol, runtime_checkable

from ipsys_log.messages import CompressedImage, CompressedVideo, Message, RawImage, SkippedVideo
from ipsys_log.vision.video import is_keyframe

# Limits of a sink's queue: above the first limit images are dropped, above the second all messages.
_MOST_WITH_IMAGES, _MOST_WAITING = 100, 200
_JOIN_TIMEOUT_S = 2.0
_IMAGES = (CompressedImage, CompressedVideo, RawImage, SkippedVideo)

# The payloads of a sink that gets all messages.
ALL: tuple[type, ...] = (object,)

# Makes an event of a kind and a text, and prints it; called from any thread.
Warn = Callable[[str, str], None]


@runtime_checkable
class InlineSink(Protocol):
    """A sink that never waits, such as a stream of datagrams: it drops what its receivers cannot take.

    It gets its messages in the thread that publishes them. A queue would delay them: a thread that wakes up
    waits for Python's lock (GIL), up to 5 ms for each switch of threads. With ``NoneType`` among its
    ``payloads``, it also gets a tick, a message without a payload, when no frame waits for the stages.
    """

    name: str
    payloads: tuple[type, ...]

    def send(self, message: Message) -> None:
        """Process one message, and return at once."""


@runtime_checkable
class QueuedSink(Protocol):
    """A sink with a thread and a queue of its own, such as a viewer. A slow one loses messages, images first.

    It gets only messages with payloads of some types: images do not fill its queue if it does not read them.
    """

    name: str
    payloads: tuple[type, ...]

    def consume(self, messages: Iterator[Message | None]) -> None:
        """Process all messages; None means that no message waits: then flush the buffers."""


# A function is an inline sink that gets all messages, for parts of the recorder such as its status.
Sink = InlineSink | QueuedSink | Callable[[Message], None]


class DropReport:
    """The number of messages that a sink lost. Events report the 1st, the 10th, the 100th loss, and so on.

    ``name`` is the name of the sink in the events.
    """

    def __init__(self, name: str, warn: Warn) -> None:
        self.count = 0
        self._name, self._warn = name, warn
        self._reported, self._next = 0, 1

    def add(self, reason: str) -> None:
        """Count one lost message."""
        self.count += 1
        if self.count >= self._next:
            self._next *= 10
            self._report(reason)

    def finish(self) -> None:
        """Report the total, unless it is reported already."""
        if self.count > self._reported:
            self._report("in all")

    def _report(self, reason: str) -> None:
        self._reported = self.count
        lost = "1 message" if self.count == 1 else f"{self.count} messages"
        self._warn("sink_dropped", f"{self._name}: {lost} dropped ({reason})")


class LiveQueue:
    """The queue of messages for a sink during a recording. ``put`` never blocks.

    If the sink is too slow, images are dropped first; of a video, all frames up to the next keyframe. Tracks
    and all other messages are dropped last.
    """

    def __init__(self) -> None:
        self._waiting: deque[Message] = deque()
        self._changed = threading.Condition()
        self._closed = False
        # Cameras whose video continues with a keyframe only.
        self._broken: set[str | None] = set()

    def put(self, message: Message) -> bool:
        """Enqueue a message; return False if it is dropped."""
        with self._changed:
            if self._closed:
                return True
            if self._is_dropped(message):
                return False
            self._waiting.append(message)
            self._changed.notify()
            return True

    def close(self) -> None:
        """End the queue: the sink gets the messages that wait, and no more."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __iter__(self) -> Iterator[Message | None]:
        while True:
            with self._changed:
                message = self._waiting.popleft() if self._waiting else None
                if message is None and self._closed:
                    return
            yield message
            if message is None:
                with self._changed:
                    self._changed.wait_for(lambda: self._waiting or self._closed)

    def _is_dropped(self, message: Message) -> bool:
        is_full = len(self._waiting) >= _MOST_WITH_IMAGES
        if isinstance(message.payload, CompressedVideo):
            if is_full:
                self._broken.add(message.camera)
            elif is_keyframe(message.payload):
                self._broken.discard(message.camera)
            return message.camera in self._broken
        return len(self._waiting) >= (
            _MOST_WITH_IMAGES if isinstance(message.payload, _IMAGES) else _MOST_WAITING
        )


class FanOut:
    """The sinks of a recording or a playback, as one function of a message. A context manager.

    Inline sinks get a message at once, before the functions among the sinks. A sink that raises an error gets
    no more messages: an event reports the error, and the recording goes on.

    ``warn`` makes an event of a kind and a text, and prints it; any thread may call it.
    """

    def __init__(self, sinks: Sequence[Sink], warn: Warn) -> None:
        self._warn = warn
        self._fault: Exception | None = None
        self._outlets: list[_Outlet] = []
        self._workers: list[_Worker] = []
        functions = []
        for sink in sinks:
            if isinstance(sink, InlineSink):
                self._outlets.append(_Outlet(sink.name, sink.payloads, sink.send))
            elif isinstance(sink, QueuedSink):
                worker = _Worker(sink, warn, self._report)
                self._workers.append(worker)
                self._outlets.append(_Outlet(sink.name, sink.payloads, worker.put))
            else:
                functions.append(_Outlet("the display", ALL, sink))
        # Streams come first: each step before them delays the positions.
        self._outlets += functions

    def __enter__(self) -> "FanOut":
        for worker in self._workers:
            worker.thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        for worker in self._workers:
            worker.queue.close()
        for worker in self._workers:
            worker.finish()

    def __call__(self, *messages: Message) -> None:
        """Hand messages to each sink, one after the other."""
        for message in messages:
            self._show(message)

    def _show(self, message: Message) -> None:
        if isinstance(message.payload, SkippedVideo):
            message = replace(message, payload=message.payload.frame)
        for outlet in tuple(self._outlets):
            if outlet.wants(message):
                try:
                    outlet.take(message)
                except Exception as fault:  # any error: the frames are more important
                    self._outlets.remove(outlet)
                    self._report(outlet.name, fault)

    def check(self) -> None:
        """Raise the error of the first sink that failed, if one did."""
        if self._fault is not None:
            raise self._fault

    def _report(self, name: str, fault: Exception) -> None:
        self._fault = self._fault or fault
        text = " ".join(str(fault).split()) or type(fault).__name__
        self._warn("sink_stopped", f"{name} stopped ({text}); the recording continues")


@dataclass(frozen=True, slots=True, eq=False)
class _Outlet:
    """A function that takes the messages of a sink: those with some payloads."""

    name: str
    payloads: tuple[type, ...]
    take: Callable[[Message], None]

    def wants(self, message: Message) -> bool:
        """Return whether the sink gets a message; only some get a tick."""
        is_tick = message.payload is None
        return NoneType in self.payloads if is_tick else isinstance(message.payload, self.payloads)


class _Worker:
    """The queue and the thread of a sink."""

    def __init__(self, sink: QueuedSink, warn: Warn, report: Callable[[str, Exception], None]) -> None:
        self.queue = LiveQueue()
        self.thread = threading.Thread(target=self._run, name=f"sink {sink.name}", daemon=True)
        self._sink, self._report = sink, report
        self._drops = DropReport(sink.name, warn)

    def put(self, message: Message) -> None:
        """Enqueue a message, or count it as lost."""
        if not self.queue.put(message):
            self._drops.add("the sink is too slow")

    def finish(self) -> None:
        """Wait for the thread, but not for ever: a window stays open as long as its user wants."""
        self.thread.join(_JOIN_TIMEOUT_S)
        self._drops.finish()

    def _run(self) -> None:
        try:
            self._sink.consume(iter(self.queue))
        except Exception as fault:  # any error: the frames are more important
            self.queue.close()
            self._report(self._sink.name, fault)
