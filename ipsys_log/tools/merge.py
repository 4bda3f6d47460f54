"""Merge of the logs of several recorders of one session, each with its own clock."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from ipsys_log.engine.output import check_copy, create_copy, write_message
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation, is_one_of
from ipsys_log.log.merged_logs import merge_messages, merged
from ipsys_log.log.part import copy_records
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import ChannelCut, Merge, MergedLog, Message
from ipsys_log.messages.channels import CUTS, MERGES
from ipsys_log.tools.merge_plan import LogOffset, MergePlan, check_logs_differ, plan_merge

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
    """Open several logs that differ, each in its own session.

    Raises
    ------
    IpsysError
        There are fewer than two logs, one is named twice, or one has no messages.
    """
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
        if not state.valid:
            states[topic] = _hash_in_log_order(plan, topic)
    return states


def _hash_in_log_order(plan: MergePlan, topic: str) -> ChannelHash:
    """Return the hash of a channel that is not in log order in the merged file."""
    state = ChannelHash()
    for _, message in merged(plan.sources, [topic]):
        state.add(message.log_time_ns, message.publish_time_ns, message.data)
    return state


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
