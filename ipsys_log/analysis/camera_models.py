"""Fitted models of cameras, each with the covariance of its positions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.cross_validation import make_folds, predict_without
from ipsys_log.arrays import Array
from ipsys_log.errors import FitError
from ipsys_log.messages import CameraModel, Noise, Pair, Parameter
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import (
    fit_cameras,
    inputs,
    min_pairs,
    parameters,
    reads_height,
)
from ipsys_log.models.uncertainty import Uncertainty, estimate_uncertainty, ruler_sigmas

# No hand-held tape is more accurate; this floor keeps the covariance of a flat data set invertible.
_FLOOR_SIGMA_M = 0.001
# Groups of calibration points; the uncertainty is estimated by leaving out one group after the other.
_GROUPS = 10


def fit_camera_models(
    name: str,
    cameras: Mapping[str, CalibrationPoints],
    pairs: Mapping[str, Sequence[Pair]],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[CameraModel]:
    """Fit the model called ``name`` for each camera, and estimate the covariance of its positions.

    Parameters
    ----------
    name : in the table of models, such as ``poly``.
    cameras : calibration points by camera.
    pairs : the same points as pairs.
    progress : called with the number of fits done, and the number of all fits.

    Returns
    -------
    For each camera: parameters, pairs, the covariance of its left-out errors, and the terms of the covariance
    of a position. The last two exist only if there are more pairs than the model needs.

    Raises
    ------
    FitError
        The calibration points do not determine a model.
    """
    models = fit_cameras(name, cameras)
    without = _predict_without_groups(name, cameras, progress)
    fitted = []
    for camera, places in cameras.items():
        arrays = parameters(models[camera])
        stored = tuple(
            Parameter(key, array.shape, array.reshape(-1)) for key, array in sorted(arrays.items())
        )
        covariance, noise = None, None
        if without is not None:
            residuals, groups = _left_out(places, without[0], without[1][camera])
            covariance = residuals.T @ residuals / len(residuals) + _FLOOR_SIGMA_M**2 * np.eye(3)
            tape_m2 = tape_covariances(pairs[camera])
            noise = _noise(name, models[camera], places, tape_m2, without[1][camera], groups)
        fitted.append(CameraModel(camera, stored, covariance, tuple(pairs[camera]), noise))
    return fitted


def tape_covariances(pairs: Sequence[Pair]) -> Array:
    """Return the covariances (n, 3, 3) of the measured world points in m^2, 0 if unknown."""
    unknown = np.zeros((3, 3))
    return np.array([unknown if p.world_covariance_m2 is None else p.world_covariance_m2 for p in pairs])


def height_sigmas(pairs: Sequence[Pair]) -> Array:
    """Return the standard deviations (n,) of the measured heights in m."""
    return ruler_sigmas(tape_covariances(pairs))


def _predict_without_groups(
    name: str, cameras: Mapping[str, CalibrationPoints], progress: Callable[[int, int], None]
) -> tuple[list[frozenset[str]], dict[str, Array]] | None:
    """Return the groups, and predictions of models fitted without each group, (g, n, 3) by camera.

    The result is None for too few calibration points.
    """
    fewest = min(len(places.names) for places in cameras.values())
    if fewest <= min_pairs(name):
        return None
    most = max(len(places.names) for places in cameras.values())
    groups = make_folds(cameras, min(most, _GROUPS), np.random.default_rng(0))
    predicted = []
    for done, group in enumerate(groups, 1):
        try:
            predicted.append(predict_without(name, cameras, group))
        except FitError:
            return None
        progress(done, len(groups))
    return groups, {camera: np.array([by_camera[camera] for by_camera in predicted]) for camera in cameras}


def _left_out(
    places: CalibrationPoints, groups: Sequence[frozenset[str]], without: Array
) -> tuple[Array, NDArray[np.int64]]:
    """Return errors (n, 3) of the models fitted without a point, and the group (n,) of each point."""
    index = np.array([next(g for g, group in enumerate(groups) if name in group) for name in places.names])
    return without[index, np.arange(len(index))] - places.world_m, index


def _noise(
    name: str,
    estimator: object,
    places: CalibrationPoints,
    tape_m2: Array,
    without: Array,
    groups: NDArray[np.int64],
) -> Noise | None:
    def predict(points_m: Array, heights_m: Array) -> Array:
        world_m: Array = estimator.predict(inputs(name, points_m, heights_m))  # type: ignore[attr-defined]
        return world_m

    uncertainty: Uncertainty = estimate_uncertainty(
        predict, places.points_m, places.world_m, tape_m2, without, groups, reads_height(name)
    )
    return Noise(uncertainty.along, uncertainty.across, uncertainty.growth, uncertainty.fit)
