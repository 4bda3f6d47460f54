"""Fitted models of cameras, each with the covariance of its positions."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError
from ipsys_log.messages import Array, CameraModel, Model, Noise, Pair, Parameter
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import fit_cameras, inputs, min_pairs, parameters, predict_array, reads_height
from ipsys_log.models.uncertainty import Uncertainty, estimate_uncertainty, ruler_sigmas
from ipsys_log.statistics.cross_validation import gather_points, make_folds, predict_without

# Two calibration points closer than this are the same point; points closer to a line (RMS) lie on it.
_SAME_PLACE_M = 0.01
_BESIDE_LINE_M = 0.03
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
    without = predict_without_groups(name, cameras, progress)
    return describe_camera_models(name, cameras, pairs, fit_cameras(name, cameras), without)


# Groups of measurements, and for each camera the predictions (g, n, 3) for all its n calibration points by
# models that are fitted without each group; None for too few calibration points.
Without = tuple[Sequence[frozenset[str]], Mapping[str, Array]] | None


def describe_camera_models(
    name: str,
    cameras: Mapping[str, CalibrationPoints],
    pairs: Mapping[str, Sequence[Pair]],
    models: Mapping[str, Any],
    without: Without,
) -> list[CameraModel]:
    """Return fitted models of cameras with the covariances of :func:`fit_camera_models`."""
    fitted = []
    for camera, places in cameras.items():
        arrays = parameters(models[camera])
        stored = tuple(
            Parameter(key, array.shape, array.reshape(-1)) for key, array in sorted(arrays.items())
        )
        covariance, noise = None, None
        if without is not None:
            residuals, group_of = _left_out(places, without[0], without[1][camera])
            covariance = residuals.T @ residuals / len(residuals) + _FLOOR_SIGMA_M**2 * np.eye(3)
            tape_m2 = tape_covariances(pairs[camera])
            noise = _noise(name, models[camera], places, tape_m2, without[1][camera], group_of)
        fitted.append(CameraModel(camera, stored, covariance, tuple(pairs[camera]), noise))
    return fitted


def tape_covariances(pairs: Sequence[Pair]) -> Array:
    """Return the covariances (n, 3, 3) of the measured world points in m^2, 0 if unknown."""
    unknown = np.zeros((3, 3))
    return np.array([unknown if p.world_covariance_m2 is None else p.world_covariance_m2 for p in pairs])


def height_sigmas(pairs: Sequence[Pair]) -> Array:
    """Return the standard deviations (n,) of the measured heights in m."""
    return ruler_sigmas(tape_covariances(pairs))


def predict_without_groups(
    name: str,
    cameras: Mapping[str, CalibrationPoints],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Without:
    """Return random groups of measurements, and predictions without each group."""
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
    estimator: Any,
    places: CalibrationPoints,
    tape_m2: Array,
    without: Array,
    groups: NDArray[np.int64],
) -> Noise | None:
    def predict(points_m: Array, heights_m: Array) -> Array:
        return predict_array(estimator, inputs(name, points_m, heights_m))

    uncertainty: Uncertainty = estimate_uncertainty(
        predict, places.points_m, places.world_m, tape_m2, without, groups, reads_height(name)
    )
    return Noise(uncertainty.along, uncertainty.across, uncertainty.growth, uncertainty.fit)


def fit_model(
    name: str,
    pairs: Mapping[str, Sequence[Pair]],
    time_ns: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Model:
    """Fit the model called ``name`` for each camera that has pairs.

    Parameters
    ----------
    name : in the table of models, such as ``poly``.
    pairs : calibration points by camera; a camera without points is left out.
    time_ns : of the last input.
    progress : called with the number of fits done, and the number of all fits.

    Returns
    -------
    Model : with each camera's parameters, pairs, the covariance of its left-out errors, and the terms of the
        covariance of a position; the last two only if there are more pairs than the model needs.

    Raises
    ------
    FitError
        A camera has fewer pairs than the model needs, or no camera has a pair.
    """
    cameras = check_pairs(name, pairs)
    return Model(time_ns, name, tuple(fit_camera_models(name, cameras, pairs, progress)))


def check_pairs(name: str, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, CalibrationPoints]:
    """Return the calibration points by camera, if they are enough for a model.

    Raises
    ------
    FitError
        No camera has a pair, or a camera has too few, or its points are too near to one another or to a line.
    """
    cameras = gather_points(pairs)
    if not cameras:
        raise FitError(
            "no camera saw a calibration point for the fit; measure points in the view of the cameras"
        )
    for camera, places in cameras.items():
        _check_count(name, camera, places)
        _check_spread(name, camera, places.world_m)
    return cameras


def _check_count(name: str, camera: str, places: CalibrationPoints) -> None:
    needed = min_pairs(name)
    if len(places.names) < needed:
        other = "" if name == "rigid" else ", or use --model rigid, which needs 3"
        raise FitError(
            f"camera {camera}: {name} needs at least {needed} calibration points, found "
            f"{len(places.names)}; measure more{other}"
        )


def _check_spread(name: str, camera: str, targets: Array) -> None:
    """Check that the points differ by more than the tape's error; otherwise they add no information."""
    check_different(name, f"camera {camera}", targets)
    beside_m = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(targets))
    if beside_m < _BESIDE_LINE_M:
        raise FitError(
            f"camera {camera}: all {len(targets)} calibration points are on one line; measure some beside it"
        )


def check_different(name: str, where: str, targets: Array) -> None:
    """Check that enough calibration points, (n, 3) in m, are different ones.

    Raises
    ------
    FitError
        The model needs more of them. The text names ``where``.
    """
    different = len(np.unique(np.round(targets / _SAME_PLACE_M), axis=0))
    if different < min_pairs(name):
        raise FitError(
            f"{where}: {name} needs at least {min_pairs(name)} different points, found {different} "
            f"in {len(targets)} measurements; measure other points, too"
        )


def check_line(where: str, train_m: Array) -> None:
    """Check that not all points (n, 3) lie on a line: then those that one camera sees do so, too.

    Raises
    ------
    FitError
        They do. The text names ``where``.
    """
    offsets_m = train_m - train_m.mean(axis=0)
    along = np.linalg.svd(offsets_m, full_matrices=False)[2][0]
    beside_m = np.linalg.norm(offsets_m - np.outer(offsets_m @ along, along), axis=1)
    if beside_m.max() < _BESIDE_LINE_M:
        raise FitError(
            f"{where}: all {len(train_m)} calibration points are on one line; measure some beside it"
        )
