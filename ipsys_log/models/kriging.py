"""Kriging from camera coordinates to world coordinates (sect. 2.2.4 and 2.2.5 of the paper)."""

from __future__ import annotations

import math
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dgels, dpotrf, dpotri, dtrtrs
from scipy.optimize import minimize
from scipy.stats.qmc import Sobol
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.models.ann import column_sigmas

_EPS = float(np.finfo(np.float64).eps)
# Bounds of the logarithms of theta, for inputs of unit variance, and of the noise, relative to the variance
# of the process. Interpolation needs a range for short waves. With noise, only long waves are plausible.
_THETA = {False: (np.log(0.1), np.log(10.0)), True: (np.log(1e-3), 0.0)}
_NOISE = (np.log(1e-8), np.log(1e2))
_STARTS_LOG2 = 5
_REFINED = 2


class _Gls(NamedTuple):
    """A trend by generalised least squares (eq. 19).

    It contains ``cholesky`` of the correlations, ``trend``, the whitened ``residuals``, and the ``variance``
    of the process.
    """

    cholesky: Array
    trend: Array
    residuals: Array
    variance: float


def _terms(points: Array) -> Array:
    """Return the regressors of the linear trend (eq. 18)."""
    return np.hstack([np.ones((len(points), 1)), points])


def _independent(terms: Array) -> Array:
    """Return an orthonormal basis of the columns of terms (n, k)."""
    basis, sizes, _ = np.linalg.svd(terms, full_matrices=False)
    independent: Array = basis[:, sizes > len(terms) * _EPS * sizes[0]]
    return independent


def _squared_gaps(points: Array, isotropic: bool) -> Array:
    """Return squared distances (k, n, n): along each axis, or their sum (k = 1)."""
    gaps = np.moveaxis((points[:, None] - points[None]) ** 2, -1, 0)
    return np.ascontiguousarray(gaps.sum(axis=0, keepdims=True) if isotropic else gaps)


def _correlations(logs: Array, gaps: Array) -> tuple[Array, Array]:
    """Return Gaussian correlations (n, n) of eq. (16), without and with noise on the diagonal (eq. 23).

    A tiny constant on the diagonal keeps the matrix regular for nearly equal points, as in DACE.
    """
    count = gaps.shape[1]
    smooth = np.exp(-np.exp(logs[: len(gaps)]) @ gaps.reshape(len(gaps), -1)).reshape(count, count)
    noise = float(np.exp(logs[len(gaps)])) if len(logs) > len(gaps) else 0.0
    noisy = smooth.copy()
    noisy.reshape(-1)[:: count + 1] += noise + (10 + count) * _EPS
    return smooth, noisy


def _gls(correlations: Array, terms: Array, targets: Array) -> _Gls | None:
    # The code calls LAPACK directly. For a few dozen points, the checks of scipy.linalg would take most of
    # the time.
    lower, failed = dpotrf(correlations, lower=1)
    if failed:
        return None
    white, _ = dtrtrs(lower, np.column_stack([terms, targets]), lower=1)
    trend = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
    residuals = white[:, -1] - white[:, :-1] @ trend
    variance = max(float(np.mean(residuals**2)), (10 * _EPS) ** 2)
    return _Gls(lower, np.asarray(trend, dtype=np.float64), residuals, variance)


def _deviances(logs: Array, gaps: Array, terms: Array, targets: Array) -> Array:
    """Return the deviances (k,) of targets (n, k) with the same correlations; infinite if these fail.

    A deviance is -2 log likelihood, without a constant, for the most likely variance (DACE).
    """
    lower, failed = dpotrf(_correlations(logs, gaps)[1], lower=1)
    if failed:
        return np.full(targets.shape[1], np.inf)
    residuals = _residuals(lower, terms, targets)
    variances = np.maximum((residuals**2).mean(axis=0), (10 * _EPS) ** 2)
    return np.asarray(len(lower) * np.log(variances) + 2 * np.log(np.diagonal(lower)).sum())


def _residuals(lower: Array, terms: Array, targets: Array) -> Array:
    """Return the whitened residuals of targets (n, k) about their trend; the terms must be independent."""
    white, _ = dtrtrs(lower, np.hstack([terms, targets]), lower=1)
    trends, values = white[:, : terms.shape[1]], white[:, terms.shape[1] :]
    solved = dgels(trends, values)[1]
    residuals: Array = values - trends @ solved[: terms.shape[1]]
    return residuals


