"""Checks of the input before any computation."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

from ipsys_log.engine.execute import has_given_name, record_of
from ipsys_log.engine.graph import Task, copy_model, is_of_model, method_of, plan_stage, stage_named
from ipsys_log.engine.model_checks import (
    check_evaluated,
    check_evaluation,
    check_heights,
    check_measurements,
    check_models,
)
from ipsys_log.engine.provenance import Outcome, check_run_name, find_run, imported_inputs, newest_run
from ipsys_log.engine.request import Request
from ipsys_log.engine.states import made_by_newer, recorded_stages
from ipsys_log.errors import FrameError, IpsysError, LogError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation, is_one_of
from ipsys_log.messages import CompressedVideo
from ipsys_log.messages.channels import (
    CAMERA_POINTS,
    EVALUATION,
    MARKERS,
    MODEL,
    POSITIONS,
    RIG,
    RUN_EVENTS,
    Channel,
)
from ipsys_log.messages.rig_file import check_rig
from ipsys_log.messages.stage import Stage
from ipsys_log.plain_text import shell_words
from ipsys_log.stages.detect import usual_corners
from ipsys_log.units import format_time
from ipsys_log.vision.decode import frame_size
from ipsys_log.vision.lenses import check_calibration, check_size
from ipsys_log.vision.video import Video

# Most messages of a channel that the checks read. Some recorders write a calibration with each frame, so that
# all of them are spread over the whole log.
_CHECKED_MESSAGES = 100


def check_inputs(
    paths: Sequence[LogLocation], request: Request, models: Sequence[str], stages: Sequence[Stage]
) -> list[str]:
    """Check the inputs of some stages; the last one is the purpose of the command.

    Returns
    -------
    One line for each remark.

    Raises
    ------
    IpsysError
        An input is missing or invalid; the text names the first one and what to do.
    """
    written = {channel for stage in stages for channel in stage.writes}
    _check_request(paths, request, models)
    remarks: list[str] = []
    with Session(paths) as session:
        _check_rigs(session, request)
        cameras = _cameras(session, written)
        _check_overrides(session, request, cameras)
        if CAMERA_POINTS in written:
            _check_lenses(session, request, cameras)
        if request.corners != "stock" or CAMERA_POINTS in written:
            _check_distortion(session, request, cameras)
        if CAMERA_POINTS in written:
            _check_sizes(session, request)
        if MODEL in written and request.model_from is None and request.model_run is None:
            check_measurements(session, request, models)
        if POSITIONS in written:
            check_heights(session, request, models)
        if MODEL in written and request.model_from is not None:
            remarks = check_models(session, request, models, written, cameras)
        if EVALUATION in written and request.model_from is not None:
            check_evaluated(session, request, models)
        if EVALUATION in stages[-1].writes:
            check_evaluation(session, request, models)
        _check_versions(session, request, models, stages)
        _check_run_name(session, request, stages[-1])
        _check_new_stages(session, request, models, stages)
    return remarks


def _check_versions(
    session: Session, request: Request, models: Sequence[str], stages: Sequence[Stage]
) -> None:
    """Check that no result to repeat is from newer software."""
    corners = request.corners or usual_corners(session.images, {*session.calibrations, *request.lenses})
    wanted = {corners, request.method, *models, ""}
    for run in session.runs():
        newer = made_by_newer(session, run) if stage_named(run.stage) in stages else ""
        if newer and method_of(session, run) in wanted:
            raise IpsysError(f"{session}: run {run.run}, stage {run.stage}: {newer}")


def _check_run_name(session: Session, request: Request, until: Stage) -> None:
    """Check that the run name of the user is not that of a run that is out of date."""
    for entry in recorded_stages(session) if request.run is not None else ():
        stage = stage_named(entry.run.stage)
        if entry.run.run == request.run and entry.out_of_date and stage and has_given_name(stage, until):
            raise IpsysError(
                f"run {request.run} already has the stage {entry.run.stage}, which is {entry.state}; "
                "use another --run name"
            )


def _check_new_stages(
    session: Session, request: Request, models: Sequence[str], stages: Sequence[Stage]
) -> None:
    """Check that the run name of the user is free for each stage that this command computes."""
    inputs = imported_inputs(session)
    new: set[Channel] = set()
    # A run name belongs to one model.
    for stage in sorted(stages, key=is_of_model) if request.run is not None else ():
        name = request.run if has_given_name(stage, stages[-1]) else None
        if not new.intersection(stage.reads):
            run = _current_run(session, request, next(iter(models), ""), stage, inputs, name)
            if run is not None:
                inputs.update({channel: run for channel in stage.writes if channel is not RUN_EVENTS})
                continue
        new |= {channel for channel in stage.writes if channel is not RUN_EVENTS}
        if any((record.run, record.stage) == (name, stage.name) for record in session.runs()):
            check_run_name(session, stage.name, str(name), stage.writes)


def _current_run(
    session: Session,
    request: Request,
    model: str,
    stage: Stage,
    inputs: Mapping[Channel, str],
    name: str | None,
) -> str | None:
    """Return the run of a stage if it is current, "" if the stage is left out; None if there is none."""
    if MODEL in stage.writes and request.model_from is not None:
        task: Task | str = copy_model(request, model)[0]
    else:
        options = request.options(model if is_of_model(stage) else None)
        task = plan_stage(stage, session, options, inputs, request.rig, request.lenses)
    return (
        task if isinstance(task, str) else find_run(session, record_of(session, task), stage.writes[0], name)
    )


def _check_request(paths: Sequence[LogLocation], request: Request, models: Sequence[str]) -> None:
    if request.run is not None and len(models) > 1:
        raise IpsysError(
            f"--run {request.run} is the name of one run, but the command fits {len(models)} models; "
            "select one with --model"
        )
    if request.model_from is None:
        return
    source = request.model_from
    if source in paths or (isinstance(source, Path) and is_one_of(source, paths)):
        raise IpsysError(f"--model-from {request.model_from}: is the same log; leave out --model-from")
    if request.train != "train":
        raise IpsysError(f"--train {request.train} has no effect with --model-from; leave one of them out")


def check_earlier_runs(session: Session, outcomes: Sequence[Outcome]) -> None:
    """Check that a log has the runs of earlier stages: another program can replace it between stages."""
    recorded = {(record.stage, record.run) for record in session.runs()}
    for outcome in outcomes:
        if (outcome.stage, outcome.run) not in recorded:
            raise LogError(
                f"{session}: another program has replaced the log in the meantime ({outcome.stage} of run "
                f"{outcome.run} is missing); run the command again"
            )


def _check_rigs(session: Session, request: Request) -> None:
    for topic in session.topics(RIG):
        for rig in session.payloads([topic]):
            check_rig(rig, f"{session}: {topic}")
    if request.rig is None and not session.topics(RIG):
        raise IpsysError(
            f"{session}: has no rig (markers, reference points); write one with 'ipsys init lab.toml' "
            "and give it with --rig lab.toml"
        )


def _cameras(session: Session, written: Collection[Channel]) -> set[str]:
    """Return the cameras whose markers need camera intrinsics; none if the log has only camera points."""
    if session.images:
        imported = session.topics(MARKERS, imported_inputs(session).get(MARKERS, ""))
        return {*session.images, *(str(camera_of_topic(topic)) for topic in imported)}
    markers = newest_run(session, MARKERS)
    if markers is not None and CAMERA_POINTS in written:
        return {str(camera_of_topic(topic)) for topic in session.topics(MARKERS, markers)}
    if CAMERA_POINTS not in written or newest_run(session, CAMERA_POINTS) is None:
        unread = session.unread_images()
        also = f"; this version cannot read {', '.join(unread)}" if unread else ""
        raise IpsysError(f"{session}: has no images to detect markers in{also}")
    return set()


def _check_overrides(session: Session, request: Request, cameras: set[str]) -> None:
    """Raise an error for an override that cannot take effect."""
    known = ", ".join(sorted(cameras)) if cameras else "none whose markers are in the log"
    for name in sorted(set(request.lenses) - cameras):
        raise IpsysError(f"--calibration {name}: the log does not have this camera; it has {known}")
    if request.rig is not None and not cameras:
        rigs = session.payloads(session.topics(RIG))
        if any(rig.marker_length_m != request.rig.marker_length_m for rig in rigs):
            raise IpsysError(
                "--rig: another marker length has no effect, because the log has camera points but no markers"
            )


def _check_lenses(session: Session, request: Request, cameras: set[str]) -> None:
    missing = sorted(cameras - set(request.lenses) - set(session.calibrations))
    if missing:
        raise IpsysError(
            f"{session}: camera {missing[0]} has no calibration; give one with "
            f"--calibration {missing[0]}=calibration.yaml"
        )


def _check_distortion(session: Session, request: Request, cameras: set[str]) -> None:
    """Check that the first calibrations in a log are valid, unless others are given."""
    for name in sorted(cameras - set(request.lenses)):
        topic = session.calibrations.get(name)
        for message in islice(session.messages([topic] if topic else []), _CHECKED_MESSAGES):
            check_calibration(replace(message.payload, frame_id=name), f"{session}: {topic}")


def _check_sizes(session: Session, request: Request) -> None:
    """Check that calibrations have the size of the images; else detection would be done in vain."""
    for name, topic in session.images.items():
        stored = [session.calibrations[name]] if name in session.calibrations else []
        lens = request.lenses.get(name) or next((m.payload for m in session.messages(stored)), None)
        size_px = None if lens is None else _first_size_px(session, topic)
        if lens is not None and size_px is not None:
            check_size(lens, *size_px, name)


def image_sizes(session: Session) -> dict[str, tuple[int, int]]:
    """Return width and height of the images by camera, from the first image or the first markers."""
    sizes_px: dict[str, tuple[int, int]] = {}
    for name, topic in session.images.items():
        size_px = _first_size_px(session, topic)
        if size_px is not None:
            sizes_px[name] = size_px
    run = newest_run(session, MARKERS)
    for topic in session.topics(MARKERS, run) if run else []:
        message = next(session.messages([topic]), None)
        if message is not None and message.camera:
            size_px = message.payload.width, message.payload.height
            sizes_px.setdefault(message.camera, size_px)
    return sizes_px


def _first_size_px(session: Session, topic: str) -> tuple[int, int] | None:
    """Return width and height of the first valid frame; None if the first frames are damaged."""
    video: Video | None = None
    for message in islice(session.messages([topic]), _CHECKED_MESSAGES):
        frame = message.payload
        with suppress(FrameError):  # a corrupt frame is an event
            if isinstance(frame, CompressedVideo):
                video = video or Video(frame.format)
                frame = video(frame)
            if frame is not None:
                return frame_size(frame)
    return None


def describe_changed_images(session: Session) -> Iterator[str]:
    """Yield for each log a remark if the CRC of a chunk shows that its images have changed."""
    for reader in session.readers:
        topics = [topic for topic in session.images.values() if topic in reader.channels]
        chunks = list(reader.changed_chunks(topics))
        if not chunks:
            continue
        offset, start_ns, names = chunks[0]
        cameras = ", ".join(sorted(camera for camera, topic in session.images.items() if topic in names))
        more = f", and of {len(chunks) - 1} more" if len(chunks) > 1 else ""
        yield (
            f"{reader.path}: the CRC of the chunk at byte {offset}{more} is wrong: images of {cameras} from "
            f"{format_time(start_ns)} on have changed since the recording, and are used as they are; copy "
            f"the log again from its origin. To find all damage: ipsys check {shell_words(reader.path)}"
        )
