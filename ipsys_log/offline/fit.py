"""Fit a model to each camera's measured places."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError
from ipsys_log.messages import CameraModel, Model, Pair, Parameter
from ipsys_log.models import create, min_pairs, parameters

__all__ = ["fit_model"]

# No hand-held tape is better than this; it keeps the covariance of a flat data set invertible.
_FLOOR_SIGMA_M = 0.001

# Nearer together than this two places are one; nearer to a line than this (RMS) they lie on it.
_SAME_PLACE_M = 0.01
_BESIDE_LINE_M = 0.03


def fit_model(name: str, pairs: Mapping[str, Sequence[Pair]], time_ns: int) -> Model:
    """Fit the model called ``name`` for each camera that has pairs.

    Parameters
    ----------
    name : of the table of models, such as ``poly``.
    pairs : measured places by camera; a camera without any is left out.
    time_ns : of the last input.

    Returns
    -------
    Model : with each camera's parameters, pairs, and the covariance of its leave-one-out errors.

    Raises
    ------
    FitError
        Where a camera has fewer pairs than the model needs, or none has any.
    """
    fitted = tuple(_fit_camera(name, camera, list(p)) for camera, p in sorted(pairs.items()) if p)
    if not fitted:
        raise FitError(
            "no camera saw any of the measured places to fit on; measure places in the cameras' view"
        )
    return Model(time_ns, name, fitted)


def _fit_camera(name: str, camera: str, pairs: list[Pair]) -> CameraModel:
    needed = min_pairs(name)
    if len(pairs) < needed:
        other = "" if name == "rigid" else ", or use --model rigid, which needs 3"
        raise FitError(
            f"camera {camera}: {name} needs at least {needed} measured places, found {len(pairs)}; "
            f"measure more{other}"
        )
    points = np.array([pair.camera_m for pair in pairs])
    targets = np.array([pair.world_m for pair in pairs])
    _check_spread(name, camera, targets)
    try:
        arrays = parameters(create(name).fit(points, targets))
    except FitError as error:
        raise FitError(f"camera {camera}: {error}") from error
    stored = tuple(Parameter(key, array.shape, array.reshape(-1)) for key, array in sorted(arrays.items()))
    return CameraModel(camera, stored, _covariance(name, points, targets), tuple(pairs))


def _check_spread(name: str, camera: str, targets: NDArray[np.float64]) -> None:
    """Places that differ by no more than the tape's error say nothing new."""
    different = len(np.unique(np.round(targets / _SAME_PLACE_M), axis=0))
    if different < min_pairs(name):
        raise FitError(
            f"camera {camera}: {name} needs at least {min_pairs(name)} different places, found {different} "
            f"in {len(targets)} measurements; measure elsewhere too"
        )
    beside_m = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(targets))
    if beside_m < _BESIDE_LINE_M:
        raise FitError(
            f"camera {camera}: the {len(targets)} measured places lie on one line; measure some beside it"
        )


def _covariance(
    name: str, points: NDArray[np.float64], targets: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Mean square of leave-one-out errors, (3, 3) in m^2; None where one fewer is too few."""
    if len(points) <= min_pairs(name):
        return None
    errors = []
    for i in range(len(points)):
        rest = np.arange(len(points)) != i
        try:
            predicted = create(name).fit(points[rest], targets[rest]).predict(points[i : i + 1])
        except FitError:
            return None
        errors.append(predicted[0] - targets[i])
    residuals = np.array(errors)
    covariance: NDArray[np.float64] = residuals.T @ residuals / len(residuals) + _FLOOR_SIGMA_M**2 * np.eye(3)
    return covariance
