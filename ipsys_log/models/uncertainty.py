"""Uncertainty of a position: its covariance, and the volume of the calibration points.

A position's error has two parts. The first part is the noise of the camera point. Along the view, this noise
is proportional to the depth. Across the view, it is an error of the direction. The model transforms this
noise to the world. The second part is the uncertainty of the model. It depends on the number of calibration
points and on the error of the tape. It is small between the calibration points, and grows towards their edge
and outside.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array

# World points (n, 3) from camera points (n, 3) and the known heights (n,), for models that use them.
Predict = Callable[[Array, Array], Array]

_STEP_M = 0.005
_STEPS_M = _STEP_M * np.eye(3)
# Standard deviation of a marker's height on its robot, which is measured once, carefully, with a ruler.
HEIGHT_SIGMA_M = 0.0005
_FLOOR_M2 = 0.0003**2 * np.eye(3)
# Prior of the noise: logarithms of its usual values (along, across), and their standard deviation.
_USUAL_NOISE = np.log([3e-4, 1e-4])
_NOISE_SPREAD = 2.0
# Possible powers of the growth of noise towards the edge of the image: 1 for the noise of a pixel, more for a
# misfit of the model.
_GROWTHS = (1.0, 2.0, 3.0)
# A jackknife with few groups is conservative (Efron and Stein 1981). In simulated labs with known heights,
# this is the ratio of the true variance of the fit to that of the jackknife.
_JACKKNIFE_SHARE = 0.8
# Squared Mahalanobis distances above this (the limit of 99.9 % of good calibration points) get less weight.
_ROBUST = 16.3
# Tolerance at the outermost calibration points: the accuracy of their positions.
_EDGE_M = 0.01


@dataclass(frozen=True, eq=False)  # without slots, because of the cached properties
class Uncertainty:
    """The parts of the covariance of a position.

    Attributes
    ----------
    along : standard deviation of a depth Zc at the principal point, relative to the depth.
    across : standard deviation of u = Xc / Zc and v = Yc / Zc at the principal point.
    growth : away from the principal point, both grow by (1 + u^2 + v^2) to this power.
    fit : (3, 3), covariance of (u, v, ln Zc) that is equivalent to the uncertainty of the fit at a leverage
        of 1.
    points_m : (n, 3), camera points of the calibration points of the fit, for the leverage.
    """

    along: float
    across: float
    growth: float
    fit: Array
    points_m: Array

    def covariances(
        self, predict: Predict, points_m: Array, heights_m: Array, height_sigmas_m: Array | None = None
    ) -> Array:
        """Return the covariance of the world point of each camera point, (n, 3, 3) in m^2.

        ``height_sigmas_m`` (n,) are the standard deviations of the known heights; None for markers on robots,
        whose heights are measured carefully.
        """
        slopes, by_height = _slopes(predict, points_m, heights_m)
        from_height = _height_covariances(by_height, height_sigmas_m)
        wide = _wide(points_m) ** (2 * self.growth)
        leverage = _leverage(self._inverse, points_m)
        inside = wide[:, None, None] * self._noise + leverage[:, None, None] * self.fit
        covariances: Array = slopes @ inside @ slopes.transpose(0, 2, 1) + from_height
        return covariances

    def error_modes(
        self, predict: Predict, points_m: Array, heights_m: Array, height_sigmas_m: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the parts of the covariances that are errors of the fit and of the height.

        Parameters
        ----------
        predict, points_m, heights_m, height_sigmas_m : as in :meth:`covariances`.

        Returns
        -------
        modes_m : (n, 3, 19), errors of the world points by independent standard normal numbers: 18 of the
            fit, and that of the height. Two camera points have the same numbers, so that the product of their
            modes is their covariance.
        rest_m2 : (n, 3, 3), the other part of the covariances, from the noise of a camera point.
        """
        slopes, by_height = _slopes(predict, points_m, heights_m)
        root = np.linalg.cholesky(self.fit + 1e-12 * np.trace(self.fit) * np.eye(3))
        terms = leverage_terms(points_m) @ np.linalg.cholesky(self._inverse)
        of_fit = ((slopes @ root)[:, :, :, None] * terms[:, None, None, :]).reshape(len(points_m), 3, 18)
        sigmas_m = HEIGHT_SIGMA_M if height_sigmas_m is None else height_sigmas_m[:, None]
        modes_m = np.concatenate([of_fit, (by_height * sigmas_m)[:, :, None]], axis=2)
        wide = _wide(points_m) ** (2 * self.growth)
        rest_m2 = slopes @ (wide[:, None, None] * self._noise) @ slopes.transpose(0, 2, 1) + _FLOOR_M2
        return modes_m, rest_m2

    @cached_property
    def _noise(self) -> Array:
        return np.diag([self.across**2, self.across**2, self.along**2])

    @cached_property
    def _inverse(self) -> Array:
        return _inverse_of_terms(self.points_m)


