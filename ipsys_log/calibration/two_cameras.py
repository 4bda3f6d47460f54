"""Results that are too poor to use: images of two cameras, too few images, a wrong lens model.

The search for two groups of images works like k-means. Each image goes to the intrinsics with the least
reprojection error, and each set of intrinsics is fitted to its images. The first groups are images with
opposite gradients at the joint fit, and images with similar names.
"""

import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import (
    Corners,
    LensFit,
    adjust,
    normal_equations,
    reduce_to_lens,
    residuals,
)
from ipsys_log.calibration.lens_models import LENS_MODELS, LensModel
from ipsys_log.calibration.solve import fitted_basis, loss_scale_px, rms_px, solve
from ipsys_log.messages import Array

Group = NDArray[np.bool_]

_MIN_IMAGES = 4
# The images are divided along so many directions of the largest contradictions,
_DIRECTIONS = 3
# and each division is improved in so many rounds.
_ROUNDS = 8
# Steps of the fit of a group, and of the poses of the other images.
_STEPS = 8
_POSE_STEPS = 4
# Least relative excess of the squared errors with one set of intrinsics for two cameras. Images of
# one camera reach 0.37 (fisheye_chessboard), and fewer images per parameter reach more.
_GAIN = 0.4
_GAIN_PER_PARAMETER = 0.6
# Least excess if the names of the images show the same groups,
_NAMED_GAIN = 0.25
# and least share of images that agree.
_AGREE = 0.9
# Largest ratio of the errors of the groups: a group with larger errors consists of bad images.
_ALIKE = 3.0


class TwoCameras(NamedTuple):
    """The images of the second camera (f,), and the RMS in px with one and two sets of intrinsics."""

    second: Group
    one_px: float
    two_px: float


class _Split(NamedTuple):
    """The images of the second camera, and the squared errors of each image in px^2."""

    second: Group
    errors: Array


def find_two_cameras(
    model: LensModel, start: LensFit, corners: Corners, names: Sequence[str]
) -> TwoCameras | None:
    """Return the images of each camera if there are two cameras; None for one camera.

    Parameters
    ----------
    model : the lens model.
    start : the first fit.
    corners : corners of all images.
    names : names of the images, (f,).
    """
    if corners.image_count < 2 * _MIN_IMAGES:
        return None
    basis = fitted_basis(model, square=False)
    scale_px = loss_scale_px(model, start, corners)
    fit = adjust(model, start, corners, basis, scale_px)
    scale_px = loss_scale_px(model, fit, corners)
    by_name = list(_name_groups(names))
    seeds = [*by_name, *_opposite_pulls(model, fit, corners, basis, scale_px)]
    splits = [_refine(model, fit, corners, basis, scale_px, seed) for seed in seeds]
    best = min(
        (split for split in splits if split is not None), key=lambda one: one.errors.sum(), default=None
    )
    if best is None:
        return None
    with_one = _errors(model, fit, corners, scale_px)
    gain = float(with_one.sum() / best.errors.sum()) - 1
    agreement = max((max(np.mean(best.second == g), np.mean(best.second != g)) for g in by_name), default=0.0)
    needed = _GAIN + _GAIN_PER_PARAMETER * basis.shape[1] / corners.image_count
    counts = corners.sums(np.ones(len(corners.image_numbers)))
    first_px, second_px = (_rms_px(best.errors[g], counts[g]) for g in (~best.second, best.second))
    if gain < (_NAMED_GAIN if agreement >= _AGREE else needed):
        return None
    if max(first_px, second_px) > _ALIKE * min(first_px, second_px):
        return None
    return TwoCameras(best.second, _rms_px(with_one, counts), _rms_px(best.errors, counts))


def _rms_px(errors: Array, counts: Array) -> float:
    return float(np.sqrt(errors.sum() / counts.sum()))


def _name_groups(names: Sequence[str]) -> Iterator[Group]:
    """Yield groups of images whose names differ only in the last number."""
    kinds = np.array([re.sub(r"\d+(?=\D*$)", "", name) for name in names])
    different = np.unique(kinds)
    for kind in different[: len(different) - 1 if len(different) == 2 else _DIRECTIONS]:
        group = kinds == kind
        if min(group.sum(), (~group).sum()) >= _MIN_IMAGES:
            yield group


