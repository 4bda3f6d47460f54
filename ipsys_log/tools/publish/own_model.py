"""A model of the user: loaded from a file that the user names, and scored in the folds of the evaluation."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ipsys_log.engine.request import Request
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CameraEvaluation, Evaluation, Model, Pair
from ipsys_log.messages.channels import CAMERA_POINTS, TRUTH
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, HELD_OUT, error_rows
from ipsys_log.statistics.calibration_points import find_pairs, held_out_ids, measured
from ipsys_log.statistics.cross_validation import cross_validate, gather_points, leave_out
from ipsys_log.statistics.ground_truth import gather_tracks, true_points
from ipsys_log.tools.publish.scores import Score, score_rows


@dataclass(frozen=True, slots=True)
class OwnModel:
    """A model of the user.

    Attributes
    ----------
    name : its name in the scores.
    create : returns an unfitted estimator with ``fit(points_m, world_m)`` and ``predict(points_m)``: camera
        points (n, 3) to world points (n, 3), in m. An estimator with a true attribute ``reads_height`` gets
        the height of each marker as the fourth column of ``points_m``.
    """

    name: str
    create: Callable[[], Any]


def load_own_model(text: str) -> OwnModel:
    """Load a class or a function from ``FILE.py:NAME``. The file is executed.

    Raises
    ------
    IpsysError
        There is no such file, or it has no such class.
    """
    file, _, name = text.rpartition(":")
    path = Path(file)
    if not file or not name.isidentifier():
        raise IpsysError(
            f"--model {text}: write the file and the class of a model, such as mine.py:Estimator"
        )
    if not path.exists():
        raise IpsysError(f"--model {text}: {path} does not exist; give the file of your model")
    if path.suffix != ".py" or not path.is_file():
        raise IpsysError(f"--model {text}: {path} is not a Python file; give the file of your model")
    spec = importlib.util.spec_from_file_location(f"ipsys_own_model_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    create = getattr(module, name, None)
    if not callable(create):
        raise IpsysError(f"--model {text}: {path} has no class {name}; give the name of the estimator")
    return OwnModel(f"{path.name}:{name}", create)


def score_own_model(
    model: OwnModel, session: Session, camera_points: str, fitted: Model, evaluation: Evaluation
) -> list[Score]:
    """Return the scores of a model of the user, at the same points and in the same folds as another model.

    Parameters
    ----------
    session : the logs.
    camera_points : the run with the camera points that the other model has read.
    fitted, evaluation : the other model, which names the cameras, and its gross outliers.

    Raises
    ------
    IpsysError
        The model returns other shapes, or numbers that are not finite.
    """
    request, view = Request(), LogView(session, {CAMERA_POINTS: camera_points})
    points = measured(view)
    excluded = {suspect.measurement for suspect in evaluation.excluded}
    held_out = held_out_ids([point.measurement for point in points], request.options()) - excluded
    cameras = {camera.camera for camera in fitted.cameras}
    pairs = {
        camera: [pair for pair in seen if pair.measurement not in excluded]
        for camera, seen in find_pairs(view, points).items()
        if camera in cameras
    }
    truth = true_points(points, gather_tracks(view.messages(TRUTH)))
    rows = _error_rows(model, fitted, pairs, held_out, truth, request.seed)
    stated = {(row.scheme, row.against) for row in evaluation.cameras}
    return [*score_rows(model.name, [row for row in rows if (row.scheme, row.against) in stated])]


def _error_rows(
    model: OwnModel,
    fitted: Model,
    pairs: Mapping[str, Sequence[Pair]],
    held_out: Collection[str],
    truth: Mapping[str, Array],
    seed: int,
) -> list[CameraEvaluation]:
    """Return the rows on held-out points and by cross-validation."""
    cameras = gather_points(pairs)
    unknown = dict.fromkeys(cameras)

    def predict(left_out: Collection[str]) -> dict[str, Array]:
        return {
            camera: _predict(model, leave_out(places, left_out), places) for camera, places in cameras.items()
        }

    tested = {}
    held_out_predictions = predict(held_out) if held_out else {}
    for camera, predicted_m in held_out_predictions.items():
        rows = [row for row, pair in enumerate(pairs[camera]) if pair.measurement in held_out]
        if rows:
            tested[camera] = ([pairs[camera][row] for row in rows], predicted_m[None, rows])
    rows_held_out = error_rows(fitted, tested, unknown, truth, HELD_OUT)
    predictions = cross_validate(model.name, cameras, seed, predict)
    crossed = {camera: (list(pairs[camera]), predictions[camera]) for camera in cameras}
    return [*rows_held_out, *error_rows(fitted, crossed, unknown, truth, CROSS_VALIDATION)]


def _predict(model: OwnModel, training: CalibrationPoints, places: CalibrationPoints) -> Array:
    """Fit a new estimator; return its predictions (n, 3) in m for all calibration points of a camera."""
    estimator = model.create()
    if not callable(getattr(estimator, "fit", None)) or not callable(getattr(estimator, "predict", None)):
        raise IpsysError(f"--model {model.name}: needs the methods fit and predict; add them")
    estimator.fit(_inputs(estimator, training), training.world_m.copy())
    predicted_m = np.asarray(estimator.predict(_inputs(estimator, places)), dtype=np.float64)
    if predicted_m.shape != places.world_m.shape:
        raise IpsysError(
            f"--model {model.name}: predict returns the shape {predicted_m.shape} for {len(places.names)} "
            f"points; return world points {places.world_m.shape} in m"
        )
    if not np.isfinite(predicted_m).all():
        raise IpsysError(f"--model {model.name}: predict returns numbers that are not finite; check the fit")
    return predicted_m


def _inputs(estimator: Any, places: CalibrationPoints) -> Array:
    """Return a copy of the inputs: a model may change its arrays."""
    if getattr(estimator, "reads_height", False):
        return np.column_stack([places.points_m, places.world_m[:, 2]])
    return places.points_m.copy()
