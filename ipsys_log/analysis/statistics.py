"""Figures for how far positions are off."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import ErrorStatistics

__all__ = ["error_statistics", "root_mean_square_m"]

_RESAMPLES = 2000


def error_statistics(errors_m: NDArray[np.float64], independent: bool = True) -> ErrorStatistics:
    """Mean, bounds, percentiles and standard deviation of distances, and how certain their mean is.

    Parameters
    ----------
    errors_m : (n,) or (repeats, n), n > 0, in m: distances at n places.
    independent : whether one place says nothing of the next, as the instants of a track do: otherwise there
        is no interval.

    Returns
    -------
    ErrorStatistics : of all distances; ``count`` is the number of places. The 95 % confidence interval
        of the mean is a percentile bootstrap over the places, which are independent as repeats at one
        place are not; always the same for the same errors.

    References
    ----------
    Ou et al., Robotica 2023, Tables I and II; the standard deviation there has n - 1. Efron and
    Tibshirani, An Introduction to the Bootstrap, 1993, ch. 13.

    Examples
    --------
    >>> found = error_statistics(np.array([0.01, 0.03]))
    >>> found.mean_m, found.median_m, found.max_m
    (0.02, 0.02, 0.03)
    """
    places_m = np.atleast_2d(errors_m).mean(axis=0)
    count = len(places_m)
    errors_m = errors_m.reshape(-1)
    median_m, p95_m = np.percentile(errors_m, [50, 95]).tolist()
    std_m = float(errors_m.std(ddof=1)) if errors_m.size > 1 else None
    low_m = high_m = None
    if count > 1 and independent:
        drawn = np.random.default_rng(0).integers(count, size=(_RESAMPLES, count))
        low_m, high_m = np.percentile(places_m[drawn].mean(axis=1), [2.5, 97.5]).tolist()
    return ErrorStatistics(
        count,
        float(errors_m.mean()),
        float(errors_m.min()),
        float(errors_m.max()),
        std_m,
        median_m,
        p95_m,
        low_m,
        high_m,
    )


def root_mean_square_m(errors: ErrorStatistics, repeats: int = 1) -> float:
    """Return the root-mean-square error (RMSE) in m, exactly, from the mean and the standard deviation.

    Parameters
    ----------
    errors : of n places.
    repeats : number of errors of each point; the standard deviation is that of all of them.

    Examples
    --------
    >>> root_mean_square_m(error_statistics(np.array([0.01, 0.07])))
    0.05
    """
    samples = errors.count * repeats
    variance_m2 = 0.0 if errors.std_m is None else errors.std_m**2 * (samples - 1) / samples
    return float(np.sqrt(errors.mean_m**2 + variance_m2))
