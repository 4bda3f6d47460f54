"""Models in closed form (sect. 2.2.1, 2.2.2 of the paper): rigid transformation and polynomial regression."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.models.plain_models import Polynomial, Rigid, regressors, rigid_transform


class RigidTransform(RegressorMixin, Rigid, BaseEstimator):  # type: ignore[misc]
    """A scikit-learn regressor from (n, 3) to (n, 3), in m, by :func:`rigid_transform`."""

    def fit(self, X: Any, y: Any) -> RigidTransform:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 3 or y.shape != X.shape:
            raise FitError(f"rigid maps (n, 3) to (n, 3), found {X.shape} and {y.shape}")
        self.rotation_, self.translation_ = rigid_transform(X, y)
        return self

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(np.asarray(X, dtype=np.float64))

    transform = predict  # the first step of a hybrid


class PolynomialRegression(MultiOutputMixin, RegressorMixin, Polynomial, BaseEstimator):  # type: ignore[misc]
    """Ordinary least squares on second-order terms (eq. 13, 14).

    The fit centres and scales the inputs, and solves the problem by singular values, not by the normal
    equations of eq. (14). The fitted function is the same, but the precision is better, because Zc^2 is
    nearly constant on a floor.
    """

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
