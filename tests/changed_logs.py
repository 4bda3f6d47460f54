"""Copies of logs with changed messages."""

from collections.abc import Callable, Iterator
from pathlib import Path

from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message


def rewrite(
    log: Path,
    change: Callable[[Message], Message | None],
    extra: tuple[Message, ...] = (),
    name: str = "changed.mcap",
) -> Path:
    """Write a log beside another one, with each message changed, or removed if ``change`` returns None.

    The messages ``extra`` come last.
    """
    path = log.with_name(name)

    def messages() -> Iterator[Message]:
        with Session([log]) as session:
            topics = [topic for reader in session.readers for topic in reader.channels]
            changed = (change(message) for message in session.messages(topics))
            yield from (message for message in changed if message is not None)
        yield from extra

    write_log(path, messages())
    return path
