"""The operator of a recording: one device at a time marks events and segments in the log."""

from collections.abc import Callable
from typing import Any, NamedTuple

from ipsys_log.app.web.requests import OperatorSeat
from ipsys_log.errors import IpsysError
from ipsys_log.messages import EVENTS_TOPIC, Event
from ipsys_log.messages.events import MARK, SEGMENT_ENDED, SEGMENT_STARTED
from ipsys_log.plain_text import plain_text

_LONGEST_TEXT, _LONGEST_NAME = 200, 40


class Segment(NamedTuple):
    """A segment of the recording that has started, and not ended yet."""

    name: str
    start_ns: int


class Operator:
    """The actions of the operator; each is an event in the log. For one thread.

    An action raises an IpsysError if another device operates, its text is empty or too long, no segment or
    another one has started, or the recording has ended.

    Parameters
    ----------
    add : writes a payload with a topic to the log, through the queue that gives log times.
    now_ns : the clock of the log times.
    say : shows the text of an event on the terminal.
    seat : the seat of the device that operates, if another page has it, too.

    Attributes
    ----------
    seat : the seat of the device that operates.
    segment : the segment that has started; None: there is none.
    """

    def __init__(
        self,
        add: Callable[[str, Any], None],
        now_ns: Callable[[], int],
        say: Callable[[str], object],
        seat: OperatorSeat | None = None,
    ) -> None:
        self.seat, self._written = OperatorSeat() if seat is None else seat, 0
        self.segment: Segment | None = None
        self._add, self._now_ns, self._say = add, now_ns, say

    @property
    def version(self) -> int:
        """A number that increases with each change of the seat or the segment."""
        return self.seat.version + self._written

    def mark(self, number: int, text: str) -> None:
        """Write a remark of the operator to the log."""
        self.seat.check(number)
        now_ns = self._now_ns()
        self._write(Event(now_ns, MARK, _clean(text, _LONGEST_TEXT, "the text of the mark")), "mark: ")

    def start_segment(self, number: int, name: str) -> None:
        """Start a named segment."""
        self.seat.check(number)
        if self.segment is not None:
            raise IpsysError(f"the segment {self.segment.name} has not ended; stop it first")
        name = _clean(name, _LONGEST_NAME, "the name of the segment")
        start_ns = self._now_ns()
        self._write(Event(start_ns, SEGMENT_STARTED, f"segment {name} started", start=start_ns, segment=name))
        self.segment = Segment(name, start_ns)

    def end_segment(self, number: int) -> None:
        """End the segment that has started."""
        self.seat.check(number)
        if self.segment is None:
            raise IpsysError("no segment has started; start one first")
        (name, start_ns), now_ns = self.segment, self._now_ns()
        text = f"segment {name} ended"
        self._write(Event(now_ns, SEGMENT_ENDED, text, start=start_ns, end=now_ns, segment=name))
        self.segment = None

    def _write(self, event: Event, prefix: str = "") -> None:
        self._add(EVENTS_TOPIC, event)
        self._written += 1
        self._say(f"{prefix}{event.text}")


def _clean(text: str, longest: int, subject: str) -> str:
    """Return a typed text on one line, without control characters."""
    cleaned = plain_text(" ".join(text.split()))
    if not cleaned:
        raise IpsysError(f"{subject} is empty; type a text")
    if len(cleaned) > longest:
        raise IpsysError(f"{subject} has {len(cleaned)} characters; use at most {longest}")
    return cleaned
