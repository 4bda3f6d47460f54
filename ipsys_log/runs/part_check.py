"""Checks of a part of a log: which results can be repeated, and whether its messages are those of the cut."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator

from ipsys_log.analysis.differences import Comparison
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import ChannelCut, Run
from ipsys_log.runs.graph import input_runs, stage_named
from ipsys_log.runs.options import Progress
from ipsys_log.runs.origins import cut_topics, left_out
from ipsys_log.runs.view import LogView

_STEP = "channels"


def repeatable_topics(session: Session, run: Run, say: Callable[[str], None]) -> set[str]:
    """Return the channels of a stage, in a part of a log, that follow from the inputs in the part.

    If all inputs are whole, also with the shifted times of a merge, these are the channels that are whole,
    too. Otherwise they are the channels without memory, of the cameras whose inputs are in the part.

    Parameters
    ----------
    say : called with the reason if there is no such channel.
    """
    entries = {topic: one for part in cut_topics(session).values() for topic, one in part.items()}
    outputs = {output.topic for output in run.outputs if output.topic in entries} - left_out(session)
    if all(session.count(read.topic) == read.messages for read in run.inputs):
        topics = {
            topic
            for topic in outputs
            if entries[topic].kept == entries[topic].messages and not entries[topic].shared
        }
        reason = "the part does not have its whole results"
    else:
        topics, reason = _stateless_topics(session, run, outputs)
    if not topics:
        say(f"run {run.run}: {run.stage} is not repeated: {reason}")
    return topics


def _stateless_topics(session: Session, run: Run, outputs: Collection[str]) -> tuple[set[str], str]:
    """Return the channels without memory that the part can repeat, and the reason if there are none."""
    stage = stage_named(run.stage)
    if stage is None:
        return set(), "it is not known here"
    missing = [read.topic for read in run.inputs if read.messages and not session.count(read.topic)]
    cameras = {camera_of_topic(topic) for topic in missing}
    if None in cameras:
        return set(), f"its input {next(t for t in missing if camera_of_topic(t) is None)} is not in the part"
    channels = stage.stateless(run.parameters, LogView(session, input_runs(run)))
    if not channels:
        return set(), "its result depends on messages outside of the part"
    stateless = {
        topic
        for topic in outputs
        for channel in channels
        if channel.topic_of(run.run, camera_of_topic(topic)) == topic
    }
    # Messages of several cameras in one channel cannot be repeated without one of the cameras.
    topics = {
        topic
        for topic in stateless
        if not cameras or (camera_of_topic(topic) is not None and camera_of_topic(topic) not in cameras)
    }
    return topics, f"its input {missing[0]} is not in the part" if missing else "the part has no result of it"


def compare_with_cut(
    session: Session, names: Collection[str], repeated: Collection[str], progress: Progress
) -> Iterator[Comparison]:
    """Yield whether the messages of each channel are those that the cut or the merge wrote.

    All bytes of the channels are read.

    Parameters
    ----------
    names : the runs; recorded channels are compared too.
    repeated : channels that are not compared, because they are repeated.
    """
    rows = [
        (reader, one)
        for reader, channels in cut_topics(session).items()
        for one in channels.values()
        if one.topic not in repeated and run_of_topic(one.topic) in (None, *names) and one.kept
    ]
    progress(_STEP, 0, len(rows))
    for done, (reader, one) in enumerate(rows, 1):
        yield _compare(reader, one)
        progress(_STEP, done, len(rows))


def _compare(reader: LogReader, one: ChannelCut) -> Comparison:
    state = ChannelHash()
    for message in reader.messages([one.topic]):
        state.add(message.log_time_ns, message.publish_time_ns, message.data)
    is_same = (state.count, state.digest.hex()) == (one.kept, one.kept_hash)
    count = state.count if is_same else 0
    first = None if is_same else "its messages are not those that the cut or the merge wrote"
    return Comparison(one.topic, state.count, one.kept, count, count, first, repeated=False)
