"""The whole system on one page: how a frame becomes a position.

A source is an iterable of messages, a stage a row that says what it reads and has a step from a
message to payloads, and :func:`run` sends one through the others. :func:`replay` does this for a
log, stage by stage: what the log does not hold yet, or no longer rightly, is computed and appended.
:func:`record` writes what cameras send; :func:`live` writes it first, and then sends it through the
same stages in the same way.

==============  ==================  ================  =====================================
stage           reads               writes            its run is named after
==============  ==================  ================  =====================================
detect          frames              markers           the corner method, ``edges``
camera-frame    markers, lenses     camera points     the run of its markers
fit             camera points,      model             the model, ``poly``
                measurements
evaluate        the same, model     evaluation        the run of its model
locate          camera points,      positions         the run of its model
                model
fuse            positions           tracks, poses     the run of its positions
==============  ==================  ================  =====================================

The rig is read by all, by locate only for models that are told the height of a marker.
:mod:`ipsys_log.tasks` says in full what each stage reads, :mod:`ipsys_log.perform` how its run is
found or made, :mod:`ipsys_log.recording` how frames get from the cameras into the log and from there,
as long as the stages keep up, to them.
"""

from __future__ import annotations

import builtins
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
from threadpoolctl import threadpool_limits

from ipsys_log.errors import IpsysError, LogError
from ipsys_log.latency import Ledger
from ipsys_log.live_plan import cameras_with_lens, check_live, copied_models, live_stages, with_corners
from ipsys_log.log.session import Session
from ipsys_log.lookup import wanted_models
from ipsys_log.messages import (
    CameraPoints,
    Evaluation,
    Event,
    FrameTransforms,
    ImageAnnotations,
    Markers,
    Message,
    Model,
    Positions,
    Rig,
    Tracks,
)
from ipsys_log.output import opened_target
from ipsys_log.perform import inputs, perform, sign
from ipsys_log.preflight import check_inputs
from ipsys_log.recording import Backlog, recording
from ipsys_log.request import Progress, Request
from ipsys_log.runs import Outcome
from ipsys_log.sources.attached import Attached
from ipsys_log.sources.frames import SourceError
from ipsys_log.tasks import STAGES, Task, model_run, plan_stage

__all__ = ["TOPICS", "Stage", "carry_out", "in_threads", "live", "record", "replay", "run"]

# Where a payload goes within its run.
TOPICS: dict[type, str] = {
    Markers: "/runs/{run}/cameras/{camera}/markers",
    ImageAnnotations: "/runs/{run}/cameras/{camera}/annotations",
    CameraPoints: "/runs/{run}/cameras/{camera}/camera_points",
    Model: "/runs/{run}/model",
    Evaluation: "/runs/{run}/evaluation",
    Positions: "/runs/{run}/cameras/{camera}/positions",
    Tracks: "/runs/{run}/tracks",
    FrameTransforms: "/runs/{run}/poses",
    Event: "/runs/{run}/events",
}

# Is shown messages on their way, and None where nothing comes.
Watch = Callable[[Message | None], None]
Map = Callable[[Callable[[Message], Any], Iterable[Message]], Iterable[Any]]


@dataclass(frozen=True, slots=True)
class Stage:
    """A causal stage: the run it writes to, which payloads it reads, and its step.

    A stage that remembers something across cameras is not ``per_camera``: it takes one message after
    the other, whatever the map.
    """

    run: str
    reads: tuple[type, ...]
    step: Callable[[Message], Iterable[Any]]
    per_camera: bool = True


def run(source: Iterable[Message], stages: Sequence[Stage], map: Map = map) -> Iterator[Message]:
    """Send every message of a source through the stages, and yield it and what they make of it.

    What a stage makes has the log time of the message it was made from, and follows it at once; the
    next stage sees both. Its publish time is its own timestamp. With ``map`` as :func:`in_threads`,
    cameras use the cores in parallel and the order stays the same.
    """
    for stage in stages:
        source = _through(stage, source, map)
    yield from source


