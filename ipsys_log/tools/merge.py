"""Merge of the logs of several recorders of one session: their clock offsets, and the new log."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ipsys_log.engine.output import check_copy, create_copy, write_message
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.hashing import ChannelHash, hash_messages
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation, is_one_of
from ipsys_log.log.merged_logs import merge_messages, merged
from ipsys_log.log.part import copy_records
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import ChannelCut, Merge, MergedLog, Message
from ipsys_log.messages.channels import CUTS, MARKERS, MERGES
from ipsys_log.plain_text import shell_words
from ipsys_log.tools.clock_offset import MarkerPath, estimate_clock_offset
from ipsys_log.tools.merge_plan import LogOffset, MergePlan, check_logs_differ, plan_merge
from ipsys_log.units import NS_PER_S

_CLOCKS_STEP = "clocks"
_LARGEST_S = 1_000_000_000


@one_reading()
def choose_offsets(
    paths: Sequence[LogLocation], texts: Sequence[str], progress: Progress = lambda stage, done, total: None
) -> list[LogOffset]:
    """Return the offset of each log: of an option ``NAME=SECONDS``, or estimated; 0 for the first log.

    An offset is estimated against all earlier logs, at the times of the first clock.

    Raises
    ------
    IpsysError
        An option names no log, or an offset cannot be estimated.
    """
    given = _given_offsets(paths, texts)
    if len(given) == len(paths) - 1:
        return [given.get(number, LogOffset()) for number in range(len(paths))]
    offsets: list[LogOffset] = []
    earlier: list[MarkerPath] = []
    with ExitStack() as stack:
        sessions = open_logs(paths, stack)
        check_logs_differ(sessions)
        zero_ns = sessions[0].start_ns
        for number, session in enumerate(sessions):
            progress(_CLOCKS_STEP, number, len(sessions))
            offset = given.get(number, LogOffset())
            needs_estimate = number > 0 and number not in given
            own = _marker_paths(session, zero_ns) if needs_estimate or number + 1 < len(paths) else []
            if needs_estimate:
                offset = _estimate(session, earlier, own)
            shift_s = offset.offset_ns / NS_PER_S
            earlier += [path._replace(times_s=path.times_s + shift_s) for path in own]
            offsets.append(offset)
    return offsets


def _estimate(session: Session, earlier: Sequence[MarkerPath], own: Sequence[MarkerPath]) -> LogOffset:
    """Estimate the offset of a log from the paths of its markers and those of earlier logs."""
    option = f"--offset {session.paths[0].stem}=SECONDS"
    try:
        estimate = estimate_clock_offset(earlier, own)
    except FitError as error:
        raise IpsysError(
            f"{session}: its clock offset cannot be estimated from markers in its images and in those of the "
            f"earlier logs: {error}; let a robot stop and go where both see it, run ipsys replay --until "
            f"detect on a log with skipped frames, or give {option}"
        ) from None
    return LogOffset(round(estimate.offset_s * NS_PER_S), estimate.sigma_s)


def _marker_paths(session: Session, zero_ns: int) -> list[MarkerPath]:
    """Return the paths of the markers in the images of each camera, by the newest run with markers."""
    run = newest_run(session, MARKERS)
    if run is None:
        raise IpsysError(
            f"{session}: has no markers, so its clock offset cannot be estimated; run: "
            f"ipsys replay --until detect {shell_words(*session.paths)}, or give all offsets: "
            f"--offset {session.paths[0].stem}=SECONDS"
        )
    rows: defaultdict[tuple[str, int], list[tuple[int, float, float]]] = defaultdict(list)
    for message in session.messages(session.topics(MARKERS, run)):
        for marker in message.payload.markers:
            time_ns = message.publish_time_ns + (marker.time_offset_ns or 0)
            x_px, y_px = marker.corners_px.mean(axis=0).tolist()
            rows[str(message.camera), marker.id].append((time_ns - zero_ns, x_px, y_px))
    return [_path(camera, marker_id, found) for (camera, marker_id), found in sorted(rows.items())]


def _path(camera: str, marker_id: int, rows: list[tuple[int, float, float]]) -> MarkerPath:
    table = np.array(rows, dtype=np.float64)
    _, first = np.unique(table[:, 0], return_index=True)  # ascending times
    return MarkerPath(camera, marker_id, table[first, 0] / NS_PER_S, table[first, 1:])


def _given_offsets(paths: Sequence[LogLocation], texts: Sequence[str]) -> dict[int, LogOffset]:
    """Return the offsets of the options by the number of their log."""
    given: dict[int, LogOffset] = {}
    for text in texts:
        name, _, value = text.rpartition("=")
        numbers = [number for number, path in enumerate(paths) if name in (str(path), path.name, path.stem)]
        if len(numbers) != 1:
            known = ", ".join(path.stem for path in paths[1:])
            raise IpsysError(
                f"--offset {text}: does not name one log; write NAME=SECONDS with one of {known}"
            )
        if numbers[0] == 0:
            raise IpsysError(f"--offset {text}: the clock of the first log counts; give the other offsets")
        if numbers[0] in given:
            raise IpsysError(f"--offset {text}: the log has two offsets; give one")
        given[numbers[0]] = LogOffset(_parse_seconds(text, value))
    return given


def _parse_seconds(text: str, value: str) -> int:
    try:
        seconds = Decimal(value)
    except InvalidOperation:
        seconds = Decimal("nan")
    if not seconds.is_finite() or abs(seconds) > _LARGEST_S:
        raise IpsysError(f"--offset {text}: has no valid number of seconds; write it as NAME=0.012")
    return round(seconds * NS_PER_S)


_STEP = "merge"
_MESSAGES_PER_STEP = 1_000


class MergeResult(NamedTuple):
    """The result of a merge: the number of its messages, and the record of each log."""

    messages: int
    logs: tuple[MergedLog, ...]


@one_reading()
def merge(
    paths: Sequence[LogLocation],
    output: Path,
    offsets: Sequence[LogOffset],
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> MergeResult:
    """Write the messages of several logs into a new log, in log order.

    The offset of a log is added to its log times, its publish times and the times within its messages. All
    else stays the same, except a combined rig. Channels that an earlier log has, with the same messages, come
    once. The new log gets its name when it is complete. It has the attachments and metadata of the logs, and
    the record of the merge as its last message.

    Parameters
    ----------
    offsets : of each log; that of the first log is 0.
    overwrite : replace an existing log.

    Raises
    ------
    IpsysError
        There are fewer than two logs, they have a camera or a result in common, their settings contradict
        each other, or the output exists or is one of the logs.
    """
    check_copy(paths, output, overwrite)
    with ExitStack() as stack:
        sessions = open_logs(paths, stack)
        check_logs_differ(sessions)
        plan = plan_merge(sessions, offsets)
        total = sum(reader.message_count for session in sessions for reader in session.readers)

        def advance(done: int) -> None:
            if done % _MESSAGES_PER_STEP == 0:
                progress(_STEP, done, total)

        writer = stack.enter_context(create_copy(output, overwrite))
        merge_messages(plan.sources, writer, advance)
        for source in plan.sources:
            copy_records(source.reader, writer)
        states = _states(plan, writer)
        logs = tuple(_record(session, plan, number, states) for number, session in enumerate(sessions))
        last_ns = max(state.last_ns for state in states.values())
        write_message(writer, Message(MERGES.topic, last_ns, last_ns, Merge(last_ns, logs)), {})
    return MergeResult(sum(state.count for state in states.values()), logs)


def open_logs(paths: Sequence[LogLocation], stack: ExitStack) -> list[Session]:
    """Open several logs that differ, each in its own session."""
    if len(paths) < 2:
        raise IpsysError("a merge needs two logs or more; name the log of each recorder")
    sessions = []
    for number, path in enumerate(paths):
        earlier = paths[:number]
        if path in earlier or (isinstance(path, Path) and is_one_of(path, earlier)):
            raise IpsysError(f"{path} is named twice; name each log once")
        session = stack.enter_context(Session([path]))
        if not session.readers[0].message_count:
            raise IpsysError(f"{path} has no messages; leave it out")
        sessions.append(session)
    return sessions


def _states(plan: MergePlan, writer: LogWriter) -> dict[str, ChannelHash]:
    """Return the number and the hash of the messages of each channel of the merged log."""
    topics = sorted({topic for source in plan.sources for topic in source.topics})
    states = {topic: writer.hash_of(topic) for topic in topics}
    for topic, state in states.items():
        if not state.valid:  # the channel is not in log order in the merged file
            states[topic] = hash_messages(message for _, message in merged(plan.sources, [topic]))
    return states


def _record(session: Session, plan: MergePlan, number: int, states: dict[str, ChannelHash]) -> MergedLog:
    """Return the record of a log; earlier records of cuts and merges describe the log, and not the merge."""
    source, offset, equal = plan.sources[number], plan.offsets[number], plan.equal[number]
    owners = Counter(topic for one in plan.sources for topic in one.topics)
    channels = []
    for topic in sorted({*source.topics, *equal} - {CUTS.topic, MERGES.topic}):
        name = equal.get(topic, topic)
        state = states[name]
        is_shared = owners[name] > 1 or name in plan.changed
        identity = session.count(topic), session.hash(topic)
        channels.append(ChannelCut(name, *identity, state.count, state.digest.hex(), shared=is_shared))
    return MergedLog(source.reader.path.name, offset.offset_ns, offset.sigma_s, tuple(channels))
