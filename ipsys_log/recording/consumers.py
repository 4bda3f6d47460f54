"""Those that are shown what was recorded: none of them can end the recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ipsys_log.messages import Message

__all__ = ["Consumer", "Consumers"]

# Is shown messages after they were written, and None where nothing comes.
Consumer = Callable[[Message | None], None]


class Consumers:
    """Show messages to several consumers. One that raises is left out from then on.

    Parameters
    ----------
    consumers : each is shown every message.
    warn : makes an event of a kind and a text, and says it.
    """

    def __init__(self, consumers: Sequence[Consumer], warn: Callable[[str, str], None]) -> None:
        self._consumers, self._warn = list(consumers), warn
        self._fault: Exception | None = None

    def __call__(self, message: Message | None) -> None:
        for consumer in tuple(self._consumers):
            try:
                consumer(message)
            except Exception as fault:  # whatever it is, the frames are worth more
                self._fault = self._fault or fault
                self._consumers.remove(consumer)
                text = " ".join(str(fault).split()) or "no word"
                self._warn("sink_stopped", f"the display stopped ({text}); the recording goes on")

    def check(self) -> None:
        """Raise what the first consumer stopped with, if one did."""
        if self._fault is not None:
            raise self._fault