def _deviance(logs: Array, gaps: Array, terms: Array, targets: Array) -> tuple[float, Array]:
    """Return the deviance of targets (n, 1) and its gradient by the logarithms of theta and the noise."""
    smooth, noisy = _correlations(logs, gaps)
    lower, failed = dpotrf(noisy, lower=1)
    if failed:
        return 1e25, np.zeros_like(logs)
    residuals = _residuals(lower, terms, targets)
    variance = max(float(np.vdot(residuals, residuals)) / len(lower), (10 * _EPS) ** 2)
    deviance = len(lower) * math.log(variance) + 2 * float(np.log(np.diagonal(lower)).sum())
    half, _ = dpotri(lower, lower=1)  # the lower triangle of the inverse; zeros above
    weights = dtrtrs(lower, residuals, lower=1, trans=1)[0][:, 0]
    # A gap on the diagonal is zero, so twice the lower triangle stands for the whole matrix.
    slope = smooth * (2 * half.T - weights[:, None] * (weights / variance))
    by_theta = -np.exp(logs[: len(gaps)]) * (gaps.reshape(len(gaps), -1) @ slope.reshape(-1))
    if len(logs) == len(gaps):
        return deviance, by_theta
    trace = float(np.trace(half)) - float(weights @ weights) / variance
    return deviance, np.append(by_theta, math.exp(logs[-1]) * trace)


def fit_correlations(points: Array, targets: Array, noisy: bool) -> Array:
    """Return the logarithms of the correlation parameters with the maximum likelihood of the targets.

    Parameters
    ----------
    points : (n, d), of unit variance.
    targets : (n, k), of unit variance.
    noisy : True if the targets have noise. Its variance is then estimated too.

    Returns
    -------
    Without noise (k, 1): log theta, the same in all directions. With noise (k, d + 1): log theta by axis, and
    the logarithm of the noise relative to the variance of the process.

    References
    ----------
    Ou et al., Robotica 2023, below eq. (16) and (24). The concentrated likelihood is that of DACE (Lophaven
    et al. 2002, eq. 2.23). Cross-validation on the authors' pairs determines if theta is isotropic.
    """
    gaps, terms = _squared_gaps(points, not noisy), _independent(_terms(points))
    bounds = [_THETA[noisy]] * len(gaps) + [_NOISE] * noisy
    low, high = np.array(bounds).T
    starts = low + (high - low) * Sobol(len(bounds), scramble=False).random_base2(_STARTS_LOG2)
    costs = np.array([_deviances(start, gaps, terms, targets) for start in starts])
    best = []
    for own, column in zip(costs.T, targets.T, strict=True):
        optima = [
            minimize(
                _deviance,
                starts[i],
                (gaps, terms, column[:, None]),
                jac=True,
                bounds=bounds,
                method="L-BFGS-B",
            )
            for i in np.argsort(own, kind="stable")[:_REFINED]
        ]
        best.append(min(optima, key=lambda result: float(result.fun)).x)
    return np.array(best)


