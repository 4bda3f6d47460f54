"""What each stage reads of a log, and what makes its result what it is: the plan of a replay."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from ipsys_log.derive import Request, Task
from ipsys_log.errors import IpsysError
from ipsys_log.geometry.lenses import same_lens
from ipsys_log.log.session import Session
from ipsys_log.messages import (
    MEASUREMENTS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    CameraCalibration,
    CameraPoints,
    Evaluation,
    Markers,
    Measurement,
    Model,
    Pair,
    Positions,
    Rig,
)
from ipsys_log.models import create
from ipsys_log.offline.evaluate import evaluate_model, gather_tracks, true_points
from ipsys_log.offline.fit import fit_model
from ipsys_log.offline.pairs import active_measurements, build_pairs, gather_sightings, split
from ipsys_log.runs import newest_run, read_channels
from ipsys_log.stages import camera_frame, detect, fuse, locate

__all__ = ["STAGES", "held_out_ids", "plan_stage", "wanted_models"]

# What a stage reads of the rig; an overriding rig that says the same there changes nothing.
_RIG_PARTS: dict[str, Callable[[Rig], Any]] = {
    "detect": lambda rig: (rig.dictionary, {marker.id for marker in rig.markers}),
    "camera-frame": lambda rig: (rig.marker_length_m, {(m.id, rig.length_of(m.id)) for m in rig.markers}),
    "fit": lambda rig: (rig.reference_points, {marker.id for marker in rig.markers}),
    "evaluate": lambda rig: (rig.reference_points, {marker.id for marker in rig.markers}),
    "fuse": lambda rig: {(marker.id, marker.robot) for marker in rig.markers},
}


def wanted_models(request: Request) -> tuple[str, ...]:
    """The models to fit or apply.

    Raises
    ------
    IpsysError
        For a name that is not in the table, or a log that has no fitted model to apply.
    """
    for name in request.models:
        create(name)
    if request.models or request.model_from is None:
        return request.models or ("poly",)
    with Session([request.model_from]) as other:
        return (_fitted(other, None)[0].name,)


def _fitted(other: Session, name: str | None) -> tuple[Model, str]:
    """The newest model in another log, of a name where one is given, and its topic."""
    for run in reversed(other.runs()):
        for topic in other.topics(Model, run.run):
            model: Model = other.payloads([topic])[-1]
            if run.stage == "fit" and name in (None, model.name):
                return model, topic
    what = f"model {name}" if name else "model"
    raise IpsysError(f"{other}: has no fitted {what}; fit one there with: ipsys fit {other}")


def _rig(session: Session, request: Request, stage: str) -> tuple[Rig | None, list[str]]:
    """The overriding rig, if it matters to a stage, or the log's topic to read it from."""
    part = _RIG_PARTS[stage]
    held = session.payloads([RIG_TOPIC]) if session.topics(Rig) else []
    if request.rig is not None and not (held and all(part(rig) == part(request.rig) for rig in held)):
        return request.rig, []
    return None, session.topics(Rig)


def plan_stage(stage: str, session: Session, request: Request, **inputs: str) -> Task | str:
    """The task of a stage on a log; or the name of a run to use as it is; or "" for nothing to do."""
    return STAGE_PLANS[stage](session, request, **inputs)


def _detect(session: Session, request: Request) -> Task | str:
    if not session.images:
        return newest_run(session, Markers) or ""
    rig, topics = _rig(session, request, "detect")
    topics += session.images.values()
    parameters = {"corners": "stock"}
    return Task(
        "detect",
        "stock",
        tuple(topics),
        detect.READS,
        lambda run: detect.Detect(),
        parameters=parameters,
        rig=rig,
    )


