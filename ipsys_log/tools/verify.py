"""Verification that a log replays: every run is repeated from its input and compared byte for byte."""

import heapq
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.engine.execute import compute_messages, one_blas_thread
from ipsys_log.engine.graph import Task, input_runs, plan_stage, stage_named, writes
from ipsys_log.engine.provenance import copied_from, is_whole, original_of, replaced_lenses
from ipsys_log.engine.replay import name_run
from ipsys_log.engine.request import Progress
from ipsys_log.engine.states import Recorded, is_fitted_here, recorded_stages
from ipsys_log.errors import IpsysError
from ipsys_log.log.codec import encode
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.hashing import ChannelHash
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import IMPORTED, FrameTransforms, Message, Run
from ipsys_log.messages.channels import CAMERA_POINTS, EVALUATION, MARKERS, MODEL, POSITIONS, TRACKS
from ipsys_log.plain_text import shell_words
from ipsys_log.tools.differences import (
    Comparison,
    Extent,
    Stored,
    compare_channels,
    explain_no_overlap,
    marker_ids,
)

# Channels with a message for each image.
_MOVING = (MARKERS, CAMERA_POINTS, POSITIONS, TRACKS)


@one_reading()
def verify(
    paths: Sequence[LogLocation],
    run: str | None,
    progress: Progress,
    say: Callable[[str], None] = lambda text: None,
) -> list[Comparison]:
    """Repeat every run from its recorded input, and compare.

    A model that was copied from another log cannot be repeated, and neither can its evaluation; results made
    with it can. A run that was imported from files of another program cannot be repeated either. A model
    cannot be repeated if measurements were added or withdrawn since. Results of another version are not
    repeated; a remark reports this. Later stages are repeated from the recorded channels.

    A cut or a merge copies runs. Those whose channels are whole in the log are repeated. The other ones are
    compared with the hashes that came with the copy, and a remark names their stages.

    Parameters
    ----------
    run : only this run; None: all.
    say : called with the runs that are not repeated.

    Returns
    -------
    One comparison for each derived channel, and each copied channel; the log is on the left.

    Raises
    ------
    IpsysError
        There is no such run, nothing of it can be verified, or its inputs are no longer in the log.
    """
    with Session(paths) as session, one_blas_thread():
        names = session.run_names() if run is None else session.run_names() & {run}
        recorded = [stage for stage in recorded_stages(session) if stage.run.run in names]
        imported = {stage.run.run for stage in recorded if stage.run.stage == IMPORTED}
        stages = [
            stage for stage in recorded if stage.run.stage != IMPORTED and not _is_of_copied_model(stage.run)
        ]
        if not stages and (run is not None or not session.copies):
            raise IpsysError(
                f"{session}: has no {'run' if run is None else f'run {run}'} to verify; "
                f"to compute one: ipsys replay {shell_words(paths[-1])}; "
                f"to list the runs: ipsys info --runs {shell_words(paths[-1])}"
            )
        checked = {output.topic for stage in stages for output in stage.run.outputs}
        repeated = [stage.run for stage in stages if _is_repeated(session, stage, checked, say)]
        if not repeated and not session.copies:
            raise IpsysError(
                f"{session}: has no run that can be verified; for the reasons: "
                f"ipsys info --runs {shell_words(paths[-1])}"
            )
        comparisons = []
        for number, name in enumerate(sorted(names)):
            progress("runs", number, len(names))
            records = [record for record in repeated if record.run == name]
            of_others = {
                output.topic
                for stage in recorded
                if stage.run.run == name and stage.run not in records
                for output in stage.run.outputs
            }
            topics = {output.topic for record in records for output in record.outputs} - of_others
            # Several stages can write to the channel of events.
            made = heapq.merge(
                *(_made_again(session, record, progress) for record in records),
                key=lambda row: row[0].log_time_ns,
            )
            own = (row for row in made if row[0].topic not in of_others)
            comparisons += compare_channels(session.stored(sorted(topics)), own)
        progress("runs", len(names), len(names))
        done = {one.topic for one in comparisons}
        comparisons += _compare_copies(session, names, done, progress, say)
        return sorted([*comparisons, *_unrecorded(session, names - imported)], key=lambda one: one.topic)


