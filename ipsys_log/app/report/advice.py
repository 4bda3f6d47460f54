"""Advice on the number of calibration points and on the model, from learning curves.

The rule selects the simplest model of a group whose mean error is within the noise of the lowest mean error.
It is the one-standard-error rule of Breiman et al., with a 95 % interval of the difference instead of one
standard error. A simple model has few free parameters.

The mean error is that of a learning curve over all cameras. The curve uses the labelled subsets of the log,
or random subsets if there are no labels. The noise has two parts. The first part is the variation of the
mean with other test points. Its estimate is the bootstrap interval of the model's error on held-out points,
or by cross-validation, scaled in proportion to the mean. The second part exists for random subsets only: the
variation with other random subsets.

All models have the same test points, so their errors are similar. Therefore the rule tends to take a
difference for noise. It rarely takes noise for a difference.

References
----------
Breiman et al., Classification and Regression Trees, 1984, sect. 3.4.3.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Evaluation, LearningPoint
from ipsys_log.models.table import is_known, min_pairs, reads_height
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, POOLED
from ipsys_log.units import CM_PER_M


class CurvePoint(NamedTuple):
    """A mean error with a number of points per camera; ``std_m`` is its spread over random subsets."""

    places: int
    mean_m: float
    std_m: float | None
    subsets: int


Curve = list[CurvePoint]


def has_published(evaluations: Sequence[Evaluation]) -> bool:
    """Return whether the log has labelled subsets of several sizes for the fit."""
    sizes = {
        (point.camera, point.pairs)
        for evaluation in evaluations
        for point in evaluation.learning
        if point.label is not None
    }
    return any(len({size for camera, size in sizes if camera == this_camera}) > 1 for this_camera, _ in sizes)


def camera_curve(evaluation: Evaluation, camera: str, published: bool, in_space: bool) -> Curve:
    """Return the learning curve of one camera, on the published subsets or on random subsets."""
    points = [p for p in evaluation.learning if (p.label is not None) == published and p.camera == camera]
    return _sorted(_point([point], point.pairs, in_space) for point in points)


def mean_curve(evaluation: Evaluation, published: bool, in_space: bool) -> Curve:
    """Return the mean curve over the cameras, at the sizes that all cameras have.

    A published subset has one label for all cameras. Its size may differ between cameras by one or two
    points.
    """
    points = [point for point in evaluation.learning if (point.label is not None) == published]
    groups: dict[str | int, list[LearningPoint]] = {}
    for point in points:
        groups.setdefault(point.pairs if point.label is None else point.label, []).append(point)
    cameras = {point.camera for point in points}
    return _sorted(
        _point(group, round(float(np.mean([point.pairs for point in group]))), in_space)
        for group in groups.values()
        if {point.camera for point in group} == cameras
    )


def _sorted(points: Iterable[CurvePoint]) -> Curve:
    return sorted(points, key=lambda point: point.places)


def _point(points: Sequence[LearningPoint], places: int, in_space: bool) -> CurvePoint:
    means_m = [point.mean_3d_m if in_space else point.mean_2d_m for point in points]
    stds_m = [point.std_3d_m if in_space else point.std_2d_m for point in points]
    known_stds_m = [std_m for std_m in stds_m if std_m is not None]
    # Cameras see different points, so their spreads are independent.
    std_m = float(np.linalg.norm(known_stds_m)) / len(points) if len(known_stds_m) == len(points) else None
    return CurvePoint(places, float(np.mean(means_m)), std_m, min(point.subsets for point in points))


# The simplest model first, by free parameters per camera: 6 for a pose, some more for lens distortion, 30 for
# a polynomial, one per point for kriging, and the weights of a network.
_SIMPLE_FIRST = (
    "rigid", "rayplane", "joint", "best", "poly", "rigid+poly", "kriging", "rigid+kriging",
    "kriging-regression", "rigid+kriging-regression", "ann", "rigid+ann",
)  # fmt: skip
# The paper recommends one of these two, by the number of points.
_SIMPLE = ("rigid", "poly")
_OWN = ("rayplane", "best", "joint")
SIMPLE, PAPER, ALL_MODELS, HEIGHT_KNOWN = "simple", "paper", "any", "height_known"
GROUPS = {
    SIMPLE: "rigid or poly",
    PAPER: "the paper's methods",
    ALL_MODELS: "all methods",
    HEIGHT_KNOWN: "all, known heights",
}
HEIGHT_NOTE = "* gets the marker height as input"
_CONFIDENCE = 1.96


@dataclass(frozen=True, slots=True)
class Choice:
    """The model to use of a group, and the model with the lowest mean error."""

    model: str
    mean_m: float
    lowest: str
    lowest_mean_m: float


@dataclass(frozen=True, slots=True)
class Advice:
    """The advice on the model, by the number of points per camera.

    Attributes
    ----------
    published : True for labelled subsets, False for random subsets.
    in_space : True for errors in space, False for errors on the floor (if heights cannot be learned).
    choices : choices by number of points and group. The group ``height_known`` exists only if a model gets
        the heights as input.
    sentences : the advice as text.
    """

    published: bool
    in_space: bool
    choices: Mapping[int, Mapping[str, Choice]]
    sentences: tuple[str, ...]

    @property
    def groups(self) -> list[str]:
        """The groups whose choices differ from all groups before them."""
        shown: dict[str, list[Choice | None]] = {}
        for group in GROUPS:
            column = [choices.get(group) for choices in self.choices.values()]
            if any(column) and column not in shown.values():
                shown[group] = column
        return list(shown)


@dataclass(frozen=True, slots=True)
class _Candidate:
    model: str
    mean_m: float
    noise_m: float

    def like(self, other: "_Candidate") -> bool:
        """Return whether the difference to another candidate is within the noise."""
        return bool(self.mean_m - other.mean_m <= _CONFIDENCE * np.hypot(self.noise_m, other.noise_m))


def uses_height(model: str) -> bool:
    """Return whether a model gets the height of a marker as input; then its 3D error is a 2D error."""
    return is_known(model) and reads_height(model)


def label(model: str) -> str:
    """Return the name of a model, with the mark of :data:`HEIGHT_NOTE` if the model gets heights as input."""
    return f"{model}*" if uses_height(model) else model


def advise(evaluations: Sequence[Evaluation]) -> Advice | None:
    """Return the advice from learning curves; None without curves for at least two numbers of points.

    A curve that ends far below the points of a camera gives no advice for them: the camera with the fewest
    points ends it.
    """
    published = has_published(evaluations)
    in_space = all(row.error_3d is not None for e in evaluations for row in e.cameras)
    table: dict[int, list[_Candidate]] = {}
    for evaluation in evaluations:
        noise = _relative_noise(evaluation, published, in_space)
        for point in mean_curve(evaluation, published, in_space):
            candidate = _Candidate(evaluation.model, point.mean_m, _noise_m(point, noise))
            table.setdefault(point.places, []).append(candidate)
    if len(table) < 2 or (not published and max(table) < _REACH * _most_points(evaluations)):
        return None
    choices = {places: _choices(candidates) for places, candidates in sorted(table.items())}
    sentences = (*_sentences(choices, table), *_too_few(evaluations, in_space))
    return Advice(published, in_space, choices, sentences)


# A curve of random subsets reaches this share of the points of a camera, if all cameras have about as many.
_REACH = 0.5


def _most_points(evaluations: Sequence[Evaluation]) -> int:
    """Return the largest number of calibration points of a camera, by the cross-validation."""
    rows = [row for evaluation in evaluations for row in evaluation.cameras if row.camera != POOLED]
    return max((row.error_2d.count for row in rows if row.scheme == CROSS_VALIDATION), default=0)


def _relative_noise(evaluation: Evaluation, published: bool, in_space: bool) -> float:
    """Return the standard error of a mean over points, in units of the mean."""
    scheme = [row for row in evaluation.cameras if (row.scheme == CROSS_VALIDATION) != published]
    rows = [row for row in scheme if row.against == "tape"]
    for row in [row for row in rows if row.camera == POOLED] or rows[:1]:
        errors = row.error_3d if in_space else row.error_2d
        if errors and errors.mean_low_m is not None and errors.mean_high_m is not None and errors.mean_m > 0:
            return (errors.mean_high_m - errors.mean_low_m) / (2 * _CONFIDENCE * errors.mean_m)
    return 0.0


def _noise_m(point: CurvePoint, relative: float) -> float:
    drawn_m = 0.0 if point.std_m is None else point.std_m / np.sqrt(point.subsets)
    return float(np.hypot(relative * point.mean_m, drawn_m))


def _choices(candidates: Sequence[_Candidate]) -> dict[str, Choice]:
    groups = {
        SIMPLE: [c for c in candidates if c.model in _SIMPLE],
        PAPER: [c for c in candidates if c.model not in _OWN],
        ALL_MODELS: [c for c in candidates if not uses_height(c.model)],
        HEIGHT_KNOWN: candidates if any(uses_height(c.model) for c in candidates) else [],
    }
    return {group: _choose(members) for group, members in groups.items() if members}


def _choose(candidates: Sequence[_Candidate]) -> Choice:
    # Models that are the same function, as poly and rigid+poly, differ in the last digits only.
    lowest = min(candidates, key=lambda candidate: (round(candidate.mean_m, 9), _rank(candidate.model)))
    chosen = min((c for c in candidates if c.like(lowest)), key=lambda c: _rank(c.model))
    return Choice(chosen.model, chosen.mean_m, lowest.model, lowest.mean_m)


def _rank(model: str) -> int:
    return _SIMPLE_FIRST.index(model) if model in _SIMPLE_FIRST else len(_SIMPLE_FIRST)


def _sentences(
    choices: Mapping[int, Mapping[str, Choice]], table: Mapping[int, Sequence[_Candidate]]
) -> Iterable[str]:
    """Yield sentences of advice on the model, by the number of points."""
    if len({candidate.model for row in table.values() for candidate in row}) == 1:
        means_cm = [row[0].mean_m * CM_PER_M for _, row in sorted(table.items())]
        name = next(iter(table.values()))[0].model
        yield (
            f"The mean error of {name} is {means_cm[0]:.1f} cm with {min(table)} points per camera, "
            f"{means_cm[-1]:.1f} cm with {max(table)}."
        )
        return
    simple = {c.model for row in table.values() for c in row if c.model in _SIMPLE}
    group, use = (SIMPLE, "Between rigid and poly, use") if len(simple) > 1 else (ALL_MODELS, "Use")
    by_places = {places: row[group].model for places, row in choices.items() if group in row}
    if by_places:
        yield f"{use} {_by_number(by_places)}."
    most = max(choices)
    for other, start in ((ALL_MODELS, "Model"), (HEIGHT_KNOWN, "With known marker heights, model")):
        if SIMPLE in choices[most] and other in choices[most]:
            yield from _saving(start, choices[most][other].model, choices[most][SIMPLE], most, table)


# A polynomial with so many times the error of the largest number of points has too few points.
_TOO_FEW = 5.0


def _too_few(evaluations: Sequence[Evaluation], in_space: bool) -> Iterable[str]:
    """Yield the reason for a large error of the polynomial with hardly more points than coefficients.

    The reason is about random subsets if there are some: the learning curve shows them.
    """
    for evaluation in evaluations:
        curve = mean_curve(evaluation, False, in_space) or mean_curve(evaluation, True, in_space)
        if evaluation.model != "poly" or len(curve) < 2:
            continue
        few, many, terms = curve[0], curve[-1], min_pairs("poly")
        if few.places < 2 * terms and few.mean_m > _TOO_FEW * many.mean_m:
            yield (
                f"The error of poly with {few.places} points, {few.mean_m * CM_PER_M:.0f} cm, is no fault of "
                f"the lab: poly has {terms} coefficients for each coordinate, so it passes through "
                f"{few.places} points with their errors and is wrong between and beyond them. With "
                f"{many.places} points, it is {many.mean_m * CM_PER_M:.1f} cm."
            )


def _by_number(models: Mapping[int, str]) -> str:
    """Return text such as ``rigid with up to 20 points per camera, poly from 30 on``."""
    parts: list[tuple[str, list[int]]] = []
    for places, model in models.items():
        if parts and parts[-1][0] == model:
            parts[-1][1].append(places)
        else:
            parts.append((model, [places]))
    if len(parts) == 1:
        return f"{parts[0][0]} with any number of points from {min(models)} to {max(models)} per camera"
    first = f"{parts[0][0]} with up to {parts[0][1][-1]} points per camera"
    middle = [f"{model} with {_span(places)}" for model, places in parts[1:-1]]
    return ", ".join([first, *middle, f"{parts[-1][0]} from {parts[-1][1][0]} on"])


def _span(places: Sequence[int]) -> str:
    return f"{places[0]} to {places[-1]}" if len(places) > 1 else f"{places[0]}"


def _saving(
    start: str, model: str, usual: Choice, most: int, table: Mapping[int, Sequence[_Candidate]]
) -> Iterable[str]:
    """Yield a sentence with the fewest points for which a model equals the usual model with most points."""
    if model == usual.model:
        return
    means_m = {
        places: c.mean_m for places, candidates in table.items() for c in candidates if c.model == model
    }
    enough = [places for places, mean_m in sorted(means_m.items()) if mean_m <= usual.mean_m]
    if enough and enough[0] < most:
        usual_cm, least_cm = (f"{mean_m * CM_PER_M:.1f} cm" for mean_m in (usual.mean_m, means_m[most]))
        more = "" if usual_cm == least_cm else f"; with {most} points, its error is {least_cm}"
        yield (
            f"{start} {model} with {enough[0]} points is as good as {usual.model} with {most} points "
            f"({usual_cm}){more}."
        )
