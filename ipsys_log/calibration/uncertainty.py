"""Uncertainty of intrinsics: by their change without some pictures, and with a richer model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import (
    Corners,
    Fit,
    corner_weights,
    normal_equations,
    reduce_to_lens,
    residuals,
)
from ipsys_log.calibration.lens_models import LensModel, project_points
from ipsys_log.calibration.model_change import model_change
from ipsys_log.calibration.picture_coverage import NEAR, group_outlines

__all__ = ["alike", "lens_covariance"]

Array = NDArray[np.float64]

# Boards that are near show the same; or those half as far apart and so on, until there are enough groups
# for a jackknife.
_HALVINGS = 4
_ENOUGH_GROUPS = 15
# A jackknife of few groups is uncertain itself. At so many groups it has the weight of least squares.
_EQUAL_GROUPS = 8


def alike(model: LensModel, fit: Fit, corners: Corners, size_px: tuple[int, int]) -> NDArray[np.intp]:
    """Return the group of each picture, (f,): a group shows the board in nearly the same pose.

    Successive frames of a video have the same errors, not new ones.
    """
    low, high = corners.board_m.min(axis=0), corners.board_m.max(axis=0)
    outline_m = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    seen_m = np.einsum("fij,kj->fki", fit.rotations, outline_m) + fit.places_m[:, None]
    outlines = project_points(model, fit.lens, seen_m.reshape(-1, 3)).reshape(-1, 4, 2)
    near_px = NEAR * float(np.hypot(*size_px))
    for _ in range(_HALVINGS):
        groups = group_outlines(outlines, near_px)
        if groups.max() + 1 >= _ENOUGH_GROUPS:
            return groups
        near_px /= 2
    return np.arange(len(outlines))


def lens_covariance(
    model: LensModel,
    fit: Fit,
    corners: Corners,
    basis: Array,
    scale_px: float | None,
    groups: NDArray[np.intp],
) -> Array:
    """Return the covariance (q, q) of the lens parameters along ``basis``.

    Corners of one picture share errors (a bent board, blur), and these differ between pictures. If the errors
    are assumed to be independent, the covariance is too small. A jackknife over whole groups needs no such
    assumption; each group is left out in one linear step. With few groups it is uncertain itself: seven
    pictures may agree by chance. So it is averaged with the covariance of least squares, with the variance
    that the jackknife shows over all parameters. Student's distribution for the number of groups makes it
    wider. The change that a richer model shows is added.

    References
    ----------
    Efron and Stein, The jackknife estimate of variance, Annals of Statistics 1981.
    """
    normal = normal_equations(model, fit, corners, basis, scale_px)
    matrices, gradients = reduce_to_lens(normal)
    whole = matrices.sum(axis=0) + normal.pull
    jackknife = _jackknife(whole, matrices, gradients, groups)
    inverse = np.linalg.inv(whole)
    squares = inverse @ (whole - normal.pull) @ inverse
    variance = _variance_px2(model, fit, corners, scale_px, basis.shape[1])
    # Not less than the residuals show.
    variance = max(variance, float(np.median(np.diag(jackknife) / np.diag(squares))))
    count = int(groups.max()) + 1
    share = count / (count + _EQUAL_GROUPS)
    widening = (count - 1) / max(count - 3, 1)
    covariance = widening * (share * jackknife + (1 - share) * variance * squares)
    shift = model_change(model, fit, corners, basis, scale_px, variance)
    # A parameter with a prior at 0 has an error of its usual size.
    drawn = inverse @ (normal.pull * (model.usual if np.isfinite(model.usual) else 0.0))
    return np.asarray(covariance + np.outer(shift, shift) + drawn @ drawn.T)


def _jackknife(whole: Array, matrices: Array, gradients: Array, groups: NDArray[np.intp]) -> Array:
    of_group = (groups == np.arange(groups.max() + 1)[:, None]).astype(float)
    without = whole - np.einsum("gf,fij->gij", of_group, matrices)
    shifts = np.linalg.solve(without, (of_group @ gradients)[..., None])[..., 0]
    count = len(of_group)
    return np.asarray((count - 1) / count * shifts.T @ shifts)


def _variance_px2(
    model: LensModel, fit: Fit, corners: Corners, scale_px: float | None, unknowns: int
) -> float:
    """Return the variance of a coordinate of a corner, for independent corners."""
    missed_px = residuals(model, fit, corners)
    squares = float(corner_weights(missed_px, scale_px) @ (missed_px**2).sum(axis=1))
    return squares / max(missed_px.size - 6 * corners.pictures - unknowns, 1)
