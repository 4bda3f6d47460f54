"""Model inputs in a log: measured points, and models that were fitted or copied into it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from ipsys_log.analysis.cross_validation import FOLDS
from ipsys_log.analysis.pairs import Measured, build_pairs, gather_sightings, measured_in_order, split
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    FRAME_SKIPPED,
    STAMP_UNRELIABLE,
    CameraPoints,
    Event,
    Markers,
    Measurement,
    Model,
    Pair,
    Rig,
)
from ipsys_log.models.table import MODELS, create, min_pairs
from ipsys_log.runs.options import Request
from ipsys_log.runs.provenance import complete_runs, newest_run

__all__ = [
    "LEAST_OFFSET_PX",
    "MIN_OFFSETS",
    "can_evaluate",
    "copied_run",
    "find_pairs",
    "fits_again",
    "fitted_in",
    "has_late_frames",
    "held_out_ids",
    "measured",
    "rig_with_offsets",
    "skipped_frames",
    "split_parameters",
    "unused_places",
    "wanted_models",
]


# Of so many markers the median edge offset is that of the camera; and less than that is none.
MIN_OFFSETS, LEAST_OFFSET_PX = 10, 0.05


def wanted_models(request: Request, until: str, paths: Sequence[Path] = ()) -> tuple[str, ...]:
    """Return the names of the models to fit or apply.

    The first that applies: the models of the request; ``poly`` or another one of ``model_from``; the models
    that were copied into the logs of ``paths``, if these have no measurements to fit to; all models, to
    evaluate; ``poly``.

    Raises
    ------
    IpsysError
        A name is not in the table, or a log has no fitted model to apply.
    """
    for name in request.models:
        create(name)
    if request.models:
        return request.models
    if request.model_from is not None:
        with Session([request.model_from]) as other:
            names = {other.payloads([topic])[-1].name for topic in _model_topics(other)}
            return ("poly" if "poly" in names else fitted_in(other, None)[0].name,)
    if paths:
        with Session(paths) as session:
            held = _copied_models(session)
        if held:
            return held
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
    option = f" --model {name}" if name else ""
    raise IpsysError(f"{other}: has no fitted {what}; fit one there with: ipsys fit {other}{option}")


def _model_topics(session: Session) -> list[str]:
    return [t for run in complete_runs(session) if run.stage == "fit" for t in session.topics(Model, run.run)]


def _copied_models(session: Session) -> tuple[str, ...]:
    """Return the names of the models that were copied into a log without measurements, oldest first."""
    if _has_measurements(session):
        return ()
    return tuple(dict.fromkeys(session.payloads([topic])[-1].name for topic in _model_topics(session)))


def _has_measurements(session: Session) -> bool:
    """Return whether a measurement was entered and not withdrawn."""
    entered: list[Measurement] = session.payloads(session.topics(Measurement))
    gone = {one.withdraws for one in entered}
    return any(one.withdraws is None and one.id not in gone for one in entered)


def copied_run(session: Session, model: str) -> str | None:
    """The run of a model that was copied into a log without measurements, the newest one."""
    if _has_measurements(session):
        return None
    for topic in reversed(_model_topics(session)):
        if session.payloads([topic])[-1].name == model:
            return run_of_topic(topic)
    return None


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
    return bool(held_out) or (fits_again(session, request, model) and enough)


def fits_again(session: Session, request: Request, model: str) -> bool:
    """Return whether a model is fitted to this log's places, so that it can be fitted to fewer of them."""
    return request.model_from is None and copied_run(session, model) is None


def split_parameters(session: Session, request: Request) -> dict[str, str]:
    """What the split depends on: the label, or the seed where nothing is labelled."""
    labelled = any(m.splits for m in session.payloads(session.topics(Measurement)))
    return {"train": request.train} if labelled else {"seed": str(request.seed)}


def find_pairs(session: Session, points: str, places: list[Measured]) -> dict[str, list[Pair]]:
    """Return the observations of the measured points by camera."""
    sightings = gather_sightings(session.messages(session.topics(CameraPoints, points)))
    return build_pairs(sightings, places)


def skipped_frames(session: Session) -> set[int]:
    """Log times of the frames that were recorded live and not looked at then."""
    events = session.payloads(session.topics(Event))
    return {event.timestamp for event in events if event.kind == FRAME_SKIPPED}


def has_late_frames(session: Session) -> bool:
    """Return whether a log has events about late frames with wrong times."""
    events = session.payloads(session.topics(Event))
    return any(event.kind == STAMP_UNRELIABLE for event in events)


def rig_with_offsets(session: Session) -> Rig:
    """The newest rig of a log, with the edge offset of each camera that has one and the rig does not say it:
    the median of those that the newest detection found.

    Raises
    ------
    IpsysError
        Where the log holds no rig.
    """
    rigs: list[Rig] = session.payloads(session.topics(Rig))
    if not rigs:
        raise IpsysError(f"{session}: holds no rig; write an example with 'ipsys init lab.toml'")
    run = newest_run(session, Markers)
    found: dict[str, list[float]] = {}
    for message in session.messages(session.topics(Markers, run) if run else []):
        offsets = found.setdefault(str(message.camera), [])
        offsets += [m.edge_offset_px for m in message.payload.markers if m.edge_offset_px is not None]
    cameras = {name: rigs[-1].camera(name) for name in [c.name for c in rigs[-1].cameras] + sorted(found)}
    for name, offsets in found.items():
        offset_px = float(np.median(offsets)) if len(offsets) >= MIN_OFFSETS else 0.0
        if abs(offset_px) >= LEAST_OFFSET_PX and cameras[name].edge_offset_px is None:
            cameras[name] = replace(cameras[name], edge_offset_px=round(offset_px, 3))
    return replace(rigs[-1], cameras=tuple(cameras.values()))


def unused_places(pairs: Mapping[str, list[Pair]], train: set[str]) -> list[str]:
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
