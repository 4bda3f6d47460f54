"""One stage on one log: is its result there already, and if not, compute and append it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.log import LogReader, LogWriter
from ipsys_log.log.session import Session, camera_of_topic, run_of_topic
from ipsys_log.messages import (
    RIG_TOPIC,
    CameraCalibration,
    ChannelRead,
    Event,
    Lens,
    Markers,
    Message,
    Model,
    Rig,
    Run,
    calibration_topic,
)
from ipsys_log.runs import (
    Outcome,
    append_run,
    check_run_name,
    find_run,
    fingerprint,
    free_name,
    read_channels,
)
from ipsys_log.units import format_time

__all__ = [
    "SHARED_STAGES",
    "Progress",
    "Request",
    "Task",
    "last_input_ns",
    "opened_target",
    "perform",
    "settings",
]

# The stages whose runs serve every model.
SHARED_STAGES = ("detect", "camera-frame")

# Called with the stage, the messages done, and all there are, where that is known.
Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asks for, beyond what the log itself says.

    Attributes
    ----------
    models : names in the table of models; empty: what ``model_from`` holds, else ``poly``.
    rig, lenses : used instead of the log's own, as a new run. Lenses by camera.
    model_from : another log, whose newest fitted model is applied and copied in.
    train, seed : the subset to fit on, or the seed of the random split where nothing is labelled.
    run : name for the new run of the last stages, instead of one made from the model.
    skip_ambiguous : go on where a marker id is seen twice in a frame, without that marker.
    """

    models: tuple[str, ...] = ()
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    model_from: Path | None = None
    train: str = "train"
    seed: int = 0
    run: str | None = None
    skip_ambiguous: bool = False


@dataclass(frozen=True, slots=True)
class Task:
    """One stage, told what to read: everything that makes its result what it is.

    Attributes
    ----------
    base : name of its run, unless that one is taken.
    topics : what it reads of the log, and ``foreign`` what it reads of another one.
    rig, lenses : set where they replace what the log holds.
    reads, step, per_camera : a causal stage: its payloads, its step for a run of a given name, and whether
        the step takes each camera by itself; or
    compute : the payload that is computed from the whole log.
    """

    stage: str
    base: str
    topics: tuple[str, ...]
    reads: tuple[type, ...] = ()
    step: Callable[[str], Callable[[Message], Iterable[Any]]] = lambda run: lambda message: ()
    per_camera: bool = True
    compute: Callable[[Session], Any] | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    foreign: tuple[ChannelRead, ...] = ()


def perform(
    session: Session,
    target: Path,
    task: Task,
    request: Request,
    until: str,
    make: Callable[[Task, Session, str], Iterable[Message]],
    progress: Progress,
) -> Outcome:
    """Find the run that has done ``task``, or ``make`` it and append it to ``target``."""
    runs = session.runs()
    # A name given by the user is for what was asked for, not for the detection on the way to it.
    on_the_way = task.stage in SHARED_STAGES and until not in SHARED_STAGES
    name = None if on_the_way else request.run
    wanted = _record(session, task)
    found = find_run(runs, wanted, name)
    if found is not None:
        return Outcome(task.stage, found, fresh=False)
    run = free_name(runs, task.stage, task.base) if name is None else check_run_name(runs, task.stage, name)
    time_ns = last_input_ns(session, task)
    input_runs = {run_of_topic(topic) for topic in task.topics} - {None}
    record = replace(
        wanted,
        timestamp=time_ns,
        run=run,
        fingerprint=fingerprint(),
        input_runs=tuple(sorted(str(name) for name in input_runs)),
        number=max((run.number for run in runs), default=0) + 1,
    )
    total = sum(session.count(topic) for topic in task.topics)
    watch = _Watch(task, total, request.skip_ambiguous, progress)
    made = append_run(target, record, time_ns, lambda: watch.derived(make(task, session, run)))
    count = sum(output.messages for output in made.outputs)
    return Outcome(task.stage, run, True, count, watch.remarks())


def _record(session: Session, task: Task) -> Run:
    lenses = tuple(
        Lens(name, lens.width, lens.height, lens.distortion_model, lens.D, lens.K)
        for name, lens in sorted(task.lenses.items())
    )
    return Run(
        timestamp=0,
        run="",
        stage=task.stage,
        parameters=dict(task.parameters),
        rig=task.rig,
        lenses=lenses,
        inputs=(*read_channels(session, task.topics), *task.foreign),
    )


