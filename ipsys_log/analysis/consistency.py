"""What error of a prediction is usual, where and in which direction: the unit that suspects are told by."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi, norm

from ipsys_log.models.poly import regressors

__all__ = ["FEWEST_POINTS", "score", "usual_covariances"]

Array = NDArray[np.float64]

# Of fewer places of a camera nobody can say what is usual: with ten terms to fit, each alone bends the model.
FEWEST_POINTS = 15
# The median of |x| and of the length of (x, y, z), all normal with a sigma of 1.
_MEDIAN_1D = float(norm.ppf(0.75))
_MEDIAN_3D = float(chi.median(3))
# Cameras look down on the middle of the places that they see, from about here; 1.5 m or 5 m would do nearly
# as well, since it only turns the axes of the yardstick and stretches the powers below.
_EYE_M = 2.0
_NEAREST_M = 0.5
# Depths get worse to the rim of an image as a power of 1 + u^2 + v^2: none, or the first in theory, with a
# standard deviation of 1; a model that does not bend enough adds to it.
_EXPONENTS = np.arange(0.0, 4.01, 0.25)
_EXPECTED = 0.5
# Fifty places tell the power no better than by this: the rim has the benefit of the doubt.
_DOUBT = 0.5
_FREEDOM = 4
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
    """For each place of a camera the covariance of a usual leave-one-out error, but for a bad tape's.

    Depths are known worse than directions, the more so to the rim of an image, so an error along the
    view is told from one across it; a model knows less at the rim of the places than amid them, by the
    leverage that second-order terms have there. The rest is one scale for each direction, from medians,
    so that gross errors do not count.

    Parameters
    ----------
    predicted_m : (n, 3), where models fitted without a place see it.
    residuals_m : (n, 3), predicted minus measured.
    fitted : (n,), whether the other models rest on a place. At least :data:`FEWEST_POINTS` are.
    tape_m2 : (n, 3, 3), covariances of the measured points, 0 where not known.

    Returns
    -------
    (n, 3, 3), in m^2, without ``tape_m2``. With it the median of :func:`score` over the fitted places is
    1 or, where the tape's error is much of it, a little less; much less for few places, which say little
    of what is usual.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> places_m = rng.uniform([0.0, 0.0, 0.0], [4.0, 4.0, 0.2], (200, 3))
    >>> errors_m = rng.normal(0.0, 0.01, (200, 3))
    >>> usual_m2 = usual_covariances(places_m, errors_m, np.ones(200, bool), np.zeros((200, 3, 3)))
    >>> usual_m2.shape, np.sqrt(usual_m2[0].diagonal()).round(2).tolist()
    ((200, 3, 3), [0.01, 0.01, 0.01])
    """
    leverage, free = _growth(predicted_m, fitted)
    views = predicted_m - [*np.median(predicted_m[:, :2], axis=0), _EYE_M]
    views[:, 2] = np.minimum(views[:, 2], -_NEAREST_M)
    slant = (views**2).sum(axis=1) / views[:, 2] ** 2
    views /= np.linalg.norm(views, axis=1)[:, None]
    scaled = residuals_m / leverage[:, None]
    along = (scaled * views).sum(axis=1)
    across = np.stack([(scaled * axes).sum(axis=1) for axes in _axes_across(views)])
    depth = slant ** (_exponent(along[fitted], slant[fitted]) + _DOUBT)
    along_m = _sigma(along[fitted] / depth[fitted]) * depth
    across_m = np.maximum(np.maximum(_sigma(across[:, fitted]), _LEAST_ACROSS * along_m), _FINEST_M)
    along_m = np.maximum(along_m, across_m)
    outer = views[:, :, None] * views[:, None, :]
    shape = (across_m**2)[:, None, None] * np.eye(3) + (along_m**2 - across_m**2)[:, None, None] * outer
    shape *= leverage[:, None, None] ** 2
    few = 1 + _FEW / max(free, 1) ** 2
    # The scatter holds the error of a usual tape, and keeps it: that of a bad one comes on top.
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


def _sigma(errors: Array) -> float:
    return float(np.median(np.abs(errors))) / _MEDIAN_1D


def _exponent(along: Array, slant: Array) -> float:
    """The power of 1 + u^2 + v^2 by which errors along the view, (n,), grow to the rim.

    The likeliest one, by Student's distribution, in which no gross error has much of a say; few places
    say little, so it is looked for around what is to be expected.
    """
    unlikely = []
    for exponent in _EXPONENTS:
        scales = slant**exponent
        sigma = max(_sigma(along / scales), _FINEST_M)
        off = (along / (sigma * scales)) ** 2
        unlikely.append(
            float(np.log(sigma * scales).sum() + (_FREEDOM + 1) / 2 * np.log1p(off / _FREEDOM).sum())
            + (exponent - _EXPECTED) ** 2 / 2
        )
    return float(_EXPONENTS[int(np.argmin(unlikely))])


def _growth(predicted_m: Array, fitted: NDArray[np.bool_]) -> tuple[Array, int]:
    """How much greater the error of a place left out is than that of its camera point, (n,); and how
    many places are left over when each term has had its own."""
    centred = predicted_m - predicted_m[fitted].mean(axis=0)
    terms = regressors(centred / np.maximum(np.abs(centred[fitted]).max(axis=0), _LEAST_SPREAD_M))
    _, sizes, axes = np.linalg.svd(terms[fitted], full_matrices=False)
    kept = sizes > 1e-6 * sizes[0]
    leverage = ((terms @ axes[kept].T / sizes[kept]) ** 2).sum(axis=1)
    # Terms that the places do not determine, as where all have one height, are fitted to noise: they
    # make a model less sure everywhere, and count three times.
    undetermined = int(_TERMS - kept.sum())
    leverage += undetermined / fitted.sum()
    growth: Array = np.where(
        fitted, 1 / np.sqrt(1 - np.minimum(leverage, _MOST_LEVERAGE)), np.sqrt(1 + leverage)
    )
    return growth, int(fitted.sum()) - _TERMS - 2 * undetermined


def _axes_across(views: Array) -> tuple[Array, Array]:
    """Two unit vectors, each (n, 3), at right angles to each view and to one another."""
    # No camera looks along the floor to the right.
    first = np.cross(views, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(views, first)
