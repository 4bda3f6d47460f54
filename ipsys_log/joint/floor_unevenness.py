"""Unevenness of the floor from the observations: the most likely standard deviation of its height."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from ipsys_log.arrays import Array

# Limits of the logarithm of the factor: between a sheet of glass and a meadow.
_LEAST, _MOST = -3.0, 3.0


def most_likely_scale(amplitudes: Array, covariance: Array, spread: float) -> float:
    """Return the factor on the floor's standard deviation that makes the observations most likely.

    The amplitudes have a standard normal prior. Their mean and covariance after the fit, without this prior,
    are the information in the observations. Another factor changes the prior, and thereby the probability of
    the observations (the evidence, with all other unknowns integrated out).

    Parameters
    ----------
    amplitudes : (m,), the estimated amplitudes of the floor's modes.
    covariance : (m, m), their covariance after the fit.
    spread : standard deviation of the logarithm of the factor before the fit.

    References
    ----------
    MacKay, Bayesian interpolation, Neural Computation 1992, for the evidence.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> measured = 3.0 * rng.standard_normal(400) + 0.5 * rng.standard_normal(400)
    >>> factor = most_likely_scale(measured / 1.25, 0.2 * np.eye(400), 1.0)
    >>> round(factor, 1)
    3.0
    """
    shares, axes = np.linalg.eigh(covariance)
    shares = np.clip(shares, 1e-12, 1.0)
    information = 1 / shares - 1
    pulls2 = ((axes.T @ amplitudes) / shares) ** 2

    def improbability(logarithm: float) -> float:
        variance = np.exp(2 * logarithm)
        fits = np.log1p(variance * information) - pulls2 * variance / (1 + variance * information)
        return float(fits.sum()) / 2 + (logarithm / spread) ** 2 / 2

    solved = minimize_scalar(improbability, bounds=(_LEAST, _MOST), method="bounded")
    return float(np.exp(solved.x))