def _opposite_pulls(
    model: LensModel, fit: LensFit, corners: Corners, basis: Array, scale_px: float
) -> list[Group]:
    """Return groups by the sign of the gradient of each image, in the strongest directions."""
    normal = normal_equations(model, fit, corners, basis, scale_px)
    matrices, gradients = reduce_to_lens(normal)
    values, vectors = np.linalg.eigh(matrices.sum(axis=0) + normal.pull)
    whitened = gradients @ (vectors / np.sqrt(np.maximum(values, 1e-12 * values.max())))
    pulls = np.linalg.svd(whitened, full_matrices=False)[0]
    return [pulls[:, n] > 0 for n in range(min(_DIRECTIONS, pulls.shape[1]))]


def _refine(
    model: LensModel, fit: LensFit, corners: Corners, basis: Array, scale_px: float, second: Group
) -> _Split | None:
    """Return the converged groups, or None if a group has too few images."""
    fits = [fit, fit]
    for _ in range(_ROUNDS):
        if min(second.sum(), (~second).sum()) < _MIN_IMAGES:
            return None
        groups = (~second, second)
        fits = [
            _fit_group(model, old, corners, basis, scale_px, g) for old, g in zip(fits, groups, strict=True)
        ]
        first_errors, second_errors = (_errors(model, group_fit, corners, scale_px) for group_fit in fits)
        nearer = second_errors < first_errors
        if (nearer == second).all():
            return _Split(second, np.where(second, second_errors, first_errors))
        second = nearer
    return None


def _fit_group(
    model: LensModel, fit: LensFit, corners: Corners, basis: Array, scale_px: float, group: Group
) -> LensFit:
    """Return the intrinsics of a group of images, and the poses of all images with these intrinsics."""
    part, _ = corners.select(group[corners.image_numbers])
    group_fit = adjust(
        model,
        LensFit(fit.intrinsics, fit.rotations[group], fit.positions_m[group]),
        part,
        basis,
        scale_px,
        _STEPS,
    )
    rotations, places_m = fit.rotations.copy(), fit.positions_m.copy()
    rotations[group], places_m[group] = group_fit.rotations, group_fit.positions_m
    return adjust(
        model,
        LensFit(group_fit.intrinsics, rotations, places_m),
        corners,
        basis[:, :0],
        scale_px,
        _POSE_STEPS,
    )


def _errors(model: LensModel, fit: LensFit, corners: Corners, scale_px: float) -> Array:
    """Return the sum of the squared errors of each image, (f,) in px^2; outliers have less weight."""
    squares = (residuals(model, fit, corners) ** 2).sum(axis=1)
    return corners.sums(scale_px**2 * np.log1p(squares / scale_px**2))


MOST_RMS_PX = 2.0
# Another model is better if its error is less than the first share of the error. Models with errors up to the
# second factor are equally good.
_BETTER, _AS_WELL = 0.6, 1.1


class BetterModel(NamedTuple):
    """The name of a lens model, and its RMS reprojection error in px."""

    name: str
    rms_px: float


def find_better_model(
    model: LensModel, corners: Corners, size_px: tuple[int, int], left_px: float
) -> BetterModel | None:
    """Return the model with the least error for the same corners, if it is far less than ``left_px``."""
    candidates = []
    for name, other in LENS_MODELS.items():
        if other == model:
            continue
        try:
            solved = solve(other, corners, size_px)
        except np.linalg.LinAlgError:
            continue
        # A model that leaves out most images does not describe them.
        if 2 * len(solved.image_numbers) >= corners.image_count:
            candidates.append(BetterModel(name, rms_px(solved)))
    least_px = min((candidate.rms_px for candidate in candidates), default=np.inf)
    if least_px >= _BETTER * left_px:
        return None
    # The first of the equally good models has fewer coefficients that are hard to determine.
    return next(candidate for candidate in candidates if candidate.rms_px <= _AS_WELL * least_px)


def two_cameras_fault(split: TwoCameras, names: Sequence[str]) -> str:
    """Return the fault text for images of two cameras, with the images of each camera."""
    groups = ", ".join(_named(names, split.second == second) for second in (False, True))
    return (
        f"the pictures are of two cameras, or of two settings of zoom or focus: {groups}; the reprojection "
        f"error is {split.one_px:.2f} px with one set of intrinsics, {split.two_px:.2f} px with two"
    )


def _named(names: Sequence[str], group: NDArray[np.bool_]) -> str:
    return f"{group.sum()} of one ({', '.join(name for name, own in zip(names, group, strict=True) if own)})"
