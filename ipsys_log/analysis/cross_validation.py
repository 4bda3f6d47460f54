"""Models fitted without some of the places: cross-validation and leave-one-out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Pair
from ipsys_log.models.table import Places, fit_cameras, inputs, predict_array, tied_cameras

__all__ = ["FOLDS", "REPEATS", "cross_validate", "deal", "gather_places", "leave_one_out", "predict_without"]

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