def _through(stage: Stage, source: Iterable[Message], map: Map) -> Iterator[Message]:
    def work(message: Message) -> tuple[Message, list[Any]]:
        return message, list(stage.step(message)) if isinstance(message.payload, stage.reads) else []

    for message, payloads in (map if stage.per_camera else builtins.map)(work, source):
        yield message
        for payload in payloads:
            topic = TOPICS[type(payload)].format(run=stage.run, camera=message.camera)
            # Transforms have their times one by one; drawings on a frame have that of the frame.
            stamped = payload.transforms[0] if isinstance(payload, FrameTransforms) else payload
            time_ns = getattr(stamped, "timestamp", message.publish_time_ns)
            yield Message(topic, message.log_time_ns, time_ns, payload, message.camera)


def in_threads(function: Callable[[Message], Any], messages: Iterable[Message]) -> Iterator[Any]:
    """``map`` with one thread per camera: a camera's messages stay in order, and so do the results.

    A message of no camera (the rig) concerns all of them: it waits for those before it. OpenCV's own
    threads are turned off meanwhile; one thread per camera uses the cores better.
    """
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    pending: deque[Future[Any]] = deque()
    workers: dict[str, ThreadPoolExecutor] = {}
    with ExitStack() as stack:
        stack.callback(cv2.setNumThreads, threads)
        for message in messages:
            if message.camera is None:
                while pending:
                    yield pending.popleft().result()
                yield function(message)
                continue
            if message.camera not in workers:
                workers[message.camera] = stack.enter_context(ThreadPoolExecutor(1))
            pending.append(workers[message.camera].submit(function, message))
            # Enough ahead that no camera waits for another, and no more in memory than that.
            while len(pending) > 4 * len(workers):
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def replay(
    paths: Sequence[Path],
    request: Request,
    until: str = "fuse",
    output: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> list[Outcome]:
    """Compute what a log lacks, up to a stage, and append it; or write it to a new log.

    Parameters
    ----------
    paths : the logs, read as one; results go to the last of them, or to ``output``.
    until : the last stage. On the way to fuse models are evaluated too, where places are held out.

    Returns
    -------
    One outcome for each stage, in order, saying which run holds it and whether it is new.

    Raises
    ------
    IpsysError
        For anything in the input that the user has to mend.
    """
    models = wanted_models(request, until)
    check_inputs(paths, request, models, until)
    outcomes: list[Outcome] = []
    # The matrices are small: threads of BLAS would only wait for one another.
    with opened_target(paths, output) as (logs, target), threadpool_limits(1, user_api="blas"):

        def do(stage: str, **given: str) -> str:
            """Do a stage, or find it done; the name of the run that holds it, if there is one."""
            if STAGES.index(stage) > STAGES.index(until):
                return ""
            with Session(logs) as session:
                task = plan_stage(stage, session, request, **given)
                if isinstance(task, str):
                    return task
                make = partial(carry_out, progress=progress)
                outcomes.append(perform(session, target, task, request, until, make))
            return outcomes[-1].run

        points = do("camera-frame", markers=do("detect"))
        for name in models:
            model = do("fit", points=points, model=name)
            if until != "locate":
                do("evaluate", points=points, model=model)
            do("fuse", positions=do("locate", points=points, model=model))
    return outcomes


def carry_out(task: Task, session: Session, name: str, progress: Progress) -> Iterator[Message]:
    """The messages of a task's run: its causal stage over the log, or one computed from all of it."""
    if task.step is None:
        assert task.compute is not None
        payload, (log_time_ns, _) = (
            task.compute(session, partial(progress, task.stage)),
            session.last(task.topics),
        )
        yield Message(TOPICS[type(payload)].format(run=name), log_time_ns, payload.timestamp, payload)
        return
    stage = Stage(name, task.reads, task.step(name), task.per_camera)
    # Threads that run Python wait for one another, and a stage takes longer in them than without.
    for message in run(inputs(session, task, progress), [stage], in_threads if task.decodes_frames else map):
        if isinstance(message.payload, task.writes):
            yield message


def record(
    source: Iterable[Message | None],
    settings: Iterable[Message],
    target: Path,
    watch: Watch = lambda one: None,
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Write what cameras send to a new log; returns how many messages went to each topic.

    Parameters
    ----------
    source : messages, and None where nothing comes.
    settings : written first: rig and lenses.
    watch : is shown everything after it was written, and None where nothing came.
    overwrite : put it in place of a log that is there.

    Raises
    ------
    IpsysError
        Where the log cannot be written; what it holds by then is a complete log.
    """
    with recording(target, overwrite) as log:
        for message in settings:
            log.put(message)
        for arrived in source:
            if arrived is None:
                log.flush()
            else:
                log.put(arrived)
            watch(arrived)
    return log.counts


def live(
    cameras: Attached,
    settings: Sequence[Message],
    target: Path,
    request: Request,
    until: str = "fuse",
    watch: Watch = lambda one: None,
    overwrite: bool = False,
) -> list[Outcome]:
    """Write what cameras send to a new log, and what the stages make of it: the run of a replay.

    Every frame is in the log before a stage sees it. What is skipped because the stages are too slow is named
    by events; a replay ``as_live`` passes over the same frames and gives the same bytes.

    Parameters
    ----------
    settings : written first: rig and lenses.
    request : corners, method and, for fuse, ``model_from``.
    until : detect, camera-frame or fuse.
    watch : is shown every frame that the stages have seen, and what they make of it.

    Returns
    -------
    One outcome for each stage, as of :func:`replay`.

    Raises
    ------
    IpsysError
        Where the other log has no such model, or the log cannot be written; what it holds is kept.
    """
    request = with_corners(request, cameras.states, settings)
    copied = copied_models(request, until)
    models = [model for _, model in copied]
    (rig,) = (message.payload for message in settings if isinstance(message.payload, Rig))
    check_live(rig, cameras.states, cameras_with_lens(settings), models, until)
    runs, rows = live_stages(request, models, until)
    stages = [Stage(*row) for row in rows]
    fault: IpsysError | None = None
    with recording(target, overwrite) as log, threadpool_limits(1, user_api="blas"):
        for message in settings:
            log.put(message)
        for model in models:
            topic = TOPICS[Model].format(run=model_run(model.name))
            log.put(Message(topic, cameras.now_ns(), model.timestamp, model))
        ledger = Ledger(cameras.clock.now_ns, cameras.received_ns)
        with Backlog(cameras, log, cameras.now_ns, cameras.stop) as frames:
            made = ledger.note("detected", Markers, run(chain(settings, frames), stages[:1], in_threads))
            made = ledger.note("located", Positions, run(made, stages[1:3]))
            made = ledger.note("fused", Tracks, run(made, stages[3:]))
            try:
                for message in made:
                    watch(message)
                    if type(message.payload) in TOPICS:
                        log.put(message)
                        entry = ledger.entry(message)
                        if entry is not None:
                            log.put(entry)
            except IpsysError as error:
                if isinstance(error, (LogError, SourceError)):
                    raise
                fault = error
                cameras.warn("stages_stopped", f"{error}; frames are recorded all the same")
                for message in frames:
                    watch(message)
    if fault is not None:
        raise IpsysError(f"{fault}; {target} has all frames: replay it") from fault
    if frames.skipped:
        cameras.say(
            f"{frames.skipped.total()} frames are recorded but were not looked at: the stages were too slow. "
            f"ipsys replay {target} looks at all, with --as-live at those that were looked at"
        )
    return sign(target, replace(request, as_live=bool(frames.skipped)), runs, [task for task, _ in copied])
