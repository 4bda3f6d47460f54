"""Unevenness of the floor: a smooth Gaussian random field on a grid of knots.

The field is a cubic B-spline in x and y. The values at the knots have a stationary squared-exponential
covariance. The parameters are amplitudes of the principal modes of this covariance, so that their prior is
a standard normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array

# Distance of the knots as a share of the correlation length. A cubic spline follows the field to 1 % of
# its standard deviation.
_KNOTS_PER_LENGTH = 0.7
# The modes that remain have this share of the variance.
_VARIANCE_SHARE = 0.999
_NUGGET = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class FloorField:
    """Height of the floor over the plane z = 0, as a sum of modes.

    ``origin_m`` (2,) is the first knot, ``spacing_m`` the distance of the knots. ``along_x`` (nx, a) and
    ``along_y`` (ny, b) are spline coefficients of modes in one direction. Mode k of the field is the product
    of the columns ``pairs[k]`` of both. The number of modes m is 0 for a flat floor.
    """

    origin_m: Array
    spacing_m: float
    along_x: Array
    along_y: Array
    pairs: NDArray[np.intp]

    @property
    def count(self) -> int:
        """The number of modes m."""
        return len(self.pairs)

    def scaled(self, factor: float) -> FloorField:
        """Return the field with another standard deviation."""
        return replace(self, along_x=self.along_x * factor)

    def modes(self, points_m: Array) -> Array:
        """Return the modes at points: (n, m) in m, for points (n, 2) or (n, 3)."""
        return self.evaluate(points_m, np.zeros(self.count))[2]

    def heights(self, points_m: Array, amplitudes: Array) -> tuple[Array, Array]:
        """Return heights (n,) in m at points (n, 2) or (n, 3), and their slopes (n, 2)."""
        return self.evaluate(points_m, amplitudes)[:2]

    def evaluate(self, points_m: Array, amplitudes: Array) -> tuple[Array, Array, Array]:
        """Return heights (n,), slopes (n, 2), and modes (n, m) at points (n, 2) or (n, 3)."""
        count = len(points_m)
        if not self.count:
            return np.zeros(count), np.zeros((count, 2)), np.zeros((count, 0))
        first, second = self.pairs[:, 0], self.pairs[:, 1]
        table = np.zeros((self.along_x.shape[1], self.along_y.shape[1]))
        table[first, second] = amplitudes
        (x, dx), (y, dy) = (self._values(points_m, axis) for axis in (0, 1))
        by_y = y @ table.T
        slopes = np.empty((count, 2))
        slopes[:, 0], slopes[:, 1] = (dx * by_y).sum(axis=1), (x * (dy @ table.T)).sum(axis=1)
        return (x * by_y).sum(axis=1), slopes, x[:, first] * y[:, second]

    def _values(self, points_m: Array, axis: int) -> tuple[Array, Array]:
        """Return the modes of one direction and their derivatives, both (n, a)."""
        coefficients = (self.along_x, self.along_y)[axis]
        last = len(coefficients) - 3
        place = (points_m[:, axis] - self.origin_m[axis]) / self.spacing_m - 1
        inside = np.clip(place, 0.0, last)
        knots = np.minimum(inside.astype(np.intp), last - 1)
        weights, slopes = spline_weights(inside - knots)
        near = coefficients[knots[:, None] + np.arange(4)]
        slopes = slopes * ((place == inside) / self.spacing_m)[:, None]
        return (weights[:, None] @ near)[:, 0], (slopes[:, None] @ near)[:, 0]


def spline_weights(share: Array) -> tuple[Array, Array]:
    """Return the weights of four knots of a uniform cubic B-spline, and their derivatives, both (n, 4).

    Parameters
    ----------
    share : (n,), position between the second and third knot, 0 to 1.

    Examples
    --------
    >>> spline_weights(np.array([0.0]))[0].round(4).tolist()
    [[0.1667, 0.6667, 0.1667, 0.0]]
    """
    s, r = share, 1 - share
    ss, rr = s * s, r * r
    weights = np.array([rr * r, (3 * s - 6) * ss + 4, (3 * r - 6) * rr + 4, ss * s]).T
    slopes = np.array([-rr, (3 * s - 4) * s, (4 - 3 * r) * r, ss]).T
    return weights / 6, slopes / 2


def make_floor_field(low_m: Array, high_m: Array, sigma_m: float, length_m: float) -> FloorField:
    """Return the field over a rectangle with the prior covariance sigma^2 exp(-d^2 / (2 length^2)).

    Parameters
    ----------
    low_m, high_m : (2,), corners of the rectangle. Outside, the field continues with its value at the edge.
    sigma_m : standard deviation of the height; 0 for a flat floor.
    length_m : correlation length.

    Examples
    --------
    >>> field = make_floor_field(np.zeros(2), np.full(2, 3.0), 0.001, 0.5)
    >>> modes = field.modes(np.array([[1.0, 2.0]]))
    >>> round(float(np.sqrt((modes**2).sum())), 5)
    0.001
    """
    spacing_m = _KNOTS_PER_LENGTH * length_m
    if sigma_m <= 0:
        none = np.zeros((4, 0))
        return FloorField(low_m - spacing_m, spacing_m, none, none, np.zeros((0, 2), dtype=np.intp))
    counts = np.maximum(np.ceil((high_m - low_m) / spacing_m).astype(int), 1) + 3
    (along_x, x_share), (along_y, y_share) = (_modes_1d(int(n), spacing_m / length_m) for n in counts)
    shares = np.outer(x_share, y_share)
    order = np.argsort(-shares, axis=None, kind="stable")
    total = np.cumsum(shares.ravel()[order]) / shares.sum()
    chosen = order[: int(np.searchsorted(total, _VARIANCE_SHARE)) + 1]
    pairs = np.stack(np.unravel_index(chosen, shares.shape), axis=1)
    return FloorField(low_m - spacing_m, spacing_m, along_x * sigma_m, along_y, pairs)


def _modes_1d(count: int, step: float) -> tuple[Array, Array]:
    """Return coefficients (n, n) of modes of unit amplitude, and their variances (n,), largest first."""
    places = step * np.arange(count)
    kernel = np.exp(-0.5 * (places[:, None] - places) ** 2) + _NUGGET * np.eye(count)
    variances, axes = np.linalg.eigh(kernel)
    variances, axes = np.maximum(variances[::-1], 0.0), axes[:, ::-1]
    axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), np.arange(count)])
    # The spline takes the values of the modes at the knots, by its coefficients there.
    values_from_coefficients = (4 * np.eye(count) + np.eye(count, k=1) + np.eye(count, k=-1)) / 6
    # At both ends, the first coefficient beyond the grid equals the last one on it.
    values_from_coefficients[0, 0] = values_from_coefficients[-1, -1] = 5 / 6
    return np.linalg.solve(values_from_coefficients, axes * np.sqrt(variances)), variances
