"""How many places are enough: the error by the number of places that a model is fitted on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.cross_validation import predict_without
from ipsys_log.errors import FitError
from ipsys_log.messages import LearningPoint, Measurement
from ipsys_log.models.table import Places, min_pairs

__all__ = ["SUBSETS", "labelled_subsets", "learning_curve", "learning_sizes", "published_curve"]

Array = NDArray[np.float64]

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
