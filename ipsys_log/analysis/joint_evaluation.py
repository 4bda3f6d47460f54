"""Errors of the joint model on calibration points that were not in its fit."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.accuracy import CROSS_VALIDATION, HELD_OUT, error_rows
from ipsys_log.analysis.cross_validation import FOLDS, gather_points, make_folds
from ipsys_log.analysis.joint_calibration import fit_without
from ipsys_log.errors import FitError
from ipsys_log.joint.locate import locate_markers
from ipsys_log.joint.model import JointModel, build_models
from ipsys_log.joint.observations import Observations
from ipsys_log.joint.payload import restore_joint
from ipsys_log.messages import CameraEvaluation, Evaluation, Model, Pair

__all__ = ["evaluate_joint"]

Array = NDArray[np.float64]
Pairs = Mapping[str, Sequence[Pair]]


def evaluate_joint(
    model: Model,
    observations: Observations,
    pairs: Pairs,
    held_out: Collection[str],
    ground_truth: Mapping[str, Array],
    seed: int | None,
    time_ns: int,
    notes: list[str],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evaluation:
    """Compute errors on held-out points, and by cross-validation with one repeat.

    Parameters
    ----------
    model : the fitted joint model.
    observations : all observations of the log.
    pairs : the calibration points that each camera saw.
    held_out : ids of the held-out measurements.
    ground_truth : world points (3,) in m by id; empty outside a simulated lab.
    seed : of the folds; None for a model of another log, which is not fitted again.
    time_ns : of the last input.
    notes : list of remarks; each impossible step adds a remark.
    progress : called with the number of fits done, and the number of all fits.
    """
    cameras = {camera.camera: restore_joint(camera) for camera in model.cameras}
    used = {pair.measurement for camera in model.cameras for pair in camera.pairs}
    rest = set(held_out) - used
    rows = _error_rows(model, [_predict(cameras, observations, pairs, rest)], ground_truth, HELD_OUT)
    if seed is not None:
        try:
            parts = []
            folds = make_folds(gather_points(pairs), FOLDS, np.random.default_rng(seed))
            for done, fold in enumerate(folds):
                progress(done, len(folds))
                fitted = build_models(fit_without(observations, fold))
                parts.append(_predict(fitted, observations, pairs, fold))
            progress(len(folds), len(folds))
            rows += _error_rows(model, parts, ground_truth, CROSS_VALIDATION)
        except FitError as error:
            notes.append(f"no cross-validation: {error}")
    return Evaluation(time_ns, model.name, tuple(rows))


# Pairs of a camera, with their predictions (n, 3) and covariances (n, 3, 3).
_Predicted = dict[str, tuple[list[Pair], Array, Array]]


def _predict(
    cameras: Mapping[str, JointModel], observations: Observations, pairs: Pairs, names: Collection[str]
) -> _Predicted:
    """Locate the markers at some calibration points by their mean corners and measured heights."""
    predicted: _Predicted = {}
    for camera, sightings in zip(observations.cameras, observations.sightings, strict=True):
        by_name = {pair.measurement: pair for pair in pairs.get(camera.name, ()) if pair.measurement in names}
        rows = [
            row
            for row, point in enumerate(sightings.point.tolist())
            if point >= 0 and observations.points[point].name in by_name
        ]
        model = cameras.get(camera.name)
        if model is None or not rows:
            continue
        points = [observations.points[int(sightings.point[row])] for row in rows]
        bodies = [observations.bodies[point.body] for point in points]
        own = [by_name[point.name] for point in points]
        located = locate_markers(
            model,
            sightings.pixels[rows],
            sightings.covariances_px2[rows],
            np.array([pair.world_m[2] for pair in own]),
            np.array([body.length_m for body in bodies]),
            np.array([point.height_sigma_m for point in points]),
        )
        predicted[camera.name] = (own, located.points_m, located.covariances_m2)
    return predicted


def _error_rows(
    model: Model, parts: Sequence[_Predicted], ground_truth: Mapping[str, Array], scheme: str
) -> list[CameraEvaluation]:
    found: dict[str, tuple[list[Pair], Array]] = {}
    covariances: dict[str, Array | None] = {}
    for camera in sorted({camera for part in parts for camera in part}):
        own = [part[camera] for part in parts if camera in part]
        predicted_m = np.concatenate([points_m for _, points_m, _ in own])[None]
        found[camera] = ([pair for kept, _, _ in own for pair in kept], predicted_m)
        covariances[camera] = np.concatenate([c for _, _, c in own])
    return error_rows(model, found, covariances, ground_truth, scheme)
