"""How well a lens is known: from how it would change if pictures were left out."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle import Corners, Fit, normal_equations
from ipsys_log.calibration.lens_models import LensModel, project_points
from ipsys_log.calibration.picture_coverage import NEAR, group_outlines

__all__ = ["alike", "lens_covariance"]

Array = NDArray[np.float64]

# Boards that are near show the same; or those half as far apart and so on, until there are enough groups
# for a jackknife.
_HALVINGS = 4
_ENOUGH_GROUPS = 15


def alike(model: LensModel, fit: Fit, corners: Corners, size_px: tuple[int, int]) -> NDArray[np.intp]:
    """The group of each picture, (f,): those that show the board at nearly the same place.

    Frames of a video that follow one another have the same errors, not new ones.
    """
    low, high = corners.board_m.min(axis=0), corners.board_m.max(axis=0)
    outline_m = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    seen_m = np.einsum("fij,kj->fki", fit.rotations, outline_m) + fit.places_m[:, None]
    outlines = project_points(model, fit.lens, seen_m.reshape(-1, 3))[0].reshape(-1, 4, 2)
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
    """Covariance (q, q) of the lens along ``basis``, by leaving out each group of pictures in turn.

    Corners of one picture share errors (a board that is not flat, blur, a lens that is not quite of this
    kind), and pictures differ in theirs. Taken for independent, they make a lens look too well known.
    The jackknife over whole groups supposes nothing of this; each is left out in one linear step.

    References
    ----------
    Efron and Stein, The jackknife estimate of variance, Annals of Statistics 1981.
    """
    normal = normal_equations(model, fit, corners, basis, scale_px)
    gradients = normal.pose_gradient[..., None]
    solved = np.linalg.solve(normal.poses, np.concatenate([normal.between, gradients], axis=2))
    transposed = normal.between.transpose(0, 2, 1)
    each = normal.lens - transposed @ solved[:, :, :-1]
    gradient = normal.lens_gradient - (transposed @ solved[:, :, -1:])[..., 0]
    of_group = (groups == np.arange(groups.max() + 1)[:, None]).astype(float)
    whole = each.sum(axis=0) + normal.pull
    without = whole - np.einsum("gf,fij->gij", of_group, each)
    shifts = np.linalg.solve(without, (of_group @ gradient)[..., None])[..., 0]
    count = len(of_group)
    # A parameter that is drawn to 0 is off by as much as it is usually large.
    drawn = np.linalg.solve(whole, normal.pull * (model.usual if np.isfinite(model.usual) else 0.0))
    return np.asarray((count - 1) / count * shifts.T @ shifts + drawn @ drawn.T)
