"""Times of the messages of a log: order, stamps of cameras, times far from the rest, and clocks of nodes."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass, field

from ipsys_log.engine.graph import writes
from ipsys_log.engine.provenance import complete_runs
from ipsys_log.engine.states import is_fitted_here
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CLOCKS, MODEL, clock_topic
from ipsys_log.models.table import is_known, reads_corners
from ipsys_log.tools.soundness.finding import REMARK, LogFinding
from ipsys_log.units import NS_PER_S, format_time

_DAY_NS = 86_400 * NS_PER_S
# Messages so many days before or after all others are far from the rest, if they are less than a tenth.
_FAR_DAYS = 30
_FAR_SHARE = 0.1
_ADVICE = "write the latency of the camera into latency_ns, or use a network with equal delays both ways"


@dataclass(slots=True)
class _Occurrences:
    """The number of messages with a fault, and the log time of the first one."""

    count: int = 0
    first_ns: int = 0

    def add(self, time_ns: int) -> None:
        if not self.count:
            self.first_ns = time_ns
        self.count += 1


@dataclass(slots=True)
class MessageTimes:
    """The times of messages in the order of the file; the memory does not grow with their number.

    Parameters
    ----------
    stamped : the topics of images whose publish times are the stamps of a camera.
    """

    stamped: Collection[str]
    _last: dict[str, tuple[int, int]] = field(default_factory=dict)
    _decreasing: dict[str, _Occurrences] = field(default_factory=dict)
    _repeated: dict[str, _Occurrences] = field(default_factory=dict)
    _distant: dict[str, _Occurrences] = field(default_factory=dict)
    _days: dict[int, dict[str, _Occurrences]] = field(default_factory=dict)

    def add(self, topic: str, log_time_ns: int, publish_time_ns: int) -> None:
        """Add the times of the next message in the file."""
        self._days.setdefault(log_time_ns // _DAY_NS, {}).setdefault(topic, _Occurrences()).add(log_time_ns)
        is_stamped = topic in self.stamped
        if topic in self._last:
            last_log_ns, last_stamp_ns = self._last[topic]
            if log_time_ns < last_log_ns:
                self._decreasing.setdefault(topic, _Occurrences()).add(log_time_ns)
            elif is_stamped and publish_time_ns <= last_stamp_ns:
                self._repeated.setdefault(topic, _Occurrences()).add(log_time_ns)
        if is_stamped and abs(publish_time_ns - log_time_ns) > _DAY_NS:
            self._distant.setdefault(topic, _Occurrences()).add(log_time_ns)
        self._last[topic] = log_time_ns, publish_time_ns

    def findings(self) -> Iterator[LogFinding]:
        """Yield the findings, by topic."""
        for tallies, text, advice in (
            (
                self._decreasing,
                "log times decrease",
                "ipsys reads the messages in the order of their times; correct the recorder",
            ),
            (
                self._repeated,
                "capture times do not increase",
                "positions at these times are not reliable; check the clock of the camera",
            ),
            (
                self._distant,
                "capture times are more than a day from the log times",
                "set the clock of the camera, and record again",
            ),
        ):
            for topic, tally in sorted(tallies.items()):
                yield LogFinding("time", REMARK, text, advice, topic, tally.first_ns, tally.count)
        yield from self._far()

    def _far(self) -> Iterator[LogFinding]:
        """Yield a finding for each topic with few messages far from the time of all others."""
        groups: list[list[int]] = []
        for day in sorted(self._days):
            if groups and day - groups[-1][-1] <= _FAR_DAYS:
                groups[-1].append(day)
            else:
                groups.append([day])
        sizes = [sum(t.count for day in group for t in self._days[day].values()) for group in groups]
        main_ns = groups[sizes.index(max(sizes))][0] * _DAY_NS if groups else 0
        for group, size in zip(groups, sizes, strict=True):
            for day in group if size < _FAR_SHARE * sum(sizes) else ():
                for topic, tally in sorted(self._days[day].items()):
                    text = f"log times are far from those of the log ({format_time(main_ns)[:10]})"
                    advice = "the clock of its writer was wrong: leave these messages out"
                    yield LogFinding("time", REMARK, text, advice, topic, tally.first_ns, tally.count)


def check_clocks(session: Session) -> Iterator[LogFinding]:
    """Check the clock estimates of nodes against the newest joint model that was fitted to this log."""
    topics = session.topics(CLOCKS)
    fitted = [run for run in complete_runs(session) if writes(run, MODEL) and is_fitted_here(run)]
    models = [session.payloads(session.topics(MODEL, run.run))[-1] for run in fitted] if topics else []
    joint = [model for model in models if is_known(model.name) and reads_corners(model.name)]
    if not joint:
        return
    # Late: it imports scipy, and most logs have no nodes.
    from ipsys_log.statistics.calibrated_cameras import find_contradicted_clocks

    for one in find_contradicted_clocks(joint[-1], session.payloads(topics)):
        yield LogFinding("time", REMARK, one.text, _ADVICE, clock_topic(one.camera))