def _wide(points_m: Array) -> Array:
    """Return 1 + u^2 + v^2, (n,)."""
    wide: Array = 1 + (points_m[:, :2] ** 2).sum(axis=1) / points_m[:, 2] ** 2
    return wide


def _slopes(predict: Predict, points_m: Array, heights_m: Array) -> tuple[Array, Array]:
    """Return the slopes of world points by (u, v, ln Zc), (n, 3, 3), and by the known height, (n, 3)."""
    count = len(points_m)
    # The point itself, one step along each axis, and the point with the marker one step higher.
    points, heights = np.empty((5, count, 3)), np.empty((5, count))
    points[:], heights[:] = points_m, heights_m
    points[1:4] += _STEPS_M[:, None]
    heights[4] += _STEP_M
    worlds_m = predict(points.reshape(-1, 3), heights.reshape(-1)).reshape(5, count, 3)
    by_x, by_y, by_z, by_height = (worlds_m[1:] - worlds_m[0]) / _STEP_M
    depth = points_m[:, 2:]
    slopes = np.empty((count, 3, 3))
    slopes[:, :, 0] = by_x * depth
    slopes[:, :, 1] = by_y * depth
    slopes[:, :, 2] = by_x * points_m[:, :1] + by_y * points_m[:, 1:2] + by_z * depth
    return slopes, by_height


def _height_covariances(by_height: Array, sigmas_m: Array | None) -> Array:
    """Return the covariances (n, 3, 3) of world points from the errors of their known heights."""
    height = by_height * (HEIGHT_SIGMA_M if sigmas_m is None else sigmas_m[:, None])
    return np.asarray(height[:, :, None] * height[:, None, :] + _FLOOR_M2)


def _inverse_of_terms(fitted_m: Array) -> Array:
    terms = leverage_terms(fitted_m)
    # A tiny constant on the diagonal, in case there are fewer calibration points than terms.
    return np.asarray(np.linalg.inv(terms.T @ terms + 1e-9 * np.eye(6)), dtype=np.float64)


def _leverage(inverse: Array, points_m: Array) -> Array:
    """Return the leverage of each point in the fit of a second-order polynomial in (u, v).

    The mean leverage of the n calibration points of the fit is 6 / n. ``inverse`` (6, 6) comes from these
    points, see :func:`_inverse_of_terms`.
    """
    terms = leverage_terms(points_m)
    leverage: Array = np.einsum("ni,ij,nj->n", terms, inverse, terms)
    return leverage


def leverage_terms(points_m: Array) -> Array:
    """Return the six terms of the leverage, (n, 6): up to second order in u = Xc / Zc, v = Yc / Zc."""
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
    known_heights: bool = False,
) -> Uncertainty:
    """Estimate the uncertainty of a model from models that are fitted without some calibration points.

    Parameters
    ----------
    predict : function of the model that is fitted to all calibration points.
    points_m, world_m : (n, 3), camera points and world points of the calibration points.
    tape_m2 : (n, 3, 3), covariances of the measured world points; zero if they are unknown. The tape's error
        then counts as an error of the camera.
    without : (g, n, 3), predictions for all calibration points by models fitted without one of g groups.
    left_out : (n,), the group of each calibration point.
    known_heights : True if the model gets the measured heights as input. Their errors, with the standard
        deviation in ``tape_m2``, then move the predicted points along the floor. The predicted heights are
        the measured ones, so their residuals are zero and say nothing about the noise.

    References
    ----------
    The fit: delete-a-group jackknife with the correction HC2 for leverage (MacKinnon and White, J.
    Econometrics 1985), group by group. The noise: maximum likelihood of the held-out residuals.
    """
    base = predict(points_m, world_m[:, 2])
    residuals = without[left_out, np.arange(len(points_m))] - world_m
    slopes, by_height = _slopes(predict, points_m, world_m[:, 2])
    leverage = _leverage(_inverse_of_terms(points_m), points_m)
    variances = _fit_variances(without - base, base - world_m, residuals, left_out)
    # If a model does not use the depth, the pseudo-inverse sets the covariance of the depth to zero.
    back = np.linalg.pinv(slopes, rcond=1e-6)
    fit = _typical(back @ variances @ back.transpose(0, 2, 1) / leverage[:, None, None])
    if known_heights:
        fit *= _JACKKNIFE_SHARE
    # A held-out point has more leverage than a point of the fit.
    more = leverage / np.maximum(1 - leverage, 0.1)
    sigmas_m = ruler_sigmas(tape_m2) if known_heights else None
    from_height = _height_covariances(by_height, sigmas_m)
    known = tape_m2 + from_height + slopes @ (more[:, None, None] * fit) @ slopes.transpose(0, 2, 1)
    size = 2 if known_heights else 3
    residuals, known, seen = residuals[:, :size], known[:, :size, :size], slopes[:, :size]
    candidates = [(*_noise(residuals, known, seen, _wide(points_m) ** power), power) for power in _GROWTHS]
    _, along, across, growth = min(candidates)
    return Uncertainty(along, across, growth, fit, points_m)


