"""Consumers of recorded messages, such as displays: none of them can end the recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ipsys_log.messages import Message

__all__ = ["Consumer", "Consumers"]

# Gets messages after they were written, and None if nothing comes.
Consumer = Callable[[Message | None], None]


class Consumers:
    """Pass messages to several consumers. A consumer that raises gets no more messages.

    Parameters
    ----------
    consumers : each gets every message.
    warn : makes an event of a kind and a text, and prints it.
    """

    def __init__(self, consumers: Sequence[Consumer], warn: Callable[[str, str], None]) -> None:
        self._consumers, self._warn = list(consumers), warn
        self._fault: Exception | None = None

    def __call__(self, message: Message | None) -> None:
        for consumer in tuple(self._consumers):
            try:
                consumer(message)
            except Exception as fault:  # any error: the frames are more important
                self._fault = self._fault or fault
                self._consumers.remove(consumer)
                text = " ".join(str(fault).split()) or "no word"
                self._warn("sink_stopped", f"the display stopped ({text}); the recording goes on")

    def check(self) -> None:
        """Raise the error of the first consumer that failed, if one did."""
        if self._fault is not None:
            raise self._fault
