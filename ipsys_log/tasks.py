"""What each stage reads of a log, and what makes its result what it is: the plan of a replay."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import same_lens
from ipsys_log.log.session import Session, run_of_topic
from ipsys_log.messages import (
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
    Pair,
    Positions,
    Rig,
    Tracks,
)
from ipsys_log.models import MODELS, create, min_pairs, reads_height
from ipsys_log.offline.crossval import FOLDS
from ipsys_log.offline.evaluate import Study, evaluate_model
from ipsys_log.offline.fit import fit_model, level_cameras
from ipsys_log.offline.learning import labelled_subsets
from ipsys_log.offline.pairs import Measured, build_pairs, gather_sightings, measured_in_order, split
from ipsys_log.offline.truth import gather_tracks, true_points
from ipsys_log.request import Request
from ipsys_log.runs import complete_runs, newest_run, read_channels
from ipsys_log.stages import camera_frame, detect, fuse, locate

__all__ = [
    "STAGES",
    "Task",
    "can_evaluate",
    "copied_run",
    "fitted_in",
    "held_out_ids",
    "measured",
    "plan_stage",
    "wanted_models",
]


@dataclass(frozen=True, slots=True)
class Task:
    """One stage, told what to read: everything that makes its result what it is.

    Attributes
    ----------
    base : name of its run, unless that one is taken.
    topics : what it reads of the log, and ``foreign`` what it reads of another one.
    writes : the payloads that it makes, first the one that it is there for.
    reads, step, per_camera : a causal stage: its payloads, its step for a run of a given name, and whether
        the step takes each camera by itself; or
    compute : the payload that is computed from the whole log, saying how far it is; what to know of it goes
        to ``notes``.
    parameters : what else its result depends on; ``input_runs`` those of ``foreign``.
    rig, lenses : set where they replace what the log holds.
    """

    stage: str
    base: str
    topics: tuple[str, ...]
    writes: tuple[type, ...]
    reads: tuple[type, ...] = ()
    step: Callable[[str], Callable[[Message], Iterable[Any]]] | None = None
    per_camera: bool = True
    compute: Callable[[Session, Callable[[int, int], None]], Any] | None = None
    parameters: Mapping[str, str] = field(default_factory=dict)
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    foreign: tuple[ChannelRead, ...] = ()
    input_runs: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)


def wanted_models(request: Request, until: str) -> tuple[str, ...]:
    """The models to fit or apply.

    Raises
    ------
    IpsysError
        For a name that is not in the table, or a log that has no fitted model to apply.
    """
    for name in request.models:
        create(name)
    if request.models:
        return request.models
    if request.model_from is not None:
        with Session([request.model_from]) as other:
            held = {other.payloads([topic])[-1].name for topic in _model_topics(other)}
            return ("poly" if "poly" in held else fitted_in(other, None)[0].name,)
    return tuple(MODELS) if until == "evaluate" else ("poly",)


def fitted_in(other: Session, name: str | None) -> tuple[Model, str]:
    """The newest model in another log, of a name where one is given, and its topic.

    Raises
    ------
    IpsysError
        Where there is none.
    """
    for topic in reversed(_model_topics(other)):
        model: Model = other.payloads([topic])[-1]
        if name in (None, model.name):
            return model, topic
    what = f"model {name}" if name else "model"
    raise IpsysError(f"{other}: has no fitted {what}; fit one there with: ipsys fit {other}")


def _model_topics(session: Session) -> list[str]:
    return [t for run in complete_runs(session) if run.stage == "fit" for t in session.topics(Model, run.run)]


def copied_run(session: Session, model: str) -> str | None:
    """The run of a model that was copied into a log without measurements, the newest one."""
    if session.topics(Measurement):
        return None
    for topic in reversed(_model_topics(session)):
        if session.payloads([topic])[-1].name == model:
            return run_of_topic(topic)
    return None


def _rig_part(stage: str) -> Callable[[Rig], Any]:
    """What a stage reads of the rig; an overriding rig that says the same there changes nothing."""
    return {
        "detect": lambda rig: (rig.dictionary, {m.id for m in rig.markers}),
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
    return Task(
        "detect",
        "stock",
        (*topics, *session.images.values()),
        (Markers, ImageAnnotations, Event),
        detect.READS,
        lambda run: detect.Detect(),
        parameters={"corners": "stock"},
        rig=rig,
    )


def _camera_frame(session: Session, request: Request, markers: str) -> Task | str:
    if not markers:
        return newest_run(session, CameraPoints) or ""
    rig, topics = _rig(session, request, "camera-frame")
    lenses = _other_lenses(session, request)
    held = [topic for camera, topic in session.calibrations.items() if camera not in lenses]
    return Task(
        "camera-frame",
        markers,
        (*topics, *session.topics(Markers, markers), *held),
        (CameraPoints, Event),
        camera_frame.READS,
        lambda run: camera_frame.CameraFrame(),
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


def _fit(session: Session, request: Request, points: str, model: str) -> Task | str:
    base = model.replace("+", "_").replace("-", "_")
    if request.model_from is not None:
        return _copy_model(request, model, base)
    if (copied := copied_run(session, model)) is not None:
        return copied
    rig, topics = _rig(session, request, "fit")
    topics += [*session.topics(CameraPoints, points), *session.topics(Measurement)]
    notes: list[str] = []

    def compute(log: Session, progress: Callable[[int, int], None]) -> Model:
        places = measured(log, rig)
        train, _ = split([place.measurement for place in places], request.train, request.seed)
        pairs = _pairs(log, points, places, train)
        fitted = fit_model(model, pairs, log.last(topics)[1], progress)
        notes.extend(_unused(pairs, train))
        notes.extend(
            f"camera {camera}: all measured places are {height_m:.3f} m high, so heights cannot be learned: "
            "its model is good in x and y, and says that height"
            for camera, height_m in level_cameras(fitted).items()
        )
        return fitted

    parameters = {"model": model, **_split_parameters(session, request)}
    return Task(
        "fit", base, tuple(topics), (Model,), compute=compute, parameters=parameters, rig=rig, notes=notes
    )


def _copy_model(request: Request, name: str, base: str) -> Task:
    assert request.model_from is not None
    with Session([request.model_from]) as other:
        model, topic = fitted_in(other, name)
        foreign = read_channels(other, [topic])
    return Task(
        "fit",
        base,
        (),
        (Model,),
        compute=lambda log, progress: model,
        parameters={"model": name},
        foreign=foreign,
        input_runs=(f"{request.model_from.name}:{topic.split('/')[2]}",),
    )


def _evaluate(session: Session, request: Request, points: str, model: str) -> Task | str:
    name = session.payloads(session.topics(Model, model))[-1].name
    if not can_evaluate(session, request, name):
        return ""
    again = _fits_again(session, request, name)
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
            _pairs(log, points, places, {m.id for m in measurements}),
            held_out_ids(measurements, request),
            labelled_subsets(measurements),
            true_points(places, gather_tracks(log.messages(log.topics(Tracks)))),
            request.seed if again else None,
        )
        return evaluate_model(fitted, study, log.last(topics)[1], notes, progress)

    parameters = {**_split_parameters(session, request), "seed": str(request.seed)} if again else {}
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
    writes, step = (Positions,), lambda run: locate.Locate(fitted)
    return Task("locate", model, tuple(topics), writes, locate.READS, step, rig=rig)


def _fuse(session: Session, request: Request, positions: str) -> Task | str:
    rig, topics = _rig(session, request, "fuse")
    topics += session.topics(Positions, positions)
    writes = (Tracks, FrameTransforms)
    return Task("fuse", positions, tuple(topics), writes, fuse.READS, fuse.Fuse, per_camera=False, rig=rig)


_PLANS: dict[str, Callable[..., Task | str]] = {
    "detect": _detect,
    "camera-frame": _camera_frame,
    "fit": _fit,
    "evaluate": _evaluate,
    "locate": _locate,
    "fuse": _fuse,
}
STAGES = tuple(_PLANS)


def measured(session: Session, rig: Rig | None) -> list[Measured]:
    """The measured places that count, each with the rig in force when it was measured, or with ``rig``."""
    topics = [*session.topics(Rig), *session.topics(Measurement)]
    return measured_in_order(session.messages(topics), rig)


def held_out_ids(measurements: Iterable[Measurement], request: Request) -> set[str]:
    """The measurements that models are evaluated on."""
    measurements = list(measurements)
    if request.model_from is None:
        return split(measurements, request.train, request.seed)[1] if measurements else set()
    # A model of another log has seen none of these places, unless it was made of them: see evaluate_model.
    labelled = any(m.splits for m in measurements)
    return {m.id for m in measurements if "test" in m.splits or not labelled}


def can_evaluate(session: Session, request: Request, model: str) -> bool:
    """Whether there are places that a model is not fitted on, or enough of them for cross-validation."""
    measurements = [place.measurement for place in measured(session, request.rig)]
    enough = len(measurements) - -(-len(measurements) // FOLDS) >= min_pairs(model)
    held_out = held_out_ids(measurements, request)
    return bool(held_out) or (_fits_again(session, request, model) and enough)


def _fits_again(session: Session, request: Request, model: str) -> bool:
    """Whether a model is fitted to this log's places, so that it can be fitted to fewer of them."""
    return request.model_from is None and copied_run(session, model) is None


def _split_parameters(session: Session, request: Request) -> dict[str, str]:
    """What the split depends on: the label, or the seed where nothing is labelled."""
    labelled = any(m.splits for m in session.payloads(session.topics(Measurement)))
    return {"train": request.train} if labelled else {"seed": str(request.seed)}


def _pairs(session: Session, points: str, places: list[Measured], ids: set[str]) -> dict[str, list[Pair]]:
    """The measured places with these ids, by camera."""
    sightings = gather_sightings(session.messages(session.topics(CameraPoints, points)))
    return build_pairs(sightings, [place for place in places if place.measurement.id in ids])


def _unused(pairs: Mapping[str, list[Pair]], train: set[str]) -> list[str]:
    """What was measured for nothing: places that no camera saw, cameras that saw no place."""
    seen = {pair.measurement for found in pairs.values() for pair in found}
    unseen = sorted(train - seen)
    lines = [
        f"camera {name} saw no measured place: it has no model" for name, found in pairs.items() if not found
    ]
    if unseen:
        names = ", ".join(unseen[:5]) + (" ..." if len(unseen) > 5 else "")
        lines.append(f"{len(unseen)} of {len(train)} measured places were seen still by no camera: {names}")
    return lines
