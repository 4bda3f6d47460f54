"""Results of checks and repairs as text and JSON: findings, differences, saved and lost messages."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from math import ceil
from typing import Any

from rich.text import Text

from ipsys_log.app.report.rows import Rows, counted
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.output import IMAGE_SCHEMAS
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import RepairReport
from ipsys_log.plain_text import plain_text
from ipsys_log.tools.differences import Comparison
from ipsys_log.tools.soundness.finding import BROKEN, SOUND, UNREAD, LogCheck, LogFinding
from ipsys_log.units import CM_PER_M, NS_PER_S, format_bytes, format_time

_MOST_LINES = 30
# A recorder flushes its messages at least once in this time.
_FLUSH_NS = NS_PER_S
# If a file was written this long after its last message, it was copied later, or recorded by another clock.
_COPIED_NS = 10 * NS_PER_S
_MOST_NOTES = 12


def check_json(checks: Sequence[LogCheck]) -> dict[str, Any]:
    """Return the results as plain data; notes are included, and missing values are left out."""
    return {
        "state": LogCheck.worst(checks),
        "logs": [
            {
                "path": str(check.path),
                "state": check.state,
                "findings": [
                    {key: value for key, value in asdict(finding).items() if value not in (None, "")}
                    for finding in check.findings
                ],
            }
            for check in checks
        ],
    }


def check_lines(check: LogCheck, details: bool = False) -> Iterator[str]:
    """Yield the answer for a log, then a line for each finding; notes only with ``details``."""
    findings = check.findings if details else check.remarks
    yield f"{check.path}: {_answer(check)}"
    for finding in findings[:_MOST_LINES]:
        if finding is not _first_fault(check):
            yield f"  {_finding_line(finding)}"
        elif finding.advice:
            yield f"  {finding.advice}"
    if len(findings) > _MOST_LINES:
        yield f"  and {len(findings) - _MOST_LINES} more: --json lists all"


def _first_fault(check: LogCheck) -> LogFinding | None:
    return next((finding for finding in check.findings if finding.level in (BROKEN, UNREAD)), None)


def _answer(check: LogCheck) -> str:
    fault = _first_fault(check)
    if fault is not None:
        return f"{check.state}: {plain_text(fault.text)}"
    number = len(check.remarks)
    return SOUND if not number else f"readable, {counted(number, 'remark')}"


def _finding_line(finding: LogFinding) -> str:
    """Return the place, the fault and the advice of a finding in one line."""
    place = [finding.topic] if finding.topic else []
    place += [f"at {format_time(finding.time_ns)}"] if finding.time_ns is not None else []
    place += [f"({finding.count} messages)"] if finding.count is not None and finding.count > 1 else []
    title = f"{' '.join(place)}: " if place else ""
    advice = f"; {finding.advice}" if finding.advice else ""
    return plain_text(f"{title}{finding.text}{advice}")


def comparison_table(found: Sequence[Comparison], sides: tuple[str, str]) -> Rows:
    """Return a table with one row per channel; ``sides`` are the headings of the two compared sides."""
    cells: list[list[str | Text]] = []
    for one in found:
        topic = Text(plain_text(one.topic.removeprefix("/runs/")), style="" if one.equal else "red")
        distances = (_distance(value, one.unit) for value in (one.rms, one.greatest))
        cells.append([topic, str(one.left), str(one.right), _same_text(one), *distances])
    columns = ("channel", *(f">{side}" for side in sides), ">same", ">RMS diff", ">max diff")
    return Rows("", columns, cells)


def _same_text(comparison: Comparison) -> str:
    if not comparison.equal:
        return str(comparison.same)
    return "all" if comparison.repeated else "as written"


def first_difference(found: Sequence[Comparison]) -> str | None:
    """Return the first difference of two sides as text; None if they are equal."""
    different = [comparison for comparison in found if not comparison.equal]
    if not different:
        return None
    if not any(comparison.together for comparison in found if comparison.left > 1):
        return "the two sides have no frame in common: no two messages have the same time"
    first = min(different, key=lambda one: one.first_ns or 0)
    return f"first difference in {first.topic}: {first.first}"


def _distance(value: float | None, unit: str | None) -> str:
    if value is None:
        return ""
    if value == 0:
        return "0"
    return f"{value:.2g} px" if unit == "px" else f"{value * CM_PER_M:.2g} cm"


def comparison_json(found: Sequence[Comparison]) -> dict[str, Any]:
    """Return the comparison as plain data: whether all channels are equal, and each channel."""
    return {
        "equal": all(comparison.equal for comparison in found),
        "channels": [asdict(comparison) for comparison in found],
    }


def repair_lines(report: RepairReport) -> Iterator[str | Rows]:
    """Yield lines and tables, at most 80 columns wide if topics and paths are short."""
    kept = f"{report.messages_kept} messages" if report.messages_kept else "no message"
    if report.changed and report.last_kept_ns is not None:
        yield f"{report.path} repaired: {kept}, up to {format_time(report.last_kept_ns)} UTC"
    else:
        yield f"{report.path} {'repaired' if report.changed else 'is undamaged and unchanged'}: {kept}"
    yield from _about_the_loss(report)
    if report.unchecked:
        yield f"{report.unchecked} of them are from damaged parts: no CRC confirms them"
    if report.damaged_file is not None:
        yield f"the old data are in {report.damaged_file}"
    yield from report.notes[:_MOST_NOTES]
    if len(report.notes) > _MOST_NOTES:
        yield f"and {len(report.notes) - _MOST_NOTES} more notes"
    if report.changed and report.messages_kept:
        yield from _about_the_rig(report)
    if report.cut_off and report.messages_kept:
        yield from _about_the_end(report)


def _about_the_loss(report: RepairReport) -> Iterator[str | Rows]:
    """Yield the number of unreadable bytes, and the known lost messages."""
    if not (report.bytes_lost or report.lost_counts):
        return
    if report.lost_counts and report.uncounted:
        ending = "these messages are lost, and an unknown number of others:"
    elif report.lost_counts:
        ending = "these messages are lost:"
    elif report.uncounted:
        ending = "the number of messages in these bytes is not known"
    else:
        ending = "these bytes contained no message"
    yield f"{format_bytes(report.bytes_lost)} cannot be read; {ending}"
    if report.lost_counts:
        yield _lost_table(report)


def _lost_table(report: RepairReport) -> Rows:
    cells = []
    for topic, number in sorted(report.lost_counts.items()):
        times_ns = report.lost.get(topic, ())
        span = (_clock(min(times_ns)), _clock(max(times_ns))) if len(times_ns) == number else ("", "")
        cells.append([topic, str(number), *span])
    return Rows("", ("channel", ">lost", ">from", ">to (UTC)"), cells)


def _about_the_rig(report: RepairReport) -> Iterator[str]:
    with LogReader(report.path) as log:
        schemas = [channel.schema for channel in log.channels.values() if channel.message_count]
        images = any(schema is not None and schema.name in IMAGE_SCHEMAS for schema in schemas)
        rig = log.channels.get("/rig")
    if images and not (rig and rig.message_count):
        yield "the log has frames but no rig: give one to each command (--rig lab.toml)"


def _about_the_end(report: RepairReport) -> Iterator[str | Rows]:
    """Yield the last message of each recorded channel, and the largest possible number of lost messages."""
    assert report.last_kept_ns is not None
    late_ns = report.written_ns - report.last_kept_ns
    copied = not -_FLUSH_NS < late_ns < _COPIED_NS
    end_ns = None if copied else report.written_ns + _FLUSH_NS
    cells = []
    with LogReader(report.path) as log:
        for topic, channel in sorted(log.channels.items()):
            if run_of_topic(topic) is None and channel.message_count:
                images = channel.schema is not None and channel.schema.name in IMAGE_SCHEMAS
                times_ns = [int(time_ns) for time_ns in log.times(topic)]
                gone = _gone(log, topic, times_ns, end_ns) if images else ""
                cells.append([topic, str(len(times_ns)), _clock(times_ns[-1]), gone])
    yield Rows("", ("channel", ">messages", ">last (UTC)", ">lost, at most"), cells)
    if copied:
        yield "The end of the log is lost. Its time is unknown: the file was copied later."
    else:
        yield (
            f"The file was last written at {_clock(report.written_ns)} UTC. Later messages are lost:\n"
            "at most those of one second, as a recorder writes at least once per second."
        )


def _gone(log: LogReader, topic: str, times_ns: Sequence[int], end_ns: int | None) -> str:
    """Return the possible number of messages of a channel with a constant rate, after its last message.

    The rate is that of the publish times: frames that wait at the start of a recording have log times that
    are too close together.
    """
    if end_ns is None or len(times_ns) < 2:
        return "not known"
    first = next(log.messages([topic]))
    *_, last = log.messages([topic], start_ns=times_ns[-1])
    span_ns = last.publish_time_ns - first.publish_time_ns
    if span_ns <= 0:  # a recorder of others has no publish times
        span_ns = max(times_ns[-1] - times_ns[0], 1)
    rate_hz = (len(times_ns) - 1) * NS_PER_S / span_ns
    return f"{ceil(max(end_ns - times_ns[-1], 0) * rate_hz / NS_PER_S)} at {rate_hz:.1f}/s"


def _clock(time_ns: int) -> str:
    """Format the time of day of a timestamp."""
    return format_time(time_ns).partition(" ")[2]
