"""Models compared with independent computations."""

from __future__ import annotations

import pickle
import warnings
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sklearn.base import clone
from sklearn.exceptions import SkipTestWarning
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures
from sklearn.utils.estimator_checks import check_estimator

from ipsys_log.errors import FitError, IpsysError
from ipsys_log.models.closed_form import PolynomialRegression
from ipsys_log.models.plain_models import rigid_transform
from ipsys_log.models.table import MODELS, create, inputs, min_pairs, parameters, predict_array, restore


def places(seed: int, count: int = 40, noise_m: float = 0.01) -> tuple[Any, Any]:
    """Return camera points over a floor, and world points near their positions."""
    rng = np.random.default_rng(seed)
    points = rng.uniform((-2.3, -1.0, 1.9), (2.3, 1.0, 2.2), (count, 3))
    world = Rotation.from_euler("xyz", (3.1, 0.02, 0.03)).apply(points) + np.array([2.4, 0.9, 2.1])
    return points, world + rng.normal(0, noise_m, world.shape)


@given(st.integers(0, 10_000), st.floats(0, 0.05))
def test_rigid_is_what_scipy_finds(seed: int, noise_m: float) -> None:
    points, world = places(seed, noise_m=noise_m)
    rotation, translation = rigid_transform(points, world)
    oracle, _ = Rotation.align_vectors(world - world.mean(axis=0), points - points.mean(axis=0))
    np.testing.assert_allclose(rotation, oracle.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(translation, world.mean(axis=0) - oracle.apply(points.mean(axis=0)), atol=1e-5)


def test_coplanar_points_give_a_rotation_not_a_reflection() -> None:
    points, _ = places(0)
    points[:, 2] = 2.0  # all at one height
    turn = Rotation.from_euler("xyz", (3.1, 0.02, 0.03))
    world = turn.apply(points) + np.array([2.4, 0.9, 2.1])
    # A little noise out of the plane makes eq. (11) mirror it.
    mirrored = points.copy()
    mirrored[:, 2] += np.random.default_rng(0).normal(0, 1e-3, len(points))
    normal = turn.apply([0, 0, 1])
    target = world - np.outer(mirrored[:, 2] - 2.0, normal)
    u, _, vt = np.linalg.svd((mirrored - mirrored.mean(axis=0)).T @ (target - target.mean(axis=0)))
    assert np.linalg.det(vt.T @ u.T) < 0  # eq. (11) as printed
    rotation, _ = rigid_transform(mirrored, target)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_allclose(rotation, turn.as_matrix(), atol=5e-3)


@given(st.integers(0, 10_000))
def test_poly_is_least_squares_on_second_order_terms(seed: int) -> None:
    points, world = places(seed)
    oracle = make_pipeline(PolynomialFeatures(2), LinearRegression(fit_intercept=False)).fit(points, world)
    elsewhere, _ = places(seed + 1)
    found = create("poly").fit(points, world).predict(elsewhere)
    np.testing.assert_allclose(found, oracle.predict(elsewhere), atol=1e-7)


def test_poly_is_more_exact_than_normal_equations() -> None:
    """The points are far from the origin and flat: centimetres, and heights that hardly vary."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-200, -100, 2000), (200, 100, 2000.5), (40, 3))
    coefficients = rng.normal(size=(10, 3))
    from ipsys_log.models.plain_models import regressors

    shifted = (points - points.mean(axis=0)) / 100
    world = regressors(shifted) @ coefficients
    found = create("poly").fit(points, world).predict(points)
    np.testing.assert_allclose(found, world, atol=1e-8)
    terms = regressors(points)
    with np.errstate(all="ignore"):
        printed = terms @ np.linalg.lstsq(terms.T @ terms, terms.T @ world, rcond=0)[0]  # eq. (14)
    assert np.abs(printed - world).max() > 1e-6


@pytest.mark.parametrize("name", list(MODELS))
def test_parameters_bring_the_model_back(name: str) -> None:
    points, world = places(0)
    points = inputs(name, points, world[:, 2])
    fitted = clone(create(name)).fit(points, world)
    arrays = parameters(fitted)
    assert all(array.dtype == np.float64 for array in arrays.values())
    back = restore(name, arrays)
    np.testing.assert_array_equal(predict_array(back, points), fitted.predict(points))
    pickle.loads(pickle.dumps(fitted))  # scikit-learn's tools allow it; the log does not


@pytest.mark.parametrize("name", list(MODELS))
def test_min_pairs_is_enough_and_one_less_is_not(name: str) -> None:
    points, world = places(0, count=min_pairs(name), noise_m=0)
    create(name).fit(inputs(name, points, world[:, 2]), world)
    if name == "rigid":
        with pytest.raises(FitError, match="at least 3 pairs, found 2"):
            create(name).fit(points[:2], world[:2])


def test_rigid_then_poly_is_poly() -> None:
    """A rotation of the inputs does not change the span of a full second-order polynomial."""
    points, world = places(3)
    both = create("rigid+poly").fit(points, world).predict(points)
    np.testing.assert_allclose(both, create("poly").fit(points, world).predict(points), atol=1e-9)


def test_poly_passes_scikit_learn_checks() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SkipTestWarning)
        check_estimator(PolynomialRegression())


def test_unknown_models_and_parameters_are_named() -> None:
    with pytest.raises(IpsysError, match="use one of rigid, poly, rigid"):
        create("spline")
    with pytest.raises(IpsysError, match="has no parameter 'rotation'"):
        restore("rigid", {"translation": np.zeros(3)})


@pytest.mark.parametrize("name", ["rigid", "poly", "rigid+poly", "rayplane", "best"])
def test_prediction_without_input_checks_is_bit_identical(name: str) -> None:
    points, world = places(0)
    heights = np.full(len(points), 0.1)
    model = create(name).fit(inputs(name, points, heights), np.column_stack([world[:, :2], heights]))
    for count in (1, 2, 5, 40):
        some = inputs(name, points[:count], heights[:count])
        assert predict_array(model, some).tobytes() == model.predict(some).tobytes()
