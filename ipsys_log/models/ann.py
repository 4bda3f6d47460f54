"""Neural networks from camera points to world points (sect. 2.2.3 of the paper)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, MultiOutputMixin, RegressorMixin
from sklearn.utils.validation import check_is_fitted, validate_data

from ipsys_log.errors import FitError
from ipsys_log.messages import Array


def column_sigmas(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation of each column, (d,) of (n, d); 1 if a column is constant.

    Examples
    --------
    >>> column_sigmas(np.array([[0.0, 5.0], [2.0, 5.0]])).tolist()
    [1.0, 1.0]
    """
    deviation = values.std(axis=0)
    # By rounding, a column of equal numbers can have a tiny variance.
    level = deviation <= 1e-12 * np.abs(values).max(axis=0)
    return np.where(level, 1.0, deviation)


_NEURONS = 3
_RESTARTS = 16
_STEPS = 60
# Standard deviation of the initial weights of a network.
_FIRST_SIGMA = 0.7
# Regularization of the other weights, relative to that of the slopes of the neurons, which bend the function.
_OTHERS_PULL = 0.01
# Number of steps before the regularization is adapted, and its bounds.
_UNTIL_ADAPTED = 3
_PULLS = (1e-8, 1e3)
# Least variance of the noise, for targets of unit variance. Exact targets have none, but the code needs its
# logarithm.
_LEAST_NOISE = 1e-12
_NOISE_OVER_PLANE = 4.0
# A complex step of the strength: so small that its square is nothing beside it.
_STEP = 1e-20


def evaluate_networks(weights: Array, inputs: Array) -> tuple[Array, Array]:
    """Return the outputs of networks with one hidden layer of tanh neurons.

    Parameters
    ----------
    weights : (b, h (d + 1) + h + 1), weights of b networks: bias and d slopes of each neuron, then bias and
        h slopes of the output.
    inputs : (n, d + 1), the first column is 1.

    Returns
    -------
    outputs : (b, n).
    neurons : (b, h, n), outputs of the hidden layer.
    """
    hidden, out = _parts(weights, inputs.shape[1])
    neurons = np.tanh(hidden @ inputs.T)
    return out[:, :1] + np.einsum("bh,bhn->bn", out[:, 1:], neurons), neurons


def _parts(weights: Array, width: int) -> tuple[Array, Array]:
    edge = _NEURONS * width
    return weights[:, :edge].reshape(-1, _NEURONS, width), weights[:, edge:]


def _slopes(weights: Array, inputs: Array, neurons: Array) -> Array:
    """Return the derivatives of the outputs by the weights, (b, weights, n)."""
    hidden, out = _parts(weights, inputs.shape[1])
    bent = (1 - neurons**2) * out[:, 1:, None]
    slopes, edge = np.empty((*weights.shape, len(inputs))), hidden[0].size
    by_hidden = slopes[:, :edge].reshape(*hidden.shape, -1)  # a view: to concatenate takes four times as long
    np.multiply(bent[:, :, None], inputs.T, out=by_hidden)
    slopes[:, edge], slopes[:, edge + 1 :] = 1.0, neurons
    return slopes


