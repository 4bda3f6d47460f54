"""Sinks: consumers of messages. They never block a recording; offline, the log waits for them."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Protocol, runtime_checkable

from ipsys_log.images.video import is_keyframe
from ipsys_log.messages import CompressedImage, CompressedVideo, Message, RawImage, SkippedVideo

# Limits of a sink's queue: above the first limit images are dropped, above the second all messages.
_MOST_WITH_IMAGES, _MOST_WAITING = 100, 200
_JOIN_TIMEOUT_S = 2.0
_IMAGES = (CompressedImage, CompressedVideo, RawImage, SkippedVideo)

# Gets messages after they were written, and None if nothing comes. This type is for parts of the recorder
# that return at once, such as its status; everything else is a sink.
Consumer = Callable[[Message | None], None]

# Makes an event of a kind and a text, and prints it; called from any thread.
Warn = Callable[[str, str], None]


class Sink(Protocol):
    """A consumer of messages, such as a display or a stream to robots.

    During a recording, ``consume`` runs in its own thread, behind a :class:`LiveQueue`: a slow sink loses
    messages and does not delay the recording. Offline, the player waits for it, and it loses none.
    """

    name: str

    def consume(self, messages: Iterator[Message | None]) -> None:
        """Process all messages; None means that no message waits: then flush the buffers."""


@runtime_checkable
class SelectiveSink(Sink, Protocol):
    """A sink that gets only messages with payloads of some types: images do not fill its queue."""

    payloads: tuple[type, ...]


@runtime_checkable
class PromptSink(SelectiveSink, Protocol):
    """A sink that never waits, such as a stream of datagrams: it drops what its receivers cannot take.

    During a recording, it gets its messages in the thread that publishes them. A queue would delay them: a
    thread that wakes up waits for Python's lock (GIL), up to 5 ms for each switch of threads.
    """

    def send(self, message: Message) -> None:
        """Process one message, and return at once."""

    def finish(self) -> None:
        """Process the end of the messages."""


def send_all(sink: PromptSink, messages: Iterator[Message | None]) -> None:
    """Let a prompt sink process messages until they end."""
    for message in messages:
        if message is not None:
            sink.send(message)
    sink.finish()


class DropReport:
    """The number of messages that a sink lost. Events report the 1st, the 10th, the 100th loss, and so on.

    Parameters
    ----------
    name : the name of the sink in the events.
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

    Attributes
    ----------
    dropped : number of dropped messages by the last part of their topic, such as ``image``.
    """

    def __init__(self) -> None:
        self.dropped: Counter[str] = Counter()
        self._waiting: deque[Message] = deque()
        self._changed = threading.Condition()
        self._closed = False
        # Cameras whose video continues with a keyframe only.
        self._broken: set[str | None] = set()

    def __len__(self) -> int:
        return len(self._waiting)

    def put(self, message: Message) -> bool:
        """Enqueue a message; return False if it is dropped."""
        with self._changed:
            if self._closed:
                return True
            if self._is_dropped(message):
                self.dropped[message.topic.rpartition("/")[2]] += 1
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


class LiveSinks:
    """The sinks of a recording, as one consumer. A context manager.

    A sink that raises an error gets no more messages: an event reports the error, and the recording goes on.

    Parameters
    ----------
    sinks : each gets every message; prompt sinks at once, the others in their own threads.
    warn : makes an event of a kind and a text, and prints it; called from any thread.
    """

    def __init__(self, sinks: Sequence[Sink], warn: Warn) -> None:
        self._prompt = [sink for sink in sinks if isinstance(sink, PromptSink)]
        queued = [sink for sink in sinks if not isinstance(sink, PromptSink)]
        self.queues = {sink.name: LiveQueue() for sink in queued}
        self._payloads = {sink.name: sink.payloads for sink in queued if isinstance(sink, SelectiveSink)}
        self._drops = {sink.name: DropReport(sink.name, warn) for sink in queued}
        self._warn = warn
        self._fault: Exception | None = None
        self._threads = [
            threading.Thread(target=self._run, args=(sink,), name=f"sink {sink.name}", daemon=True)
            for sink in queued
        ]

    def __enter__(self) -> LiveSinks:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for sink in tuple(self._prompt):
            self._call(sink, sink.finish)
        for waiting in self.queues.values():
            waiting.close()
        for thread in self._threads:
            thread.join(_JOIN_TIMEOUT_S)  # a window stays open as long as its user wants
        for drops in self._drops.values():
            drops.finish()

    def __call__(self, message: Message | None) -> None:
        """Hand a message to each sink."""
        if message is None:
            return
        if isinstance(message.payload, SkippedVideo):
            message = replace(message, payload=message.payload.frame)
        for sink in tuple(self._prompt):
            if isinstance(message.payload, sink.payloads):
                self._call(sink, sink.send, message)
        for name, waiting in self.queues.items():
            wanted = name not in self._payloads or isinstance(message.payload, self._payloads[name])
            if wanted and not waiting.put(message):
                self._drops[name].add("the sink is too slow")

    def check(self) -> None:
        """Raise the error of the first sink that failed, if one did."""
        if self._fault is not None:
            raise self._fault

    def _call(self, sink: PromptSink, function: Callable[..., None], *arguments: Message) -> None:
        try:
            function(*arguments)
        except Exception as fault:  # any error: the frames are more important
            self._prompt.remove(sink)
            self._report(sink, fault)

    def _run(self, sink: Sink) -> None:
        waiting = self.queues[sink.name]
        try:
            sink.consume(iter(waiting))
        except Exception as fault:  # any error: the frames are more important
            waiting.close()
            self._report(sink, fault)

    def _report(self, sink: Sink, fault: Exception) -> None:
        self._fault = self._fault or fault
        self._warn("sink_stopped", f"{sink.name} stopped ({_text_of(fault)}); the recording continues")


class Consumers:
    """The consumers of a recording, and its sinks; it passes messages to them. A context manager.

    A consumer that raises an error gets no more messages.

    Parameters
    ----------
    consumers : each gets every message.
    warn : makes an event of a kind and a text, and prints it.
    sinks : each gets every message that is not dropped for it, in its own thread.
    """

    def __init__(self, consumers: Sequence[Consumer], warn: Warn, sinks: Sequence[Sink] = ()) -> None:
        self._sinks = LiveSinks(sinks, warn)
        # Streams come first: each step before them delays the positions.
        self._consumers: list[Consumer] = [self._sinks, *consumers]
        self._warn = warn
        self._fault: Exception | None = None

    def __enter__(self) -> Consumers:
        self._sinks.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._sinks.__exit__(kind, error, trace)

    def __call__(self, message: Message | None) -> None:
        for consumer in tuple(self._consumers):
            try:
                consumer(message)
            except Exception as fault:  # any error: the frames are more important
                self._fault = self._fault or fault
                self._consumers.remove(consumer)
                self._warn(
                    "sink_stopped", f"the display stopped ({_text_of(fault)}); the recording continues"
                )

    def check(self) -> None:
        """Raise the error of the first consumer or sink that failed, if one did."""
        if self._fault is not None:
            raise self._fault
        self._sinks.check()


def _text_of(fault: Exception) -> str:
    """Return the text of an error on one line; its type if it has no text."""
    try:
        return " ".join(str(fault).split()) or type(fault).__name__
    except Exception:  # an error without a text
        return type(fault).__name__
