"""Known height: a marker lies where its ray meets the height at which it is carried."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.geometry.planes import meet_height
from ipsys_log.models.rays import Places, directions, fit_bearings

__all__ = ["RayPlane"]

Array = NDArray[np.float64]


class RayPlane(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """From (n, 4), a camera point and the marker's known height in m, to the world point (n, 3) in m.

    Only the direction (Xc / Zc, Yc / Zc) of the camera point counts.

    Attributes
    ----------
    rotation_ : (3, 3), from the frame of the camera to the world.
    origin_ : (3,), of the camera, in m.
    lens_ : (3,), see :func:`ipsys_log.models.rays.directions`.
    """

    min_pairs: ClassVar[int] = 5
    fitted: ClassVar[tuple[str, ...]] = ("rotation_", "origin_", "lens_")
    reads_height: ClassVar[bool] = True

    def fit(self, X: Any, y: Any) -> RayPlane:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 4 or y.shape != (len(X), 3):
            raise FitError(f"rayplane maps (n, 4) to (n, 3), found {X.shape} and {y.shape}")
        places = Places(X[:, :3], np.column_stack([y[:, :2], X[:, 3]]), tuple(map(str, range(len(X)))))
        return self.fit_jointly([self], [places])[0]

    @staticmethod
    def fit_jointly(models: Sequence[RayPlane], cameras: Sequence[Places]) -> list[RayPlane]:
        """Fit one model for each camera, tied together by the places that several of them saw."""
        for model, bearings in zip(models, fit_bearings(cameras), strict=True):
            model.n_features_in_ = 4
            model.rotation_, model.origin_ = bearings.rotation, bearings.origin_m
            model.lens_ = bearings.lens
        return list(models)

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(np.asarray(X, dtype=np.float64))

    def predict_array(self, X: Array) -> Array:
        rays = directions(X[:, :3], self.lens_) @ self.rotation_.T
        return meet_height(self.origin_, rays, X[:, 3])
