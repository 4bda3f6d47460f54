"""The findings of a check of a log, and its result."""

from collections.abc import Iterable
from dataclasses import dataclass

from ipsys_log.log.location import LogLocation

# The levels of a finding. After the level UNREAD, nothing is known of the log.
BROKEN, UNREAD, REMARK, NOTE = "broken", "unread", "remark", "note"
# The states of a log without a fault of the levels BROKEN and UNREAD, which are states, too.
SOUND, READABLE = "sound", "readable"


@dataclass(frozen=True, slots=True)
class LogFinding:
    """A finding of a check.

    Attributes
    ----------
    kind : ``file``, ``schema``, ``message``, ``time``, ``rate``, ``event``, ``reference`` or ``run``.
    level : ``broken``, ``unread``, ``remark``, or ``note``; a log with notes only is sound.
    text : the fault, without its place.
    advice : the next step of the user; "" if there is none.
    topic, time_ns, count : its place: the topic, the first log time in ns, and the number of messages.
    """

    kind: str
    level: str
    text: str
    advice: str = ""
    topic: str | None = None
    time_ns: int | None = None
    count: int | None = None


@dataclass(frozen=True, slots=True)
class LogCheck:
    """The result of the check of a log: its path and its findings, in the order of the checks."""

    path: LogLocation
    findings: tuple[LogFinding, ...] = ()

    def __repr__(self) -> str:
        notes = len(self.findings) - len(self.remarks)
        return f"<LogCheck of {self.path}: {self.state}; {len(self.remarks)} remarks, {notes} notes>"

    @property
    def state(self) -> str:
        """Return ``sound``, ``readable`` (with remarks), ``unread`` or ``broken``."""
        levels = {finding.level for finding in self.findings}
        for fault in (BROKEN, UNREAD):
            if fault in levels:
                return fault
        return READABLE if REMARK in levels else SOUND

    @property
    def remarks(self) -> tuple[LogFinding, ...]:
        """The findings that are no notes."""
        return tuple(finding for finding in self.findings if finding.level != NOTE)

    @staticmethod
    def worst(checks: "Iterable[LogCheck]") -> str:
        """Return the worst state of several logs."""
        order = (SOUND, READABLE, UNREAD, BROKEN)
        return max((check.state for check in checks), key=order.index, default=SOUND)
