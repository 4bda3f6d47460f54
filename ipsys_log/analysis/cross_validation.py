"""Models fitted without some calibration points: cross-validation, leave-one-out, learning curves."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import FitError
from ipsys_log.messages import LearningPoint, Measurement, Pair
from ipsys_log.models.table import Places, fit_cameras, inputs, min_pairs, predict_array, tied_cameras

__all__ = [
    "FOLDS",
    "REPEATS",
    "SUBSETS",
    "cross_validate",
    "deal",
    "gather_places",
    "labelled_subsets",
    "learning_curve",
    "learning_sizes",
    "leave_one_out",
    "predict_without",
    "published_curve",
]

Array = NDArray[np.float64]

FOLDS = 5
REPEATS = 4


def gather_places(pairs: Mapping[str, Sequence[Pair]]) -> dict[str, Places]:
    """The pairs of each camera as arrays; a camera without any is left out."""
    return {
        camera: Places(
            np.array([pair.camera_m for pair in found]),
            np.array([pair.world_m for pair in found]),
            tuple(pair.measurement for pair in found),
        )
        for camera, found in sorted(pairs.items())
        if found
    }


def deal(cameras: Mapping[str, Places], folds: int, rng: np.random.Generator) -> list[frozenset[str]]:
    """Names of places dealt at random into folds, so that each camera's share in all of them is alike.

    A place is in one fold only, whichever cameras saw it: otherwise what is held out from one camera
    would be known through another.
    """
    dealt: dict[str, int] = {}
    for places in cameras.values():
        counts = np.bincount([dealt[n] for n in places.names if n in dealt], minlength=folds)
        rest = [name for name in places.names if name not in dealt]
        for index in rng.permutation(len(rest)):
            fold = int(counts.argmin())
            dealt[rest[index]] = fold
            counts[fold] += 1
    return [frozenset(name for name, fold in dealt.items() if fold == f) for f in range(folds)]


def predict_without(name: str, cameras: Mapping[str, Places], left_out: Collection[str]) -> dict[str, Array]:
    """What a model fitted without some places predicts for all of them, (n, 3) in m by camera.

    Raises
    ------
    FitError
        Where too few places are left.
    """
    rest = {camera: _without(places, left_out) for camera, places in cameras.items()}
    models = fit_cameras(name, rest)
    return {
        camera: predict_array(models[camera], inputs(name, places.points_m, places.world_m[:, 2]))
        for camera, places in cameras.items()
    }


def _without(places: Places, left_out: Collection[str]) -> Places:
    keep = np.array([name not in left_out for name in places.names], dtype=bool)
    names = tuple(name for name in places.names if name not in left_out)
    return Places(places.points_m[keep], places.world_m[keep], names)


def cross_validate(name: str, cameras: Mapping[str, Places], seed: int) -> dict[str, Array]:
    """Repeated k-fold cross-validation: for each camera what models that had not seen a place predict.

    Parameters
    ----------
    name : of the table of models.
    cameras : all measured places.
    seed : of the folds.

    Returns
    -------
    dict from camera to (repeats, n, 3), world points in m.

    Raises
    ------
    FitError
        Where a fold leaves too few places.
    """
    rng = np.random.default_rng(seed)
    found = {camera: np.full((REPEATS, *places.world_m.shape), np.nan) for camera, places in cameras.items()}
    for repeat in range(REPEATS):
        for fold in deal(cameras, FOLDS, rng):
            predicted = predict_without(name, cameras, fold)
            for camera, places in cameras.items():
                rows = [row for row, place in enumerate(places.names) if place in fold]
                found[camera][repeat, rows] = predicted[camera][rows]
    return found


def leave_one_out(
    name: str, cameras: Mapping[str, Places]
) -> Callable[[frozenset[str]], dict[str, dict[str, Array]]]:
    """Models fitted without one place after the other.

    Returns
    -------
    A function that is given the places that no model shall be fitted to (they are predicted as well), and
    gives for each camera and place the world point (3,) in m of a model fitted without that place. It
    fits again only cameras on which what is given has a bearing.
    """
    groups = [{camera: cameras[camera] for camera in tied} for tied in tied_cameras(name, cameras)]
    known: dict[tuple[int, frozenset[str]], dict[str, dict[str, Array]]] = {}

    def left_out(unused: frozenset[str]) -> dict[str, dict[str, Array]]:
        found = {}
        for number, group in enumerate(groups):
            key = number, unused & {place for places in group.values() for place in places.names}
            if key not in known:
                known[key] = _each_left_out(name, group, key[1])
            found.update(known[key])
        return found

    return left_out


def _each_left_out(
    name: str, cameras: Mapping[str, Places], unused: Collection[str]
) -> dict[str, dict[str, Array]]:
    found: dict[str, dict[str, Array]] = {camera: {} for camera in cameras}
    for place in dict.fromkeys(place for places in cameras.values() for place in places.names):
        predicted = predict_without(name, cameras, {place, *unused})
        for camera, places in cameras.items():
            if place in places.names:
                found[camera][place] = predicted[camera][places.names.index(place)]
    return found


SUBSETS = 10
_SIZES = (5, 7, 10, 15, 20, 30, 40, 60, 80, 120, 160, 240)
# So many places at least are left to see the error at.
_LEAST_REST = 5


def learning_sizes(name: str, cameras: Mapping[str, Places]) -> list[int]:
    """How many places a curve is drawn at, for the camera that has fewest."""
    fewest = min(len(places.names) for places in cameras.values())
    return [size for size in _SIZES if min_pairs(name) <= size <= fewest - _LEAST_REST]


def learning_curve(name: str, cameras: Mapping[str, Places], seed: int) -> Iterator[list[LearningPoint]]:
    """For one number of places after the other the errors of models fitted to random subsets, by camera.

    Parameters
    ----------
    name : of the table of models.
    cameras : all measured places; the errors are those at the places that are not in a subset.
    seed : of the subsets.
    """
    rng = np.random.default_rng(seed)
    names = sorted({name for places in cameras.values() for name in places.names})
    for size in learning_sizes(name, cameras):
        errors: dict[str, list[tuple[float, float]]] = {camera: [] for camera in cameras}
        for _ in range(SUBSETS):
            order = rng.permutation(names).tolist()
            used = {place for places in cameras.values() for place in _first(places, order, size)}
            for camera, found in _errors(name, cameras, set(names) - used, set(names) - used).items():
                errors[camera].append(found)
        yield [_point(camera, size, np.array(found)) for camera, found in errors.items() if found]


def _point(camera: str, size: int, errors_m: Array) -> LearningPoint:
    """The mean and its spread over subsets; ``errors_m`` (subsets, 2) in space and on the floor."""
    mean_3d, mean_2d = errors_m.mean(axis=0).tolist()
    std_3d, std_2d = errors_m.std(axis=0, ddof=1).tolist() if len(errors_m) > 1 else (None, None)
    return LearningPoint(camera, size, mean_3d, mean_2d, len(errors_m), std_3d_m=std_3d, std_2d_m=std_2d)


def labelled_subsets(measurements: Iterable[Measurement]) -> dict[str, set[str]]:
    """Ids by the labels other than ``train`` and ``test``: subsets that somebody chose to fit on."""
    subsets: dict[str, set[str]] = {}
    for measurement in measurements:
        for label in set(measurement.splits) - {"train", "test"}:
            subsets.setdefault(label, set()).add(measurement.id)
    return subsets


def published_curve(
    name: str, cameras: Mapping[str, Places], subsets: Mapping[str, set[str]], held_out: set[str]
) -> list[LearningPoint]:
    """Errors at held-out places of models fitted to labelled subsets, as in the paper's figures 10, 11."""
    names = {name for places in cameras.values() for name in places.names}
    points = []
    for label, used in sorted(subsets.items()):
        for camera, found in _errors(name, cameras, names - used, held_out - used).items():
            count = sum(place in used for place in cameras[camera].names)
            points.append(LearningPoint(camera, count, *found, subsets=1, label=label))
    return points


def _first(places: Places, order: list[str], size: int) -> list[str]:
    own = set(places.names)
    return [place for place in order if place in own][:size]


def _errors(
    name: str, cameras: Mapping[str, Places], left_out: set[str], looked_at: set[str]
) -> dict[str, tuple[float, float]]:
    """Mean error in space and on the floor by camera; none where the rest does not determine a model."""
    try:
        predicted = predict_without(name, cameras, left_out)
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
