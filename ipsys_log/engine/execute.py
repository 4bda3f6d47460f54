"""Execution of one stage on a log: find its run, complete it, or compute and append it. One BLAS thread."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

from threadpoolctl import threadpool_limits

from ipsys_log.engine.graph import Task, is_of_model, method_of, plan_stage
from ipsys_log.engine.model_checks import Remarks
from ipsys_log.engine.output import append_messages, append_run, record_message
from ipsys_log.engine.pieces import DividedRun, merge_pieces
from ipsys_log.engine.provenance import (
    Outcome,
    check_run_name,
    find_run,
    fingerprint,
    free_name,
    next_number,
    read_channels,
)
from ipsys_log.engine.request import Progress, Request
from ipsys_log.engine.states import Recorded, recorded_stages
from ipsys_log.engine.stream import WiredStage, in_threads, run, wire
from ipsys_log.engine.view import inputs
from ipsys_log.log.codec import encode
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import ChannelWritten, Event, Lens, Message, Model, Run
from ipsys_log.messages.channels import MODEL, Channel, channel_of
from ipsys_log.messages.rig_file import hide_passwords
from ipsys_log.messages.stage import Stage, Timed
from ipsys_log.units import format_time


class OtherContentError(Exception):
    """The error of a run that contains a message that its stage does not make from the log."""


def find_unfinished(session: Session, target: Path, task: Task, run: str) -> dict[str, int]:
    """Return the number of messages by topic that an unsigned stage wrote to a run in ``target``.

    The result is empty if the run has nothing of the stage, or if the stage has its record.
    """
    signed = any((record.run, record.stage) == (run, task.stage.name) for record in session.runs())
    if signed or task.step is None or not session.topics(task.stage.writes[0], run):
        return {}
    topics = [topic for channel in task.stage.writes for topic in session.topics(channel, run)]
    available = {topic for reader in session.readers if reader.path == target for topic in reader.channels}
    return {topic: session.count(topic) for topic in topics} if available.issuperset(topics) else {}


def missing_messages(session: Session, held: Collection[str], made: Iterable[Message]) -> Iterator[Message]:
    """Yield the messages of ``made`` that are missing in a run; messages are compared byte for byte.

    Parameters
    ----------
    held : the topics of the run.
    made : all messages that its stage makes, in log order.

    Raises
    ------
    OtherContentError
        The run contains another message. Events are exempt: two stages can share a channel of events.
    """
    waiting = session.messages(held)
    following = next(waiting, None)
    pending: list[Message] = []
    for message in made:
        while following is not None and following.log_time_ns <= message.log_time_ns:
            pending.append(following)
            following = next(waiting, None)
        _refuse(stored for stored in pending if stored.log_time_ns < message.log_time_ns)
        pending = [stored for stored in pending if stored.log_time_ns == message.log_time_ns]
        same = next((stored for stored in pending if _same(stored, message)), None)
        if same is None:
            yield message
        else:
            pending.remove(same)
    _refuse(pending)
    _refuse(stored for stored in (following, *waiting) if stored is not None)


def _same(one: Message, other: Message) -> bool:
    return (
        (one.topic, one.publish_time_ns) == (other.topic, other.publish_time_ns)
        and encode(one.payload) == encode(other.payload)
    )  # fmt: skip


def _refuse(left: Iterable[Message]) -> None:
    for message in left:
        if not isinstance(message.payload, Event):
            raise OtherContentError(
                f"{message.topic} has other content at {format_time(message.log_time_ns)}"
            )


Make = Callable[[Task, Session, str], Iterable[Message]]


def run_stage(
    session: Session,
    target: Path,
    task: Task,
    request: Request,
    until: Stage,
    make: Make,
    say: Callable[[str], None] = lambda text: None,
    prepare: Callable[[Task, Session], None] = lambda task, session: None,
) -> Outcome:
    """Find the run that has done ``task``, or ``make`` it and append it to ``target``.

    An interrupted run is completed, if its content equals the present result. If the newest run of such a
    task is out of date, a remark reports this before a new run is made. ``prepare`` is called before all
    other work on a run that the log lacks.
    """
    name = request.run if has_given_name(task.stage, until) else None
    record = record_of(session, task)
    finished_run = find_run(session, record, task.stage.writes[0], name)
    if finished_run is not None:
        return Outcome(task.stage.name, finished_run, fresh=False)
    prepare(task, session)
    _say_renewal(session, task, record, say)
    record = replace(record, fingerprint=fingerprint(), number=next_number(session))
    remarks: tuple[str, ...] = ()
    run_name = name or task.run
    if counts := find_unfinished(session, target, task, run_name):
        try:
            return _append(session, target, task, replace(record, run=run_name), counts, request, make)
        except OtherContentError as other:
            remarks = (f"run {run_name} stays unfinished: {other}",)
    if name is None:
        name = free_name(session, record, task.run, task.stage.writes)
    else:
        check_run_name(session, task.stage.name, name, task.stage.writes)
    outcome = _append(session, target, task, replace(record, run=name), {}, request, make)
    return replace(outcome, remarks=(*remarks, *outcome.remarks))


def has_given_name(stage: Stage, until: Stage) -> bool:
    """Return whether the run name of the user is for a stage: the last one, or all stages of the model."""
    return stage is until or (is_of_model(stage) and is_of_model(until))


def _say_renewal(session: Session, task: Task, record: Run, say: Callable[[str], None]) -> None:
    """Print that the newest run of a task is out of date, and how much is computed again."""
    method = method_of(session, record)

    def is_such(one: Recorded) -> bool:
        is_same = (one.run.stage, one.method) == (task.stage.name, method)
        # A stage without methods differs by its input only: the stage that wrote it has reported the change.
        return is_same and (bool(method) or one.run.input_runs == record.input_runs)

    matches = [recorded for recorded in recorded_stages(session) if is_such(recorded)]
    if matches and matches[-1].out_of_date:
        frames = sum(session.count(topic) for topic in task.topics if topic in session.images.values())
        much = f" for {frames} frames" if frames else ""
        say(f"{task.stage.name} is computed again{much}; run {matches[-1].run.run} is {matches[-1].state}")


def _append(
    session: Session,
    target: Path,
    task: Task,
    record: Run,
    held: Mapping[str, int],
    request: Request,
    make: Make,
) -> Outcome:
    """Compute a run; append the messages that the log does not hold yet, and the record of the run."""
    log_time_ns, publish_time_ns = session.last(task.topics)
    remarks = Remarks(task, request.skip_ambiguous)
    made = append_run(
        target,
        replace(record, timestamp=publish_time_ns),
        log_time_ns,
        lambda: missing_messages(session, held, remarks.watch(make(task, session, record.run))),
        held,
    )
    count = sum(output.messages for output in made.outputs)
    return Outcome(task.stage.name, record.run, True, count, remarks.lines())


class LiveRun(NamedTuple):
    """A run that a stage writes live, and by derived channel the runs that it reads.

    ``copied`` is a run that was copied from another log and has its record.
    """

    stage: Stage
    run: str
    inputs: Mapping[Channel, str]
    copied: bool = False


def sign(path: Path, options: Mapping[str, str], runs: Sequence[LiveRun]) -> list[Outcome]:
    """Append the records of stages that have written their channels already, live.

    Parameters
    ----------
    options : of the stages, by name.
    runs : in order.
    """
    records, outcomes = [], []
    with Session([path]) as session:
        for number, (stage, name, inputs, copied) in enumerate(runs, next_number(session)):
            if copied:
                outcomes.append(Outcome(stage.name, name, True, 1))
                continue
            task = plan_stage(stage, session, options, inputs)
            assert isinstance(task, Task), f"{stage.name} was not done live"
            outputs = tuple(
                ChannelWritten(topic, session.count(topic))
                for topic in sorted(t for channel in stage.writes for t in session.topics(channel, name))
            )
            log_time_ns, time_ns = session.last(task.topics)
            record = replace(record_of(session, task), run=name, outputs=outputs, number=number)
            record = replace(record, timestamp=time_ns, fingerprint=fingerprint())
            records.append(record_message(record, log_time_ns))
            outcomes.append(Outcome(stage.name, name, True, sum(output.messages for output in outputs)))
    append_messages(path, records)
    return outcomes


def copy_messages(task: Task, model: Model, number: int, now_ns: Callable[[], int]) -> list[Message]:
    """Return the messages that copy a model into a new log: the model, and the record of its run."""
    topic = MODEL.topic_of(task.run)
    record = Run(
        timestamp=model.timestamp,
        run=task.run,
        stage=task.stage.name,
        parameters=dict(task.parameters),
        fingerprint=fingerprint(),
        input_runs=task.input_runs,
        inputs=task.foreign,
        outputs=(ChannelWritten(topic, 1),),
        number=number,
    )
    return [Message(topic, now_ns(), model.timestamp, model), record_message(record, now_ns())]


def record_of(session: Session, task: Task) -> Run:
    """Return the record of a task, without its name, its time and its outputs."""
    lenses = tuple(
        Lens(name, lens.width, lens.height, lens.distortion_model, lens.D, lens.K)
        for name, lens in sorted(task.lenses.items())
    )
    input_runs = {run for topic in task.topics if (run := run_of_topic(topic))} | set(task.input_runs)
    return Run(
        timestamp=0,
        run="",
        stage=task.stage.name,
        parameters=dict(task.parameters),
        rig=task.rig and hide_passwords(task.rig),
        lenses=lenses,
        input_runs=tuple(sorted(input_runs)),
        inputs=(*read_channels(session, task.topics), *task.foreign),
    )


def compute_messages(
    task: Task, session: Session, name: str, progress: Progress, divided: DividedRun | None = None
) -> Iterator[Message]:
    """Yield the messages of a task's run: of its causal stage, or those computed from the whole log.

    The workers of a ``divided`` run compute it in pieces.
    """
    if task.step is None:
        yield from _compute_whole(task, session, name, progress)
        return
    wired = wire(task.stage, name, task.inputs, task.step(name))
    if divided is not None:
        plan, workers = divided
        yield from merge_pieces(wired, plan, workers.compute(plan), partial(progress, task.stage.name))
    else:
        yield from _stream(task, session, wired, progress)


def _compute_whole(task: Task, session: Session, name: str, progress: Progress) -> Iterator[Message]:
    assert task.compute is not None
    computed = task.compute(partial(progress, task.stage.name))
    # One payload, such as a model, speaks of the whole log: it belongs to the last message.
    is_timed = isinstance(computed, (list, Iterator))
    rows = computed if is_timed else [Timed(session.last(task.topics)[0], computed)]
    for log_time_ns, payload in rows:
        topic = task.stage.channel_for(type(payload)).topic_of(name)
        yield Message(topic, log_time_ns, payload.timestamp, payload)


def _stream(task: Task, session: Session, wired: WiredStage, progress: Progress) -> Iterator[Message]:
    """Yield the messages that a causal stage makes from the messages of the log, in this process."""
    written = {(channel, wired.run) for channel in task.stage.writes}
    is_written: dict[tuple[str, type], bool] = {}
    # Python threads wait for one another: a stage that runs Python is slower in threads than without.
    mapped = in_threads if task.stage.in_threads else map
    for message in run(inputs(session, task, progress), [wired], mapped):
        key = message.topic, type(message.payload)
        if key not in is_written:
            is_written[key] = (channel_of(*key), run_of_topic(message.topic)) in written
        if is_written[key]:
            yield message


def one_blas_thread() -> threadpool_limits:
    """Limit BLAS to one thread for a ``with`` block.

    The matrices are small: more threads would only wait for one another. Their number also changes the last
    bits of results, such as those of LAPACK's dpotri.
    """
    # A library that is loaded within the block would not be limited. scipy has a BLAS of its own.
    import scipy.linalg  # noqa: F401

    return threadpool_limits(1, user_api="blas")
