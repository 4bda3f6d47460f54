"""Models fitted without some calibration points: cross-validation, leave-one-out, learning curves."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError
from ipsys_log.messages import Array, LearningPoint, Measurement, Pair
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import fit_cameras, group_dependent_cameras, inputs, min_pairs, predict_array
from ipsys_log.statistics.tape import RiggedMeasurement

FOLDS = 5
REPEATS = 4
SUBSETS = 10

# A function from ids of measurements that a fit leaves out to the predictions of that fit for all points,
# (n, 3) in m by camera. It raises FitError if the other points determine no model.
Predict = Callable[[Collection[str]], Mapping[str, Array]]


def gather_points(pairs: Mapping[str, Sequence[Pair]]) -> dict[str, CalibrationPoints]:
    """Return the pairs of each camera as arrays; omit cameras without pairs."""
    return {
        camera: CalibrationPoints(
            np.array([pair.camera_m for pair in own_pairs]),
            np.array([pair.world_m for pair in own_pairs]),
            tuple(pair.measurement for pair in own_pairs),
            tuple(pair.calibration_point or pair.measurement for pair in own_pairs),
        )
        for camera, own_pairs in sorted(pairs.items())
        if own_pairs
    }


def make_folds(
    cameras: Mapping[str, CalibrationPoints], folds: int, rng: np.random.Generator
) -> list[frozenset[str]]:
    """Return random folds of names of measurements, with equal shares of each camera in all folds.

    All measurements of a calibration point are in one fold, for all cameras. Otherwise, a point that is held
    out from one camera would be known through another camera.
    """
    dealt: dict[str, int] = {}
    for places in cameras.values():
        own = list(dict.fromkeys(places.point_names))
        counts = np.bincount([dealt[n] for n in own if n in dealt], minlength=folds)
        rest = [name for name in own if name not in dealt]
        for index in rng.permutation(len(rest)):
            fold = int(counts.argmin())
            dealt[rest[index]] = fold
            counts[fold] += 1
    return [_measurements(cameras, {n for n, fold in dealt.items() if fold == f}) for f in range(folds)]


def _measurements(cameras: Mapping[str, CalibrationPoints], points: Collection[str]) -> frozenset[str]:
    """Return the names of all measurements of some calibration points."""
    return frozenset(
        name
        for places in cameras.values()
        for name, point in zip(places.names, places.point_names, strict=True)
        if point in points
    )


def predict_without(
    name: str, cameras: Mapping[str, CalibrationPoints], left_out: Collection[str]
) -> dict[str, Array]:
    """Fit a model without some calibration points; return its predictions for all, (n, 3) in m by camera.

    Raises
    ------
    FitError
        Too few calibration points remain.
    """
    return predict_points(name, fit_without(name, cameras, left_out), cameras)


def fit_without(
    name: str, cameras: Mapping[str, CalibrationPoints], left_out: Collection[str]
) -> dict[str, Any]:
    """Return the models of cameras, fitted without some calibration points; for errors see above."""
    return fit_cameras(name, {camera: leave_out(places, left_out) for camera, places in cameras.items()})


def predict_points(
    name: str, models: Mapping[str, Any], cameras: Mapping[str, CalibrationPoints]
) -> dict[str, Array]:
    """Return the predictions of fitted models for calibration points, (n, 3) in m by camera."""
    return {
        camera: predict_array(models[camera], inputs(name, places.points_m, places.world_m[:, 2]))
        for camera, places in cameras.items()
    }


def leave_out(places: CalibrationPoints, left_out: Collection[str]) -> CalibrationPoints:
    """Return the calibration points of a camera without some measurements."""
    keep = np.array([name not in left_out for name in places.names], dtype=bool)
    names, points = (
        tuple(name for name, kept in zip(all_names, keep, strict=True) if kept)
        for all_names in (places.names, places.point_names)
    )
    return CalibrationPoints(places.points_m[keep], places.world_m[keep], names, points)


def cross_validate(
    name: str, cameras: Mapping[str, CalibrationPoints], seed: int, predict: Predict | None = None
) -> dict[str, Array]:
    """Predict held-out points by repeated k-fold cross-validation, for each camera.

    Parameters
    ----------
    name : name in the table of models.
    cameras : all calibration points.
    seed : random seed of the folds.
    predict : predictions of a fit to some points; None for those of :func:`predict_without`.

    Returns
    -------
    dict from camera to (repeats, n, 3), world points in m.

    Raises
    ------
    FitError
        Too few calibration points remain without a fold.
    """
    predict = predict or partial(predict_without, name, cameras)
    rng = np.random.default_rng(seed)
    predictions = {
        camera: np.full((REPEATS, *places.world_m.shape), np.nan) for camera, places in cameras.items()
    }
    for repeat in range(REPEATS):
        for fold in make_folds(cameras, FOLDS, rng):
            predicted = predict(fold)
            for camera, places in cameras.items():
                rows = [row for row, place in enumerate(places.names) if place in fold]
                predictions[camera][repeat, rows] = predicted[camera][rows]
    return predictions


def leave_one_out(
    name: str, cameras: Mapping[str, CalibrationPoints]
) -> Callable[[frozenset[str]], dict[str, dict[str, Array]]]:
    """Return a function that fits models without one calibration point after the other.

    Returns
    -------
    A function of the calibration points that no fit may use; they are predicted too. For each camera and
    point, it returns the world point (3,) in m that a model without this point predicts. It repeats the fit
    only for cameras that depend on the unused points.
    """
    groups = [{camera: cameras[camera] for camera in tied} for tied in group_dependent_cameras(name, cameras)]
    known: dict[tuple[int, frozenset[str]], dict[str, dict[str, Array]]] = {}

    def left_out(unused: frozenset[str]) -> dict[str, dict[str, Array]]:
        predictions = {}
        for number, group in enumerate(groups):
            key = number, unused & {place for places in group.values() for place in places.names}
            if key not in known:
                known[key] = _each_left_out(name, group, key[1])
            predictions.update(known[key])
        return predictions

    return left_out


def _each_left_out(
    name: str, cameras: Mapping[str, CalibrationPoints], unused: Collection[str]
) -> dict[str, dict[str, Array]]:
    predictions: dict[str, dict[str, Array]] = {camera: {} for camera in cameras}
    for point in dict.fromkeys(point for places in cameras.values() for point in places.point_names):
        same = _measurements(cameras, {point})
        predicted = predict_without(name, cameras, {*same, *unused})
        for camera, places in cameras.items():
            for row, place in enumerate(places.names):
                if place in same:
                    predictions[camera][place] = predicted[camera][row]
    return predictions


_SIZES = (5, 7, 10, 15, 20, 30, 40, 60, 80, 120, 160, 240)


# A mean error of a learning curve is certain enough if this share of it is its standard error.
_CERTAIN = 0.1
# Least number of held-out points for an error.
_LEAST_REST = 5


def learning_sizes(name: str, cameras: Mapping[str, CalibrationPoints]) -> list[int]:
    """Return the subset sizes of a learning curve, for the camera with the fewest calibration points."""
    fewest = min(len(places.names) for places in cameras.values())
    return [size for size in _SIZES if min_pairs(name) <= size <= fewest - _LEAST_REST]


def learning_curve(
    name: str,
    cameras: Mapping[str, CalibrationPoints],
    seed: int,
    predict: Predict | None = None,
    subsets: int = SUBSETS,
) -> Iterator[list[LearningPoint]]:
    """Yield the errors of models that are fitted to random subsets, for one subset size after the other.

    Each list contains the errors of all cameras.

    Parameters
    ----------
    name : name in the table of models.
    cameras : all calibration points; the errors are those at the points that are not in a subset.
    seed : random seed of the subsets.
    predict : predictions of a fit to some points; None for those of :func:`predict_without`.
    subsets : the largest number of subsets of each size. Half of them are enough if the standard error of
        each mean error is then at most a tenth of it.
    """
    predict = predict or partial(predict_without, name, cameras)
    rng = np.random.default_rng(seed)
    points = sorted({point for places in cameras.values() for point in places.point_names})
    for size in learning_sizes(name, cameras):
        errors: dict[str, list[tuple[float, float]]] = {camera: [] for camera in cameras}
        for order in [rng.permutation(points).tolist() for _ in range(subsets)]:
            used = {point for places in cameras.values() for point in _first(places, order, size)}
            left_out = set(_measurements(cameras, set(points) - used))
            for camera, means_m in _errors(predict, cameras, left_out, left_out).items():
                errors[camera].append(means_m)
            if all(_is_enough(np.array(rows), subsets) for rows in errors.values()):
                break
        yield [_point(camera, size, np.array(rows)) for camera, rows in errors.items() if rows]


def _is_enough(errors_m: Array, subsets: int) -> bool:
    """Return whether the means of errors (n, 2) of n subsets are certain enough."""
    if len(errors_m) < max(2, subsets / 2):
        return False
    standard_m = errors_m.std(axis=0, ddof=1) / np.sqrt(len(errors_m))
    return bool((standard_m <= _CERTAIN * errors_m.mean(axis=0)).all())


def _point(camera: str, size: int, errors_m: Array) -> LearningPoint:
    """Return the mean error and its spread over subsets; ``errors_m`` (subsets, 2) is 3D and on the floor."""
    mean_3d, mean_2d = errors_m.mean(axis=0).tolist()
    std_3d, std_2d = errors_m.std(axis=0, ddof=1).tolist() if len(errors_m) > 1 else (None, None)
    return LearningPoint(camera, size, mean_3d, mean_2d, len(errors_m), std_3d_m=std_3d, std_2d_m=std_2d)


def labelled_subsets(measurements: Iterable[Measurement]) -> dict[str, set[str]]:
    """Return ids by labels other than ``train`` and ``test``: manually selected subsets for fits."""
    subsets: dict[str, set[str]] = {}
    for measurement in measurements:
        for label in set(measurement.splits) - {"train", "test"}:
            subsets.setdefault(label, set()).add(measurement.id)
    return subsets


def published_curve(
    name: str,
    cameras: Mapping[str, CalibrationPoints],
    subsets: Mapping[str, set[str]],
    held_out: set[str],
    predict: Predict | None = None,
) -> list[LearningPoint]:
    """Return errors at held-out points of models fitted to labelled subsets (the paper's figures 10, 11)."""
    predict = predict or partial(predict_without, name, cameras)
    names = {name for places in cameras.values() for name in places.names}
    points = []
    for label, used in sorted(subsets.items()):
        for camera, means_m in _errors(predict, cameras, names - used, held_out - used).items():
            count = sum(place in used for place in cameras[camera].names)
            points.append(LearningPoint(camera, count, *means_m, subsets=1, label=label))
    return points


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The data for an evaluation.

    Attributes
    ----------
    places : the measurements that count.
    pairs : pairs of all measurements that a camera saw, by camera.
    held_out : ids of the held-out measurements.
    subsets : ids by the label of a published subset for fitting.
    truth : ground-truth world points (3,) in m by id; empty outside a simulated lab.
    seed : of folds and random subsets; None for a model of another log, which is not fitted again.
    """

    places: Sequence[RiggedMeasurement]
    pairs: Mapping[str, Sequence[Pair]]
    held_out: set[str]
    subsets: Mapping[str, set[str]]
    truth: Mapping[str, NDArray[np.float64]]
    seed: int | None


def _first(places: CalibrationPoints, order: list[str], size: int) -> list[str]:
    own = set(places.point_names)
    return [place for place in order if place in own][:size]


def _errors(
    predict: Predict, cameras: Mapping[str, CalibrationPoints], left_out: set[str], looked_at: set[str]
) -> dict[str, tuple[float, float]]:
    """Return the mean 3D error and floor error by camera; none if the other points determine no model."""
    try:
        predicted = predict(left_out)
    except FitError:
        return {}
    errors = {}
    for camera, places in cameras.items():
        rows = [n for n, place in enumerate(places.names) if place in looked_at]
        offsets_m = (predicted[camera] - places.world_m)[rows]
        if rows:
            errors[camera] = (
                float(np.linalg.norm(offsets_m, axis=1).mean()),
                float(np.linalg.norm(offsets_m[:, :2], axis=1).mean()),
            )
    return errors
