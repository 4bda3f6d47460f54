"""Kriging from the frame of a camera to the world (sect. 2.2.4 and 2.2.5 of the paper)."""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri, dtrtrs
from scipy.optimize import minimize
from scipy.stats.qmc import Sobol
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.models.ann import spread

__all__ = ["Kriging", "most_likely"]

Array = NDArray[np.float64]

_EPS = float(np.finfo(np.float64).eps)
# Logarithms of theta, for inputs of unit variance, and of the noise, relative to the process's variance.
# Interpolation needs room for short waves; with noise, only long ones are believed.
_THETA = {False: (np.log(0.1), np.log(10.0)), True: (np.log(1e-3), 0.0)}
_NOISE = (np.log(1e-8), np.log(1e2))
_STARTS_LOG2 = 5
_REFINED = 2


class _Gls(NamedTuple):
    """Trend by generalised least squares: ``cholesky`` of the correlations, ``trend``, the whitened
    ``residuals``, and the ``variance`` of the process (eq. 19)."""

    cholesky: Array
    trend: Array
    residuals: Array
    variance: float

    def deviance(self) -> float:
        """-2 log likelihood, apart from a constant, with the variance at its best (DACE)."""
        log_det = 2 * np.log(np.diagonal(self.cholesky)).sum()
        return float(len(self.cholesky) * np.log(self.variance) + log_det)


def _terms(points: Array) -> Array:
    """The linear trend's regressors (eq. 18)."""
    return np.hstack([np.ones((len(points), 1)), points])


def _squared_gaps(points: Array, isotropic: bool) -> Array:
    """Squared distances (k, n, n): along each axis, or their sum (k = 1)."""
    gaps = np.moveaxis((points[:, None] - points[None]) ** 2, -1, 0)
    return np.ascontiguousarray(gaps.sum(axis=0, keepdims=True) if isotropic else gaps)


def _correlations(logs: Array, gaps: Array) -> tuple[Array, Array]:
    """Gaussian correlations (n, n) of eq. (16), without and with the noise on the diagonal (eq. 23).

    The trace that is always there keeps close places apart, as in DACE.
    """
    smooth = np.exp(-np.tensordot(np.exp(logs[: len(gaps)]), gaps, axes=1))
    noise = float(np.exp(logs[len(gaps)])) if len(logs) > len(gaps) else 0.0
    count = len(smooth)
    return smooth, smooth + (noise + (10 + count) * _EPS) * np.eye(count)


def _gls(correlations: Array, terms: Array, targets: Array) -> _Gls | None:
    # LAPACK itself: for some dozens of places scipy.linalg's checks would take most of the time.
    lower, failed = dpotrf(correlations, lower=1)
    if failed:
        return None
    white, _ = dtrtrs(lower, np.column_stack([terms, targets]), lower=1)
    trend = np.linalg.lstsq(white[:, :-1], white[:, -1], rcond=None)[0]
    residuals = white[:, -1] - white[:, :-1] @ trend
    variance = max(float(np.mean(residuals**2)), (10 * _EPS) ** 2)
    return _Gls(lower, np.asarray(trend, dtype=np.float64), residuals, variance)


def _deviance(logs: Array, gaps: Array, terms: Array, targets: Array) -> tuple[float, Array]:
    """Deviance and its gradient by the logarithms of theta and the noise."""
    smooth, noisy = _correlations(logs, gaps)
    fitted = _gls(noisy, terms, targets)
    if fitted is None:
        return 1e25, np.zeros_like(logs)
    half, _ = dpotri(fitted.cholesky, lower=1)  # the lower triangle of the inverse
    weights, _ = dtrtrs(fitted.cholesky, fitted.residuals, lower=1, trans=1)
    slope = half + np.tril(half, -1).T - np.outer(weights, weights) / fitted.variance
    by_theta = -np.exp(logs[: len(gaps)]) * np.tensordot(gaps, slope * smooth, axes=2)
    by_noise = [np.exp(logs[-1]) * np.trace(slope)] if len(logs) > len(gaps) else []
    return fitted.deviance(), np.append(by_theta, by_noise)


