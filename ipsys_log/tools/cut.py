"""Cut of a log: a part of its messages in a new log, with the record from which its provenance follows."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ipsys_log.engine.output import check_copy, create_copy, write_message
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.dataset import Session
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.log.part import Choose, copy_messages, copy_records
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import ChannelCut, Cut, Message
from ipsys_log.messages.channels import CUTS
from ipsys_log.tools.cut_selection import CutOptions, Selection, select

_STEP = "cut"
_BYTES_PER_STEP = 1_000_000


class CutResult(NamedTuple):
    """The result of a cut: the kept messages and all messages of the log, and the number of its channels."""

    kept: int
    messages: int
    channels: int


@one_reading()
def cut(
    paths: Sequence[LogLocation],
    output: Path,
    options: CutOptions,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> CutResult:
    """Write the selected part of logs to a new log; topic, times and data of each message stay the same.

    The new log gets its name when it is complete. It has the attachments and metadata of the logs, and the
    record of the cut as its last message.

    Parameters
    ----------
    overwrite : replace an existing log.

    Raises
    ------
    IpsysError
        The output exists or is one of the logs, an option names nothing in the logs, or no message is
        selected.
    """
    check_copy(paths, output, overwrite)
    with Session(paths) as session:
        _check_ids(session)
        selection = select(session, options)
        with create_copy(output, overwrite) as writer:
            _copy(session, writer, selection, progress)
            channels = _channel_cuts(session, writer, selection)
            if not any(one.kept for one in channels if selection.is_ranged(one.topic)):
                raise IpsysError(
                    f"{session}: no message is selected besides the settings; widen the range, or leave out "
                    "an option; to list the topics: ipsys info"
                )
            last_ns = max(writer.hash_of(one.topic).last_ns for one in channels)
            names = tuple(path.name for path in paths)
            record = Cut(last_ns, names, options.as_text(), channels)
            write_message(writer, Message(CUTS.topic, last_ns, last_ns, record), {})
        counts = [(one.kept, one.messages, one.kept > 0) for one in channels]
    return CutResult(*(sum(column) for column in zip(*counts, strict=True)))


def _check_ids(session: Session) -> None:
    """Refuse logs whose measurements have the same ids: in one log, the later one would replace the other."""
    if session.has_new_ids:
        raise LogError(f"{session}: two logs have measurements with the same id; cut the logs one by one")


def _copy(session: Session, writer: LogWriter, selection: Selection, progress: Progress) -> None:
    total = sum(reader.size for reader in session.readers)
    before = 0

    def advance(done: int) -> None:
        progress(_STEP, (before + done) // _BYTES_PER_STEP, total // _BYTES_PER_STEP)

    for reader in session.readers:
        copy_messages(reader, writer, selection.choose, advance)
        copy_records(reader, writer)
        before += reader.size
        advance(0)


def _channel_cuts(session: Session, writer: LogWriter, selection: Selection) -> tuple[ChannelCut, ...]:
    """Return the entries of all channels with messages, except the earlier records of cuts."""
    return tuple(
        _channel_cut(session, writer, selection, topic)
        for topic in selection.rules
        if topic != CUTS.topic and session.count(topic)
    )


def _channel_cut(session: Session, writer: LogWriter, selection: Selection, topic: str) -> ChannelCut:
    state = writer.hash_of(topic)
    if not state.valid:
        state = _hash_in_log_order(session, topic, selection.choose)
    return ChannelCut(
        topic,
        session.count(topic),
        session.hash(topic),
        state.count,
        state.digest.hex() if state.count else None,
        selection.is_left_out(topic),
    )


def _hash_in_log_order(session: Session, topic: str, choose: Choose) -> ChannelHash:
    """Return the hash of the selected messages of a channel that is not in log order in its file."""
    streams = [reader.messages([topic]) for reader in session.readers if topic in reader.channels]
    state = ChannelHash()
    for message in heapq.merge(*streams, key=lambda message: message.log_time_ns):
        if choose(topic, np.array([message.log_time_ns]))[0]:
            state.add(message.log_time_ns, message.publish_time_ns, message.data)
    return state
