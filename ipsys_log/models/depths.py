"""Corrected depths of eq. (3), and the check of known marker heights by them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages.arrays import Array
from ipsys_log.models.rays import CameraRays, directions

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
