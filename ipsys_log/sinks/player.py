"""The player: it sends the messages of a log through sinks."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress

from ipsys_log.messages import Message
from ipsys_log.sinks.sink import Sink

_MOST_WAITING = 200


def play(
    messages: Iterable[Message],
    sinks: Sequence[Sink],
    pace: Callable[[Message], None] = lambda message: None,
) -> None:
    """Send the messages of a log through sinks. No message is dropped: the log waits for the slowest sink.

    One sink runs in the thread of the caller, several have a thread each.

    Parameters
    ----------
    pace : called before each message is sent; it waits for the time of the message, by a clock of its own.

    Raises
    ------
    Exception
        The error of the first sink that fails; the others end with the messages so far.
    """
    if len(sinks) == 1:
        sinks[0].consume(_paced(messages, pace))
        return
    readers = [_Reader(sink) for sink in sinks]
    try:
        for message in _paced(messages, pace):
            if any(reader.fault for reader in readers):
                break
            for reader in readers:
                reader.put(message)
    except BaseException:
        for reader in readers:
            reader.forget()
        raise
    finally:
        for reader in readers:
            reader.put(None)
    for reader in readers:
        reader.join()
    for reader in readers:
        if reader.fault is not None:
            raise reader.fault


def _paced(messages: Iterable[Message], pace: Callable[[Message], None]) -> Iterator[Message]:
    for message in messages:
        pace(message)
        yield message


class _Reader(threading.Thread):
    """The thread of a sink. It takes all messages, also after the sink has ended: the player never hangs."""

    def __init__(self, sink: Sink) -> None:
        super().__init__(name=f"sink {sink.name}", daemon=True)
        self.fault: Exception | None = None
        self._sink = sink
        self._waiting: queue.Queue[Message | None] = queue.Queue(_MOST_WAITING)
        self.start()

    def put(self, message: Message | None) -> None:
        """Hand over a message, or None at the end; block while the queue is full."""
        self._waiting.put(message)

    def forget(self) -> None:
        """Drop the messages that wait."""
        with suppress(queue.Empty):
            while True:
                self._waiting.get_nowait()

    def run(self) -> None:
        """Give the messages to the sink."""
        messages = iter(self._waiting.get, None)
        try:
            self._sink.consume(messages)
        except Exception as fault:
            self.fault = fault
        for _ in messages:
            pass
