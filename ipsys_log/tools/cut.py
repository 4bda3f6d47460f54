"""Smaller copies of a log: a cut with a part of its messages, and a copy without superseded runs."""

import hashlib
import heapq
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.graph import versioned_names
from ipsys_log.engine.output import check_copy, create_copy, write_message
from ipsys_log.engine.provenance import is_complete, is_whole, original_of, recorded_version, with_inputs
from ipsys_log.engine.request import Progress
from ipsys_log.engine.states import CURRENT, Recorded, recorded_stages
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.codec import encode
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.hashing import ChannelHash, hash_messages
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.log.part import Choose, copy_messages, copy_records
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import IMPORTED, ChannelCut, Cut, Message, Run
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

    Raises
    ------
    IpsysError
        The output exists or is one of the logs, an option names nothing in the logs, or no message is
        selected.
    """
    check_copy(paths, output, overwrite)
    with Session(paths) as session:
        if session.has_new_ids:  # in one log, the later measurement would replace the other one
            raise LogError(f"{session}: two logs have measurements with the same id; cut the logs one by one")
        selection = select(session, options)
        with create_copy(output, overwrite) as writer:
            _copy(session, writer, selection, progress)
            channels = tuple(
                _channel_cut(session, writer, selection, topic)
                for topic in selection.rules
                if topic != CUTS.topic and session.count(topic)  # earlier records of cuts are left out
            )
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
    messages = heapq.merge(*streams, key=lambda message: message.log_time_ns)
    return hash_messages(one for one in messages if choose(topic, np.array([one.log_time_ns]))[0])


# The number that a new run gets if the name of its branch is taken: poly, poly_2, poly_3.
_NUMBER = re.compile(r"_[0-9]+$")


@dataclass(frozen=True, slots=True)
class SupersededRun:
    """A run that no other run of its log needs.

    Attributes
    ----------
    run : its name.
    stages : the names of its recorded stages.
    newer : the newest runs that replace it; without them, the run is unfinished.
    """

    run: str
    stages: tuple[str, ...]
    newer: tuple[str, ...]

    @property
    def reason(self) -> str:
        """The reason as text."""
        return f"superseded by {', '.join(self.newer)}" if self.newer else "unfinished"


def superseded_runs(session: Session) -> list[SupersededRun]:
    """Return the runs of a log that are superseded or unfinished, and that no other run needs, by name.

    A stage of a run is superseded if a newer complete run has the same stage in the same branch of the graph:
    the same method, the same settings, rig and intrinsics of the user, the same name but for its number, and
    inputs of the same branches. An older version supersedes no newer one, and only a current stage supersedes
    a current stage. A run is superseded if all its stages are superseded or unfinished. Never returned are
    imported runs, and the runs that a kept run has read, directly or through others.
    """
    stages = recorded_stages(session)
    newer = _newer_stages(session, stages)
    by_run: dict[str, list[Recorded]] = {name: [] for name in session.run_names()}
    for stage in stages:
        by_run.setdefault(stage.run.run, []).append(stage)
    candidates = {
        name
        for name, of_run in by_run.items()
        if all(id(stage) in newer or not is_complete(session, stage.run) for stage in of_run)
    }
    reads = _read_runs(session, (stage.run for stage in stages))
    kept = with_inputs(by_run.keys() - candidates, reads)
    return [
        SupersededRun(
            name,
            tuple(stage.run.stage for stage in by_run[name]),
            tuple(sorted({newer[id(stage)] for stage in by_run[name] if id(stage) in newer})),
        )
        for name in sorted(candidates - kept)
    ]


def outdated_runs(session: Session) -> list[str]:
    """Return the runs of a log with a stage that is out of date, by name, without the superseded ones.

    A replay with the same options computes these runs again.
    """
    outdated = {stage.run.run for stage in recorded_stages(session) if stage.out_of_date}
    if not outdated:
        return []
    return sorted(outdated - {run.run for run in superseded_runs(session)})


def _newer_stages(session: Session, stages: Sequence[Recorded]) -> dict[int, str]:
    """Return the newest run that supersedes a stage, by the identity of the stage."""
    newest: dict[bytes, Recorded] = {}
    newer: dict[int, str] = {}
    for stage, branch in reversed([*zip(stages, _branches(session, stages), strict=True)]):
        if stage.run.stage == IMPORTED or not is_complete(session, stage.run):
            continue
        last = newest.setdefault(branch, stage)
        if last.run.run != stage.run.run and _replaces(last, stage):
            newer[id(stage)] = last.run.run
    return newer


def _replaces(last: Recorded, stage: Recorded) -> bool:
    """Return whether the newest stage of a branch is as good as an earlier one."""
    names = versioned_names(stage.run.stage, stage.method)
    is_older = any(recorded_version(last.run, name) < recorded_version(stage.run, name) for name in names)
    return not is_older and (stage.state != CURRENT or last.state == CURRENT)


def _branches(session: Session, stages: Iterable[Recorded]) -> list[bytes]:
    """Return the branch of each stage: stages of one branch differ in inputs, versions and environment."""
    writers: dict[str, bytes] = {}  # the branch by topic; a stage reads channels of earlier stages only
    branches = []
    for stage in stages:
        own = _own_inputs(session, stage.run)
        inputs = {
            writers.get(read.topic, b"") if read.topic in own else read.topic.encode()
            for read in stage.run.inputs
        }
        branches.append(_branch(stage, inputs))
        writers |= {output.topic: branches[-1] for output in stage.run.outputs}
    return branches


def _branch(stage: Recorded, inputs: Iterable[bytes]) -> bytes:
    """Return the identity of a branch from a stage and the branches of its inputs."""
    run, versions = stage.run, versioned_names(stage.run.stage, stage.method)
    settings = {name: text for name, text in sorted(run.parameters.items()) if name not in versions}
    name = _NUMBER.sub("", run.run)
    parts = [encode(Run(0, name, run.stage, settings, rig=run.rig, lenses=run.lenses)), stage.method.encode()]
    state = hashlib.blake2b(digest_size=16)
    for part in (*parts, *sorted(set(inputs))):
        state.update(len(part).to_bytes(8, "little") + part)
    return state.digest()


def _read_runs(session: Session, runs: Iterable[Run]) -> dict[str, set[str]]:
    """Return by run the runs of this log that its stages have read."""
    reads: dict[str, set[str]] = {}
    for run in runs:
        reads.setdefault(run.run, set()).update(_own_inputs(session, run).values())
    return reads


def _own_inputs(session: Session, run: Run) -> dict[str, str]:
    """Return the topics of runs of this log that a stage has read, each with its run."""
    reads = ((read, run_of_topic(read.topic)) for read in run.inputs)
    return {
        read.topic: name
        for read, name in reads
        if name is not None and (is_whole(session, read) or original_of(session, read) is not None)
    }


@dataclass(frozen=True, slots=True)
class DroppedRun:
    """A run that a compaction drops: its messages, and about their bytes in the file, after compression."""

    run: SupersededRun
    messages: int
    stored_bytes: int


def dropped_runs(path: LogLocation) -> list[DroppedRun]:
    """Return the runs that a compaction of a log drops, by name; only their chunks are read."""
    with Session([path]) as session:
        runs = superseded_runs(session)
        (reader,) = session.readers
        names = {run.run for run in runs}
        sizes = reader.sizes(topics={topic for topic in reader.channels if run_of_topic(topic) in names})
    rows = {
        name: [size for size in sizes if run_of_topic(size.topic) == name]
        for name in (run.run for run in runs)
    }
    return [
        DroppedRun(
            run,
            sum(size.messages for size in rows[run.run]),
            sum(size.stored_bytes for size in rows[run.run]),
        )
        for run in runs
    ]


@one_reading()
def compact(
    path: LogLocation,
    output: Path,
    overwrite: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> None:
    """Write a copy of a log without its superseded runs; all other messages stay the same.

    The copy gets its name when it is complete. Each kept channel has the same messages, so the records of the
    kept runs are true for the copy, too.

    Raises
    ------
    IpsysError
        The output exists, or is the log itself.
    LogError
        The log is damaged.
    """
    check_copy([path], output, overwrite)
    with Session([path]) as session:
        dropped = {run.run for run in superseded_runs(session)}
        (reader,) = session.readers

        def choose(topic: str, times_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
            return np.full(len(times_ns), run_of_topic(topic) not in dropped)

        total = reader.size // _BYTES_PER_STEP
        with create_copy(output, overwrite) as writer:
            copy_messages(
                reader, writer, choose, lambda done: progress("compact", done // _BYTES_PER_STEP, total)
            )
            copy_records(reader, writer)
