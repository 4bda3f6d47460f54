"""The whole system on one page: how a frame becomes a position.

A source is an iterable of messages, a stage a row that says what it reads and has a step from a
message to payloads, and :func:`run` sends one through the others. :func:`replay` does this for a
log, stage by stage: what the log does not hold yet, or no longer rightly, is computed and appended.
:func:`record` writes what cameras send; :func:`live` writes it first, and then sends it through the
same stages in the same way; :func:`measure` writes only what is measured.

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
:mod:`ipsys_log.runs` says in full what each stage reads (``tasks``) and how its run is found or made
(``perform``), :mod:`ipsys_log.recording` how frames get from the cameras into the log (``recorder``) and from
there, as long as the stages keep up, to them (``waiting``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path

from threadpoolctl import threadpool_limits

from ipsys_log.analysis.latency import Ledger
from ipsys_log.capture.backlog import TICK, Backlog
from ipsys_log.capture.frames import SourceError
from ipsys_log.capture.live_plan import check_pictures, plan_live
from ipsys_log.capture.multiplexer import Attached
from ipsys_log.capture.recent_frames import Recent
from ipsys_log.capture.recorder import Recording, Source, recording, written
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import EVENTS_TOPIC, Markers, Message, Positions, Tracks
from ipsys_log.runs.checks import check_inputs
from ipsys_log.runs.execute import carry_out, perform, sign
from ipsys_log.runs.graph import STAGES, plan_stage
from ipsys_log.runs.options import Progress, Request
from ipsys_log.runs.output import opened_target
from ipsys_log.runs.provenance import Outcome
from ipsys_log.runs.select import wanted_models
from ipsys_log.runs.stream import TOPICS, Stage, in_threads, run
from ipsys_log.sinks.sink import Consumer, Consumers

__all__ = ["live", "measure", "record", "replay"]


def replay(
    paths: Sequence[Path],
    request: Request,
    until: str = "fuse",
    output: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Outcome]:
    """Compute what a log lacks, up to a stage, and append it; or write it to a new log.

    Results that are out of date are computed again, as a new run beside the old one.

    Parameters
    ----------
    paths : the logs, read as one; results go to the last of them, or to ``output``.
    until : the last stage. With fuse, models are also evaluated if points are held out.
    say : called before the computation, with the runs that are out of date and the reason.

    Returns
    -------
    One outcome for each stage, in order, saying which run holds it and whether it is new.

    Raises
    ------
    IpsysError
        The input has a fault that the user must correct.
    """
    models = wanted_models(request, until, paths)
    check_inputs(paths, request, models, until)
    outcomes: list[Outcome] = []
    # The matrices are small: threads of BLAS would only wait for one another.
    with opened_target(paths, output) as (logs, target), threadpool_limits(1, user_api="blas"):

        def do(stage: str, **given: str) -> str:
            """Run a stage, or find its result; return the name of its run, if there is one."""
            if STAGES.index(stage) > STAGES.index(until):
                return ""
            with Session(logs) as session:
                task = plan_stage(stage, session, request, **given)
                if isinstance(task, str):
                    return task
                make = partial(carry_out, progress=progress)
                outcomes.append(perform(session, target, task, request, until, make, say))
            return outcomes[-1].run

        points = do("camera-frame", markers=do("detect"))
        for name in models:
            model = do("fit", points=points, model=name)
            if until != "locate":
                do("evaluate", points=points, model=model)
            do("fuse", positions=do("locate", points=points, model=model))
    return outcomes


def record(
    source: Source,
    settings: Iterable[Message],
    target: Path,
    consumers: Sequence[Consumer] = (),
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Write the messages of cameras to a new log; return the number of messages of each topic.

    Parameters
    ----------
    source : messages, and None where nothing comes.
    settings : written first: rig and lenses.
    consumers : each is shown everything after it was written, and None where nothing came.
    overwrite : put it in place of a log that is there.

    Raises
    ------
    IpsysError
        The log cannot be written; it is complete up to then.
    Exception
        The error of the first failed consumer, after the recording has ended: it cannot end it.
    """
    show = Consumers(consumers, source.warn)
    with recording(target, settings, overwrite) as log:
        for arrived in written(source, log):
            show(arrived)
    log.check_disk()
    show.check()
    return log.counts


