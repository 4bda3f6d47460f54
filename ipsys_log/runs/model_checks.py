"""Checks of measurements and models before any computation."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.calibration_points import find_pairs, measured, split_ids
from ipsys_log.analysis.tape import RiggedMeasurement, world_point
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Model
from ipsys_log.messages.channels import (
    CAMERA_POINTS,
    EVALUATION,
    POSITIONS,
    RIG,
    Channel,
)
from ipsys_log.models.table import AppliedModel, min_pairs, needs_height, reads_corners
from ipsys_log.plain_text import shell_words
from ipsys_log.runs.options import Request
from ipsys_log.runs.provenance import newest_run
from ipsys_log.runs.select import copied_run, fitted_in, has_corners
from ipsys_log.runs.view import LogView
from ipsys_log.stages.evaluate import can_evaluate
from ipsys_log.stages.fit import BESIDE_LINE_M, check_different, check_pairs


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
        if reads_corners(model):
            _check_corners(session, model)
        if len(train) < min_pairs(model):
            raise FitError(
                f"{session}: {model} needs at least {min_pairs(model)} calibration points for each camera, "
                f"but the log has {len(train)} in all; measure more"
                + ("" if model == "rigid" else ", or use --model rigid")
            )
        if not reads_corners(model):
            check_different(model, str(session), train_m)
    # For a model of all corners, a drive is enough beside the line; its fit checks that.
    if not all(reads_corners(model) for model in models):
        _check_line(session, train_m)


def _check_corners(session: Session, model: str) -> None:
    """Check that the log has corners of markers, or images to detect them in."""
    if not has_corners(session):
        raise FitError(
            f"{session}: {model} is fitted to the corners of markers, but the log has only camera points; "
            "use --model best"
        )


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


def _check_line(session: Session, train_m: NDArray[np.float64]) -> None:
    """Check that not all points lie on a line: then those that one camera sees do so, too."""
    offsets_m = train_m - train_m.mean(axis=0)
    along = np.linalg.svd(offsets_m, full_matrices=False)[2][0]
    beside_m = np.linalg.norm(offsets_m - np.outer(offsets_m @ along, along), axis=1)
    if beside_m.max() < BESIDE_LINE_M:
        raise FitError(
            f"{session}: all {len(train_m)} calibration points are on one line; measure some beside it"
        )


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
    points = measured(view)
    train, _ = split_ids([point.measurement for point in points], request.options())
    pairs = {
        camera: [pair for pair in seen if pair.measurement in train]
        for camera, seen in find_pairs(view, points).items()
    }
    for model in models:
        if not reads_corners(model):
            check_pairs(model, pairs)


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
                _restore(model)
            fitted = {camera.camera for camera in model.cameras}
            if POSITIONS in written and not fitted & cameras:
                raise IpsysError(
                    f"--model-from {request.model_from}: its model is for the cameras "
                    f"{', '.join(sorted(fitted))}, but the log has {', '.join(sorted(cameras))}; give a "
                    "model of these cameras"
                )


def _restore(model: Model) -> object:
    if not reads_corners(model.name):
        return [AppliedModel(model.name, camera) for camera in model.cameras]
    from ipsys_log.joint.payload import restore_joint  # late: scipy takes 1 s

    return restore_joint(model)


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
