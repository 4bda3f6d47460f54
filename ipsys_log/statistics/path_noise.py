"""Errors along a path: white noise, and a smooth field over the floor that repeats with the place.

Neighbouring residuals of a track are alike, and a robot that passes a place again meets the same error of the
calibration. Standard deviations from independent residuals are 10 to 40 times too small.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize

from ipsys_log.messages import Array, Mask

# Lengths over which the errors of a calibration are alike, in m; the likelihood selects one.
_LENGTHS_M = (0.12, 0.25, 0.5, 1.0, 2.0)
_ROUGH_LENGTHS_M = (0.5, 2.0, 8.0, 1e6)
# Distance of the nodes of the field, as a share of its length: the field between them is exact to 1 %.
_NODE_SHARE = 0.2
# More nodes cost time, and a shorter length is then left out.
_MOST_NODES = 400
# So many instants determine the noise; the estimate itself uses all.
_MOST_INSTANTS = 1500
# The slope of the field is at most this: a steeper one would contradict its own calibration.
_LARGEST_SLOPE = 0.1
# The field of a calibrated lab is usually of this size, 5 mm and 3 mrad, within a factor of 4. A short path
# does not determine it.
_USUAL_FIELD = (5e-3, 3e-3)
_USUAL_FACTOR = np.log(4.0)
# Below this share of the white noise, the field has no effect.
_LEAST_RATIO = 5e-3
_JITTER = 1e-6
_RIDGES = (1e-12, 1e-9, 1e-6)


class Channel(NamedTuple):
    """Residuals of one kind at some instants, such as x and y in m, or the heading in rad.

    Attributes
    ----------
    rows : the instants (n,) of its residuals among all instants.
    residual : (n, d), the d axes have equal noise.
    jacobian : (n, d, p), its derivatives with respect to the p unknowns, with the sign of the residual: the
        residual of a step is ``residual - jacobian @ step``.
    least_sigma : a smaller white noise is none of a camera.
    """

    rows: Mask
    residual: Array
    jacobian: Array
    least_sigma: float


class Field(NamedTuple):
    """A smooth error over the floor: the nodes (m, 2) in m and its length in m."""

    nodes_m: Array
    length_m: float

    def basis(self, places_m: Array) -> Array:
        """Return a basis (n, m) at places (n, 2): a field of unit variance has unit normal coefficients."""
        kernel = _kernel(self.nodes_m, self.nodes_m, self.length_m)
        factor = np.linalg.cholesky(kernel + _JITTER * np.eye(len(kernel)))
        across = _kernel(self.nodes_m, places_m, self.length_m)
        return np.asarray(solve_triangular(factor, across, lower=True).T)


class Noise(NamedTuple):
    """The standard deviations of the white noise and of the field, for each channel, and the field."""

    white: tuple[float, ...]
    smooth: tuple[float, ...]
    field: Field


def _kernel(a_m: Array, b_m: Array, length_m: float) -> Array:
    squares = ((a_m[:, None] - b_m[None]) ** 2).sum(axis=2)
    return np.asarray(np.exp(squares / (-2 * length_m**2)))


def spread_nodes(places_m: Array, distance_m: float, most: int) -> Array | None:
    """Return places (m, 2), so that each of (n, 2) is near one; None if it takes too many."""
    cells = np.unique(np.round(places_m / (0.5 * distance_m)), axis=0) * (0.5 * distance_m)
    far = np.full(len(cells), np.inf)
    nodes: list[Array] = []
    while far.max() > distance_m:
        if len(nodes) == most:
            return None
        nodes.append(cells[int(far.argmax())])
        far = np.minimum(far, np.linalg.norm(cells - nodes[-1], axis=1))
    return np.array(nodes)


class Modes(NamedTuple):
    """The field at the rows of a channel, as independent modes: shapes (n, m), sums of squares (m,)."""

    shapes: Array
    squares: Array


def field_modes(places_m: Array, channels: Sequence[Channel], field: Field) -> list[Modes]:
    """Return the modes of a field for each channel; channels with the same rows share theirs."""
    basis = field.basis(places_m)
    found: list[Modes] = []
    for number, channel in enumerate(channels):
        if number and np.array_equal(channel.rows, channels[0].rows):
            found.append(found[0])
            continue
        used = basis[channel.rows]
        squares, vectors = np.linalg.eigh(used.T @ used)
        found.append(Modes(used @ vectors, squares.clip(min=0.0)))
    return found


class _Sums(NamedTuple):
    """Sums of products of a channel: ``across`` (m, d, p + 1) of the modes with derivatives and residual.

    ``inside`` (d, p + 1, p + 1) is of derivatives and residual alone; ``squares`` (m,) is of the modes alone.
    """

    squares: Array
    across: Array
    inside: Array
    size: int


def _sums(channel: Channel, modes: Modes) -> _Sums:
    columns = np.concatenate([channel.jacobian, channel.residual[:, :, None]], axis=2)
    flat = columns.reshape(len(columns), -1)
    across = (modes.shapes.T @ flat).reshape(-1, *columns.shape[1:])
    inside = np.array([columns[:, axis].T @ columns[:, axis] for axis in range(columns.shape[1])])
    return _Sums(modes.squares, across, inside, channel.residual.size)


def _weighed(sums: _Sums, white: float, smooth: float) -> tuple[Array, float]:
    """Return the products (p + 1, p + 1) weighed by the inverse covariance, and its log determinant."""
    axes = sums.inside.shape[0]
    ratio = (smooth / white) ** 2
    shares = ratio / (1.0 + ratio * sums.squares)
    across = sums.across.reshape(-1, sums.across.shape[2])
    products = sums.inside.sum(axis=0) - across.T @ (np.repeat(shares, axes)[:, None] * across)
    log_det = sums.size * 2 * np.log(white) + axes * np.log1p(ratio * sums.squares).sum()
    return products / white**2, float(log_det)


class Solution(NamedTuple):
    """The step (p,) to the best unknowns, its covariance (p, p), and the log likelihood of the noise."""

    step: Array
    covariance: Array
    likelihood: float


def factorize(scaled: Array) -> Array:
    """Return the lower Cholesky factor (p, p) of normal equations with a unit diagonal.

    A small ridge gives unknowns that the motion does not determine a large standard deviation.

    Raises
    ------
    numpy.linalg.LinAlgError
        The matrix is not finite, or far from positive.
    """
    for ridge in _RIDGES[:-1]:
        with suppress(LinAlgError):
            return np.asarray(np.linalg.cholesky(scaled + ridge * np.eye(len(scaled))))
    return np.asarray(np.linalg.cholesky(scaled + _RIDGES[-1] * np.eye(len(scaled))))


def _solve(parts: Sequence[tuple[Array, float]], prior: Array, values: Array) -> Solution:
    """Solve the weighed normal equations with a prior: the information (p,) of unknowns with ``values`` (p,).

    References
    ----------
    Restricted likelihood: Patterson and Thompson, Biometrika 1971, eq. (7).
    """
    products = sum((part[0] for part in parts), np.zeros((len(prior) + 1,) * 2))
    normal = products[:-1, :-1] + np.diag(prior)
    right = products[:-1, -1] - prior * values
    scale = 1 / np.sqrt(np.diag(normal).clip(min=1e-30))
    factor = factorize(normal * np.outer(scale, scale))
    step = scale * cho_solve((factor, True), scale * right)
    covariance = np.outer(scale, scale) * cho_solve((factor, True), np.eye(len(scale)))
    misfit = products[-1, -1] + float(prior @ values**2) - float(step @ right)
    log_dets = sum(part[1] for part in parts) + 2 * np.log(np.diag(factor)).sum() - 2 * np.log(scale).sum()
    return Solution(step, covariance, -0.5 * (misfit + log_dets))


def rough_noise(places_m: Array, channels: Sequence[Channel]) -> Noise:
    """Return a white noise of the size of the steps of residuals, and a field of the size of the rest."""
    white, smooth = [], []
    for channel in channels:
        steps = np.median(np.abs(np.diff(channel.residual, axis=0)))
        white.append(max(1.4826 * float(steps) / np.sqrt(2), channel.least_sigma))
        smooth.append(max(1.4826 * float(np.median(np.abs(channel.residual))), channel.least_sigma))
    for length_m in _ROUGH_LENGTHS_M:
        nodes_m = spread_nodes(places_m, _NODE_SHARE * length_m, _MOST_NODES)
        if nodes_m is not None:
            break
    assert nodes_m is not None
    return Noise(tuple(white), tuple(smooth), Field(nodes_m, length_m))


def estimate_noise(places_m: Array, channels: Sequence[Channel], prior: Array, values: Array) -> Noise:
    """Estimate the noise of the channels by restricted maximum likelihood.

    Parameters
    ----------
    places_m : (n, 2), of all instants.
    prior, values : (p,), the information and the present values of the unknowns.
    """
    every = -(-len(places_m) // _MOST_INSTANTS)
    kept = np.zeros(len(places_m), dtype=np.bool_)
    kept[::every] = True
    thin = [
        Channel(c.rows[kept], c.residual[kept[c.rows]], c.jacobian[kept[c.rows]], c.least_sigma)
        for c in channels
    ]
    best: tuple[float, Noise] | None = None
    for length_m in reversed(_LENGTHS_M):
        nodes_m = spread_nodes(places_m, _NODE_SHARE * length_m, _MOST_NODES)
        if nodes_m is None:
            break
        field = Field(nodes_m, length_m)
        modes = field_modes(places_m[kept], thin, field)
        sums = [_sums(channel, one) for channel, one in zip(thin, modes, strict=True)]
        noise, likelihood = _fit_sigmas(sums, thin, prior, values, field)
        if best is None or likelihood > best[0]:
            best = likelihood, noise
    assert best is not None
    return best[1]


def _fit_sigmas(
    sums: Sequence[_Sums], channels: Sequence[Channel], prior: Array, values: Array, field: Field
) -> tuple[Noise, float]:
    usual = [max(float(np.sqrt((c.residual**2).mean())), c.least_sigma) for c in channels]
    low = np.log([c.least_sigma for c in channels])

    lowest = np.concatenate([low, low + np.log(_LEAST_RATIO)])
    usual_field = np.log(_USUAL_FIELD)[: len(low)]
    # a heading turns by as much as its field is steep
    highest = np.log(_LARGEST_SLOPE * np.array([field.length_m, 1.0])[: len(low)])

    def sigmas(x: Array) -> tuple[Array, Array]:
        white, smooth = np.exp(np.maximum(x, lowest)).reshape(2, -1)
        return white, np.minimum(smooth, np.exp(highest))

    def cost(x: Array) -> float:
        parts = [_weighed(s, w, f) for s, w, f in zip(sums, *sigmas(x), strict=True)]
        excess = np.maximum(lowest - x, 0).sum() + np.maximum(x[len(low) :] - highest, 0).sum()
        unusual = (np.maximum(x[len(low) :], lowest[len(low) :]) - usual_field) / _USUAL_FACTOR
        return -_solve(parts, prior, values).likelihood + float(excess + 0.5 * unusual @ unusual)

    start = np.concatenate([np.log(usual) - 1.0, np.log(usual)])
    found = minimize(
        cost, start, method="Nelder-Mead", options={"xatol": 0.02, "fatol": 0.02, "maxiter": 400}
    )
    white, smooth = sigmas(found.x)
    return Noise(tuple(white.tolist()), tuple(smooth.tolist()), field), -float(found.fun)


def solve_with_noise(
    channels: Sequence[Channel], noise: Noise, modes: Sequence[Modes], prior: Array, values: Array
) -> Solution:
    """Return the generalised least-squares step of the unknowns, with the covariance of the noise."""
    parts = [
        _weighed(_sums(channel, one), white, smooth)
        for channel, one, white, smooth in zip(channels, modes, noise.white, noise.smooth, strict=True)
    ]
    return _solve(parts, prior, values)


def solve_white(channels: Sequence[Channel], prior: Array, values: Array) -> Solution:
    """Return the least-squares step with white noise of the size of the residuals."""
    parts = []
    for channel in channels:
        columns = np.concatenate([channel.jacobian, channel.residual[:, :, None]], axis=2)
        white = max(1.4826 * float(np.median(np.abs(channel.residual))), channel.least_sigma)
        products = np.einsum("ndj,ndk->jk", columns, columns, optimize=True) / white**2
        parts.append((products, channel.residual.size * 2 * np.log(white)))
    return _solve(parts, prior, values)
