"""Standard deviations of priors from the observations: unevenness of the floor, and scale of the tape."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.parameters import Layout, State, tape_sigmas
from ipsys_log.messages import Array

# Uncertainty of the standard deviations of both scales, as that of their logarithm: the readings decide.
_SPREAD = 3.0
# Limits of the logarithm of the factor: between a sheet of glass and a meadow.
_LEAST, _MOST = -3.0, 3.0


def widen_tape(layout: Layout, state: State, covariance: Array) -> Layout:
    """Return the layout with larger standard deviations of the scales if the readings contradict them.

    The readings show that tape and reference points disagree, but not which of them is wrong. So both get the
    same factor, of at least 1: their covariance then covers the contradiction.

    The layout, the state and the covariance (g, g) of the global unknowns are those of a fit.
    """
    columns = _free(layout)
    if not len(columns):
        return layout
    sigma = layout.sigma.copy()
    units = sigma[columns]
    pulls = (state.values - layout.mean)[columns] / units
    shares = covariance[np.ix_(columns, columns)] / units[:, None] / units
    # One contradiction determines a standard deviation poorly: its most likely factor is often too small. Its
    # square is a choice for the coverage of positions with a tape that is 0.3 % too long.
    sigma[columns] *= max(1.0, most_likely_scale(pulls, shares, _SPREAD)) ** 2
    return replace(layout, sigma=sigma)


def tape_contradiction(
    layout: Layout, state: State, covariance: Array, observations: Observations
) -> tuple[float, float]:
    """Return by how much the tape reads too long for the reference points, and this in standard deviations.

    The relative length is that of the readings alone, without what is known before. Its standard deviation
    has the errors of the readings, and those of both scales.
    """
    columns = _free(layout)
    if not len(columns):
        return 0.0, 0.0
    inverse = np.linalg.inv(covariance[np.ix_(columns, columns)])
    information = inverse - np.diag(1 / layout.sigma[columns] ** 2)
    pull = inverse @ (state.values - layout.mean)[columns]
    known = tape_sigmas(observations)[columns - layout.tape.start]
    by_scales = information.sum(axis=0)
    weight = float(by_scales.sum())
    variance = float(by_scales @ (known**2 * by_scales)) + weight
    total = float(pull.sum())
    return len(columns) * total / weight, total / float(np.sqrt(variance))


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


def _free(layout: Layout) -> NDArray[np.intp]:
    """Return the columns of the scales that the fit estimates."""
    columns = np.arange(layout.tape.start, layout.tape.stop)
    return columns[layout.sigma[columns] > 0]