def ruler_sigmas(tape_m2: Array) -> Array:
    """Return the standard deviation of the measured height of each calibration point, (n,) in m.

    ``tape_m2`` (n, 3, 3) are the covariances of the measured points, 0 if unknown.
    """
    variances_m2 = tape_m2[:, 2, 2]
    return np.where(variances_m2 > 0, np.sqrt(variances_m2), HEIGHT_SIGMA_M)


def _fit_variances(shifts: Array, fitted: Array, residuals: Array, left_out: NDArray[np.int64]) -> Array:
    """Return jackknife covariances (n, 3, 3) of the fit at its points.

    They follow from the shifts (g, n, 3) of the predictions without each group of points.
    """
    kept = np.array([_kept(fitted[left_out == g], residuals[left_out == g]) for g in range(len(shifts))])
    variances: Array = np.einsum("g,gni,gnj->nij", kept, shifts, shifts)
    return variances


def _noise(residuals: Array, known: Array, slopes: Array, wide: Array) -> tuple[float, float, float]:
    """Return the least cost, and the noise along and across, with maximum likelihood of held-out residuals.

    The residuals are (n, 3), in m, or (n, 2) on the floor.
    """
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

    from scipy.optimize import minimize  # late: most commands fit nothing, and it takes 0.5 s

    optimum = minimize(cost, _USUAL_NOISE, method="Nelder-Mead", options={"xatol": 1e-2, "fatol": 1e-2})
    return float(optimum.fun), *np.exp(optimum.x).tolist()


def _typical(covariances: Array) -> Array:
    """Return the mean of covariances (n, 3, 3), scaled to their median size.

    With this scale, a few large covariances at the edge do not dominate the mean.
    """
    sizes = np.trace(covariances, axis1=1, axis2=2)
    typical: Array = covariances.mean(axis=0) * float(np.median(sizes) / max(sizes.mean(), 1e-300))
    return typical


def _kept(fitted: Array, residuals: Array) -> float:
    """Return the ratio of a fitted residual to the held-out residual, which is 1 minus the leverage."""
    return min(float(np.linalg.norm(fitted)) / max(float(np.linalg.norm(residuals)), 1e-12), 1.0)


class Volume:
    """The volume of the calibration points: their convex hull in the camera's x and y, and their heights.

    Both are those of the camera points and the world points (n, 3) of the calibration.
    """

    def __init__(self, points_m: Array, world_m: Array) -> None:
        from scipy.spatial import ConvexHull, QhullError  # late: most commands need no hull

        try:
            self._edges: Array | None = ConvexHull(points_m[:, :2]).equations
        except (QhullError, ValueError):
            self._edges = None  # fewer than three points, or all on a line: the volume is empty
        self._lowest_m, self._highest_m = world_m[:, 2].min(), world_m[:, 2].max()

    def contains(self, points_m: Array, heights_m: Array, sigmas_m: Array) -> NDArray[np.bool_]:
        """Return a mask (n,) of the camera points (n, 3) with heights (n,) inside the volume.

        A height is outside if it is more than 1 cm plus two of its own standard deviations ``sigmas_m`` (n,)
        outside the range of the heights.
        """
        if self._edges is None:
            return np.zeros(len(points_m), dtype=bool)
        beyond_m = (points_m[:, :2] @ self._edges[:, :2].T + self._edges[:, 2]).max(axis=1)
        slack_m = _EDGE_M + 2 * sigmas_m
        level = (heights_m >= self._lowest_m - slack_m) & (heights_m <= self._highest_m + slack_m)
        inside: NDArray[np.bool_] = (beyond_m <= _EDGE_M) & level
        return inside
