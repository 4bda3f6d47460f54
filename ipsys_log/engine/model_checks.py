"""Checks of measurements and models before any computation."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.options import Request
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.select import copied_run, fitted_in, has_corners
from ipsys_log.engine.view import LogView
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import (
    CAMERA_POINTS,
    EVALUATION,
    POSITIONS,
    RIG,
    Channel,
)
from ipsys_log.models.table import needs_height
from ipsys_log.plain_text import shell_words
from ipsys_log.statistics.calibration_points import measured, split_ids, training_pairs
from ipsys_log.statistics.model_kinds import model_kind
from ipsys_log.statistics.point_evaluation import can_evaluate
from ipsys_log.statistics.tape import RiggedMeasurement, world_point


def check_measurements(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check that the measurements are valid, and enough to fit the models.

    Raises
    ------
    IpsysError
        They are not; the text names the first fault.
    """
    places = measured(LogView(session, rig=request.rig))
    if not places and all(copied_run(session, model) for model in models):
        return
    if not places:
        raise FitError(
            f"{session}: has no measurements to fit a model to; enter some with "
            f"'ipsys measure {shell_words(session.paths[-1])}', or apply a model of another log with "
            "--model-from calibration.mcap"
        )
    train, _ = split_ids([place.measurement for place in places], request.options())
    world_m = _check_places(places)
    train_m = np.array([world_m[name] for name in sorted(train)]).reshape(-1, 3)
    for model in models:
        model_kind(model).check_points(model, str(session), train_m, has_corners(session))


def _check_places(places: Sequence[RiggedMeasurement]) -> dict[str, NDArray[np.float64]]:
    """Return the world points (3,) in m of valid measurements, by id."""
    world_m = {}
    for place in places:
        world_m[place.measurement.id] = world_point(place.measurement, place.rig).world_m
        marker_id = place.measurement.marker_id
        if marker_id is not None and not place.rig.knows(marker_id):
            known = ", ".join(str(marker.id) for marker in place.rig.markers)
            raise IpsysError(
                f"measurement {place.measurement.id} names marker {marker_id}, which is not in the rig "
                f"(it has {known}); correct lab.toml and give it with --rig"
            )
    return world_m


def check_fits(
    session: Session, request: Request, inputs: Mapping[Channel, str], models: Sequence[str]
) -> None:
    """Check that models can be fitted to the camera points of a run, before the first model is fitted.

    Raises
    ------
    IpsysError
        A camera sees too few calibration points for a model, or a measured marker was never seen.
    """
    view = LogView(session, inputs, request.rig)
    train, _ = split_ids([point.measurement for point in measured(view)], request.options())
    pairs = training_pairs(view, train)
    for model in models:
        model_kind(model).check_pairs(model, pairs)


def check_evaluated(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check the measurements on which a model of another log is evaluated.

    Raises
    ------
    IpsysError
        A measurement is invalid.
    """
    view = LogView(session, rig=request.rig)
    if any(can_evaluate(view, request.options(), model) for model in models):
        _check_places(measured(view))


def check_models(
    session: Session, request: Request, models: Sequence[str], written: Collection[Channel], cameras: set[str]
) -> None:
    """Check that the other log has the models, and that they can be applied if a stage applies them.

    Raises
    ------
    IpsysError
        A model is missing or damaged, or is for other cameras.
    """
    assert request.model_from is not None
    if not cameras:
        run = newest_run(session, CAMERA_POINTS)
        cameras = {str(camera_of_topic(topic)) for topic in session.topics(CAMERA_POINTS, run)}
    with Session([request.model_from]) as other:
        for name in models:
            model, _ = fitted_in(other, name)
            if {EVALUATION, POSITIONS} & {*written}:
                model_kind(model.name).restore(model)
            fitted = {camera.camera for camera in model.cameras}
            if POSITIONS in written and not fitted & cameras:
                raise IpsysError(
                    f"--model-from {request.model_from}: its model is for the cameras "
                    f"{', '.join(sorted(fitted))}, but the log has {', '.join(sorted(cameras))}; give a "
                    "model of these cameras"
                )


def check_heights(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check that the rig has a height for each marker, if a model needs the heights of markers.

    Raises
    ------
    IpsysError
        The rig has no height for a marker.
    """
    rigs = [request.rig] if request.rig is not None else session.payloads(session.topics(RIG))
    for name in models:
        for rig in rigs:
            missing = [m.id for m in rig.markers if rig.height_of(m.id) is None]
            if needs_height(name) and (missing or (not rig.markers and rig.marker_height_m is None)):
                which = f"marker {missing[0]}" if missing else "the markers"
                raise IpsysError(
                    f"{session}: {name} needs the height of {which} above the floor: write marker_height_m "
                    "into lab.toml ('ipsys init lab.toml --from LOG' writes the rig of the log), and "
                    "give the file with --rig"
                )


def check_evaluation(session: Session, request: Request, models: Sequence[str]) -> None:
    """Check that the log has points to evaluate a model on.

    Raises
    ------
    IpsysError
        It has neither held-out points nor enough points for cross-validation.
    """
    view = LogView(session, rig=request.rig)
    if not any(can_evaluate(view, request.options(), model) for model in models):
        raise IpsysError(
            f"{session}: has no held-out points, and its {len(measured(view))} calibration points are too "
            "few for cross-validation; label some 'test', or measure more"
        )
