"""Learning curves as they are drawn and judged: the mean error by the number of places."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Evaluation, LearningPoint

__all__ = ["Curve", "CurvePoint", "camera_curve", "has_published", "mean_curve"]


class CurvePoint(NamedTuple):
    """A mean error at so many places for each camera; ``std_m`` is its spread over random subsets."""

    places: int
    mean_m: float
    std_m: float | None
    subsets: int


Curve = list[CurvePoint]


def has_published(evaluations: Sequence[Evaluation]) -> bool:
    """Whether somebody chose subsets of several sizes to fit on, and labelled them."""
    sizes = {
        (point.camera, point.pairs)
        for evaluation in evaluations
        for point in evaluation.learning
        if point.label is not None
    }
    return any(len({size for camera, size in sizes if camera == own}) > 1 for own, _ in sizes)


def camera_curve(evaluation: Evaluation, camera: str, published: bool, in_space: bool) -> Curve:
    """The curve of one camera, of the published subsets or of random ones."""
    points = [p for p in evaluation.learning if (p.label is not None) == published and p.camera == camera]
    return _sorted(_point([point], point.pairs, in_space) for point in points)


def mean_curve(evaluation: Evaluation, published: bool, in_space: bool) -> Curve:
    """The mean over the cameras, where all of them have a point.

    Published subsets have one label for all cameras, and may differ in size by a place or two.
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
    known = [std_m for std_m in stds_m if std_m is not None]
    # Cameras see different places: their spreads are independent.
    std_m = float(np.linalg.norm(known)) / len(points) if len(known) == len(points) else None
    return CurvePoint(places, float(np.mean(means_m)), std_m, min(point.subsets for point in points))
