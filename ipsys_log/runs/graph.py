"""The plan of a replay: the inputs and the parameters of each stage."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ipsys_log.analysis.cross_validation import FOLDS, REPEATS, labelled_subsets
from ipsys_log.analysis.ground_truth import gather_tracks, true_points
from ipsys_log.analysis.pairs import level_cameras, split
from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import same_lens
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    EVENTS_TOPIC,
    CameraCalibration,
    CameraPoints,
    ChannelRead,
    Evaluation,
    Event,
    FrameTransforms,
    ImageAnnotations,
    Markers,
    Measurement,
    Message,
    Model,
    Positions,
    Rig,
    RigCamera,
    Tracks,
)
from ipsys_log.models.table import reads_height
from ipsys_log.runs.options import Request
from ipsys_log.runs.provenance import newest_run, read_channels, version_parameters
from ipsys_log.runs.select import (
    can_evaluate,
    copied_run,
    find_pairs,
    fits_again,
    fitted_in,
    has_late_frames,
    held_out_ids,
    measured,
    skipped_frames,
    split_parameters,
    unused_places,
)
from ipsys_log.stages import camera_frame, detect, fuse, locate
from ipsys_log.stages.evaluate import Study, evaluate_model
from ipsys_log.stages.fit import fit_model

__all__ = ["STAGES", "Task", "copy_model", "model_run", "plan_stage", "points_run", "usual_corners"]


@dataclass(frozen=True, slots=True)
class Task:
    """One stage, told what to read: everything that makes its result what it is.

    Attributes
    ----------
    base : name of its run, unless that one is taken.
    topics : what it reads of the log, and ``foreign`` what it reads of another one.
    writes : the payloads that it makes, first the one that it is there for.
    reads, step, per_camera : a causal stage: its payloads, its step for a run of a given name, and whether
        the step takes each camera by itself; ``decodes_frames`` says that its work is done outside of Python,
        so that cameras can use the cores at the same time; or
    compute : the payload that is computed from the whole log, saying how far it is; what to know of it goes
        to ``notes``.
    parameters : what else its result depends on; ``input_runs`` those of ``foreign``.
    rig, lenses : set where they replace what the log holds.
    as_live : frames that were skipped live are not read.
    """

    stage: str
    base: str
    topics: tuple[str, ...]
    writes: tuple[type, ...]
    reads: tuple[type, ...] = ()
    step: Callable[[str], Callable[[Message], Iterable[Any]]] | None = None
    per_camera: bool = True
    decodes_frames: bool = False
    compute: Callable[[Session, Callable[[int, int], None]], Any] | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    as_live: bool = False
    foreign: tuple[ChannelRead, ...] = ()
    input_runs: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)


def _shutter(camera: RigCamera) -> tuple[int | None, float | None]:
    return camera.row_time_ns, camera.edge_offset_px


def _rig_part(stage: str) -> Callable[[Rig], Any]:
    """What a stage reads of the rig; an overriding rig that says the same there changes nothing."""
    return {
        "detect": lambda rig: (
            rig.dictionary,
            {m.id for m in rig.markers},
            {(camera.name, *shutter) for camera in rig.cameras if any(shutter := _shutter(camera))},
        ),
        "camera-frame": lambda rig: (rig.marker_length_m, {(m.id, rig.length_of(m.id)) for m in rig.markers}),
        "locate": lambda rig: (rig.marker_height_m, {(m.id, m.height_m) for m in rig.markers}),
        "fuse": lambda rig: {(m.id, m.robot) for m in rig.markers},
    }.get(stage, lambda rig: (rig.reference_points, {m.id for m in rig.markers}))


def _rig(session: Session, request: Request, stage: str) -> tuple[Rig | None, list[str]]:
    """The overriding rig, if it matters to a stage, or the log's topics to read it from."""
    part = _rig_part(stage)
    held = session.payloads(session.topics(Rig))
    if request.rig is not None and not (held and all(part(rig) == part(request.rig) for rig in held)):
        return request.rig, []
    return None, session.topics(Rig)


def plan_stage(stage: str, session: Session, request: Request, **given: str) -> Task | str:
    """The task of a stage on a log; or the name of a run to use as it is, "" where there is none."""
    return _PLANS[stage](session, request, **given)


