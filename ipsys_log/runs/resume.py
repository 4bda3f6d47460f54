"""Runs that were cut short: what a recorder had written when it was killed stays, if it is right."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Event, Message
from ipsys_log.runs.graph import Task
from ipsys_log.units import format_time

__all__ = ["OtherContentError", "cut_short", "without_held"]


class OtherContentError(Exception):
    """A run holds something that its stage does not make of the log."""


def cut_short(session: Session, target: Path, task: Task, run: str) -> dict[str, int]:
    """What a run in ``target`` holds of a stage that has not signed it: messages by topic, or nothing."""
    signed = any((one.run, one.stage) == (run, task.stage) for one in session.runs())
    if signed or task.step is None or not session.topics(task.writes[0], run):
        return {}
    topics = [topic for payload in task.writes for topic in session.topics(payload, run)]
    here = {topic for reader in session.readers if reader.path == target for topic in reader.channels}
    return {topic: session.count(topic) for topic in topics} if here.issuperset(topics) else {}


def without_held(session: Session, held: Collection[str], made: Iterable[Message]) -> Iterator[Message]:
    """What is missing in a run: those of the messages made that are not there, byte for byte.

    Parameters
    ----------
    held : the run's topics.
    made : all that its stage makes, in log order.

    Raises
    ------
    OtherContentError
        Where the run has something else. Events may be another stage's: these two can share a channel.
    """
    waiting = session.messages(held)
    following = next(waiting, None)
    here: list[Message] = []
    for message in made:
        while following is not None and following.log_time_ns <= message.log_time_ns:
            here.append(following)
            following = next(waiting, None)
        _refuse(one for one in here if one.log_time_ns < message.log_time_ns)
        here = [one for one in here if one.log_time_ns == message.log_time_ns]
        same = next((one for one in here if _same(one, message)), None)
        if same is None:
            yield message
        else:
            here.remove(same)
    _refuse(here)
    _refuse(one for one in (following, *waiting) if one is not None)


def _same(one: Message, other: Message) -> bool:
    return (
        (one.topic, one.publish_time_ns) == (other.topic, other.publish_time_ns)
        and encode(one.payload) == encode(other.payload)
    )  # fmt: skip


def _refuse(left: Iterable[Message]) -> None:
    for one in left:
        if not isinstance(one.payload, Event):
            raise OtherContentError(f"{one.topic} is another one at {format_time(one.log_time_ns)}")
