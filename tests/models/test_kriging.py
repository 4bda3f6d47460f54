"""Kriging compared with written formulas and with the paper's figures."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from sklearn.exceptions import SkipTestWarning
from sklearn.utils.estimator_checks import check_estimator

from ipsys_log.errors import FitError
from ipsys_log.models.kriging import Kriging, _correlations, _gls, _squared_gaps, fit_correlations
from ipsys_log.models.table import create, parameters, restore
from tests import labs
from tests.models.test_rays import authors_pairs, error_cm


def wavy(seed: int, count: int = 30, noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    x = rng.uniform(-2, 2, (count, 3))
    return x, np.sin(2 * x[:, 0]) + 0.3 * x[:, 1] ** 2 + 0.5 * x[:, 2] + noise * rng.normal(size=count)


@pytest.mark.parametrize("noisy", [False, True])
def test_mean_and_variance_are_those_of_the_textbook(noisy: bool) -> None:
    """Compute universal kriging by its normal equations, with the fitted parameters."""
    x, y = wavy(0, noise=0.1 if noisy else 0.0)
    model = Kriging(noisy).fit(x, y)
    points = (x - model.centre_) / model.scale_
    z = (y - model.target_centre_) / model.target_scale_
    at = np.random.default_rng(1).uniform(-2, 2, (7, 3))
    q = (at - model.centre_) / model.scale_
    theta = np.exp(model.logs_[0][:3] if noisy else np.repeat(model.logs_[0], 3))

    def correlation(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.asarray(np.exp(-((a[:, None] - b[None]) ** 2 * theta).sum(axis=2)))

    full = correlation(points, points) + (np.exp(model.logs_[0][3]) if noisy else 0.0) * np.eye(len(x))
    f, fq = (np.column_stack([np.ones(len(p)), p]) for p in (points, q))
    inverse = np.linalg.inv(full)
    alpha = np.linalg.solve(f.T @ inverse @ f, f.T @ inverse @ z)
    r = correlation(q, points)
    mean = fq @ alpha + r @ inverse @ (z - f @ alpha)
    sigma2 = (z - f @ alpha) @ inverse @ (z - f @ alpha) / len(z)
    u = f.T @ inverse @ r.T - fq.T
    spread = np.einsum("in,ij,jn->n", u, np.linalg.inv(f.T @ inverse @ f), u)
    variance = sigma2 * (1 + spread - np.einsum("ni,ij,nj->n", r, inverse, r))
    found, std = model.predict(at, return_std=True)
    np.testing.assert_allclose(found, mean * model.target_scale_ + model.target_centre_, atol=1e-5)
    np.testing.assert_allclose(std, np.sqrt(variance) * model.target_scale_, rtol=1e-3, atol=1e-6)


def test_interpolation_is_exact_only_at_its_points() -> None:
    x, y = wavy(1)
    model = Kriging().fit(x, y)
    found, std = model.predict(x, return_std=True)
    np.testing.assert_allclose(found, y, atol=1e-5)
    assert std.max() < 1e-3
    far = model.predict(x + 5.0, return_std=True)[1]
    assert far.min() > 100 * std.max()


def test_regression_finds_the_noise() -> None:
    x, y = wavy(2, count=120, noise=0.2)
    model = Kriging(noisy=True).fit(x, y)
    noise = np.sqrt(np.exp(model.logs_[0][-1]) * model.variance_[0]) * model.target_scale_[0]
    assert noise == pytest.approx(0.2, rel=0.25)
    assert np.abs(model.predict(x) - y).std() > 0.1


def test_fitted_parameters_maximise_the_likelihood() -> None:
    from scipy.stats import multivariate_normal

    x, y = wavy(3, count=40, noise=0.1)
    points, z = (x - x.mean(axis=0)) / x.std(axis=0), (y - y.mean()) / y.std()
    f = np.column_stack([np.ones(len(x)), points])

    def log_likelihood(logs: np.ndarray) -> float:
        gaps = (points[:, None] - points[None]) ** 2
        full = np.exp(-(gaps * np.exp(logs[:3])).sum(axis=2)) + np.exp(logs[3]) * np.eye(len(x))
        inverse = np.linalg.inv(full)
        alpha = np.linalg.solve(f.T @ inverse @ f, f.T @ inverse @ z)
        sigma2 = (z - f @ alpha) @ inverse @ (z - f @ alpha) / len(z)
        return float(multivariate_normal.logpdf(z, f @ alpha, sigma2 * full))

    (best,) = fit_correlations(points, z[:, None], noisy=True)
    rng = np.random.default_rng(0)
    low, high = np.log([1e-3, 1e-3, 1e-3, 1e-8]), np.log([1.0, 1.0, 1.0, 1e2])
    others = [*(best + rng.normal(0, 0.1, 4) for _ in range(40)), *rng.uniform(low, high, (200, 4))]
    assert log_likelihood(best) >= max(log_likelihood(np.clip(o, low, high)) for o in others) - 1e-6


def test_duplicate_points_do_not_break_the_fit() -> None:
    x, y = wavy(4)
    x[5] = x[6]
    found = Kriging().fit(x, y).predict(x)
    assert np.isfinite(found).all()
    assert np.isfinite(Kriging(noisy=True).fit(x, y).predict(x)).all()


# It fits 11 rows of 10 columns: the linear trend leaves no data for a variance.
_TOO_FEW = {"check_regressor_multioutput": "has fewer rows than a linear trend of its columns needs"}


# The checks of scikit-learn: dozens of fits.
@pytest.mark.slow
@pytest.mark.parametrize("noisy", [False, True])
def test_estimator_passes_scikit_learn_checks(noisy: bool) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SkipTestWarning)
        check_estimator(Kriging(noisy), expected_failed_checks=_TOO_FEW)


def test_too_few_pairs_for_a_trend_are_refused() -> None:
    x, y = wavy(5, count=6)
    Kriging().fit(x, y)
    with pytest.raises(FitError, match=r"kriging needs at least 6 pairs .*, found 5 samples; measure more"):
        Kriging().fit(x[:5], y[:5])


def test_much_noise_leaves_the_plane() -> None:
    x, y = wavy(6)
    terms = np.column_stack([np.ones(len(x)), x])
    noisy = _correlations(np.log([1.0, 1.0, 1.0, 1e9]), _squared_gaps(x, isotropic=False))[1]
    found = _gls(noisy, terms, y)
    assert found is not None
    np.testing.assert_allclose(found.trend, np.linalg.lstsq(terms, y, rcond=None)[0], atol=1e-6)


def test_the_variance_comes_back_out_of_a_log_too() -> None:
    rng = np.random.default_rng(0)
    world = labs.places(rng, 30)
    points = labs.camera(rng).see(world, rng)
    model = create("kriging-regression").fit(points, world)
    back = restore("kriging-regression", parameters(model))
    for one, other in zip(
        model.predict(points, return_std=True), back.predict(points, return_std=True), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=1e-9)


# Table I: means of KI and RT+KI in cm for the red, white and black camera.
INTERPOLATED = {"kriging": (1.306, 2.297, 2.898), "rigid+kriging": (1.312, 2.294, 2.804)}
REGRESSED = {"kriging-regression": 2.048, "rigid+kriging-regression": 2.033}


def test_the_papers_figures(data: Path) -> None:
    for name in (*INTERPOLATED, *REGRESSED):
        means = np.array(
            [
                error_cm(create(name).fit(x, y).predict(test_x), test_y)
                for x, y, test_x, test_y in authors_pairs(data).values()
            ]
        )
        if name in INTERPOLATED:
            np.testing.assert_allclose(means, np.array(INTERPOLATED[name]), rtol=0.08)
        else:
            assert means.mean() <= REGRESSED[name]
