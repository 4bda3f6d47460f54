"""How far off a position may be: its covariance, and whether it lies among the measured places.

A position's error has two parts. The camera point is noisy: relative to its depth along the view, and in
its direction across it; the model carries that into the world. And the model itself is uncertain, because
it was fitted to so many places with so uncertain a tape: less in their midst, more towards their edge and
beyond.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError

__all__ = ["Predict", "Uncertainty", "Volume", "estimate_uncertainty", "leverage_terms"]

Array = NDArray[np.float64]

# World points (n, 3) from camera points (n, 3) and the known heights (n,), for models that use them.
Predict = Callable[[Array, Array], Array]

_STEP_M = 0.005
_STEPS_M = _STEP_M * np.eye(3)
# A marker's height on its robot is measured with a ruler, once and with care.
_HEIGHT_SIGMA_M = 0.0005
_FLOOR_M2 = 0.0003**2 * np.eye(3)
# What the noise usually is, and within which factor (e to the power of it), before anything is measured.
_USUAL_NOISE = np.log([3e-4, 1e-4])
_NOISE_SPREAD = 2.0
# How noise may grow towards the edge: that of a pixel by the first power, a misfit of the model by more.
_GROWTHS = (1.0, 2.0, 3.0)
# Squared Mahalanobis distances beyond this (99.9 % of good places) count less and less.
_ROBUST = 16.3
# As near to the outermost measured places as they are known.
_EDGE_M = 0.01


@dataclass(frozen=True, eq=False)  # without slots, for what is kept
class Uncertainty:
    """What the covariance of a position is made of.

    Attributes
    ----------
    along : standard deviation of a depth Zc in the middle of the image, relative to it.
    across : standard deviation of u = Xc / Zc and v = Yc / Zc there.
    growth : both grow by (1 + u^2 + v^2) to this power away from the middle.
    fit : (3, 3), covariance of (u, v, ln Zc) that has the effect of the uncertainty of the fit where the
        leverage is 1.
    points_m : (n, 3), camera points of the places that were fitted on, for the leverage.
    """

    along: float
    across: float
    growth: float
    fit: Array
    points_m: Array

    def covariances(self, predict: Predict, points_m: Array, heights_m: Array) -> Array:
        """Covariance of the world point of each camera point, (n, 3, 3) in m^2."""
        slopes, by_height = _slopes(predict, points_m, heights_m)
        wide = _wide(points_m) ** (2 * self.growth)
        leverage = _leverage(self._inverse, points_m)
        inside = wide[:, None, None] * self._noise + leverage[:, None, None] * self.fit
        covariances: Array = slopes @ inside @ slopes.transpose(0, 2, 1) + by_height
        return covariances

    @cached_property
    def _noise(self) -> Array:
        return np.diag([self.across**2, self.across**2, self.along**2])

    @cached_property
    def _inverse(self) -> Array:
        return _inverse_of_terms(self.points_m)


def _wide(points_m: Array) -> Array:
    """1 + u^2 + v^2, (n,)."""
    wide: Array = 1 + (points_m[:, :2] ** 2).sum(axis=1) / points_m[:, 2] ** 2
    return wide


def _slopes(predict: Predict, points_m: Array, heights_m: Array) -> tuple[Array, Array]:
    """Derivative of the world point by (u, v, ln Zc), (n, 3, 3), and its covariance from the known height."""
    count = len(points_m)
    # Here, one step along each axis, and here with the marker one step higher.
    points, heights = np.empty((5, count, 3)), np.empty((5, count))
    points[:], heights[:] = points_m, heights_m
    points[1:4] += _STEPS_M[:, None]
    heights[4] += _STEP_M
    found = predict(points.reshape(-1, 3), heights.reshape(-1)).reshape(5, count, 3)
    by_x, by_y, by_z, by_height = (found[1:] - found[0]) / _STEP_M
    depth = points_m[:, 2:]
    slopes = np.empty((count, 3, 3))
    slopes[:, :, 0] = by_x * depth
    slopes[:, :, 1] = by_y * depth
    slopes[:, :, 2] = by_x * points_m[:, :1] + by_y * points_m[:, 1:2] + by_z * depth
    height = by_height * _HEIGHT_SIGMA_M
    return slopes, height[:, :, None] * height[:, None, :] + _FLOOR_M2


def _inverse_of_terms(fitted_m: Array) -> Array:
    terms = leverage_terms(fitted_m)
    # A trace on the diagonal where there are fewer places than terms.
    return np.asarray(np.linalg.inv(terms.T @ terms + 1e-9 * np.eye(6)), dtype=np.float64)


def _leverage(inverse: Array, points_m: Array) -> Array:
    """How much a second-order polynomial in (u, v) rests on itself at each point: mean 6 / n where fitted.

    ``inverse`` is that of the places that were fitted on, (6, 6).
    """
    at = leverage_terms(points_m)
    leverage: Array = np.einsum("ni,ij,nj->n", at, inverse, at)
    return leverage


def leverage_terms(points_m: Array) -> Array:
    """The six terms up to second order in u = Xc / Zc, v = Yc / Zc, (n, 6), that leverage is reckoned by."""
    terms = np.ones((len(points_m), 6))
    uv = terms[:, 1:3] = points_m[:, :2] / points_m[:, 2:]
    terms[:, 3:5] = uv * uv[:, :1]
    terms[:, 5] = uv[:, 1] ** 2
    return terms


def estimate_uncertainty(
    predict: Predict,
    points_m: Array,
    world_m: Array,
    tape_m2: Array,
    without: Array,
    left_out: NDArray[np.int64],
) -> Uncertainty:
    """Find the uncertainty of a fitted model from models fitted without some of its places.

    Parameters
    ----------
    predict : of the model fitted to all places.
    points_m, world_m : (n, 3), its places.
    tape_m2 : (n, 3, 3), covariances of the world points as measured; zero where they are not known, and the
        tape's error is then taken for the camera's.
    without : (g, n, 3), what each model fitted without a group of places predicts for all of them.
    left_out : (n,), the group of each place.

    References
    ----------
    The fit: delete-a-group jackknife with the correction HC2 for leverage (MacKinnon and White, J.
    Econometrics 1985), group by group. The noise: maximum likelihood of the left-out residuals.
    """
    base = predict(points_m, world_m[:, 2])
    residuals = without[left_out, np.arange(len(points_m))] - world_m
    slopes, by_height = _slopes(predict, points_m, world_m[:, 2])
    leverage = _leverage(_inverse_of_terms(points_m), points_m)
    variances = _fit_variances(without - base, base - world_m, residuals, left_out)
    # Where a model does not use the depth, nothing is said of it.
    back = np.linalg.pinv(slopes, rcond=1e-6)
    fit = _typical(back @ variances @ back.transpose(0, 2, 1) / leverage[:, None, None])
    # A place that is left out has more leverage than one that is fitted on.
    more = leverage / np.maximum(1 - leverage, 0.1)
    known = tape_m2 + by_height + slopes @ (more[:, None, None] * fit) @ slopes.transpose(0, 2, 1)
    found = [(*_noise(residuals, known, slopes, _wide(points_m) ** power), power) for power in _GROWTHS]
    _, along, across, growth = min(found)
    return Uncertainty(along, across, growth, fit, points_m)


def _fit_variances(shifts: Array, fitted: Array, residuals: Array, left_out: NDArray[np.int64]) -> Array:
    """Jackknife covariances (n, 3, 3) of the fit at its places, from the shifts (g, n, 3) without groups."""
    kept = np.array([_kept(fitted[left_out == g], residuals[left_out == g]) for g in range(len(shifts))])
    variances: Array = np.einsum("g,gni,gnj->nij", kept, shifts, shifts)
    return variances


def _noise(residuals: Array, known: Array, slopes: Array, wide: Array) -> tuple[float, float, float]:
    """Cost, and noise along and across, that make left-out residuals (n, 3) most likely."""
    along = slopes[:, :, 2] * wide[:, None]
    across = slopes[:, :, :2] * wide[:, None, None]
    by_depth, by_ray = along[:, :, None] * along[:, None, :], across @ across.transpose(0, 2, 1)

    def cost(logs: Array) -> float:
        along2, across2 = np.exp(2 * logs)
        covariances = known + along2 * by_depth + across2 * by_ray
        squares = np.einsum("ni,ni->n", residuals, np.linalg.solve(covariances, residuals[..., None])[..., 0])
        squares = np.where(
            squares > _ROBUST, _ROBUST * (1 + np.log(np.maximum(squares, 1) / _ROBUST)), squares
        )
        usual = ((logs - _USUAL_NOISE) / _NOISE_SPREAD) ** 2
        return float(np.linalg.slogdet(covariances)[1].sum() + squares.sum() + usual.sum()) / 2

    found = minimize(cost, _USUAL_NOISE, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-2})
    return float(found.fun), *np.exp(found.x).tolist()


def _typical(covariances: Array) -> Array:
    """The mean of covariances (n, 3, 3), scaled to their median size: few at the edge do not rule it."""
    sizes = np.trace(covariances, axis1=1, axis2=2)
    typical: Array = covariances.mean(axis=0) * float(np.median(sizes) / max(sizes.mean(), 1e-300))
    return typical


def _kept(fitted: Array, residuals: Array) -> float:
    """Share of a left-out residual that stays where it is fitted on: 1 minus the leverage."""
    return min(float(np.linalg.norm(fitted)) / max(float(np.linalg.norm(residuals)), 1e-12), 1.0)


class Volume:
    """The space over the measured places: their convex hull in the camera's x and y, and their heights.

    Parameters
    ----------
    points_m, world_m : (n, 3), camera points and world points of the places.
    """

    def __init__(self, points_m: Array, world_m: Array) -> None:
        try:
            self._edges: Array | None = ConvexHull(points_m[:, :2]).equations
        except (QhullError, ValueError):
            self._edges = None  # fewer than three places, or all on a line: nothing lies among them
        self._lowest_m, self._highest_m = world_m[:, 2].min(), world_m[:, 2].max()

    def contains(self, points_m: Array, heights_m: Array, sigmas_m: Array) -> NDArray[np.bool_]:
        """Whether each camera point (n, 3) with its height (n,) lies inside.

        A height counts as outside where it is so by more than 1 cm and two of its own standard
        deviations ``sigmas_m`` (n,).
        """
        if self._edges is None:
            return np.zeros(len(points_m), dtype=bool)
        beyond_m = (points_m[:, :2] @ self._edges[:, :2].T + self._edges[:, 2]).max(axis=1)
        slack_m = _EDGE_M + 2 * sigmas_m
        level = (heights_m >= self._lowest_m - slack_m) & (heights_m <= self._highest_m + slack_m)
        inside: NDArray[np.bool_] = (beyond_m <= _EDGE_M) & level
        return inside
