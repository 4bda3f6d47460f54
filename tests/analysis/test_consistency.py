"""Estimates of the usual errors, from errors with a known distribution."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi, norm

from ipsys_log.models.closed_form import PolynomialRegression
from ipsys_log.statistics import consistency
from ipsys_log.statistics.consistency import score, usual_covariances

Array = NDArray[np.float64]

EYE = np.array([2.0, 2.0, 2.0])


def floor(rng: np.random.Generator, count: int) -> Array:
    return rng.uniform([0, 0, 0], [4, 4, 0.2], (count, 3))


def errors(rng: np.random.Generator, places: Array, along: float, across: float, power: float = 0.0) -> Array:
    """Return errors along and across the view from EYE; those along the view grow towards the rim."""
    views = places - EYE
    slant = (views**2).sum(axis=1) / views[:, 2] ** 2
    views /= np.linalg.norm(views, axis=1)[:, None]
    noise = rng.normal(0, across, places.shape)
    noise -= (noise * views).sum(axis=1)[:, None] * views
    found: Array = noise + views * (rng.normal(0, along, len(places)) * slant**power)[:, None]
    return found


def usual(places: Array, off: Array, *, left_out: int = 0, tape: float = 0.0) -> Array:
    fitted = np.arange(len(places)) >= left_out
    return usual_covariances(places, off, fitted, np.full((len(places), 3, 3), tape**2 * np.eye(3)))


def test_the_score_is_a_length_in_units_of_the_usual_one() -> None:
    rng = np.random.default_rng(0)
    root = np.array([[0.02, 0, 0], [0.01, 0.005, 0], [0, 0.003, 0.01]])
    drawn = rng.normal(size=(20000, 3)) @ root.T
    scores = score(drawn, np.broadcast_to(root @ root.T, (20000, 3, 3)))
    assert np.median(scores) == pytest.approx(1, abs=0.02)
    assert np.quantile(scores, 0.99) == pytest.approx(chi.ppf(0.99, 3) / chi.median(3), rel=0.03)
    np.testing.assert_allclose(score(2 * drawn, np.broadcast_to(root @ root.T, (20000, 3, 3))), 2 * scores)


@pytest.mark.parametrize("scale", [1.0, 10.0])
def test_the_median_score_is_one_whatever_the_errors(scale: float) -> None:
    rng = np.random.default_rng(1)
    places = floor(rng, 400)
    off = scale * errors(rng, places, 0.01, 0.003)
    assert np.median(score(off, usual(places, off))) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("power", [0.0, 1.0, 2.0])
def test_errors_along_the_view_are_told_from_errors_across_it(power: float) -> None:
    rng = np.random.default_rng(2)
    places = floor(rng, 2000)
    found = usual(places, errors(rng, places, 0.01, 0.004, power))
    views = places - EYE
    slant = (views**2).sum(axis=1) / views[:, 2] ** 2
    views /= np.linalg.norm(views, axis=1)[:, None]
    along = np.sqrt(np.einsum("ni,nij,nj->n", views, found, views))
    across = np.sqrt((np.trace(found, axis1=1, axis2=2) - along**2) / 2)
    assert 1.3 < np.median((along / across)[slant < 1.1]) < 3.0
    # The test is less strict at the rim, by half a power.
    assert np.polyfit(np.log(slant), np.log(along), 1)[0] == pytest.approx(power + 0.5, abs=0.3)


def test_gross_errors_do_not_move_the_yardstick() -> None:
    rng = np.random.default_rng(3)
    places = floor(rng, 60)
    off = errors(rng, places, 0.01, 0.003, 1.0)
    spoilt = off.copy()
    spoilt[:6] += rng.normal(0, 1, (6, 3))
    ratio = np.linalg.det(usual(places, spoilt)) / np.linalg.det(usual(places, off))
    assert (ratio ** (1 / 6) < 1.6).all()
    assert score(spoilt, usual(places, spoilt))[:6].min() > 5


def test_threshold_grows_with_leverage_at_the_rim() -> None:
    """Return leave-one-out errors of the polynomial itself, on points with equal noise (Monte Carlo)."""
    rng = np.random.default_rng(4)
    places = floor(rng, 30)
    squares = np.zeros(30)
    for _ in range(60):
        seen = places + rng.normal(0, 0.01, places.shape)
        for n in range(30):
            rest = np.arange(30) != n
            squares[n] += (
                (PolynomialRegression().fit(seen[rest], places[rest]).predict(seen[n : n + 1]) - places[n])
                ** 2
            ).sum()
    allowed = np.trace(usual(places, rng.normal(0, 0.01, places.shape)), axis1=1, axis2=2)
    assert np.corrcoef(np.log(squares), np.log(allowed))[0, 1] > 0.7
    assert allowed.max() > 2 * allowed.min()


def test_few_points_increase_the_threshold() -> None:
    rng = np.random.default_rng(5)
    sizes = []
    for count in (15, 20, 50, 200):
        places = floor(rng, count)
        off = rng.normal(0, 0.01, places.shape)
        sizes.append(float(np.median(score(off, usual(places, off)))))
    assert sizes == sorted(sizes)
    assert sizes[0] < 0.5
    assert sizes[-1] > 0.95


def test_tape_error_adds_to_the_error() -> None:
    rng = np.random.default_rng(6)
    places = floor(rng, 200)
    off = rng.normal(0, 0.01, places.shape)
    tape_m2 = 0.008**2 * np.eye(3)
    known = usual(places, off, tape=0.008)
    assert np.trace(known.mean(axis=0)) < np.trace(usual(places, off).mean(axis=0))
    # The usual error is rather overestimated than underestimated with the tape's part.
    assert 0.7 < np.median(score(off, known + tape_m2)) <= 1.01


def test_excluded_points_are_judged_by_the_others() -> None:
    rng = np.random.default_rng(7)
    places = floor(rng, 50)
    off = rng.normal(0, 0.01, places.shape)
    before = usual(places, off, left_out=5)
    off[:5] += 3.0
    np.testing.assert_allclose(usual(places, off, left_out=5), before, rtol=1e-12)


@pytest.mark.parametrize("kind", ["exact", "one height", "one place", "on a line"])
def test_degenerate_sessions_have_a_yardstick(kind: str) -> None:
    rng = np.random.default_rng(8)
    places = floor(rng, 20)
    off = rng.normal(0, 0.01, places.shape)
    if kind == "exact":
        off[:] = 0
    elif kind == "one height":
        places[:, 2], off[:, 2] = 0, 0
    elif kind == "one place":
        places[:] = [1.0, 2.0, 0.1]
    else:
        places[:, 1:] = [2.0, 0.0]
    found = usual(places, off)
    assert np.isfinite(found).all()
    assert np.linalg.eigvalsh(found).min() > 0


def test_medians_are_those_of_normal_errors() -> None:
    assert pytest.approx(norm.ppf(0.75), rel=1e-15) == consistency._MEDIAN_1D
    assert pytest.approx(chi.median(3), rel=1e-15) == consistency._MEDIAN_3D
