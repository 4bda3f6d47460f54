"""Polynomial regression from camera coordinates to world coordinates (sect. 2.2.2 of the paper)."""

from __future__ import annotations

from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.messages.arrays import Array


def regressors(points: Array) -> Array:
    """Return constant, linear and second-order terms of each row: ten terms for three columns.

    Parameters
    ----------
    points : (n, d)

    Returns
    -------
    (n, 1 + d + d (d + 1) / 2): 1, x, y, z, xx, xy, xz, yy, yz, zz for d = 3.

    References
    ----------
    Ou et al., Robotica 2023, below eq. (13).

    Examples
    --------
    >>> regressors(np.array([[2.0, 3.0, 5.0]]))[0].tolist()
    [1.0, 2.0, 3.0, 5.0, 4.0, 6.0, 10.0, 9.0, 15.0, 25.0]
    """
    first, second = _factors(points.shape[1])
    count, columns = points.shape
    terms: Array = np.ones((count, 1 + columns + len(first)))
    terms[:, 1 : 1 + columns] = points
    np.multiply(points[:, first], points[:, second], out=terms[:, 1 + columns :])
    return terms


@cache
def _factors(columns: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the columns of both factors of the second-order terms."""
    first, second = np.triu_indices(columns)
    return first, second


class PolynomialRegression(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """Ordinary least squares on second-order terms (eq. 13, 14).

    The fit centres and scales the inputs, and solves the problem by singular values, not by the normal
    equations of eq. (14). The fitted function is the same, but the precision is better, because Zc^2 is
    nearly constant on a floor.

    Attributes
    ----------
    centre_, scale_ : (d,), mean and largest absolute deviation of the inputs.
    coefficients_ : (terms, outputs), for the centred and scaled inputs.
    """

    fitted: ClassVar[tuple[str, ...]] = ("centre_", "scale_", "coefficients_")

    def fit(self, X: Any, y: Any) -> PolynomialRegression:
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        self.centre_ = X.mean(axis=0)
        spread = np.abs(X - self.centre_).max(axis=0)
        self.scale_ = np.where(spread > 0, spread, 1.0)
        terms = regressors((X - self.centre_) / self.scale_)
        self.coefficients_ = np.linalg.lstsq(terms, y, rcond=None)[0]
        return self

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(validate_data(self, X, dtype=np.float64, reset=False))

    def predict_array(self, X: Array) -> Array:
        prediction: Array = regressors((X - self.centre_) / self.scale_) @ self.coefficients_
        return prediction