def _is_repeated(
    session: Session, stage: Recorded, checked: Collection[str], say: Callable[[str], None]
) -> bool:
    """Return whether a stage is repeated; print the reason if not."""
    run = stage.run
    if logs := copied_from(session, run):
        say(f"run {run.run}: {run.stage} was copied from {', '.join(logs)}; its hashes are compared")
        return False
    if stage.is_of_other_version:
        say(f"run {run.run}: {run.stage} is {stage.state}; it is not verified")
        return False
    return _is_up_to_date(session, run, checked, say)


def _compare_copies(
    session: Session,
    names: Collection[str],
    repeated: Collection[str],
    progress: Progress,
    say: Callable[[str], None],
) -> Iterator[Comparison]:
    """Yield whether the messages of each copied channel are those that the cut or the merge wrote.

    All bytes of the channels are read.

    Parameters
    ----------
    names : the runs; recorded channels are compared too.
    repeated : channels that are not compared, because they are repeated.
    """
    rows = {
        (reader, one.topic): one
        for reader, copies in session.copies.items()
        for copy in copies
        for one in copy.channels
        if one.topic not in repeated and run_of_topic(one.topic) in (None, *names)
    }
    progress("channels", 0, len(rows))
    for done, ((reader, topic), one) in enumerate(rows.items(), 1):
        state = ChannelHash()
        for message in reader.messages([topic]):
            state.add(message.log_time_ns, message.publish_time_ns, message.data)
        progress("channels", done, len(rows))
        if state.count > one.kept:
            added = state.count - one.kept
            say(f"{topic}: messages were added after the copy ({added}); it is not compared")
        elif one.kept:
            is_same = (state.count, state.digest.hex()) == (one.kept, one.kept_hash)
            first = None if is_same else "its messages are not those that the cut or the merge wrote"
            same = state.count if is_same else 0
            yield Comparison(topic, state.count, one.kept, same, same, first, repeated=False)


def _is_of_copied_model(run: Run) -> bool:
    """Return whether a stage copied a model from another log, or evaluated such a model."""
    return _is_of_model(run) and not is_fitted_here(run)


def _is_of_model(run: Run) -> bool:
    """Return whether a stage fits a model, or evaluates it: these depend on all measurements."""
    return writes(run, MODEL) or writes(run, EVALUATION)


def _unrecorded(session: Session, names: Collection[str]) -> list[Comparison]:
    """Return a comparison for each channel of the runs that no record names."""
    known = {output.topic for record in session.runs() for output in record.outputs}
    return [
        Comparison(topic, session.count(topic), 0, 0, 0, "no record of the run", 0)
        for topic in sorted({topic for reader in session.readers for topic in reader.channels} - known)
        if run_of_topic(topic) in names and not topic.endswith("/record") and session.count(topic)
    ]


def diff(left: LogLocation, right: LogLocation, runs: tuple[str | None, str | None]) -> list[Comparison]:
    """Compare the derived channels of two logs, or of two runs.

    Parameters
    ----------
    runs : of the left and of the right log; None: all common runs.
    """
    with Session([left]) as left_session, Session([right]) as right_session:
        first, second = _compared_runs(left_session, right_session, runs)
        ours, theirs = _derived(left_session, first, None), _derived(right_session, second, runs[0])
        return compare_channels(ours, theirs)


def explain_diff(left: LogLocation, right: LogLocation, runs: tuple[str | None, str | None]) -> str | None:
    """Return the reason why two logs or two runs cannot be compared; None if they can.

    The parameters are those of `diff`.
    """
    with Session([left]) as left_session, Session([right]) as right_session:
        first, second = _compared_runs(left_session, right_session, runs)
        return explain_no_overlap(_extent(left_session, first), _extent(right_session, second))