def train_networks(inputs: Array, targets: Array, weights: Array) -> tuple[Array, Array]:
    """Train networks by Levenberg-Marquardt; estimate the regularization of the weights from the data.

    Parameters
    ----------
    inputs : (n, d + 1), the first column is 1, the others have unit variance.
    targets : (b, n), of unit variance, one row for each network.
    weights : (b, w), initial weights.

    Returns
    -------
    weights : (b, w).
    evidence : (b,), logarithm of the likelihood of the targets, without a constant. Misfit and bending reduce
        it. The best network has the greatest evidence.

    References
    ----------
    MacKay, Neural Computation 1992 (3), 415 and 448; Foresee and Hagan, ICNN 1997.
    """
    most_noise = _most_noise(inputs, targets)
    pull = _relative_pulls(inputs.shape[1], weights.shape[1])
    strength, damping = np.full(len(weights), 1e-3), np.full(len(weights), 1e-2)
    outputs, neurons = evaluate_networks(weights, inputs)
    for step in range(_STEPS):
        slopes = _slopes(weights, inputs, neurons)
        curvature = slopes @ slopes.transpose(0, 2, 1)
        misfit = outputs - targets
        if step >= _UNTIL_ADAPTED:
            strength = _adapted(strength, curvature, misfit, weights, pull, most_noise)
        cost = (misfit**2).sum(axis=1) + strength * (weights**2 @ pull)
        gradient = (slopes @ misfit[:, :, None])[:, :, 0] + strength[:, None] * pull * weights
        damped = _add_diagonal(curvature, strength[:, None] * pull + damping[:, None])
        tried = weights - np.linalg.solve(damped, gradient[:, :, None])[:, :, 0]
        tried_outputs, tried_neurons = evaluate_networks(tried, inputs)
        tried_cost = ((tried_outputs - targets) ** 2).sum(axis=1) + strength * (tried**2 @ pull)
        better = tried_cost < cost
        weights = np.where(better[:, None], tried, weights)
        outputs = np.where(better[:, None], tried_outputs, outputs)
        neurons = np.where(better[:, None, None], tried_neurons, neurons)
        damping = np.clip(np.where(better, damping * 0.2, damping * 4), 1e-12, 1e8)
    return weights, _evidence(weights, inputs, targets, strength, pull, most_noise)


def _most_noise(inputs: Array, targets: Array) -> Array:
    """Return the largest allowed variance (b,) of the noise: a few times that about a plane of the targets.

    Without this bound, a flat network can explain a few pairs as noise alone.
    """
    residuals = targets.T - inputs @ np.linalg.lstsq(inputs, targets.T, rcond=None)[0]
    variance = (residuals**2).sum(axis=0) / max(len(inputs) - inputs.shape[1], 1)
    most: Array = np.maximum(_NOISE_OVER_PLANE * variance, _LEAST_NOISE)
    return most


def _relative_pulls(inputs: int, width: int) -> Array:
    pull = np.full(width, _OTHERS_PULL)
    bending = np.ones((_NEURONS, inputs), dtype=bool)
    bending[:, 0] = False
    pull[: bending.size][bending.reshape(-1)] = 1.0
    return pull


def _add_diagonal(matrices: Any, values: Any) -> Any:
    """Return square matrices (b, w, w) with values (b, w) added to their diagonals."""
    added = matrices.copy()
    added.reshape(len(added), -1)[:, :: added.shape[1] + 1] += values
    return added


def _adapted(
    strength: Array, curvature: Array, misfit: Array, weights: Array, pull: Array, most_noise: Array
) -> Array:
    """Return the regularization that is consistent with noise and weights (MacKay 1992, eq. 2.21)."""
    determined, noise = _determined(strength, curvature, misfit, pull, most_noise)
    size = weights**2 @ pull / np.maximum(determined, 1e-3)
    adapted: Array = np.clip(noise / np.maximum(size, 1e-300), *_PULLS)
    return adapted


def _determined(
    strength: Array, curvature: Array, misfit: Array, pull: Array, most_noise: Array
) -> tuple[Array, Array]:
    """Return the number of weights that the data determine, and the variance of the noise, (b,) each.

    ``misfit`` is (b, n).
    """
    # tr(H^-1 P) is the derivative of log det H by the strength. A complex step is faster than an inverse.
    stepped = _add_diagonal(curvature.astype(complex), (strength[:, None] + _STEP * 1j) * pull + 1e-12)
    determined = len(pull) - strength * np.linalg.slogdet(stepped)[0].imag / _STEP
    count = misfit.shape[1]
    noise = (misfit**2).sum(axis=1) / np.maximum(count - determined, 0.1 * count)
    return determined, np.clip(noise, _LEAST_NOISE, most_noise)