def most_likely(points: Array, targets: Array, noisy: bool) -> Array:
    """Logarithms of the correlation's parameters that make the targets most likely.

    Parameters
    ----------
    points : (n, d), of unit variance.
    targets : (n,), of unit variance.
    noisy : whether the targets have noise, whose variance is then found as well.

    Returns
    -------
    Without noise (1,): log theta, the same in all directions. With noise (d + 1,): log theta by axis, and the
    logarithm of the noise relative to the variance of the process.

    References
    ----------
    Ou et al., Robotica 2023, below eq. (16) and (24); the concentrated likelihood is that of DACE (Lophaven
    et al. 2002, eq. 2.23). Theta is isotropic or not as cross-validation on the authors' pairs says.
    """
    gaps, terms = _squared_gaps(points, not noisy), _terms(points)
    bounds = [_THETA[noisy]] * len(gaps) + [_NOISE] * noisy
    low, high = np.array(bounds).T
    starts = low + (high - low) * Sobol(len(bounds), scramble=False).random_base2(_STARTS_LOG2)
    costs = []
    for start in starts:
        fitted = _gls(_correlations(start, gaps)[1], terms, targets)
        costs.append(np.inf if fitted is None else fitted.deviance())
    found = [
        minimize(_deviance, starts[i], (gaps, terms, targets), jac=True, bounds=bounds, method="L-BFGS-B")
        for i in np.argsort(costs, kind="stable")[:_REFINED]
    ]
    best: Array = min(found, key=lambda result: float(result.fun)).x
    return best


class Kriging(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Kriging with a linear trend and Gaussian correlation, as DACE has it.

    Parameters
    ----------
    noisy : False for interpolation (eq. 15-21), True for regression (eq. 22-24): the noise 10^epsilon of the
        targets is then found with the rest, by likelihood.

    Attributes
    ----------
    points_ : (n, d), the inputs, centred by ``centre_`` (d,) and divided by ``scale_`` (d,).
    target_centre_, target_scale_ : (outputs,)
    logs_ : (outputs, 1) or (outputs, d + 1), see :func:`most_likely`.
    trend_ : (outputs, d + 1), of eq. (19), for the scaled inputs and outputs.
    weights_ : (outputs, n), of the correlations in eq. (17) and (23).
    variance_ : (outputs,), of the process, scaled.

    Examples
    --------
    >>> x = np.linspace(0, 1, 8)[:, None]
    >>> model = Kriging().fit(x, np.sin(5 * x[:, 0]))
    >>> bool(abs(model.predict(x) - np.sin(5 * x[:, 0])).max() < 1e-6)
    True
    """

    min_pairs: ClassVar[int] = 6
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
        if len(X) < X.shape[1] + 3:  # the trend, and two more: with none over, the variance is zero
            raise FitError(
                f"kriging needs at least {X.shape[1] + 3} pairs (samples), found {len(X)} sample"
                f"{'s' if len(X) > 1 else ''}; measure more places"
            )
        targets = y.reshape(len(y), -1)
        self._single = y.ndim == 1
        self.centre_, self.scale_ = X.mean(axis=0), spread(X)
        self.target_centre_, self.target_scale_ = targets.mean(axis=0), spread(targets)
        self.points_ = (X - self.centre_) / self.scale_
        scaled = (targets - self.target_centre_) / self.target_scale_
        self.logs_ = np.array([most_likely(self.points_, column, self.noisy) for column in scaled.T])
        solved = [self._solve(logs, column) for logs, column in zip(self.logs_, scaled.T, strict=True)]
        self.trend_ = np.array([found.trend for found in solved])
        self.weights_ = np.array(
            [solve_triangular(found.cholesky, found.residuals, lower=True, trans=1) for found in solved]
        )
        self.variance_ = np.array([found.variance for found in solved])
        return self

    def _solve(self, logs: Array, targets: Array) -> _Gls:
        gaps, terms = _squared_gaps(self.points_, not self.noisy), _terms(self.points_)
        found = _gls(_correlations(logs, gaps)[1], terms, targets)
        if found is None:
            raise ArithmeticError("the most likely correlations have no Cholesky factor")  # a bug
        return found

    def predict(self, X: Any, return_std: bool = False) -> Any:
        """Eq. (17), (23), (n, outputs); with ``return_std`` also the predictor's standard deviations.

        Of kriging regression they are those of the function, without the noise of a measurement.
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
        """Correlations (n, m) of points with those fitted on, eq. (20)."""
        theta = np.exp(logs[: points.shape[1]] if self.noisy else logs)
        gaps = (points[:, None] - self.points_[None]) ** 2
        near: Array = np.exp(-(gaps * theta).sum(axis=-1))
        return near

    def _variance(self, output: int, terms: Array, near: Array) -> Array:
        """Eq. (21) for a linear trend: s2 = sigma2 (1 + u' (F' R^-1 F)^-1 u - r' R^-1 r), u = F' R^-1 r - f.

        As printed it holds for a constant trend only; this is DACE's (Lophaven et al. 2002, eq. 2.19).
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