def _detect(session: Session, request: Request) -> Task | str:
    if not session.images:
        return newest_run(session, Markers) or ""
    rig, topics = _rig(session, request, "detect")
    without = sorted(set(session.images) - set(session.calibrations) - set(request.lenses))
    corners = request.corners or usual_corners(session.images, {*session.calibrations, *request.lenses})
    lenses: dict[str, CameraCalibration] = {}
    if corners == detect.EDGES:
        lenses = _other_lenses(session, request)
        topics += _held_lenses(session, lenses)
    skipped = skipped_frames(session)
    as_live = request.as_live and bool(skipped)
    notes = [] if request.corners else [_why_stock(name) for name in without]
    if as_live:
        topics.append(EVENTS_TOPIC)
    elif skipped:
        notes.append(
            f"{len(skipped)} frames that were skipped live are looked at too, which makes another run; "
            "--as-live passes over them"
        )
    return Task(
        "detect",
        corners,
        (*topics, *session.images.values()),
        (Markers, ImageAnnotations, Event),
        detect.READS,
        lambda run: detect.Detect(corners),
        decodes_frames=True,
        parameters={
            "corners": corners,
            **({"as_live": "yes"} if as_live else {}),
            **version_parameters("detect", corners),
        },
        rig=rig,
        lenses=lenses,
        as_live=as_live,
        notes=notes,
    )


def _why_stock(camera: str) -> str:
    return (
        f"camera {camera} has no calibration: corners are found as with --corners stock, ten times less "
        f"exact than with --calibration {camera}=calibration.yaml"
    )


def _camera_frame(session: Session, request: Request, markers: str) -> Task | str:
    default = request.method == camera_frame.PERIMETER
    if not markers and default:
        return newest_run(session, CameraPoints) or ""
    if not markers:
        raise IpsysError(f"--method {request.method}: cannot take effect, the log has no markers")
    rig, topics = _rig(session, request, "camera-frame")
    lenses = _other_lenses(session, request)
    held = _held_lenses(session, lenses)
    return Task(
        "camera-frame",
        points_run(markers, request.method),
        (*topics, *session.topics(Markers, markers), *held),
        (CameraPoints, Event),
        camera_frame.READS,
        lambda run: camera_frame.CameraFrame(request.method),
        # Logs from before there was a choice have no such parameter.
        parameters={
            **({} if default else {"method": request.method}),
            **version_parameters("camera-frame", request.method),
        },
        rig=rig,
        lenses=lenses,
    )


def _other_lenses(session: Session, request: Request) -> dict[str, CameraCalibration]:
    """The overriding lenses that say something else than the log."""
    lenses = dict(request.lenses)
    for camera, topic in session.calibrations.items():
        if camera in lenses and all(same_lens(held, lenses[camera]) for held in session.payloads([topic])):
            del lenses[camera]
    return lenses


def _held_lenses(session: Session, other: Mapping[str, CameraCalibration]) -> list[str]:
    """The topics of the lenses that no other one overrides."""
    return [topic for camera, topic in session.calibrations.items() if camera not in other]


def _fit(session: Session, request: Request, points: str, model: str) -> Task | str:
    base = model_run(model)
    if request.model_from is not None:
        return copy_model(request, model)[0]
    if (copied := copied_run(session, model)) is not None:
        return copied
    rig, topics = _rig(session, request, "fit")
    topics += [*session.topics(CameraPoints, points), *session.topics(Measurement)]
    notes: list[str] = []

    def compute(log: Session, progress: Callable[[int, int], None]) -> Model:
        places = measured(log, rig)
        train, _ = split([place.measurement for place in places], request.train, request.seed)
        pairs = {
            camera: [pair for pair in found if pair.measurement in train]
            for camera, found in find_pairs(log, points, places).items()
        }
        fitted = fit_model(model, pairs, log.last(topics)[1], progress)
        notes.extend(unused_places(pairs, train))
        notes.extend(
            f"camera {camera}: all measured places are {height_m:.3f} m high, so heights cannot be learned: "
            "its model is good in x and y, and says that height"
            for camera, height_m in level_cameras(fitted).items()
        )
        return fitted

    split_by = split_parameters(session, request)
    parameters = {"model": model, **split_by, **version_parameters("fit", model)}
    return Task(
        "fit", base, tuple(topics), (Model,), compute=compute, parameters=parameters, rig=rig, notes=notes
    )


