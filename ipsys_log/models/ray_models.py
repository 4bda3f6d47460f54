"""Models on rays: ``raydepth`` corrects the depth, ``rayplane`` uses the known height of a marker."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.geometry.lenses import meet_height
from ipsys_log.models.rays import Bearings, Places, directions, fit_bearings

__all__ = ["RayDepth", "RayPlane", "fit_depths"]

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


# Standard deviation that the terms of the depth correction have before anything was measured.
_TERM_SIGMA = 0.02
# Relative errors of depth beyond this many usual ones count less and less.
_ROBUST = 2.0
# No marker's size says its depth better than this (relative).
_LEAST_NOISE = 2e-4
_ROUNDS = 12


def depth_terms(points_m: Array) -> tuple[Array, Array]:
    """What the depth correction is made of, and how uncertain a depth is at each point.

    Parameters
    ----------
    points_m : (n, 3), in the frame of the camera.

    Returns
    -------
    terms : (n, 11): constant, second and third order in u = Xc / Zc, v = Yc / Zc, and (u^2 + v^2)^2.
    growth : (n,): 1 + u^2 + v^2. A pixel of a wide lens spans so much more towards the edge that the
        error of a depth grows by it.
    """
    u, v = points_m[:, 0] / points_m[:, 2], points_m[:, 1] / points_m[:, 2]
    r2 = u * u + v * v
    terms = [np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3, r2 * r2]
    return np.stack(terms, axis=1), 1 + r2


def fit_depths(points_m: Array, ratios: Array) -> tuple[Array, Array]:
    """A smooth correction of depths: Bayesian linear regression with a robust loss.

    Parameters
    ----------
    points_m : (n, 3), in the frame of the camera.
    ratios : (n,), true depth over measured depth, minus one.

    Returns
    -------
    coefficients : (11,), of :func:`depth_terms`; all but the constant are drawn towards zero as far as
        the noise, which is estimated from leave-one-out residuals, makes them uncertain.
    left_out : (n,), the residual of each ratio where it is left out.

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
        noise = max(1.4826 * float(np.median(np.abs(left_out) / growth)), _LEAST_NOISE)
        weights = 1 / np.sqrt(1 + (residuals / growth / (_ROBUST * noise)) ** 2)
    return coefficients, left_out


class RayDepth(RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """From camera points (n, 3) to world points (n, 3), in m.

    The camera's pose and lens are fitted at the known heights of the measured places; a smooth correction
    then turns each depth of eq. (3) into the true one. The height that follows from a depth is drawn
    towards the mean height of the measured places as far as its noise warrants, along the ray; where all
    places have one height it is that height.

    Attributes
    ----------
    rotation_, origin_, lens_ : see :class:`ipsys_log.models.ray_models.RayPlane`.
    depth_ : (11,), see :func:`fit_depths`.
    heights_ : (3,), mean (m) and variance (m^2) of the measured heights, and the variance (m^2) of a
        height that follows from a depth, in the middle of the image.
    """

    min_pairs: ClassVar[int] = 5
    fitted: ClassVar[tuple[str, ...]] = ("rotation_", "origin_", "lens_", "depth_", "heights_")

    def fit(self, X: Any, y: Any) -> RayDepth:
        X, y = validate_data(self, X, y, multi_output=True, dtype=np.float64)
        if X.shape[1] != 3 or y.shape != X.shape:
            raise FitError(f"best maps (n, 3) to (n, 3), found {X.shape} and {y.shape}")
        return self.fit_jointly([self], [Places(X, y, tuple(map(str, range(len(X)))))])[0]

    @staticmethod
    def fit_jointly(models: Sequence[RayDepth], cameras: Sequence[Places]) -> list[RayDepth]:
        """Fit one model for each camera, tied together by the places that several of them saw."""
        for model, places, bearings in zip(models, cameras, fit_bearings(cameras), strict=True):
            model._fit_depths(places, bearings)
        return list(models)

    def _fit_depths(self, places: Places, bearings: Bearings) -> None:
        self.n_features_in_ = 3
        self.rotation_, self.origin_, self.lens_ = bearings.rotation, bearings.origin_m, bearings.lens
        points_m, world_m = places.points_m, places.world_m
        depths_m = (world_m - bearings.origin_m) @ bearings.rotation[:, 2]
        self.depth_, left_out = fit_depths(points_m, depths_m / points_m[:, 2] - 1)
        _, growth = depth_terms(points_m)
        falls = (directions(points_m, bearings.lens) @ bearings.rotation.T)[:, 2]
        noise_m2 = np.mean((left_out * points_m[:, 2] * falls / growth) ** 2) + _LEAST_NOISE**2
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
        return meet_height(self.origin_, rays, mean_m + trust * (heights_m - mean_m))
