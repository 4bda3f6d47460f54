"""Models on rays: corrected depths of eq. (3) in ``RayDepth``, known heights of markers in ``RayPlane``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages import Array
from ipsys_log.models.rays import CalibrationPoints, CameraRays, directions, fit_rays
from ipsys_log.vision.lenses import intersect_height

# Prior standard deviation of the terms of the depth correction.
_TERM_SIGMA = 0.02
# Relative depth errors above this multiple of the noise get less weight.
_ROBUST = 2.0
# Least relative noise of a depth from the size of a marker.
LEAST_NOISE = 2e-4
_ROUNDS = 12
# Usual tilt of a marker on a robot, 0.2 degrees. Away from the principal point, eq. (3) takes a tilt for a
# change of the distance.
_TILT_RAD = 0.0035
# A smaller difference between two heights has no effect on the use of a position.
_SAME_HEIGHT_M = 0.01


def depth_terms(points_m: Array) -> tuple[Array, Array]:
    """Return the terms of the depth correction, and the relative uncertainty of the depth at each point.

    Parameters
    ----------
    points_m : (n, 3), in camera coordinates.

    Returns
    -------
    terms : (n, 11): constant, first, second and third order in u = Xc / Zc, v = Yc / Zc, and (u^2 + v^2)^2.
    growth : (n,): 1 + u^2 + v^2. A pixel of a wide-angle lens covers more of the scene towards the edge of
        the image. The error of a depth grows by this factor.
    """
    u, v = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
    r2 = u * u + v * v
    columns = (u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3, r2 * r2)
    terms = np.ones((len(u), len(columns) + 1))
    for n, column in enumerate(columns, 1):  # np.stack takes longer for the few points of a frame
        terms[:, n] = column
    return terms, 1 + r2


def fit_depths(points_m: Array, ratios: Array) -> tuple[Array, Array]:
    """Fit a smooth correction of depths by Bayesian linear regression with a robust loss.

    Parameters
    ----------
    points_m : (n, 3), in camera coordinates.
    ratios : (n,), true depth over measured depth, minus one.

    Returns
    -------
    coefficients : (11,), coefficients of :func:`depth_terms`. A prior moves all coefficients except the
        constant towards zero, according to the noise. The noise is estimated from leave-one-out residuals.
    left_out : (n,), leave-one-out residual of each ratio.

    References
    ----------
    Soft-L1 weights and leave-one-out residuals of ridge regression: Huber and Ronchetti, Robust
    Statistics, 2009, sect. 7.8; Hastie et al., Elements of Statistical Learning, eq. (7.64).
    """
    terms, growth = depth_terms(points_m)
    loose = np.r_[0.0, np.ones(terms.shape[1] - 1)] / _TERM_SIGMA**2
    weights, noise = np.ones(len(ratios)), 0.01
    for _ in range(_ROUNDS):
        precision = weights / growth**2
        inverse = np.linalg.inv((terms.T * precision) @ terms + np.diag(noise**2 * loose))
        coefficients = inverse @ (terms.T @ (precision * ratios))
        residuals = ratios - terms @ coefficients
        leverage = np.einsum("ni,ij,nj->n", terms, inverse, terms) * precision
        left_out = residuals / np.maximum(1 - leverage, 1e-3)
        noise = max(1.4826 * float(np.median(np.abs(left_out) / growth)), LEAST_NOISE)
        weights = 1 / np.sqrt(1 + (residuals / growth / (_ROBUST * noise)) ** 2)
    return coefficients, left_out


class HeightCheck:
    """A check of the heights that markers are taken to be at, by their depths of eq. (3).

    The calibration points give a correction of the depths of a camera, and its uncertainty.

    Parameters
    ----------
    camera_rays : pose and lens correction of the camera.
    points_m, world_m : (n, 3), camera points and world points of the calibration points.
    """

    def __init__(self, camera_rays: CameraRays, points_m: Array, world_m: Array) -> None:
        self._rays = camera_rays
        depths_m = (world_m - camera_rays.origin_m) @ camera_rays.rotation[:, 2]
        self._coefficients, left_out = fit_depths(points_m, depths_m / points_m[:, 2] - 1)
        terms, growth = depth_terms(points_m)
        self._noise = max(1.4826 * float(np.median(np.abs(left_out) / growth)), LEAST_NOISE)
        loose = np.r_[0.0, np.ones(terms.shape[1] - 1)] / _TERM_SIGMA**2
        self._covariance = np.linalg.inv((terms.T / (growth * self._noise) ** 2) @ terms + np.diag(loose))

    def agrees(
        self, points_m: Array, world_m: Array, height_sigmas_m: Array, depth_sigmas_m: Array
    ) -> NDArray[np.bool_]:
        """Return a mask (n,) of the markers whose depths agree with their heights.

        A height disagrees if it differs by more than 1 cm and two standard deviations of the difference.

        Parameters
        ----------
        points_m : (n, 3), in camera coordinates.
        world_m : (n, 3), positions at the heights that the markers are taken to be at.
        height_sigmas_m : (n,), standard deviations of these heights.
        depth_sigmas_m : (n,), standard deviations of the depths from the noise of the image, 0 if unknown.
        """
        rises_m, sigmas_m = self.rises(points_m, world_m, depth_sigmas_m)
        # A position that is not finite, because its ray misses the height, agrees with nothing.
        most_m = _SAME_HEIGHT_M + 2 * np.sqrt(sigmas_m**2 + height_sigmas_m**2)
        agrees: NDArray[np.bool_] = np.abs(rises_m) <= most_m
        return agrees

    def rises(self, points_m: Array, world_m: Array, depth_sigmas_m: Array) -> tuple[Array, Array]:
        """Return the heights by the depths minus those of the positions, and their sigmas, both (n,)."""
        terms, growth = depth_terms(points_m)
        taken_m = (world_m - self._rays.origin_m) @ self._rays.rotation[:, 2]
        depths_m = points_m[:, 2] * (1 + terms @ self._coefficients)
        falls = (directions(points_m, self._rays.lens) @ self._rays.rotation.T)[:, 2]
        tilts = _TILT_RAD * np.hypot(points_m[:, 0], points_m[:, 1]) / points_m[:, 2]
        variances = (
            (self._noise * growth) ** 2
            + np.einsum("ni,ij,nj->n", terms, self._covariance, terms)
            + tilts**2
            + (depth_sigmas_m / points_m[:, 2]) ** 2
        )
        return (depths_m - taken_m) * falls, np.sqrt(variances) * np.abs(depths_m * falls)


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
    depth_ : (11,), see :func:`ipsys_log.models.ray_models.fit_depths`.
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