def _evidence(
    weights: Array, inputs: Array, targets: Array, strength: Array, pull: Array, most_noise: Array
) -> Array:
    outputs, neurons = evaluate_networks(weights, inputs)
    slopes, misfit = _slopes(weights, inputs, neurons), outputs - targets
    curvature = slopes @ slopes.transpose(0, 2, 1)
    _, noise = _determined(strength, curvature, misfit, pull, most_noise)
    hessian = _add_diagonal(curvature, strength[:, None] * pull)
    cost = ((misfit**2).sum(axis=1) + strength * (weights**2 @ pull)) / noise
    log_det = np.linalg.slogdet(hessian / noise[:, None, None])[1]
    prior = len(pull) * np.log(strength / noise)
    evidence: Array = -(cost + log_det - prior + targets.shape[1] * np.log(noise)) / 2
    return evidence


class NeuralNetwork(MultiOutputMixin, RegressorMixin, BaseEstimator):  # type: ignore[misc]
    """One network for each world coordinate: three tanh neurons and a linear output (fig. 4 of the paper).

    Parameters
    ----------
    seed : random seed of the initial weights. The fit keeps the network with the greatest evidence of 16
        starts.

    Attributes
    ----------
    centre_, scale_ : (d,), mean and standard deviation of the inputs.
    target_centre_, target_scale_ : (outputs,), the same of the targets.
    weights_ : (outputs, 3 (d + 1) + 4), see :func:`evaluate_networks`.

    Examples
    --------
    >>> x = np.linspace(-2, 2, 30)[:, None]
    >>> model = NeuralNetwork().fit(x, np.tanh(x[:, 0]))
    >>> bool(abs(model.predict(x) - np.tanh(x[:, 0])).max() < 0.01)
    True
    """

    fitted: ClassVar[tuple[str, ...]] = ("centre_", "scale_", "target_centre_", "target_scale_", "weights_")

    def __init__(self, seed: int = 0) -> None:
        self.seed = seed

    def fit(self, X: Any, y: Any) -> NeuralNetwork:
        X, y = validate_data(self, X, y, multi_output=True, y_numeric=True, dtype=np.float64)
        if len(X) < X.shape[1] + 1:
            raise FitError(
                f"ann needs at least {X.shape[1] + 1} pairs (samples), found {len(X)} sample"
                f"{'s' if len(X) > 1 else ''}; measure more points"
            )
        targets = y.reshape(len(y), -1)
        self._single = y.ndim == 1
        self.centre_, self.scale_ = X.mean(axis=0), column_sigmas(X)
        self.target_centre_, self.target_scale_ = targets.mean(axis=0), column_sigmas(targets)
        scaled = ((targets - self.target_centre_) / self.target_scale_).T
        inputs = self._inputs(X)
        width = _NEURONS * inputs.shape[1] + _NEURONS + 1
        first = np.random.default_rng(self.seed).normal(0.0, _FIRST_SIGMA, (_RESTARTS, width))
        weights, evidence = train_networks(
            inputs, np.repeat(scaled, _RESTARTS, axis=0), np.tile(first, (len(scaled), 1))
        )
        best = evidence.reshape(len(scaled), _RESTARTS).argmax(axis=1)
        self.weights_ = weights.reshape(len(scaled), _RESTARTS, width)[np.arange(len(scaled)), best]
        return self

    def predict(self, X: Any) -> Array:
        check_is_fitted(self)
        X = validate_data(self, X, dtype=np.float64, reset=False)
        scaled, _ = evaluate_networks(self.weights_, self._inputs(X))
        values: Array = scaled.T * self.target_scale_ + self.target_centre_
        return values[:, 0] if getattr(self, "_single", False) else values

    def _inputs(self, X: Array) -> Array:
        return np.hstack([np.ones((len(X), 1)), (X - self.centre_) / self.scale_])