def usual_corners(cameras: Iterable[str], with_lens: Collection[str]) -> str:
    """Return how corners are found unless it is said: by edges if all cameras have a lens."""
    return detect.EDGES if set(cameras) <= set(with_lens) else detect.STOCK


def points_run(markers: str, method: str) -> str:
    """What the run of camera points is called, after that of its markers."""
    return markers if method == camera_frame.PERIMETER else f"{markers}_{method}"


def model_run(model: str) -> str:
    """What the run of a model is called, unless that is taken."""
    return model.replace("+", "_").replace("-", "_")


def copy_model(request: Request, name: str) -> tuple[Task, Model]:
    """The task that copies a model of another log in, and the model.

    Raises
    ------
    IpsysError
        Where the other log has no such model.
    """
    assert request.model_from is not None
    with Session([request.model_from]) as other:
        model, topic = fitted_in(other, name)
        foreign = read_channels(other, [topic])
    task = Task(
        "fit",
        model_run(name),
        (),
        (Model,),
        compute=lambda log, progress: model,
        parameters={"model": name},
        foreign=foreign,
        input_runs=(f"{request.model_from.name}:{topic.split('/')[2]}",),
    )
    return task, model


def _evaluate(session: Session, request: Request, points: str, model: str) -> Task | str:
    name = session.payloads(session.topics(Model, model))[-1].name
    if not can_evaluate(session, request, name):
        return ""
    again = fits_again(session, request, name)
    rig, topics = _rig(session, request, "evaluate")
    topics += [*session.topics(CameraPoints, points), *session.topics(Model, model)]
    topics += [*session.topics(Measurement), *session.topics(Tracks)]
    notes: list[str] = []

    def compute(log: Session, progress: Callable[[int, int], None]) -> Evaluation:
        fitted: Model = log.payloads(log.topics(Model, model))[-1]
        places = measured(log, rig)
        measurements = [place.measurement for place in places]
        study = Study(
            places,
            find_pairs(log, points, places),
            held_out_ids(measurements, request),
            labelled_subsets(measurements),
            true_points(places, gather_tracks(log.messages(log.topics(Tracks)))),
            request.seed if again else None,
        )
        return evaluate_model(fitted, study, log.last(topics)[1], notes, progress)

    parameters = {}
    if again:
        folds = {"folds": str(FOLDS), "repeats": str(REPEATS), "seed": str(request.seed)}
        parameters = {**split_parameters(session, request), **folds}
    parameters |= version_parameters("evaluate", name)
    return Task(
        "evaluate",
        model,
        tuple(topics),
        (Evaluation,),
        compute=compute,
        parameters=parameters,
        rig=rig,
        notes=notes,
    )


def _locate(session: Session, request: Request, points: str, model: str) -> Task | str:
    fitted: Model = session.payloads(session.topics(Model, model))[-1]
    rig, topics = _rig(session, request, "locate") if reads_height(fitted.name) else (None, [])
    topics += [*session.topics(CameraPoints, points), *session.topics(Model, model)]
    return Task(
        "locate",
        model,
        tuple(topics),
        (Positions,),
        locate.READS,
        lambda run: locate.Locate(fitted),
        parameters=version_parameters("locate", fitted.name),
        rig=rig,
    )


def _fuse(session: Session, request: Request, positions: str) -> Task | str:
    rig, topics = _rig(session, request, "fuse")
    topics += session.topics(Positions, positions)
    if has_late_frames(session):  # a log without such events keeps its runs
        topics.append(EVENTS_TOPIC)
    return Task(
        "fuse",
        positions,
        tuple(topics),
        (Tracks, FrameTransforms),
        fuse.READS,
        fuse.Fuse,
        per_camera=False,
        parameters=version_parameters("fuse"),
        rig=rig,
    )


_PLANS: dict[str, Callable[..., Task | str]] = {
    "detect": _detect,
    "camera-frame": _camera_frame,
    "fit": _fit,
    "evaluate": _evaluate,
    "locate": _locate,
    "fuse": _fuse,
}
STAGES = tuple(_PLANS)
