"""Origins of the channels of a part of a log, or of a merged log: their identity before each cut or merge."""

from __future__ import annotations

from typing import NamedTuple

from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.reader import LogReader
from ipsys_log.messages import ChannelCut, ChannelRead, MergedLog, Run
from ipsys_log.messages.channels import Channel


class Origin(NamedTuple):
    """A channel before a cut, or before a merge: the number of its messages, their hash, and its logs.

    ``shift_ns`` is the time that merges have added to its log times since then.
    """

    messages: int
    hash: str
    logs: tuple[str, ...]
    is_merged: bool
    shift_ns: int

    def text(self, run: str) -> str:
        """Return the state of a run with such a channel."""
        if self.is_merged:
            return f"run {run} merged from {', '.join(self.logs)}"
        return f"part of run {run}, cut from {', '.join(self.logs)}"


def _origins(session: Session, topic: str) -> list[Origin]:
    """Return a channel before each cut and each merge, the last one first.

    A record counts only if the channel is now, or was before a later record, as the cut or merge has left it.
    """
    readers = [reader for reader in session.readers if topic in reader.channels]
    if len(readers) > 1:  # the channel goes on in a second log, which the record does not know
        return []
    cuts = session.cuts.get(readers[0], []) if readers else [cut for c in session.cuts.values() for cut in c]
    if not cuts:
        return []
    states, origins = {(session.count(topic), session.hash(topic))}, []
    shift_ns = 0
    for cut in reversed(cuts):
        before = next((one for one in cut.channels if one.topic == topic and not one.shared), None)
        if before is not None and (before.kept, before.kept_hash or "") in states:
            states.add((before.messages, before.hash))
            is_merged = isinstance(cut, MergedLog)
            shift_ns += cut.offset_ns if isinstance(cut, MergedLog) else 0
            origins.append(Origin(before.messages, before.hash, cut.logs, is_merged, shift_ns))
    return origins


def is_whole(session: Session, read: ChannelRead) -> bool:
    """Return whether a channel is now as a stage has read it."""
    return session.count(read.topic) == read.messages and session.hash(read.topic) == read.hash


def _origin_of(session: Session, read: ChannelRead) -> Origin | None:
    wanted = read.messages, read.hash
    return next((one for one in _origins(session, read.topic) if one[:2] == wanted), None)


def is_cut(session: Session, read: ChannelRead) -> bool:
    """Return whether a channel was as a stage has read it, before a cut; it did not change otherwise."""
    return _origin_of(session, read) is not None


def origin_of_run(session: Session, run: Run) -> Origin | None:
    """Return the origin of a run that was cut or merged, by one of its channels.

    Returns
    -------
    None if the run is whole, or if one of its inputs changed in another way than by a cut or a merge. A run
    that was both merged and cut is a part.
    """
    origins: list[Origin] = []
    for read in run.inputs:
        if not is_whole(session, read):
            origin = _origin_of(session, read)
            if origin is None:
                return None
            origins.append(origin)
    for output in run.outputs:
        if session.count(output.topic) < output.messages:
            enough = (one for one in _origins(session, output.topic) if one.messages >= output.messages)
            origin = next(enough, None)
            if origin is None:
                return None
            origins.append(origin)
    return min(origins, key=lambda one: one.is_merged, default=None)


def shift_of_run(session: Session, run: Run) -> int:
    """Return the time in ns that merges have added to the log times of a run since it was computed."""
    origins = (_origin_of(session, read) for read in run.inputs if not is_whole(session, read))
    return next((one.shift_ns for one in origins if one is not None and one.shift_ns), 0)


def own_inputs(session: Session, run: Run) -> dict[str, str]:
    """Return the topics of runs of this log that a stage has read, each with its run."""
    reads = ((read, run_of_topic(read.topic)) for read in run.inputs)
    return {
        read.topic: name
        for read, name in reads
        if name is not None and (is_whole(session, read) or is_cut(session, read))
    }


def was_complete(session: Session, topic: str, messages: int) -> bool:
    """Return whether a channel had this number of messages before a cut."""
    return any(one.messages >= messages for one in _origins(session, topic))


def present_inputs(session: Session, run: Run) -> tuple[ChannelRead, ...]:
    """Return the inputs of a run as they are in this part; inputs without messages here are left out.

    Inputs that were not cut, or changed in another way, stay as they are.
    """
    inputs = []
    for read in run.inputs:
        if is_whole(session, read) or _origin_of(session, read) is None:
            inputs.append(read)
        elif session.count(read.topic):
            inputs.append(ChannelRead(read.topic, session.count(read.topic), session.hash(read.topic)))
    return tuple(inputs)


def cut_topics(session: Session) -> dict[LogReader, dict[str, ChannelCut]]:
    """Return for each part the entry of each channel in the newest record of a cut that names it."""
    return {
        reader: {one.topic: one for cut in cuts for one in cut.channels}
        for reader, cuts in session.cuts.items()
    }


def left_out(session: Session) -> set[str]:
    """Return the channels that the options of a cut have excluded."""
    excluded = {
        one.topic for cuts in session.cuts.values() for cut in cuts for one in cut.channels if one.left_out
    }
    return {topic for topic in excluded if not session.count(topic)}


def has_result(session: Session, run: Run, purpose: Channel) -> bool:
    """Return whether the part has the result of a run for all its cameras.

    Parameters
    ----------
    purpose : the channel of the result.
    """
    missing = left_out(session)
    cameras = {camera_of_topic(read.topic) for read in run.inputs if read.topic in missing} - {None}
    results = (
        output.topic
        for output in run.outputs
        if purpose.topic_of(run.run, camera_of_topic(output.topic)) == output.topic
    )
    return not any(topic in missing and camera_of_topic(topic) not in cameras for topic in results)
