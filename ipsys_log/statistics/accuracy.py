"""Errors of models on held-out and cross-validated points (eq. 26, 27), and their statistics."""

from collections.abc import Collection, Mapping, Sequence
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraEvaluation, ErrorStatistics, Model, Pair, Residual
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import AppliedModel, min_pairs, reads_height
from ipsys_log.statistics.calibration_points import level_cameras
from ipsys_log.statistics.camera_models import (
    Without,
    describe_camera_models,
    height_sigmas,
    predict_without_groups,
    tape_covariances,
)
from ipsys_log.statistics.cross_validation import (
    FOLDS,
    Predict,
    cross_validate,
    fit_without,
    gather_points,
    leave_out,
    make_folds,
    predict_points,
)
from ipsys_log.statistics.remaining_error import with_remaining_error
from ipsys_log.vision.trilateration import USUAL_TAPE_SCALE_SIGMA

_RESAMPLES = 2000


def error_statistics(
    errors_m: NDArray[np.float64], independent: bool = True, points: Sequence[str] | None = None
) -> ErrorStatistics:
    """Return mean, bounds, percentiles and standard deviation of distances, and an interval of their mean.

    Parameters
    ----------
    errors_m : (n,) or (repeats, n), n > 0, in m: distances at n points.
    independent : True if the errors of the points are independent. The errors at the instants of a track are
        not, and then there is no interval.
    points : (n,), names of the calibration points; errors with the same name are of one point that several
        cameras saw. None if all points are different.

    Returns
    -------
    ErrorStatistics : statistics of all distances; ``count`` is the number of points. The 95 % confidence
        interval of the mean is a percentile bootstrap over the points. Repeats at one point, and errors of
        several cameras at one point, are not independent: they share the error of the tape. So they are
        drawn together. Equal errors always give the same interval.

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
    if independent:
        low_m, high_m = _bootstrap(places_m, range(count) if points is None else points)
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


def _bootstrap(
    places_m: NDArray[np.float64], points: Sequence[object]
) -> tuple[float, float] | tuple[None, None]:
    """Return the 95 % confidence interval of a mean; errors (n,) of one point are drawn together."""
    clusters = {point: number for number, point in enumerate(dict.fromkeys(points))}
    if len(clusters) < 2:
        return None, None
    numbers = [clusters[point] for point in points]
    sums_m, counts = np.bincount(numbers, places_m), np.bincount(numbers)
    drawn = np.random.default_rng(0).integers(len(clusters), size=(_RESAMPLES, len(clusters)))
    means_m = sums_m[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    low_m, high_m = np.percentile(means_m, [2.5, 97.5]).tolist()
    return low_m, high_m


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
    predictions, covariances = {}, {}
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
            covariances[camera.camera] = _covariances(applied, pairs)
    return error_rows(model, predictions, covariances, ground_truth, HELD_OUT)


def evaluate_cross_validated(
    model: Model, pairs: Mapping[str, Sequence[Pair]], ground_truth: Mapping[str, Array], seed: int
) -> list[CameraEvaluation]:
    """Return cross-validated errors: repeated cross-validation over all calibration points.

    The errors of a published split can be too small, because they depend on the number of held-out points at
    the edge. Cross-validation does not have this bias.

    Parameters
    ----------
    model : the model. Its name selects the model for each fold.
    pairs : all calibration points by camera.
    ground_truth : as in :func:`evaluate_held_out`.
    seed : random seed of the folds.

    Returns
    -------
    Rows as in :func:`evaluate_held_out`. The shares of the errors within the regions of the covariance are
    those of the first repeat, in which each point is held out once. Its error is compared with the covariance
    of the model that was fitted without it. The covariance of one fold takes ten further fits, so the other
    repeats have none.

    Raises
    ------
    FitError
        Too few calibration points remain for the fit of a fold.
    """
    cameras = gather_points(pairs)
    fit = cache(partial(fit_without, model.name, cameras))

    def predict(left_out: Collection[str]) -> dict[str, Array]:
        return predict_points(model.name, fit(frozenset(left_out)), cameras)

    predicted = cross_validate(model.name, cameras, seed, predict)
    predictions = {camera: (list(pairs[camera]), predicted[camera]) for camera in cameras}
    folds = make_folds(cameras, FOLDS, np.random.default_rng(seed))
    covariances: dict[str, Array | None] = {
        camera: np.full((len(places.names), 3, 3), np.nan) for camera, places in cameras.items()
    }
    for fold in folds:
        without = _predict_without_folds(model.name, cameras, fold, folds, predict)
        rest = {c: [pair for pair in pairs[c] if pair.measurement not in fold] for c in cameras}
        for camera in describe_camera_models(model.name, gather_points(rest), rest, fit(fold), without):
            rows = [n for n, pair in enumerate(pairs[camera.camera]) if pair.measurement in fold]
            whole = covariances[camera.camera]
            if rows and whole is not None:
                known = _covariances(
                    AppliedModel(model.name, camera), [pairs[camera.camera][n] for n in rows]
                )
                if known is None:
                    covariances[camera.camera] = None
                else:
                    whole[rows] = known
    return error_rows(model, predictions, covariances, ground_truth, CROSS_VALIDATION)


def _predict_without_folds(
    name: str,
    cameras: Mapping[str, CalibrationPoints],
    fold: frozenset[str],
    folds: Sequence[frozenset[str]],
    predict: Predict,
) -> Without:
    """Return the other folds, and predictions without a fold and each of them: two folds share one fit.

    With few calibration points, the groups are smaller.
    """
    rest = {camera: leave_out(places, fold) for camera, places in cameras.items()}
    others = [other for other in folds if other != fold]
    fewest = min(len(leave_out(places, one).names) for places in rest.values() for one in others)
    if fewest < min_pairs(name):
        return predict_without_groups(name, rest)
    predicted = {}
    for camera, places in cameras.items():
        rows = [name not in fold for name in places.names]
        predicted[camera] = np.array([predict(fold | other)[camera][rows] for other in others])
    return others, predicted


def _covariances(applied: AppliedModel, pairs: Sequence[Pair]) -> Array | None:
    points_m, world_m = _arrays(pairs)
    return applied.covariances(points_m, world_m[:, 2], height_sigmas(pairs))


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


def error_rows(
    model: Model,
    found: Mapping[str, tuple[list[Pair], Array]],
    covariances: Mapping[str, Array | None],
    ground_truth: Mapping[str, Array],
    scheme: str,
) -> list[CameraEvaluation]:
    """Return rows of errors for each camera, and for all; ``found`` has their pairs and predictions.

    The predictions are (repeats, n, 3).

    ``covariances`` (n, 3, 3) are those of the first repeat.
    """
    level = level_cameras(model)
    rows: list[CameraEvaluation] = []
    for against in ("tape", "truth"):
        compared: list[tuple[Array, Array | None, list[str]]] = []
        tapes: list[tuple[Array, Array]] = []
        for camera, (pairs, predicted_m) in found.items():
            known = {p.measurement: p.world_m for p in pairs} if against == "tape" else ground_truth
            keep = [n for n, pair in enumerate(pairs) if pair.measurement in known]
            if not keep:
                continue
            kept = [pairs[n] for n in keep]
            targets_m = np.array([known[pair.measurement] for pair in kept])
            offsets_m = predicted_m[:, keep] - targets_m
            known_m2 = covariances[camera]
            shares = None
            tape_m2 = tape_covariances(kept) if against == "tape" else np.zeros((len(kept), 3, 3))
            # A known height, or the only height of all calibration points, has no error.
            size = 2 if camera in level or reads_height(model.name) else 3
            tapes.append((_of_size(tape_m2, size), _scale_sigmas(targets_m)))
            if known_m2 is not None:
                shares = _shares(offsets_m[0], known_m2[keep] + tape_m2, size)
            names = [pair.calibration_point or pair.measurement for pair in kept]
            residuals = tuple(
                Residual(pair.measurement, target, point)
                for repeat in predicted_m[:, keep]
                for pair, target, point in zip(kept, targets_m, repeat, strict=True)
            )
            rows.append(
                _row(
                    camera, against, scheme, offsets_m, names, shares, residuals, camera in level, *tapes[-1]
                )
            )
            compared.append((offsets_m, shares, names))
        if len(compared) > 1:
            offsets_m = np.concatenate([offsets for offsets, _, _ in compared], axis=1)
            known_shares = [s for _, s, _ in compared if s is not None]
            shares = np.concatenate(known_shares) if len(known_shares) == len(compared) else None
            names = [name for _, _, own in compared for name in own]
            tape_m2, scales_m = (np.concatenate(parts) for parts in zip(*tapes, strict=True))
            rows.append(
                _row(POOLED, against, scheme, offsets_m, names, shares, (), bool(level), tape_m2, scales_m)
            )
    return rows


def _row(
    camera: str,
    against: str,
    scheme: str,
    offsets_m: Array,
    names: Sequence[str],
    shares: Array | None,
    residuals: tuple[Residual, ...],
    level: bool,
    tape_m2: Array,
    scales_m: Array,
) -> CameraEvaluation:
    def statistics(size: int) -> ErrorStatistics:
        own_m = offsets_m[:, :, :size]
        errors = error_statistics(np.linalg.norm(own_m, axis=2), points=names)
        if against != "tape":
            return errors
        return with_remaining_error(errors, own_m, tape_m2[:, :size, :size], scales_m, names)

    within = [None, None] if shares is None else [float((shares <= region).mean()) for region in _REGIONS]
    return CameraEvaluation(
        camera,
        against,
        # If all calibration points have the same height, the 3D error is not meaningful.
        None if level else statistics(3),  # eq. (26)
        statistics(2),  # eq. (27)
        residuals,
        scheme,
        offsets_m.reshape(-1, 3).mean(axis=0),
        within[0],
        within[1],
    )


def _of_size(tape_m2: Array, size: int) -> Array:
    """Return covariances (n, 3, 3) whose heights have no error if ``size`` is 2."""
    known = np.array([1.0, 1.0, float(size == 3)])
    return np.asarray(tape_m2 * known[:, None] * known)


def _scale_sigmas(world_m: Array) -> Array:
    """Return the standard deviations (n,) of points by the scale of a usual tape, about their middle."""
    away_m = np.linalg.norm(world_m[:, :2] - world_m[:, :2].mean(axis=0), axis=1)
    return np.asarray(USUAL_TAPE_SCALE_SIGMA * away_m)


def _shares(offsets_m: Array, covariances_m2: Array, size: int) -> Array:
    """Return the probability of the smallest region of the covariance with each error, (n,).

    Only the first ``size`` coordinates count.
    """
    from scipy.special import chdtr  # late: most commands evaluate nothing; scipy.stats takes 0.3 s more

    offsets_m = offsets_m[:, :size]
    weighted = np.linalg.solve(covariances_m2[:, :size, :size], offsets_m[:, :, None])[:, :, 0]
    shares: Array = chdtr(size, (offsets_m * weighted).sum(axis=1))
    return shares
