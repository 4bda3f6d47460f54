"""The whole system on one page: how a frame becomes a position.

A source is an iterable of messages. A stage is a row with the channels that it reads and a step from a
message to payloads. :func:`run` sends a source through stages. :func:`replay` does this for a log, stage
by stage: missing results and results that are out of date are computed and appended. :func:`record` writes
the messages of cameras. :func:`live` writes them first, and then sends them through the same stages in the
same way; :func:`measure` writes only the measurements with their frames.

==============  ==================  ================  =====================================
stage           reads               writes            its run is named after
==============  ==================  ================  =====================================
detect          frames              markers           the corner method, ``edges``
camera-frame    markers,            camera points     the run of its markers
                intrinsics
fit             camera points,      model             the model, ``poly``
                measurements
evaluate        the same, model     evaluation        the run of its model
watch           markers, model      camera poses      the run of its model
locate          camera points,      positions         the run of its model
                model, camera poses
fuse            positions           tracks, poses     the run of its positions
==============  ==================  ================  =====================================

The model ``joint`` reads markers and intrinsics instead of camera points, in fit, evaluate and locate. Only
this model is watched.
All stages read the rig; locate reads it only for models that need the height of a marker.
:mod:`ipsys_log.engine` has the details: the plan of each stage (``graph``), and the search or creation of its
run (``execute``). :mod:`ipsys_log.capture` moves frames from the cameras into the log (``recorder``), and
from the log to the stages, as long as the stages keep up (``backlog``).
"""

import gc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from itertools import chain
from pathlib import Path

from ipsys_log.capture.backlog import Backlog, RecentFrames
from ipsys_log.capture.frames import SourceError
from ipsys_log.capture.live_check import knock_events
from ipsys_log.capture.live_plan import check_independent_frames, plan_live
from ipsys_log.capture.multiplexer import LiveCameras
from ipsys_log.capture.recorder import CameraSource, Recording, open_recording, write_each
from ipsys_log.engine.checks import check_inputs
from ipsys_log.engine.execute import one_blas_thread, sign
from ipsys_log.engine.graph import stages_until
from ipsys_log.engine.model_choice import choose_models
from ipsys_log.engine.output import open_target
from ipsys_log.engine.pieces import PieceWorkers
from ipsys_log.engine.provenance import Outcome
from ipsys_log.engine.replay import Replay
from ipsys_log.engine.request import Progress, Request
from ipsys_log.engine.stream import Route, WiredStage, in_threads, run
from ipsys_log.engine.workers import LocalWorkers, check_jobs
from ipsys_log.errors import IpsysError, LogError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Message
from ipsys_log.messages.channels import CAMERA_POSES, channel_of
from ipsys_log.messages.events import CONTRADICTIONS, WATCHED
from ipsys_log.plain_text import shell_words
from ipsys_log.sinks.sink import FanOut, Sink
from ipsys_log.statistics.latency import Ledger


@one_reading()
def replay(
    paths: Sequence[LogLocation],
    request: Request,
    until: str | None = None,
    output: Path | None = None,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
    jobs: int = 1,
    workers: PieceWorkers | None = None,
) -> list[Outcome]:
    """Compute the results that a log lacks, up to a stage, and append them; or write them to a new log.

    Results that are out of date are computed again, as a new run beside the old one.

    Parameters
    ----------
    paths : the logs, read as one; results go to the last of them, or to ``output``.
    until : the last stage; None: all stages. With fuse, models are also evaluated if points are held out.
    say : called before the computation, with the runs that are out of date and the reason.
    jobs : number of processes that detect markers in a long log, or evaluate several models; the bytes are
        the same with any number.
    workers : they compute the pieces of a long log, instead of ``jobs`` processes of this machine.

    Returns
    -------
    One outcome for each stage, in order, with the run of its result; ``fresh`` if the run is new.
    """
    check_jobs(jobs)
    stages = stages_until(until)
    choice = choose_models(request, paths, stages[-1])
    for line in check_inputs(paths, choice.request, choice.models, stages):
        say(line)
    if workers is not None and workers.first_only and len(stages) > 1:
        # The given name is for the last stage.
        choice, stages = choice._replace(request=replace(choice.request, run=None)), stages[:1]
    with open_target(paths, output) as (logs, target), LocalWorkers(jobs) as local:
        work = Replay(choice, stages, logs, target, workers or local, local, progress, say)
        work.compute()
    return work.outcomes