def _camera_frame(session: Session, request: Request, markers: str) -> Task | str:
    if not markers:
        return newest_run(session, CameraPoints) or ""
    rig, topics = _rig(session, request, "camera-frame")
    topics += session.topics(Markers, markers)
    lenses = _other_lenses(session, request)
    topics += [topic for camera, topic in session.calibrations.items() if camera not in lenses]
    return Task(
        "camera-frame",
        markers,
        tuple(topics),
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
    rig, topics = _rig(session, request, "fit")
    topics += [*session.topics(CameraPoints, points), MEASUREMENTS_TOPIC]

    def compute(log: Session) -> Model:
        measurements = active_measurements(log.payloads([MEASUREMENTS_TOPIC]))
        train, _ = split(measurements, request.train, request.seed)
        return fit_model(model, _pairs(log, rig, points, measurements, train), log.last_ns(topics))

    parameters = {"model": model, "train": request.train, "seed": str(request.seed)}
    return Task("fit", base, tuple(topics), compute=compute, parameters=parameters, rig=rig)


def _copy_model(request: Request, name: str, base: str) -> Task:
    assert request.model_from is not None
    with Session([request.model_from]) as other:
        model, topic = _fitted(other, name)
        foreign = read_channels(other, [topic])
    parameters = {"model": name, "copied_from": request.model_from.name}
    return Task("fit", base, (), compute=lambda log: model, parameters=parameters, foreign=foreign)


def _evaluate(session: Session, request: Request, points: str, model: str) -> Task | str:
    if not held_out_ids(active_measurements(session.payloads([MEASUREMENTS_TOPIC])), request):
        return ""
    rig, topics = _rig(session, request, "evaluate")
    topics += [*session.topics(CameraPoints, points), *session.topics(Model, model), MEASUREMENTS_TOPIC]
    topics += [TRUTH_TOPIC] if session.count(TRUTH_TOPIC) else []

    def compute(log: Session) -> Evaluation:
        fitted: Model = log.payloads(log.topics(Model, model))[-1]
        measurements = active_measurements(log.payloads([MEASUREMENTS_TOPIC]))
        held_out = held_out_ids(measurements, request)
        truth = true_points(measurements, gather_tracks(log.messages([TRUTH_TOPIC])))
        pairs = _pairs(log, rig, points, measurements, held_out)
        return evaluate_model(fitted, pairs, truth, log.last_ns(topics))

    parameters = {"train": request.train, "seed": str(request.seed)}
    if request.model_from is not None:
        parameters = {"held_out": "test, or all where nothing is labelled"}
    return Task("evaluate", model, tuple(topics), compute=compute, parameters=parameters, rig=rig)


def _locate(session: Session, _request: Request, points: str, model: str) -> Task | str:
    topics = (*session.topics(CameraPoints, points), *session.topics(Model, model))
    fitted: Model = session.payloads(session.topics(Model, model))[-1]
    return Task("locate", model, topics, locate.READS, lambda run: locate.Locate(fitted))


def _fuse(session: Session, request: Request, positions: str) -> Task | str:
    rig, topics = _rig(session, request, "fuse")
    topics += session.topics(Positions, positions)
    return Task("fuse", positions, tuple(topics), fuse.READS, fuse.Fuse, per_camera=False, rig=rig)


STAGE_PLANS: dict[str, Callable[..., Task | str]] = {
    "detect": _detect,
    "camera-frame": _camera_frame,
    "fit": _fit,
    "evaluate": _evaluate,
    "locate": _locate,
    "fuse": _fuse,
}
STAGES = tuple(STAGE_PLANS)


def held_out_ids(measurements: list[Measurement], request: Request) -> set[str]:
    """The measurements that the models are evaluated on."""
    if request.model_from is None:
        return split(measurements, request.train, request.seed)[1]
    # A model of another log has seen none of these places.
    labelled = any(m.splits for m in measurements)
    return {m.id for m in measurements if "test" in m.splits or not labelled}


def _pairs(
    session: Session, rig: Rig | None, points: str, measurements: list[Measurement], ids: set[str]
) -> dict[str, list[Pair]]:
    """The measured places with these ids, by camera."""
    rig = rig or session.payloads([RIG_TOPIC])[-1]
    sightings = gather_sightings(session.messages(session.topics(CameraPoints, points)))
    return build_pairs(sightings, [m for m in measurements if m.id in ids], rig)