class Kriging(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Kriging with a linear trend and Gaussian correlation, as in DACE.

    Parameters
    ----------
    noisy : False for interpolation (eq. 15-21), True for regression (eq. 22-24). Regression also estimates
        the noise 10^epsilon of the targets, by maximum likelihood.

    Attributes
    ----------
    points_ : (n, d), the inputs, centred by ``centre_`` (d,) and divided by ``scale_`` (d,).
    target_centre_, target_scale_ : (outputs,), mean and standard deviation of the targets.
    logs_ : (outputs, 1) or (outputs, d + 1), see :func:`fit_correlations`.
    trend_ : (outputs, d + 1), coefficients of eq. (19), for the scaled inputs and outputs.
    weights_ : (outputs, n), weights of the correlations in eq. (17) and (23).
    variance_ : (outputs,), variance of the process, scaled.

    Examples
    --------
    >>> x = np.linspace(0, 1, 8)[:, None]
    >>> model = Kriging().fit(x, np.sin(5 * x[:, 0]))
    >>> bool(abs(model.predict(x) - np.sin(5 * x[:, 0])).max() < 1e-6)
    True
    """

    fitted: ClassVar[tuple[str, ...]] = (
        "points_",
        "centre_",
        "scale_",
        "target_centre_",
        "target_scale_",
        "logs_",
        "trend_",
        "weights_",
        "variance_",
    )

    def __init__(self, noisy: bool = False) -> None:
        self.noisy = noisy

    def fit(self, X: Any, y: Any) -> Kriging:
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        if len(X) < X.shape[1] + 3:  # the trend, and two more: without additional pairs, the variance is zero
            raise FitError(
                f"kriging needs at least {X.shape[1] + 3} pairs (samples), found {len(X)} sample"
                f"{'s' if len(X) > 1 else ''}; measure more points"
            )
        targets = y.reshape(len(y), -1)
        self._single = y.ndim == 1
        self.centre_, self.scale_ = X.mean(axis=0), column_sigmas(X)
        self.target_centre_, self.target_scale_ = targets.mean(axis=0), column_sigmas(targets)
        self.points_ = (X - self.centre_) / self.scale_
        scaled = (targets - self.target_centre_) / self.target_scale_
        self.logs_ = fit_correlations(self.points_, scaled, self.noisy)
        solved = [self._solve(logs, column) for logs, column in zip(self.logs_, scaled.T, strict=True)]
        self.trend_ = np.array([gls.trend for gls in solved])
        self.weights_ = np.array(
            [solve_triangular(gls.cholesky, gls.residuals, lower=True, trans=1) for gls in solved]
        )
        self.variance_ = np.array([gls.variance for gls in solved])
        return self

    def _solve(self, logs: Array, targets: Array) -> _Gls:
        gaps, terms = _squared_gaps(self.points_, not self.noisy), _terms(self.points_)
        gls = _gls(_correlations(logs, gaps)[1], terms, targets)
        if gls is None:
            raise ArithmeticError("the most likely correlations have no Cholesky factor")  # a bug
        return gls

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Return predictions (n, outputs) of eq. (17), (23); with ``return_std`` also standard deviations.

        For kriging regression, they are the standard deviations of the function, without the noise of a
        measurement.
        """
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        points = (X - self.centre_) / self.scale_
        near = [self._near(logs, points) for logs in self.logs_]
        terms = _terms(points)
        scaled = [
            terms @ trend + r @ weights
            for trend, r, weights in zip(self.trend_, near, self.weights_, strict=True)
        ]
        mean = self._shaped(np.array(scaled).T * self.target_scale_ + self.target_centre_)
        if not return_std:
            return mean
        variances = [self._variance(k, terms, r) for k, r in enumerate(near)]
        return mean, self._shaped(np.sqrt(np.array(variances)).T * self.target_scale_)

    def _near(self, logs: Array, points: Array) -> Array:
        """Return correlations (n, m) of points with the points of the fit, eq. (20)."""
        theta = np.exp(logs[: points.shape[1]] if self.noisy else logs)
        gaps = (points[:, None] - self.points_[None]) ** 2
        near: Array = np.exp(-(gaps * theta).sum(axis=-1))
        return near

    def _variance(self, output: int, terms: Array, near: Array) -> Array:
        """Return the variance of eq. (21) for a linear trend.

        s2 = sigma2 (1 + u' (F' R^-1 F)^-1 u - r' R^-1 r), u = F' R^-1 r - f. The printed equation is valid
        only for a constant trend. This equation is that of DACE (Lophaven et al. 2002, eq. 2.19).
        """
        gaps, fitted = _squared_gaps(self.points_, not self.noisy), _terms(self.points_)
        lower = cholesky(_correlations(self.logs_[output], gaps)[1], lower=True)
        white = solve_triangular(lower, near.T, lower=True)
        basis = solve_triangular(lower, fitted, lower=True)
        u = basis.T @ white - terms.T
        from_trend = np.einsum("in,ij,jn->n", u, np.linalg.pinv(basis.T @ basis), u)
        share: Array = np.maximum(1 + from_trend - (white**2).sum(axis=0), 0.0)
        return share * float(self.variance_[output])

    def _shaped(self, values: Array) -> Array:
        return values[:, 0] if getattr(self, "_single", False) else values