def record(
    source: CameraSource,
    settings: Iterable[Message],
    target: Path,
    sinks: Sequence[Sink] = (),
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Write the messages of cameras to a new log; return the number of messages of each topic.

    Parameters
    ----------
    source : messages, and None if no message came.
    settings : written first: rig and camera intrinsics.
    sinks : each gets everything after it was written.
    overwrite : replace an existing log.

    Raises
    ------
    IpsysError
        The log cannot be written; the messages before the error are complete in it.
    Exception
        The error of the first failed sink. It cannot end the recording, and is raised after it.
    """
    with FanOut(sinks, source.add_event) as show, open_recording(target, settings, overwrite) as log:
        for arrived in write_each(source, log):
            show(arrived)
    log.check_disk()
    show.check()
    return log.counts


def measure(
    cameras: LiveCameras,
    settings: Sequence[Message],
    target: Path,
    request: Request,
    sinks: Sequence[Sink],
    overwrite: bool = False,
) -> Mapping[str, int]:
    """Detect markers in the frames of cameras, and write measurements with their frames to a new log.

    A measurement in the cameras' stream keeps the frames of the second in which its marker was stationary;
    all other frames are processed and discarded. Results of the stages are only shown: a replay computes them
    from the frames.

    Parameters
    ----------
    settings : written first: rig and camera intrinsics.
    request : corners.
    sinks : each gets every frame that the stages have processed, its markers and camera points.

    Returns
    -------
    The number of messages by topic.

    Raises
    ------
    IpsysError
        A camera sends video instead of single images, or the log cannot be written; its content is kept.
    Exception
        The first error of ``sinks``, after the log is complete.
    """
    check_independent_frames(cameras.states)
    plan = plan_live(cameras.states, settings, request, "camera-frame")
    with (
        FanOut([_contradictions(cameras.say), *sinks], cameras.add_event) as show,
        one_blas_thread(),
        open_recording(target, settings, overwrite) as log,
        RecentFrames(log) as recent,
        Backlog(cameras, log, cameras.now_ns, recent.put) as frames,
    ):
        for message in _through(plan.stages, chain(settings, frames)):
            show(*frames.take_events(), message)
    log.check_disk()
    show.check()
    return log.counts


def live(
    cameras: CameraSource,
    settings: Sequence[Message],
    target: Path | None,
    request: Request,
    until: str | None = None,
    sinks: Sequence[Sink] = (),
    overwrite: bool = False,
) -> list[Outcome]:
    """Write the messages of cameras to a new log with the results of the stages: the run of a replay.

    Every frame is in the log before a stage sees it. Events name the frames that are skipped because the
    stages are too slow; a replay ``as_live`` skips the same frames and gives the same bytes.

    Parameters
    ----------
    cameras : live cameras, or simulated ones with a simulated clock.
    settings : written first: rig and camera intrinsics.
    target : the new log; None: nothing is recorded.
    request : corners, method and, for stages that read a model, ``model_from``.
    until : the last stage, such as detect or camera-frame; None: all causal stages.
    sinks : each gets every frame that the stages have processed, and their results, after the write.

    Returns
    -------
    One outcome for each stage, as from :func:`replay`.

    Raises
    ------
    IpsysError
        The other log has no such model, or the log cannot be written; its content is kept.
    Exception
        The first error of ``sinks``, after the log is complete: it cannot end the recording.
    """
    plan = plan_live(cameras.states, settings, request, until)
    if plan.reason:
        cameras.say(plan.reason)
    first = (*settings, *plan.copies(cameras.now_ns))
    is_watched = any(CAMERA_POSES in wired.stage.writes for wired in plan.stages)
    knocks = [] if is_watched else [knock_events(plan.rig, cameras.add_event)]
    with (
        FanOut([cameras.positions, *knocks, _contradictions(cameras.say), *sinks], cameras.add_event) as show,
        one_blas_thread(),
        open_recording(target, first, overwrite) as log,
        ExitStack() as resources,
    ):
        frames = Backlog(cameras, log, cameras.now_ns)
        arriving, events = _begin(frames, resources), frames.take_events
        ledger = Ledger(cameras.clock.now_ns, cameras.received_ns)
        fault = _put_through(chain(settings, arriving), plan.stages, ledger, log, show, events)
        if fault is not None and target is not None:
            cameras.add_event("stages_stopped", f"{fault}; the recording continues")
            for message in arriving:
                show(*events(), message)
        show(*events())
    log.check_file()
    if target is None:
        if fault is not None:
            raise fault
        if frames.skipped:
            cameras.say(f"{frames.skipped.total()} frames skipped: processing could not keep up")
        show.check()
        return [Outcome(one.stage.name, one.run, True) for one in plan.runs]
    if fault is not None:
        raise IpsysError(
            f"{fault}; {target} has all frames; to process them: ipsys replay {shell_words(target)}"
        ) from fault
    try:
        outcomes = sign(target, replace(plan.request, as_live=bool(frames.skipped)).options(), plan.runs)
    finally:
        log.check_disk()
    if frames.skipped:
        cameras.say(
            f"{frames.skipped.total()} frames skipped: processing could not keep up. All are recorded. To "
            f"process all: ipsys replay {shell_words(target)}; --as-live excludes the skipped frames"
        )
    show.check()
    return outcomes


def _begin(frames: Backlog, resources: ExitStack) -> Iterator[Message]:
    """Begin the recording, and yield its frames: after the preparation of the stages, so that none is late.

    From then on, the search for garbage leaves out the objects from before. Most of them are models: for 24
    cameras, the search takes an eighth of the time of a message.
    """
    gc.freeze()
    resources.callback(gc.unfreeze)
    resources.enter_context(frames)
    yield from frames


def _through(
    stages: Sequence[WiredStage], source: Iterable[Message], ledger: Ledger | None = None
) -> Iterable[Message]:
    """Send messages through live stages; note the time of each step."""
    for wired in stages:
        source = run(source, [wired], in_threads if wired.stage.in_threads else map)
        if ledger is not None:
            source = ledger.note(wired.stage.writes[0], wired.run, source)
    return source


def _put_through(
    frames: Iterable[Message],
    stages: Sequence[WiredStage],
    ledger: Ledger,
    log: Recording,
    show: FanOut,
    events: Callable[[], Iterable[Message]],
) -> IpsysError | None:
    """Write the results of the stages for incoming frames, then show them; return the error of a stage.

    The results are shown with the ``events`` that were written meanwhile, and before their latencies.
    """
    computed = {Route(channel, wired.run) for wired in stages for channel in wired.stage.writes}
    try:
        for message in _through(stages, frames, ledger):
            entry = None
            if _route_of(message) in computed:  # all other messages are written already
                entry = ledger.entry(message)
                log.put(message)
            show(*events(), message)
            if entry is not None:
                log.put(entry)
                show(entry)
    except (LogError, SourceError):
        raise
    except IpsysError as fault:
        return fault
    return None


def _contradictions(say: Callable[[str], None]) -> Sink:
    """Return a sink that prints the contradictions between cameras and their calibrations, and their moves.

    The moves that the recorder notes are printed there.
    """

    def print_text(message: Message) -> None:
        kind = getattr(message.payload, "kind", None)
        if kind in CONTRADICTIONS or (kind in WATCHED and run_of_topic(message.topic) is not None):
            say(message.payload.text)

    return print_text


def _route_of(message: Message) -> Route | None:
    """Return the channel and the run of a message; None for a message outside of all runs."""
    run_name = run_of_topic(message.topic)
    channel = channel_of(message.topic, type(message.payload)) if run_name is not None else None
    return None if channel is None else Route(channel, run_name)
