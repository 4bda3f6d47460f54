"""Errors of models on held-out and cross-validated points (eq. 26, 27), and their statistics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.cross_validation import cross_validate, gather_points
from ipsys_log.analysis.pairs import level_cameras
from ipsys_log.messages import CameraEvaluation, CameraModel, ErrorStatistics, Model, Pair, Residual
from ipsys_log.models.table import AppliedModel, reads_height

__all__ = [
    "CROSS_VALIDATION",
    "HELD_OUT",
    "POOLED",
    "count_repeats",
    "error_statistics",
    "evaluate_cross_validated",
    "evaluate_held_out",
    "root_mean_square_m",
]

_RESAMPLES = 2000


def error_statistics(errors_m: NDArray[np.float64], independent: bool = True) -> ErrorStatistics:
    """Return mean, bounds, percentiles and standard deviation of distances, and an interval of their mean.

    Parameters
    ----------
    errors_m : (n,) or (repeats, n), n > 0, in m: distances at n points.
    independent : True if the errors of the points are independent. The errors at the instants of a track are
        not, and then there is no interval.

    Returns
    -------
    ErrorStatistics : statistics of all distances; ``count`` is the number of points. The 95 % confidence
        interval of the mean is a percentile bootstrap over the points, because points are independent and
        repeats at one point are not. Equal errors always give the same interval.

    References
    ----------
    Ou et al., Robotica 2023, Tables I and II. The standard deviation there uses n - 1. Efron and
    Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13.

    Examples
    --------
    >>> found = error_statistics(np.array([0.01, 0.03]))
    >>> found.mean_m, found.median_m, found.max_m
    (0.02, 0.02, 0.03)
    """
    places_m = np.atleast_2d(errors_m).mean(axis=0)
    count = len(places_m)
    errors_m = errors_m.reshape(-1)
    median_m, p95_m = np.percentile(errors_m, [50, 95]).tolist()
    std_m = float(errors_m.std(ddof=1)) if errors_m.size > 1 else None
    low_m = high_m = None
    if count > 1 and independent:
        drawn = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
        low_m, high_m = np.percentile(places_m[drawn].mean(axis=1), [2.5, 97.5]).tolist()
    return ErrorStatistics(
        count,
        float(errors_m.mean()),
        float(errors_m.min()),
        float(errors_m.max()),
        std_m,
        median_m,
        p95_m,
        low_m,
        high_m,
    )


def root_mean_square_m(errors: ErrorStatistics, repeats: int = 1) -> float:
    """Return the root-mean-square error (RMSE) in m, exactly, from the mean and the standard deviation.

    Parameters
    ----------
    errors : error statistics of n points.
    repeats : number of errors of each point; the standard deviation is that of all of them.

    Examples
    --------
    >>> root_mean_square_m(error_statistics(np.array([0.01, 0.07])))
    0.05
    """
    samples = errors.count * repeats
    variance_m2 = 0.0 if errors.std_m is None else errors.std_m**2 * (samples - 1) / samples
    return float(np.sqrt(errors.mean_m**2 + variance_m2))


Array = NDArray[np.float64]

HELD_OUT = "held_out"
CROSS_VALIDATION = "cross_validation"
# Name of the camera in a row for all cameras together.
POOLED = ""
# Probabilities of the tested regions of the covariance.
_REGIONS = (0.68, 0.95)


def evaluate_held_out(
    model: Model, held_out: Mapping[str, Sequence[Pair]], ground_truth: Mapping[str, Array]
) -> list[CameraEvaluation]:
    """Return the errors of a model at held-out points, against the tape and, if known, the ground truth.

    Parameters
    ----------
    model : the fitted model.
    held_out : calibration points by camera. Points that were used in the fit of the model do not count.
    ground_truth : true world points (3,) in m by id of the measurement; empty outside a simulated lab.

    Returns
    -------
    A row for each camera with held-out points, and a row for all cameras if there are several.
    """
    predictions = {}
    for camera in model.cameras:
        used = {pair.measurement: pair.world_m for pair in camera.pairs}
        pairs = [
            pair
            for pair in held_out.get(camera.camera, ())
            if not np.array_equal(used.get(pair.measurement, ()), pair.world_m)
        ]
        if pairs:
            applied = AppliedModel(model.name, camera)
            points_m, world_m = _arrays(pairs)
            predictions[camera.camera] = (pairs, applied.predict(points_m, world_m[:, 2])[None])
    return _rows(model, predictions, ground_truth, HELD_OUT)


def evaluate_cross_validated(
    model: Model, pairs: Mapping[str, Sequence[Pair]], ground_truth: Mapping[str, Array], seed: int
) -> list[CameraEvaluation]:
    """Return cross-validated errors: repeated cross-validation over all calibration points.

    The errors of a published split can be too small, because they depend on the number of held-out points at
    the edge. Cross-validation does not have this bias.

    Parameters
    ----------
    model : the model. Its name selects the model for each fold. The errors are compared with its covariances.
    pairs : all calibration points by camera.
    ground_truth : as in :func:`evaluate_held_out`.
    seed : random seed of the folds.

    Raises
    ------
    FitError
        Too few calibration points remain for the fit of a fold.
    """
    cameras = gather_points(pairs)
    predicted = cross_validate(model.name, cameras, seed)
    predictions = {camera: (list(pairs[camera]), predicted[camera]) for camera in cameras}
    return _rows(model, predictions, ground_truth, CROSS_VALIDATION)


def count_repeats(row: CameraEvaluation, rows: Sequence[CameraEvaluation]) -> int | None:
    """Return the number of errors of each point in a row.

    Parameters
    ----------
    row : row of an evaluation.
    rows : all rows; the row for all cameras has no residuals, but the rows of single cameras have residuals.

    Returns
    -------
    The number, or None if the log does not contain it.
    """
    if row.scheme != CROSS_VALIDATION:
        return 1
    for other in rows:
        if (other.scheme, other.against) == (row.scheme, row.against) and other.residuals:
            return len(other.residuals) // other.error_2d.count
    return None


def _arrays(pairs: Sequence[Pair]) -> tuple[Array, Array]:
    return np.array([pair.camera_m for pair in pairs]), np.array([pair.world_m for pair in pairs])


def _rows(
    model: Model,
    found: Mapping[str, tuple[list[Pair], Array]],
    ground_truth: Mapping[str, Array],
    scheme: str,
) -> list[CameraEvaluation]:
    """Return rows of errors; ``found`` has pairs and predictions (repeats, n, 3) of each camera."""
    fitted = {camera.camera: camera for camera in model.cameras}
    level = level_cameras(model)
    rows: list[CameraEvaluation] = []
    for against in ("tape", "truth"):
        compared: list[tuple[Array, Array | None]] = []
        for camera, (pairs, predicted_m) in found.items():
            known = {p.measurement: p.world_m for p in pairs} if against == "tape" else ground_truth
            keep = [n for n, pair in enumerate(pairs) if pair.measurement in known]
            if not keep:
                continue
            kept = [pairs[n] for n in keep]
            targets_m = np.array([known[pair.measurement] for pair in kept])
            offsets_m = predicted_m[:, keep] - targets_m
            squares = _squares(model.name, fitted.get(camera), kept, offsets_m, against, camera in level)
            residuals = tuple(
                Residual(pair.measurement, target, point)
                for repeat in predicted_m[:, keep]
                for pair, target, point in zip(kept, targets_m, repeat, strict=True)
            )
            rows.append(_row(camera, against, scheme, offsets_m, squares, residuals, camera in level))
            compared.append((offsets_m, squares))
        if len(compared) > 1:
            offsets_m = np.concatenate([offsets for offsets, _ in compared], axis=1)
            known_squares = [s for _, s in compared if s is not None]
            squares = np.concatenate(known_squares, axis=1) if len(known_squares) == len(compared) else None
            rows.append(_row(POOLED, against, scheme, offsets_m, squares, (), bool(level)))
    return rows


def _row(
    camera: str,
    against: str,
    scheme: str,
    offsets_m: Array,
    shares: Array | None,
    residuals: tuple[Residual, ...],
    level: bool,
) -> CameraEvaluation:
    within = [None, None] if shares is None else [float((shares <= region).mean()) for region in _REGIONS]
    return CameraEvaluation(
        camera,
        against,
        # If all calibration points have the same height, the 3D error is not meaningful.
        None if level else error_statistics(np.linalg.norm(offsets_m, axis=2)),  # eq. (26)
        error_statistics(np.linalg.norm(offsets_m[:, :, :2], axis=2)),  # eq. (27)
        residuals,
        scheme,
        offsets_m.reshape(-1, 3).mean(axis=0),
        within[0],
        within[1],
    )


def _squares(
    name: str, camera: CameraModel | None, pairs: Sequence[Pair], offsets_m: Array, against: str, level: bool
) -> Array | None:
    """Return the probability of the smallest region of the covariance with each error, (repeats, n)."""
    if camera is None:
        return None
    points_m, world_m = _arrays(pairs)
    covariances = AppliedModel(name, camera).covariances(points_m, world_m[:, 2])
    if covariances is None:
        return None
    if against == "tape":
        tape = [np.zeros((3, 3)) if p.world_covariance_m2 is None else p.world_covariance_m2 for p in pairs]
        covariances = covariances + np.array(tape)
    # A known height, or the only height of all calibration points, has no error.
    size = 2 if level or reads_height(name) else 3
    inverse = np.linalg.inv(covariances[:, :size, :size])
    squares = np.einsum("rni,nij,rnj->rn", offsets_m[:, :, :size], inverse, offsets_m[:, :, :size])
    from scipy.stats import chi2  # late: most commands evaluate nothing, and it takes 1 s

    shares: Array = chi2.cdf(squares, size)
    return shares
