"""The result of a repair as text: saved and lost messages."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import ceil

from ipsys_log.app.report.rows import Rows
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.output import IMAGE_SCHEMAS
from ipsys_log.log.reader import LogReader
from ipsys_log.log.recovery import RepairReport
from ipsys_log.units import NS_PER_S, format_bytes, format_time

# A recorder flushes its messages at least once in this time.
_FLUSH_NS = NS_PER_S
# If a file was written this long after its last message, it was copied later, or recorded by another clock.
_COPIED_NS = 10 * NS_PER_S
_MOST_NOTES = 12


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
