"""Usual errors of predictions by position and direction: the unit for the detection of outliers."""

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array

# With fewer calibration points of a camera, the usual error is unknown: the fit has ten terms, so each point
# alone bends the model.
FEWEST_POINTS = 15
# Medians of |x| and of the length of (x, y, z), if x, y and z are normal with a sigma of 1.
# They are norm.ppf(0.75) and chi.median(3) of scipy.stats, whose import takes 1 s.
_MEDIAN_1D = 0.6744897501960817
_MEDIAN_3D = 1.5381722544550522
# Assumed height of a camera above the middle of its calibration points. Results for 1.5 m or 5 m are nearly
# the same, because the height only rotates the axes of the usual errors and scales the powers below.
_EYE_M = 2.0
_NEAREST_M = 0.5
# Depth errors grow towards the rim of an image by a power of 1 + u^2 + v^2. In theory, the power is 0 or 1;
# its prior has a standard deviation of 1. A model that does not bend enough increases the power.
_EXPONENTS = np.arange(0.0, 4.01, 0.25)
_EXPECTED = 0.5
# Uncertainty of the power from fifty calibration points. The code adds it, in favour of points at the rim.
_DOUBT = 0.5
_FREEDOM = 4
# Least ratio of the error across the view to the error along the view.
_LEAST_ACROSS = 0.3
# Best accuracy of a manual measurement. It prevents usual errors as small as rounding errors.
_FINEST_M = 0.001
# Number of terms of the polynomial, and upper limit of the leverage of a calibration point.
_TERMS = 10
_MOST_LEVERAGE = 0.9
# An empirical value: with few additional calibration points, leave-one-out errors scatter more than their
# leverage predicts.
_FEW = 50.0
_LEAST_SPREAD_M = 0.02


def usual_covariances(
    predicted_m: Array, residuals_m: Array, fitted: NDArray[np.bool_], tape_m2: Array
) -> Array:
    """Return the covariance of a usual leave-one-out error for each calibration point of a camera.

    It does not contain the error of a bad tape. Depths are less accurate than directions, in particular at
    the rim of an image. The covariance therefore distinguishes errors along and across the view. A model is
    less accurate at the rim of the calibration points, by the leverage of second-order terms. Each direction
    has one scale, from medians, so gross errors have no effect.

    Parameters
    ----------
    predicted_m : (n, 3), predictions for each point by models fitted without this point.
    residuals_m : (n, 3), predicted minus measured.
    fitted : (n,), True if the other models use the point. At least :data:`FEWEST_POINTS` points are True.
    tape_m2 : (n, 3, 3), covariances of the measured points, 0 if unknown.

    Returns
    -------
    (n, 3, 3), in m^2, without ``tape_m2``. With ``tape_m2``, the median of :func:`score` over the fitted
    points is 1, or slightly less if the tape's error is large. It is much less for few points, because they
    do not determine the usual error well.

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
    # The scatter contains the error of a usual tape. The error of a bad tape is additional.
    median = float(np.median(score(residuals_m[fitted], shape[fitted] + tape_m2[fitted])))
    covariances: Array = (few * median) ** 2 * shape + _FINEST_M**2 * np.eye(3)
    return covariances


def score(residuals_m: Array, covariances_m2: Array) -> Array:
    """Return the lengths (n,) of residuals (n, 3) in units of the usual error with covariance (n, 3, 3).

    Examples
    --------
    >>> score(np.array([[0.0, 0.0, 0.0154]]), 0.01**2 * np.eye(3)[None]).round(2).tolist()
    [1.0]
    """
    weighted = np.linalg.solve(covariances_m2, residuals_m[:, :, None])[:, :, 0]
    lengths: Array = np.sqrt((residuals_m * weighted).sum(axis=1)) / _MEDIAN_3D
    return lengths


def _sigma(errors: Array) -> float:
    return float(np.median(np.abs(errors))) / _MEDIAN_1D


def _exponent(along: Array, slant: Array) -> float:
    """Return the power of 1 + u^2 + v^2 by which errors along the view, (n,), grow towards the rim.

    It is the most likely power by Student's distribution, which limits the effect of gross errors. A prior
    around the expected power stabilizes the result for few calibration points.
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
    """Return the factors (n,) from errors of camera points to errors of held-out points, and the redundancy.

    The redundancy is the number of fitted points minus the number of terms.
    """
    from ipsys_log.models.plain_models import regressors

    centred = predicted_m - predicted_m[fitted].mean(axis=0)
    terms = regressors(centred / np.maximum(np.abs(centred[fitted]).max(axis=0), _LEAST_SPREAD_M))
    _, sizes, axes = np.linalg.svd(terms[fitted], full_matrices=False)
    kept = sizes > 1e-6 * sizes[0]
    leverage = ((terms @ axes[kept].T / sizes[kept]) ** 2).sum(axis=1)
    # Some terms are not determined, for example if all calibration points have the same height. The fit of
    # such terms depends on noise. They make a model less accurate everywhere, and count three times.
    undetermined = int(_TERMS - kept.sum())
    leverage += undetermined / fitted.sum()
    growth: Array = np.where(
        fitted, 1 / np.sqrt(1 - np.minimum(leverage, _MOST_LEVERAGE)), np.sqrt(1 + leverage)
    )
    return growth, int(fitted.sum()) - _TERMS - 2 * undetermined


def _axes_across(views: Array) -> tuple[Array, Array]:
    """Return two unit vectors, (n, 3) each, perpendicular to each view and to each other."""
    # No camera looks to the right, parallel to the floor, so the cross product is never zero.
    first = np.cross(views, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first, axis=1)[:, None]
    return first, np.cross(views, first)
