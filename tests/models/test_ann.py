"""Small networks: their gradients, their learning, and the paper's figures."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import approx_fprime
from sklearn.exceptions import SkipTestWarning
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import Pipeline
from sklearn.utils.estimator_checks import check_estimator

from ipsys_log.errors import FitError
from ipsys_log.models.ann import NeuralNetwork, _slopes, evaluate_networks
from ipsys_log.models.closed_form import RigidTransform
from ipsys_log.models.table import create
from tests.models.test_rays import authors_pairs, error_cm


def test_three_tanh_neurons_and_a_linear_output() -> None:
    """Compute the network of fig. 4 of the paper, written out."""
    rng = np.random.default_rng(0)
    weights, x = rng.normal(size=16), rng.normal(size=(5, 3))
    neurons = [np.tanh(weights[4 * k] + x @ weights[4 * k + 1 : 4 * k + 4]) for k in range(3)]
    expected = weights[12] + sum(w * n for w, n in zip(weights[13:], neurons, strict=True))
    found, _ = evaluate_networks(weights[None], np.column_stack([np.ones(5), x]))
    np.testing.assert_allclose(found[0], expected, atol=1e-12)


def test_gradients_equal_finite_differences() -> None:
    rng = np.random.default_rng(1)
    weights, inputs = rng.normal(size=16), np.column_stack([np.ones(6), rng.normal(size=(6, 3))])

    def outputs(flat: np.ndarray) -> np.ndarray:
        return np.asarray(evaluate_networks(flat[None], inputs)[0][0])

    numeric = approx_fprime(weights, outputs, 1e-7)
    found = _slopes(weights[None], inputs, evaluate_networks(weights[None], inputs)[1])
    np.testing.assert_allclose(found[0].T, numeric, atol=1e-5)


def test_network_learns_the_output_of_another_network() -> None:
    rng = np.random.default_rng(2)
    x, elsewhere = rng.normal(size=(200, 3)), rng.normal(size=(200, 3))
    teacher = MLPRegressor(
        hidden_layer_sizes=(3,), activation="tanh", solver="lbfgs", max_iter=2000, random_state=0
    )
    teacher.fit(x, np.tanh(x[:, 0] - 0.5 * x[:, 1]) + 0.3 * x[:, 2])
    found = NeuralNetwork().fit(x, teacher.predict(x)).predict(elsewhere)
    assert np.abs(found - teacher.predict(elsewhere)).max() < 0.03


def test_noise_alone_is_not_learned() -> None:
    """The data select the weight decay: without it, 16 weights overfit 40 numbers."""
    rng = np.random.default_rng(3)
    x, noise = rng.normal(size=(40, 3)), rng.normal(size=40)
    assert NeuralNetwork().fit(x, noise).predict(x).std() < 0.2 * noise.std()


@pytest.mark.parametrize("count", [5, 6, 8, 10])
def test_few_pairs_give_no_noise_estimate(count: int) -> None:
    """A constant network also explains the data if the noise may be as large as the floor."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        x = rng.uniform((-2.3, -1.0, 1.9), (2.3, 1.0, 2.2), (count, 3))
        y = x * [1, -1, -1] + [2.4, 0.9, 2.1] + 0.01 * rng.normal(size=(count, 3))
        assert np.abs(NeuralNetwork().fit(x, y).predict(x) - y)[:, :2].max() < 0.1


def test_fewer_than_a_plane_needs_are_refused() -> None:
    with pytest.raises(FitError, match=r"ann needs at least 4 pairs .*, found 3 samples; measure more"):
        NeuralNetwork().fit(np.eye(3), np.eye(3))


def test_a_seed_gives_the_same_network_and_another_another() -> None:
    rng = np.random.default_rng(4)
    x = rng.normal(size=(40, 3))
    y = np.sin(2 * x) + 0.1 * rng.normal(size=(40, 3))
    one, same, other = (NeuralNetwork(seed).fit(x, y).predict(x) for seed in (0, 0, 1))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)


def test_estimator_passes_scikit_learn_checks() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SkipTestWarning)
        check_estimator(NeuralNetwork())


@pytest.mark.parametrize(("hybrid", "limit_cm"), [(False, 1.782), (True, 1.670)])
def test_the_papers_figures(data: Path, hybrid: bool, limit_cm: float) -> None:
    """Compare the means of ANN and RT+ANN over the three cameras with Table I, for any seed."""
    means = []
    for seed in range(5):
        network_of_seed = NeuralNetwork(seed)
        model = (
            Pipeline([("rigid", RigidTransform()), ("ann", network_of_seed)]) if hybrid else network_of_seed
        )
        means.append(
            np.mean([error_cm(model.fit(x, y).predict(u), v) for x, y, u, v in authors_pairs(data).values()])
        )
    assert means[0] <= limit_cm
    assert np.median(means) <= limit_cm


@pytest.mark.parametrize("subset", [10, 20, 30])
def test_all_nine_methods_can_be_fitted_to_the_published_subsets(data: Path, subset: int) -> None:
    import scipy.io

    from ipsys_log.models.table import MODELS

    training = scipy.io.loadmat(data / "imsel" / f"training_{subset}.mat")
    for name in [name for name in MODELS if name not in ("rayplane", "best")]:
        for camera in ("red", "white", "black"):
            x, y = training[f"Xc_{camera}"] / 100, training[f"Xw_{camera}"] / 100
            assert np.isfinite(create(name).fit(x, y).predict(x)).all(), (name, camera)
