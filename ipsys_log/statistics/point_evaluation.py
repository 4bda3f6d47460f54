"""Evaluation of a model of camera points: errors, effect of the number of points, suspect measurements."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from ipsys_log.errors import FitError
from ipsys_log.messages import CameraEvaluation, Evaluation, LearningPoint, Model, Pair, Suspect
from ipsys_log.messages.channels import MODEL
from ipsys_log.messages.stage import StageView
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import min_pairs
from ipsys_log.statistics.accuracy import evaluate_cross_validated, evaluate_held_out
from ipsys_log.statistics.calibration_points import has_measurements, held_out_ids, measured
from ipsys_log.statistics.camera_models import fit_camera_models
from ipsys_log.statistics.cross_validation import (
    FOLDS,
    Study,
    gather_points,
    learning_curve,
    learning_sizes,
    leave_one_out,
    published_curve,
)
from ipsys_log.statistics.outliers import find_outliers, is_gross
from ipsys_log.statistics.tape import RiggedMeasurement

# Models that check the measurements. They fit in milliseconds, and they follow the calibration points
# closely enough to show an error of some centimetres.
SCREENING = ("poly", "rayplane", "best", "joint")
# The same model selects the gross outliers for all evaluations, so that all models have the same points. The
# polynomial is a hundred times as fast as the second model;
_GROSS_MODEL = "poly"
_GROSS_MODEL_FEW = "best"
# with fewer points of a camera, it is too uncertain.
_FEW = 20


def evaluate_model(
    model: Model, study: Study, time_ns: int, notes: list[str], progress: Callable[[int, int], None]
) -> Evaluation:
    """Compute errors on held-out points and by cross-validation, learning curve and suspect measurements.

    Gross outliers come first. The errors and the learning curve are without them, in the fit and in the test;
    the errors with them are in ``with_excluded``.

    Parameters
    ----------
    model : fitted model.
    time_ns : of the last input.
    notes : list of remarks; each impossible step adds a remark.
    progress : called with the number of steps done, and the number of all steps.
    """
    if study.seed is None:
        return Evaluation(time_ns, model.name, tuple(_held_out_rows(model, study)))
    cameras = gather_points(fitted_pairs(model, study))
    excluded = gross_outliers(cameras, study.places)
    reduced, clean = _without(model, study, {suspect.measurement for suspect in excluded}, notes)
    if reduced is model:
        excluded = ()
    remaining = gather_points(fitted_pairs(reduced, clean))
    total = 2 + len(learning_sizes(model.name, remaining))
    progress(0, total)
    rows = _rows(reduced, clean, notes)
    progress(1, total)
    learning: list[LearningPoint] = published_curve(model.name, remaining, study.subsets, clean.held_out)
    for done, points in enumerate(learning_curve(model.name, remaining, study.seed), 2):
        learning += points
        progress(done, total)
    suspects = _suspects(model.name, cameras, study.places) if model.name in SCREENING else ()
    with_excluded = _rows(model, study, []) if excluded else ()
    progress(total, total)
    return Evaluation(time_ns, model.name, rows, tuple(learning), suspects, excluded, with_excluded)


def fitted_pairs(model: Model, study: Study) -> dict[str, Sequence[Pair]]:
    fitted = {camera.camera for camera in model.cameras}
    return {camera: camera_pairs for camera, camera_pairs in study.pairs.items() if camera in fitted}


def _held_out_rows(model: Model, study: Study) -> list[CameraEvaluation]:
    held_out = {
        camera: [pair for pair in camera_pairs if pair.measurement in study.held_out]
        for camera, camera_pairs in study.pairs.items()
    }
    return evaluate_held_out(model, held_out, study.truth)


def _rows(model: Model, study: Study, notes: list[str]) -> tuple[CameraEvaluation, ...]:
    """Return the errors on held-out points and by cross-validation."""
    assert study.seed is not None
    rows, pairs = _held_out_rows(model, study), fitted_pairs(model, study)
    if _enough(model.name, pairs, notes):
        try:
            rows += evaluate_cross_validated(model, pairs, study.truth, study.seed)
        except FitError as error:
            notes.append(f"no cross-validation: {error}")
    return tuple(rows)


def gross_outliers(
    cameras: Mapping[str, CalibrationPoints], places: Sequence[RiggedMeasurement]
) -> tuple[Suspect, ...]:
    fewest = min((len(points.names) for points in cameras.values()), default=0)
    name = _GROSS_MODEL if fewest >= _FEW else _GROSS_MODEL_FEW
    return tuple(suspect for suspect in _suspects(name, cameras, places) if is_gross(suspect))


def _without(model: Model, study: Study, names: set[str], notes: list[str]) -> tuple[Model, Study]:
    """Return the model and the data without some measurements; both unchanged if this is impossible."""
    if not names:
        return model, study
    pairs = {camera: _remaining(camera_pairs, names) for camera, camera_pairs in study.pairs.items()}
    fitted = {camera.camera: _remaining(camera.pairs, names) for camera in model.cameras}
    if any(len(camera_pairs) < min_pairs(model.name) for camera_pairs in fitted.values()):
        notes.append("gross outliers are not excluded: too few calibration points remain")
        return model, study
    try:
        cameras = tuple(fit_camera_models(model.name, gather_points(fitted), fitted))
    except FitError as error:
        notes.append(f"gross outliers are not excluded: {error}")
        return model, study
    clean = replace(study, pairs=pairs, held_out=study.held_out - names)
    return replace(model, cameras=cameras), clean


def _remaining(pairs: Sequence[Pair], names: set[str]) -> list[Pair]:
    return [pair for pair in pairs if pair.measurement not in names]


def _enough(name: str, pairs: Mapping[str, Sequence[Pair]], notes: list[str]) -> bool:
    """Return whether each fold leaves enough calibration points for a fit."""
    for camera, camera_pairs in pairs.items():
        if len(camera_pairs) - -(-len(camera_pairs) // FOLDS) < min_pairs(name):
            notes.append(
                f"no cross-validation of {name}: camera {camera} has only {len(camera_pairs)} "
                "calibration points"
            )
            return False
    return True


def _suspects(
    name: str, cameras: Mapping[str, CalibrationPoints], places: Sequence[RiggedMeasurement]
) -> tuple[Suspect, ...]:
    if any(len(points.names) <= min_pairs(name) + 1 for points in cameras.values()):
        return ()
    seen = {place for camera_places in cameras.values() for place in camera_places.names}
    try:
        return find_outliers(leave_one_out(name, cameras), [p for p in places if p.measurement.id in seen])
    except FitError:
        return ()


def can_evaluate(view: StageView, options: Mapping[str, str], model: str) -> bool:
    """Return whether a model has held-out points, or enough points for cross-validation."""
    measurements = [point.measurement for point in measured(view)]
    enough = len(measurements) - -(-len(measurements) // FOLDS) >= min_pairs(model)
    held_out = held_out_ids(measurements, options)
    return bool(held_out) or (can_refit(view, options, model) and enough)


def can_refit(view: StageView, options: Mapping[str, str], model: str) -> bool:
    """Return whether a model is fitted to points of this log: then it can be fitted to fewer points too."""
    if "model_from" in options:
        return False
    return has_measurements(view) or all(copy.name != model for _, copy in view.copied(MODEL))
