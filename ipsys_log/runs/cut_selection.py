"""Selection of a part of a log: its time range, topics, cameras, runs, robots and frames."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from enum import Enum
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CHANNELS, CUTS, RECORD
from ipsys_log.units import NS_PER_S, format_time

__all__ = ["CutOptions", "Selection", "select"]

_MOST_NAMES = 12


@dataclass(frozen=True, slots=True, kw_only=True)
class CutOptions:
    """The options of a cut; an empty option excludes nothing.

    Attributes
    ----------
    start, end : UTC as text, or seconds from the first message of the log; the end is not included.
    topics, exclude_topics : patterns of topics, with ``*`` and ``?``.
    cameras, runs : names.
    """

    start: str = ""
    end: str = ""
    topics: Sequence[str] = ()
    exclude_topics: Sequence[str] = ()
    cameras: Sequence[str] = ()
    runs: Sequence[str] = ()

    def as_text(self) -> dict[str, str]:
        """Return the options that are set, by name."""
        texts = {
            "start": self.start,
            "end": self.end,
            "topics": " ".join(self.topics),
            "exclude_topics": " ".join(self.exclude_topics),
            "cameras": " ".join(self.cameras),
            "runs": " ".join(self.runs),
        }
        return {name: text for name, text in texts.items() if text}


class _Keep(Enum):
    """The part of a channel that a cut keeps."""

    NOTHING = "nothing"
    RANGE = "the messages in the range"
    ALL = "all messages"


@dataclass(frozen=True, slots=True)
class Selection:
    """The selected part of a log: log times from ``start_ns`` to before ``end_ns``, and a rule per topic."""

    start_ns: int
    end_ns: int
    rules: Mapping[str, _Keep] = field(default_factory=dict)

    def choose(self, topic: str, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return which messages of a topic are selected, (n,), by their log times (n,) in ns."""
        rule = self.rules[topic]
        if rule is not _Keep.RANGE:
            return np.full(len(times_ns), rule is _Keep.ALL)
        return (times_ns >= self.start_ns) & (times_ns < self.end_ns)

    def is_left_out(self, topic: str) -> bool:
        """Return whether the options exclude a whole channel."""
        return self.rules[topic] is _Keep.NOTHING

    def is_ranged(self, topic: str) -> bool:
        """Return whether the time range applies to a channel."""
        return self.rules[topic] is _Keep.RANGE


def select(session: Session, options: CutOptions) -> Selection:
    """Return the part of a log that options select.

    Lasting channels, such as the rig, the models and the measurements, are selected whatever the time range
    and ``topics`` are, and so are the records of the selected runs and of the runs that these have read.

    Raises
    ------
    IpsysError
        A camera, run or topic is not in the log, or the range is outside of it.
    """
    _check_names(session, options)
    start_ns, end_ns = _time_range(session, options)
    lasting = _lasting_topics(session)
    read_too = _with_inputs(session, options.runs)
    camera_of = _cameras(session)

    def rule(topic: str) -> _Keep:
        run = run_of_topic(topic)
        if run is not None and options.runs and run not in read_too:
            return _Keep.NOTHING
        if topic in (RECORD.topic_of(run), CUTS.topic):
            return _Keep.ALL
        if options.cameras and camera_of.get(topic, options.cameras[0]) not in options.cameras:
            return _Keep.NOTHING
        if run is not None and options.runs and run not in options.runs and topic not in lasting:
            return _Keep.NOTHING
        if _matches(topic, options.exclude_topics):
            return _Keep.NOTHING
        if topic in lasting:
            return _Keep.ALL
        return _Keep.RANGE if not options.topics or _matches(topic, options.topics) else _Keep.NOTHING

    topics = {topic for reader in session.readers for topic in reader.channels}
    return Selection(start_ns, end_ns, {topic: rule(topic) for topic in sorted(topics)})


def _lasting_topics(session: Session) -> set[str]:
    runs = [None, *session.run_names()]
    channels = [channel for channel in CHANNELS if channel.lasting]
    return {topic for channel in channels for run in runs for topic in session.topics(channel, run)}


def _cameras(session: Session) -> dict[str, str]:
    """Return the camera by topic; the names of cameras in logs of other programs come from the session."""
    named = {topic: camera_of_topic(topic) for reader in session.readers for topic in reader.channels}
    own = {topic: camera for topic, camera in named.items() if camera is not None}
    by_topic = {
        topic: camera for topics in (session.calibrations, session.images) for camera, topic in topics.items()
    }
    return own | by_topic


def _with_inputs(session: Session, runs: Iterable[str]) -> set[str]:
    """Return runs and all runs that they have read, directly or through others."""
    inputs: dict[str, set[str]] = {}
    for record in session.runs():
        inputs.setdefault(record.run, set()).update(record.input_runs)
    waiting, reached = list(runs), set(runs)
    while waiting:
        new = inputs.get(waiting.pop(), set()) - reached
        reached |= new
        waiting += new
    return reached


def _matches(topic: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(topic, pattern) for pattern in patterns)


def _check_names(session: Session, options: CutOptions) -> None:
    topics = sorted({topic for reader in session.readers for topic in reader.channels})
    _check_known(session, "camera", options.cameras, set(_cameras(session).values()))
    _check_known(session, "run", options.runs, session.run_names())
    for pattern in (*options.topics, *options.exclude_topics):
        if not any(fnmatchcase(topic, pattern) for topic in topics):
            raise IpsysError(f"{session}: no topic fits {pattern!r}; the log has {_listed(topics)}")


def _check_known(session: Session, kind: str, names: Iterable[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise IpsysError(f"{session}: has no {kind} {name!r}; it has {_listed(sorted(known))}")


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _MOST_NAMES
    text = ", ".join(names[:_MOST_NAMES]) or "none"
    return text if more <= 0 else f"{text} and {more} more"


def _time_range(session: Session, options: CutOptions) -> tuple[int, int]:
    first_ns, last_ns = session.start_ns, session.end_ns
    start_ns = _parse_time(options.start, "--start", first_ns) if options.start else first_ns
    end_ns = _parse_time(options.end, "--end", first_ns) if options.end else last_ns + 1
    extent = f"the log is from {format_time(first_ns)} to {format_time(last_ns)} UTC"
    if start_ns >= end_ns and options.start and options.end:
        raise IpsysError(
            f"--end {options.end}: is not after --start {options.start}; give a later end; {extent}"
        )
    if start_ns > last_ns or end_ns <= first_ns:
        raise IpsysError(
            f"{session}: has no message in the range; {extent} ({(last_ns - first_ns) / NS_PER_S:.1f} s)"
        )
    return start_ns, end_ns


def _parse_time(text: str, option: str, first_ns: int) -> int:
    """Return a time in ns: seconds from the first message, or UTC in ISO 8601."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = None
    if seconds is not None and seconds.is_finite() and abs(seconds) < NS_PER_S:
        return first_ns + int(seconds * NS_PER_S)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise IpsysError(
            f"{option} {text}: is no time; give seconds from the start of the log, such as 12.5, or UTC, such "
            f"as '{format_time(first_ns)}'"
        ) from None
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime.fromtimestamp(0, UTC)
    return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1_000
