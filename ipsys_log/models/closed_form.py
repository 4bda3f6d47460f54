"""Models in closed form (sect. 2.2.1, 2.2.2 of the paper): rigid transformation and polynomial regression."""

from __future__ import annotations

from typing import Any

import numpy as np
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.models.plain_models import Polynomial, Rigid


class RigidTransform(RegressorMixin, Rigid, BaseEstimator):  # type: ignore[misc]
    """A scikit-learn regressor from (n, 3) to (n, 3), in m, by :func:`rigid_transform`."""

    def fit(self, X: Any, y: Any) -> RigidTransform:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 3 or y.shape != X.shape:
            raise FitError(f"rigid maps (n, 3) to (n, 3), found {X.shape} and {y.shape}")
        return self.fit_array(X, y)

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(np.asarray(X, dtype=np.float64))

    transform = predict  # the first step of a hybrid


class PolynomialRegression(MultiOutputMixin, RegressorMixin, Polynomial, BaseEstimator):  # type: ignore[misc]
    """A scikit-learn regressor by ordinary least squares on second-order terms (eq. 13, 14)."""

    def fit(self, X: Any, y: Any) -> PolynomialRegression:
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        return self.fit_array(X, y)

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(validate_data(self, X, dtype=np.float64, reset=False))