def _compared_runs(
    one: Session, other: Session, runs: tuple[str | None, str | None]
) -> tuple[set[str], set[str]]:
    names = [_run_names(one, runs[0]), _run_names(other, runs[1])]
    both = names[0] & names[1] if runs[0] is None else names[0]
    if not both:
        raise IpsysError(
            f"{one} and {other} have no run with the same name; to list the runs of one: "
            f"ipsys info --runs {shell_words(*one.paths)}; "
            "give the runs with --run"
        )
    return both, both if runs[1] is None else names[1]


def _extent(session: Session, runs: Collection[str]) -> Extent:
    topics = [topic for run in runs for channel in _MOVING for topic in session.topics(channel, run)]
    cameras, times_ns, ids = set(), set(), set()
    for message in session.messages(topics):
        times_ns.add(message.log_time_ns)
        ids |= marker_ids(message.payload)
        cameras |= {message.camera} - {None}
    return Extent(frozenset(map(str, cameras)), np.array(sorted(times_ns), dtype=np.int64), frozenset(ids))


def _run_names(session: Session, wanted: str | None) -> set[str]:
    names = session.run_names()
    if wanted is not None and wanted not in names:
        raise IpsysError(f"{session}: has no run {wanted}; it has {', '.join(sorted(names)) or 'none'}")
    return names if wanted is None else {wanted}


def _derived(session: Session, runs: set[str], called: str | None) -> Iterator[Stored]:
    """Yield the messages of runs without their records; rename the run to ``called``, if given.

    Models come first and have time 0: a copied model has the time of its copy.
    """
    topics = {
        topic
        for reader in session.readers
        for topic in reader.channels
        if run_of_topic(topic) in runs and not topic.endswith("/record")
    }
    models = topics & {topic for run in runs for topic in session.topics(MODEL, run)}
    for message, data in session.stored(models):
        yield replace(_called(message, called), log_time_ns=0, publish_time_ns=0), data
    for message, data in session.stored(topics - models):
        other = _called(message, called)
        yield other, data if other.payload is message.payload else encode(other.payload)


def _called(message: Message, run: str | None) -> Message:
    """Return a message as a message of another run: the run's name is in its topic and in robot frame ids."""
    if run is None:
        return message
    payload = message.payload
    if isinstance(payload, FrameTransforms):
        payload = FrameTransforms(
            tuple(
                replace(one, child_frame_id=f"{run}/{one.child_frame_id.partition('/')[2]}")
                for one in payload.transforms
            )
        )
    topic = message.topic.replace(f"/runs/{run_of_topic(message.topic)}/", f"/runs/{run}/", 1)
    return replace(message, topic=topic, payload=payload)


def _is_up_to_date(session: Session, run: Run, checked: Collection[str], say: Callable[[str], None]) -> bool:
    """Return whether a stage can be repeated; skip inputs that are ``checked`` themselves."""
    for read in run.inputs:
        count = session.count(read.topic)
        if read.topic in checked or is_whole(session, read) or original_of(session, read) is not None:
            continue
        if count == 0:
            say(
                f"run {run.run}: {run.stage} is not verified: its input {read.topic} is not in {session}; "
                "give the log with this topic, too"
            )
            return False
        text = (
            f"run {run.run} is out of date: it has read {read.messages} messages of {read.topic}, but the "
            f"log has other ones now ({count} messages)"
        )
        if _is_of_model(run):
            say(f"{text}; its {run.stage} is not verified: ipsys replay computes it again")
            return False
        raise IpsysError(f"{session}: {text}; run 'ipsys replay', or give the input log, too")
    return True


def _made_again(session: Session, run: Run, progress: Progress) -> Iterator[Stored]:
    stage = stage_named(run.stage)
    cameras = {camera for read in run.inputs if (camera := session.camera_of(read.topic)) is not None}
    if session.copies and cameras:  # a merged log has cameras that the stage did not read
        session = session.with_cameras(cameras)
    inputs = input_runs(run)
    task = plan_stage(stage, session, run.parameters, inputs, run.rig, replaced_lenses(run)) if stage else ""
    if isinstance(task, Task):
        for message in compute_messages(task, session, run.run, name_run(progress, run.run)):
            yield message, encode(message.payload)
