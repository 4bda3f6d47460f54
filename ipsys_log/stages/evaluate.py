"""What a lab wants to know of a model: how good it is, from how many places, and which of them are wrong."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.accuracy import errors_cross_validated, errors_held_out
from ipsys_log.analysis.cross_validation import (
    FOLDS,
    gather_places,
    learning_curve,
    learning_sizes,
    leave_one_out,
    published_curve,
)
from ipsys_log.analysis.outliers import find_suspects
from ipsys_log.analysis.pairs import Measured
from ipsys_log.errors import FitError
from ipsys_log.messages import Evaluation, LearningPoint, Model, Pair, Suspect
from ipsys_log.models.table import Places, min_pairs

__all__ = ["SCREENING", "Study", "evaluate_model"]

# The models that measurements are checked with: of those that fit in milliseconds the ones that follow
# the places closely enough to see an error of some centimetres.
SCREENING = ("poly", "rayplane", "best")


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """What there is to evaluate on.

    Attributes
    ----------
    places : the measurements that count.
    pairs : all of them that were seen, by camera.
    held_out : ids of those that were held out.
    subsets : ids by the label of a published subset to be fitted on.
    truth : true world points (3,) in m by id; empty outside a simulated lab.
    seed : of folds and random subsets; None for a model of another log, which is not fitted again.
    """

    places: Sequence[Measured]
    pairs: Mapping[str, Sequence[Pair]]
    held_out: set[str]
    subsets: Mapping[str, set[str]]
    truth: Mapping[str, NDArray[np.float64]]
    seed: int | None


def evaluate_model(
    model: Model, study: Study, time_ns: int, notes: list[str], progress: Callable[[int, int], None]
) -> Evaluation:
    """Errors on places held out and by cross-validation, learning curve and suspect measurements.

    Parameters
    ----------
    model : fitted.
    time_ns : of the last input.
    notes : what could not be done is added to it.
    progress : called with the steps done, and all there are.
    """
    held_out = {
        camera: [pair for pair in found if pair.measurement in study.held_out]
        for camera, found in study.pairs.items()
    }
    rows = errors_held_out(model, held_out, study.truth)
    learning: list[LearningPoint] = []
    suspects: tuple[Suspect, ...] = ()
    if study.seed is not None:
        fitted = {camera.camera for camera in model.cameras}
        pairs = {camera: found for camera, found in study.pairs.items() if camera in fitted}
        cameras = gather_places(pairs)
        sizes = learning_sizes(model.name, cameras)
        total = 2 + len(sizes)
        progress(0, total)
        if _enough(model.name, pairs, notes):
            try:
                rows += errors_cross_validated(model, pairs, study.truth, study.seed)
            except FitError as error:
                notes.append(f"no cross-validation: {error}")
        progress(1, total)
        learning = published_curve(model.name, cameras, study.subsets, study.held_out)
        for done, points in enumerate(learning_curve(model.name, cameras, study.seed), 2):
            learning += points
            progress(done, total)
        suspects = _suspects(model.name, cameras, study.places)
        progress(total, total)
    return Evaluation(time_ns, model.name, tuple(rows), tuple(learning), suspects)


def _enough(name: str, pairs: Mapping[str, Sequence[Pair]], notes: list[str]) -> bool:
    """Whether each fold leaves enough places to fit to."""
    for camera, found in pairs.items():
        if len(found) - -(-len(found) // FOLDS) < min_pairs(name):
            notes.append(f"no cross-validation of {name}: camera {camera} has only {len(found)} places")
            return False
    return True


def _suspects(name: str, cameras: Mapping[str, Places], places: Sequence[Measured]) -> tuple[Suspect, ...]:
    if name not in SCREENING or any(len(p.names) <= min_pairs(name) + 1 for p in cameras.values()):
        return ()
    seen = {place for found in cameras.values() for place in found.names}
    try:
        return find_suspects(leave_one_out(name, cameras), [p for p in places if p.measurement.id in seen])
    except FitError:
        return ()
