"""What error of a prediction is usual, where and in which direction: the unit that suspects are told by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi, norm

from ipsys_log.models.poly import regressors

__all__ = ["FEWEST", "score", "usual_covariances"]

Array = NDArray[np.float64]

# Of fewer places of a camera nobody can say what is usual: with ten terms to fit, each alone bends the model.
FEWEST = 15
# The median of |x| and of the length of (x, y, z), all normal with a sigma of 1.
_MEDIAN_1D = float(norm.ppf(0.75))
_MEDIAN_3D = float(chi.median(3))
# Cameras look down on the middle of the places that they see, from about here. It only turns the axes
# of the yardstick, so 1.5 m or 5 m would do as well.
_EYE_M = 2.5
# Across the view an error is smaller than along it, yet not nothing.
_LEAST_ACROSS = 0.3
# Nobody measures places better; keeps the yardstick from shrinking to rounding errors.
_FINEST_M = 0.001
# The polynomial has this many terms; a place that determines more than this of its own fit counts as this.
_TERMS = 10
_MOST_LEVERAGE = 0.9
# Found by trial: what leave-one-out errors scatter beyond their leverage when few places are left over.
_FEW = 50.0
_LEAST_SPREAD_M = 0.02


def usual_covariances(
    predicted_m: Array, residuals_m: Array, fitted: NDArray[np.bool_], tape_m2: Array
) -> Array:
    """For each place of a camera the covariance of a usual leave-one-out error, without that of its tape.

    Depths are known worse than directions, so an error along the view is told from one across it; a
    model knows less at the rim of the places than amid them, by the leverage that second-order terms
    have there. The rest is one scale for each direction, from medians, so that gross errors do not count.

    Parameters
    ----------
    predicted_m : (n, 3), where models fitted without a place see it.
    residuals_m : (n, 3), predicted minus measured.
    fitted : (n,), whether the other models rest on a place. At least :data:`FEWEST` are.
    tape_m2 : (n, 3, 3), covariances of the measured points, 0 where not known.

    Returns
    -------
    (n, 3, 3), in m^2, such that the median of :func:`score` over the fitted places is 1, and somewhat
    greater for few places, which say less of what is usual.
    """
    growth = _growth(predicted_m, fitted)
    views = predicted_m - [*np.median(predicted_m[:, :2], axis=0), _EYE_M]
    views /= np.linalg.norm(views, axis=1)[:, None]
    scaled = residuals_m / growth[:, None]
    along = (scaled * views).sum(axis=1)
    across = np.stack([(scaled * axes).sum(axis=1) for axes in _axes_across(views)])
    along_m = float(np.median(np.abs(along[fitted]))) / _MEDIAN_1D
    across_m = float(np.median(np.abs(across[:, fitted]))) / _MEDIAN_1D
    across_m = max(across_m, _LEAST_ACROSS * along_m, _FINEST_M)
    along_m = max(along_m, across_m)
    outer = views[:, :, None] * views[:, None, :]
    shape = growth[:, None, None] ** 2 * (across_m**2 * np.eye(3) + (along_m**2 - across_m**2) * outer)
    few = 1 + _FEW / (int(fitted.sum()) - _TERMS) ** 2
    median = float(np.median(score(residuals_m[fitted], shape[fitted] + tape_m2[fitted])))
    covariances: Array = (few * median) ** 2 * shape + _FINEST_M**2 * np.eye(3)
    return covariances


def score(residuals_m: Array, covariances_m2: Array) -> Array:
    """Lengths (n,) of residuals (n, 3) in units of the usual one, given its covariance (n, 3, 3).

    Examples
    --------
    >>> score(np.array([[0.0, 0.0, 0.0154]]), 0.01**2 * np.eye(3)[None]).round(2).tolist()
    [1.0]
    """
    weighed = np.linalg.solve(covariances_m2, residuals_m[:, :, None])[:, :, 0]
    lengths: Array = np.sqrt((residuals_m * weighed).sum(axis=1)) / _MEDIAN_3D
    return lengths


def _growth(predicted_m: Array, fitted: NDArray[np.bool_]) -> Array:
    """How much greater the error of a place left out is than that of its camera point, (n,)."""
    centred = predicted_m - predicted_m[fitted].mean(axis=0)
    terms = regressors(centred / np.maximum(np.abs(centred[fitted]).max(axis=0), _LEAST_SPREAD_M))
    _, sizes, axes = np.linalg.svd(terms[fitted], full_matrices=False)
    kept = sizes > 1e-6 * sizes[0]
    leverage = ((terms @ axes[kept].T / sizes[kept]) ** 2).sum(axis=1)
    # Terms that the places do not determine, as where all have one height, a model fits to noise.
    leverage += (_TERMS - kept.sum()) / fitted.sum()
    growth: Array = np.where(
        fitted, 1 / np.sqrt(1 - np.minimum(leverage, _MOST_LEVERAGE)), np.sqrt(1 + leverage)
    )
    return growth


def _axes_across(views: Array) -> tuple[Array, Array]:
    """Two unit vectors, each (n, 3), at right angles to each view and to one another."""
    # No camera looks along the floor to the right.
    first = np.cross(views, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(views, first)
