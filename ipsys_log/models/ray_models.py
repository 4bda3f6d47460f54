"""Models on rays: ``RayDepth`` corrects the depth, ``RayPlane`` uses the known height of a marker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages.arrays import Array
from ipsys_log.models.depths import LEAST_NOISE, depth_terms, fit_depths
from ipsys_log.models.rays import CalibrationPoints, CameraRays, directions, fit_rays
from ipsys_log.vision.lenses import intersect_height


class RayPlane(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A model from camera points and known marker heights, (n, 4) in m, to world points (n, 3) in m.

    It uses only the direction (Xc / Zc, Yc / Zc) of the camera point.

    Attributes
    ----------
    rotation_ : (3, 3), from camera coordinates to world coordinates.
    origin_ : (3,), position of the camera, in m.
    lens_ : (3,), see :func:`ipsys_log.models.rays.directions`.
    """

    fitted: ClassVar[tuple[str, ...]] = ("rotation_", "origin_", "lens_")

    def fit(self, X: Any, y: Any) -> RayPlane:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 4 or y.shape != (len(X), 3):
            raise FitError(f"rayplane maps (n, 4) to (n, 3), found {X.shape} and {y.shape}")
        places = CalibrationPoints(
            X[:, :3], np.column_stack([y[:, :2], X[:, 3]]), tuple(map(str, range(len(X))))
        )
        return self.fit_jointly([self], [places])[0]

    @staticmethod
    def fit_jointly(models: Sequence[RayPlane], cameras: Sequence[CalibrationPoints]) -> list[RayPlane]:
        """Fit one model for each camera; points that several cameras measured tie the models together."""
        for model, camera_rays in zip(models, fit_rays(cameras), strict=True):
            model.n_features_in_ = 4
            model.rotation_, model.origin_ = camera_rays.rotation, camera_rays.origin_m
            model.lens_ = camera_rays.lens
        return list(models)

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(np.asarray(X, dtype=np.float64))

    @property
    def camera_rays(self) -> CameraRays:
        """Pose and lens correction of the camera."""
        return CameraRays(self.rotation_, self.origin_, self.lens_)

    def predict_array(self, X: Array) -> Array:
        rays = directions(X[:, :3], self.lens_) @ self.rotation_.T
        return intersect_height(self.origin_, rays, X[:, 3])


class RayDepth(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """A model from camera points (n, 3) to world points (n, 3), in m.

    The fit estimates the camera's pose and lens correction at the known heights of the calibration points. A
    smooth correction then turns each depth of eq. (3) into the true depth. The height from a depth is moved
    along the ray towards the mean height of the calibration points, in proportion to its noise. If all
    calibration points have the same height, the result is that height.

    Attributes
    ----------
    rotation_, origin_, lens_ : see :class:`ipsys_log.models.ray_models.RayPlane`.
    depth_ : (11,), see :func:`ipsys_log.models.depths.fit_depths`.
    heights_ : (3,), mean (m) and variance (m^2) of the measured heights, and the variance (m^2) of a
        height from a depth, at the principal point.
    """

    fitted: ClassVar[tuple[str, ...]] = ("rotation_", "origin_", "lens_", "depth_", "heights_")

    def fit(self, X: Any, y: Any) -> RayDepth:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 3 or y.shape != X.shape:
            raise FitError(f"best maps (n, 3) to (n, 3), found {X.shape} and {y.shape}")
        return self.fit_jointly([self], [CalibrationPoints(X, y, tuple(map(str, range(len(X)))))])[0]

    @staticmethod
    def fit_jointly(models: Sequence[RayDepth], cameras: Sequence[CalibrationPoints]) -> list[RayDepth]:
        """Fit one model for each camera; points that several cameras measured tie the models together."""
        for model, places, camera_rays in zip(models, cameras, fit_rays(cameras), strict=True):
            model._fit_depths(places, camera_rays)
        return list(models)

    def _fit_depths(self, places: CalibrationPoints, camera_rays: CameraRays) -> None:
        self.n_features_in_ = 3
        self.rotation_, self.origin_, self.lens_ = (
            camera_rays.rotation,
            camera_rays.origin_m,
            camera_rays.lens,
        )
        points_m, world_m = places.points_m, places.world_m
        depths_m = (world_m - camera_rays.origin_m) @ camera_rays.rotation[:, 2]
        self.depth_, left_out = fit_depths(points_m, depths_m / points_m[:, 2] - 1)
        _, growth = depth_terms(points_m)
        falls = (directions(points_m, camera_rays.lens) @ camera_rays.rotation.T)[:, 2]
        noise_m2 = np.mean((left_out * points_m[:, 2] * falls / growth) ** 2) + LEAST_NOISE**2
        self.heights_ = np.array([world_m[:, 2].mean(), world_m[:, 2].var(), noise_m2])

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        return self.predict_array(np.asarray(X, dtype=np.float64))

    def predict_array(self, X: Array) -> Array:
        rays = directions(X, self.lens_) @ self.rotation_.T
        terms, growth = depth_terms(X)
        heights_m = self.origin_[2] + X[:, 2] * (1 + terms @ self.depth_) * rays[:, 2]
        mean_m, spread_m2, noise_m2 = self.heights_
        trust = spread_m2 / (spread_m2 + noise_m2 * growth**2)
        return intersect_height(self.origin_, rays, mean_m + trust * (heights_m - mean_m))
