"""Smooth Gaussian random fields: the unevenness of a floor, and the wobble of a robot over time.

A field is white noise on a grid, convolved with a Gaussian. Its covariance is
``rms**2 * exp(-d**2 / (2 * length**2))`` for a distance d.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ipsys_log.messages import Array

# Grid nodes per correlation length. With 2, the variance of the field changes between the nodes by 1e-8 of
# itself.
_NODES_PER_LENGTH = 2.0
# The kernel exp(-d^2 / length^2) is below 1e-7 beyond this number of correlation lengths.
_REACH = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class SmoothField:
    """A random field over a square of the plane.

    ``noise`` (m, m) is white noise of unit variance on the nodes ``first + step * (i, j)``, in m.
    """

    rms: float
    length_m: float
    first_m: float
    noise: Array

    @classmethod
    def draw(cls, rms: float, length_m: float, size_m: float, rng: np.random.Generator) -> SmoothField:
        """Draw a field that is valid for x and y from ``-0.5`` m to ``size_m + 0.5`` m."""
        first_m = -0.5 - _REACH * length_m
        nodes = int(np.ceil((size_m - 2 * first_m) * _NODES_PER_LENGTH / length_m)) + 1
        return cls(rms, length_m, first_m, rng.standard_normal((nodes, nodes)))

    def at(self, points_m: Array) -> Array:
        """Return the field (n,) at points (n, 2), in the unit of ``rms``."""
        (along_x, along_y), _ = self._kernels(points_m)
        value: Array = self.rms * ((along_x @ self.noise) * along_y).sum(axis=1)
        return value

    def gradient(self, points_m: Array) -> Array:
        """Return the derivatives (n, 2) of the field by x and y, in the unit of ``rms`` per m."""
        (along_x, along_y), (by_x, by_y) = self._kernels(points_m)
        slopes = [((by_x @ self.noise) * along_y).sum(axis=1), ((along_x @ self.noise) * by_y).sum(axis=1)]
        return self.rms * np.stack(slopes, axis=1)

    def _kernels(self, points_m: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        steps = np.arange(len(self.noise), dtype=np.float64)
        nodes_m: Array = self.first_m + steps * (self.length_m / _NODES_PER_LENGTH)
        both = [_kernel(points_m[:, axis], nodes_m, self.length_m) for axis in (0, 1)]
        return (both[0][0], both[1][0]), (both[0][1], both[1][1])


@dataclass(frozen=True, slots=True, eq=False)
class SmoothSignal:
    """Independent random signals over time.

    ``noise`` (m, k) is white noise of unit variance for k signals, on nodes in time.
    """

    rms: float
    length_s: float
    noise: Array

    @classmethod
    def draw(
        cls, rms: float, length_s: float, duration_s: float, count: int, rng: np.random.Generator
    ) -> SmoothSignal:
        """Draw ``count`` signals that are valid from ``-1`` s to ``duration_s + 1`` s."""
        reach_s = 1.0 + _REACH * length_s
        nodes = int(np.ceil((duration_s + 2 * reach_s) * _NODES_PER_LENGTH / length_s)) + 1
        return cls(rms, length_s, rng.standard_normal((nodes, count)))

    def at(self, times_s: Array) -> Array:
        """Return the signals at times (n,): (n, k), in the unit of ``rms``."""
        step_s = self.length_s / _NODES_PER_LENGTH
        # Only nodes within the reach of the kernel count: a long signal has thousands of nodes.
        around = np.arange(-int(_REACH * _NODES_PER_LENGTH), int(_REACH * _NODES_PER_LENGTH) + 1)
        place = (times_s + 1.0 + _REACH * self.length_s) / step_s
        nearest = np.rint(place).astype(np.int64)
        index = np.clip(nearest[:, None] + around, 0, len(self.noise) - 1)
        weights = np.exp(-(((index - place[:, None]) / _NODES_PER_LENGTH) ** 2)) * _unit_scale()
        signals: Array = self.rms * np.einsum("ns,nsk->nk", weights, self.noise[index])
        return signals


def _kernel(at_m: Array, nodes_m: Array, length_m: float) -> tuple[Array, Array]:
    """Return the weights (n, m) of the nodes for unit variance, and their derivatives by the place."""
    apart = (at_m[:, None] - nodes_m) / length_m
    weights = np.exp(-(apart**2)) * _unit_scale()
    return weights, weights * (-2 * apart / length_m)


def _unit_scale() -> float:
    """Return the factor that gives a sum over nodes unit variance: the sum of exp(-2 d^2), inverted."""
    return float((2 / np.pi) ** 0.25 / np.sqrt(_NODES_PER_LENGTH))
