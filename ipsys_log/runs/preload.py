"""Libraries of later stages, loaded in a thread while other processes compute an earlier stage.

scikit-learn takes a second.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from threading import Thread

from ipsys_log.messages import Message
from ipsys_log.models.table import create


def preload(messages: Iterable[Message], models: Sequence[str]) -> Iterator[Message]:
    """Yield the messages of a stage, and load the libraries of models meanwhile.

    The loading begins after the first message, and the end waits for it. So the imports of the stages never
    meet it: two threads that import modules with mutual imports can see unfinished ones.
    """
    thread = None
    for message in messages:
        yield message
        if thread is None:
            thread = Thread(target=_load, args=(tuple(models),), name="preload", daemon=True)
            thread.start()
    if thread is not None:
        thread.join()


def _load(models: Sequence[str]) -> None:
    for model in models:
        with suppress(Exception):  # the stage that needs it reports the error
            create(model)