def measure(
    cameras: Attached,
    settings: Sequence[Message],
    target: Path,
    request: Request,
    consumers: Sequence[Consumer],
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Detect markers in the frames of cameras, and write measurements with their frames to a new log.

    A measurement in the cameras' stream keeps the frames of the second in which its marker was stationary;
    all others are processed and discarded. Results of the stages are only shown: a replay computes them from
    the frames.

    Parameters
    ----------
    settings : written first: rig and lenses.
    request : corners.
    consumers : each is shown every frame that the stages have seen, its markers and camera points.

    Returns
    -------
    How many messages went to each topic.

    Raises
    ------
    IpsysError
        For cameras that send no pictures but video, or a log that cannot be written; what it holds is kept.
    Exception
        What the first of ``consumers`` raised, after the log is complete.
    """
    check_pictures(cameras.states)
    show = Consumers(consumers, cameras.warn)
    plan = plan_live(cameras.states, settings, request, "camera-frame")
    detect, camera_frame = (Stage(*row) for row in plan.rows)
    with (
        threadpool_limits(1, user_api="blas"),
        recording(target, settings, overwrite) as log,
        Recent(log) as recent,
        Backlog(cameras, recent, cameras.now_ns) as frames,
    ):
        for message in run(run(chain(settings, frames), [detect], in_threads), [camera_frame]):
            if message is not TICK:
                show(message)
    log.check_disk()
    show.check()
    return log.counts


def live(
    cameras: Attached,
    settings: Sequence[Message],
    target: Path,
    request: Request,
    until: str = "fuse",
    consumers: Sequence[Consumer] = (),
    overwrite: bool = False,
) -> list[Outcome]:
    """Write the messages of cameras to a new log with the results of the stages: the run of a replay.

    Every frame is in the log before a stage sees it. Events name the frames that are skipped because the
    stages are too slow; a replay ``as_live`` skips the same frames and gives the same bytes.

    Parameters
    ----------
    settings : written first: rig and lenses.
    request : corners, method and, for fuse, ``model_from``.
    until : detect, camera-frame or fuse.
    consumers : each is shown every frame that the stages have seen, and what they make of it, after it was
        written.

    Returns
    -------
    One outcome for each stage, as of :func:`replay`.

    Raises
    ------
    IpsysError
        Where the other log has no such model, or the log cannot be written; what it holds is kept.
    Exception
        What the first of ``consumers`` raised, after the log is complete: it cannot end the recording.
    """
    plan = plan_live(cameras.states, settings, request, until)
    first = (*settings, *plan.copies(cameras.now_ns))
    show = Consumers(consumers, cameras.warn)
    with (
        threadpool_limits(1, user_api="blas"),
        recording(target, first, overwrite) as log,
        Backlog(cameras, log, cameras.now_ns) as frames,
    ):
        stages = [Stage(*row) for row in plan.rows]
        ledger = Ledger(cameras.clock.now_ns, cameras.received_ns)
        fault = _put_through(chain(settings, frames), stages, ledger, log, show)
        if fault is not None:
            cameras.warn("stages_stopped", f"{fault}; frames are recorded all the same")
            for message in frames:
                if message is not TICK:
                    show(message)
    if fault is not None:
        raise IpsysError(f"{fault}; {target} has all frames: replay it") from fault
    try:
        outcomes = sign(target, replace(plan.request, as_live=bool(frames.skipped)), plan.runs)
    finally:
        log.check_disk()
    if frames.skipped:
        cameras.say(
            f"{frames.skipped.total()} frames are recorded but were not looked at: the stages were too slow. "
            f"ipsys replay {target} looks at all, with --as-live at those that were looked at"
        )
    show.check()
    return outcomes


def _put_through(
    frames: Iterable[Message], stages: Sequence[Stage], ledger: Ledger, log: Recording, show: Consumers
) -> IpsysError | None:
    """Write the results of the stages for incoming frames, then show them; return the error of a stage."""
    made = ledger.note("detected", Markers, run(frames, stages[:1], in_threads))
    made = ledger.note("located", Positions, run(made, stages[1:3]))
    made = ledger.note("fused", Tracks, run(made, stages[3:]))
    try:
        for message in made:
            if message is TICK:
                continue
            if type(message.payload) in TOPICS and message.topic != EVENTS_TOPIC:  # those are written already
                log.put(message)
                entry = ledger.entry(message)
                if entry is not None:
                    log.put(entry)
            show(message)
    except (LogError, SourceError):
        raise
    except IpsysError as fault:
        return fault
    return None