class _Watch:
    """Look at what a stage makes: what the user should know, and what the user has to decide."""

    def __init__(self, task: Task, total: int, skip_ambiguous: bool, progress: Progress) -> None:
        self._task, self._total = task, total
        self._skip_ambiguous = skip_ambiguous
        self._progress = progress
        self._events: dict[str, list[Message]] = {}
        self._markers = 0
        self._unmodelled: set[str] = set()

    def derived(self, messages: Iterable[Message]) -> Iterator[Message]:
        self._progress(self._task.stage, 0, self._total)
        for done, message in enumerate(messages, 1):
            self._note(message)
            self._progress(self._task.stage, min(done, self._total), self._total)
            yield message
        self._progress(self._task.stage, self._total, self._total)
        unknown = {str(message.payload.marker_id) for message in self._events.get("unknown_marker", ())}
        if unknown and not self._markers:
            raise IpsysError(
                f"no marker of the rig is in any frame, but ids {', '.join(sorted(unknown))} are: add "
                "them as [[markers]] to lab.toml and give it with --rig"
            )

    def _note(self, message: Message) -> None:
        payload = message.payload
        if isinstance(payload, Event):
            self._events.setdefault(payload.kind, []).append(message)
            if payload.kind == "ambiguous_marker" and not self._skip_ambiguous:
                raise IpsysError(
                    f"{_said(message)}: give each marker an id of its own, or leave it out of such frames "
                    "with --skip-ambiguous"
                )
        elif isinstance(payload, Markers):
            self._markers += len(payload.markers)
        elif isinstance(payload, Model):
            cameras = {camera_of_topic(topic) for topic in self._task.topics} - {None}
            self._unmodelled = {str(name) for name in cameras} - {model.camera for model in payload.cameras}

    def remarks(self) -> tuple[str, ...]:
        lines = [
            f"{len(found)} x {kind.replace('_', ' ')}, first: {_said(found[0])}"
            for kind, found in sorted(self._events.items())
        ]
        if self._task.stage == "detect" and not self._markers:
            lines.append("no marker was found: were they printed from the dictionary in the rig?")
        lines += [
            f"camera {name} saw no measured place: it has no model" for name in sorted(self._unmodelled)
        ]
        return tuple(lines)


def _said(message: Message) -> str:
    return f"{message.payload.text}, at {format_time(message.log_time_ns)} ({message.log_time_ns} ns)"


@contextmanager
def opened_target(paths: Sequence[Path], output: Path | None) -> Iterator[tuple[list[Path], Path]]:
    """The logs to read and the one to append to: the last one given, or a new one.

    A new one has its name only when all is done; where nothing was to do, or after an error, there is
    none.
    """
    if output is None:
        yield list(paths), paths[-1]
        return
    if output.exists():
        raise IpsysError(
            f"{output}: exists already; choose another name, or give it as an input to extend it"
        )
    partial = output.with_name(output.name + ".partial")
    partial.unlink(missing_ok=True)
    try:
        with LogWriter.create(partial):
            pass
        yield [*paths, partial], partial
        with LogReader(partial) as log:
            anything = log.message_count > 0
        if anything:
            partial.rename(output)
    finally:
        partial.unlink(missing_ok=True)


def last_input_ns(session: Session, task: Task) -> int:
    """Log time of what a task as a whole makes; the start of the log where it reads none of it."""
    return session.last_ns(task.topics) or session.start_ns


def settings(
    session: Session, topics: Iterable[str], rig: Rig | None, lenses: Mapping[str, CameraCalibration]
) -> list[Message]:
    """What holds before the first frame: overrides, or the first rig and lenses of the log."""
    start_ns = session.start_ns
    first = [
        Message(calibration_topic(camera), start_ns, start_ns, lens, camera)
        for camera, lens in lenses.items()
    ]
    if rig is not None:
        first.append(Message(RIG_TOPIC, start_ns, start_ns, rig))
    for topic in sorted(topics):
        if topic == RIG_TOPIC or topic in session.calibrations.values():
            first += [m for m in [next(session.messages([topic]), None)] if m is not None]
    return first
