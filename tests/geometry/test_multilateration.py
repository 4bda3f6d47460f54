"""Least squares of eq. (25) compared with scipy; its covariance with closed forms and samples."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import least_squares

from ipsys_log.errors import IpsysError
from ipsys_log.vision.trilateration import (
    are_collinear,
    crossing_angle,
    multilaterate,
    tape_covariance,
    trilaterate,
)

Array = NDArray[np.float64]

A, B, C = np.array([1.2192, 2.4384]), np.array([3.6576, 2.4384]), np.array([2.4384, 0.6])
coordinates = st.floats(-5, 10)


def ranges(point_m: Array, references_m: Array) -> Array:
    return np.array([np.hypot(*(point_m - reference)) for reference in references_m])


def triangle_area(a: Array, b: Array, c: Array) -> float:
    return abs(float((b - a)[0] * (c - a)[1] - (b - a)[1] * (c - a)[0])) / 2


@given(st.tuples(*[coordinates] * 6), st.sampled_from(["left", "right"]))
def test_two_distances_are_eq_25_to_the_last_digit(numbers: tuple[float, ...], side: str) -> None:
    a, b, point = np.array(numbers).reshape(3, 2)
    assume(np.hypot(*(b - a)) > 0.1)
    d1, d2 = ranges(point, np.array([a, b])).tolist()
    try:
        expected = trilaterate(a, b, d1, d2, side)
    except IpsysError as error:
        with pytest.raises(IpsysError, match=str(error)[:40]):
            multilaterate(np.array([a, b]), np.array([d1, d2]), side=side)
        return
    found = multilaterate(np.array([a, b]), np.array([d1, d2]), side=side)
    assert found.point_m.tobytes() == expected.tobytes()
    assert found.residuals_m.tolist() == [0.0, 0.0]
    assert found.covariance_m2 is None
    assert found.reduced_chi2 is None


@given(st.lists(st.tuples(coordinates, coordinates), min_size=4, max_size=7))
def test_exact_distances_from_three_points_or_more_need_no_side(numbers: list[tuple[float, float]]) -> None:
    point, references = np.array(numbers[0]), np.array(numbers[1:])
    triangles = [triangle_area(*corners) for corners in combinations(references, 3)]
    assume(max(triangles) > 0.5)  # some three of them are far from one line
    assume(not are_collinear(references) and ranges(point, references).min() > 0)
    found = multilaterate(references, ranges(point, references))
    np.testing.assert_allclose(found.point_m, point, atol=1e-6)
    np.testing.assert_allclose(found.residuals_m, 0, atol=1e-7)


@given(st.integers(0, 10_000), st.integers(3, 6))
@settings(max_examples=60)
def test_contradicting_distances_are_weighed_as_scipy_does(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    references, point = rng.uniform(0, 5, (count, 2)), rng.uniform(0, 5, 2)
    assume(max(triangle_area(*corners) for corners in combinations(references, 3)) > 1)
    assume(ranges(point, references).min() > 0.3)
    sigmas = rng.uniform(0.002, 0.02, count)
    distances = ranges(point, references) + rng.normal(0, sigmas)
    found = multilaterate(references, distances, sigmas)

    def off(at: Array) -> Array:
        return (distances - ranges(at, references)) / sigmas

    # Near a line through most of the reference points there is a second, mirrored minimum.
    starts = [point, *(2 * reference - point for reference in references), *rng.uniform(0, 5, (6, 2))]
    tried = [least_squares(off, start, xtol=1e-14, ftol=1e-14, gtol=1e-14) for start in starts]
    wanted = min(tried, key=lambda one: float(one.cost))
    np.testing.assert_allclose(found.point_m, wanted.x, atol=1e-7)
    np.testing.assert_allclose(found.residuals_m, wanted.fun * sigmas, atol=1e-7)
    assert found.reduced_chi2 == pytest.approx(2 * wanted.cost / (count - 2), rel=1e-6, abs=1e-9)
    slope = np.asarray(wanted.jac)
    assert found.covariance_m2 is not None
    np.testing.assert_allclose(found.covariance_m2, np.linalg.inv(slope.T @ slope), rtol=1e-4, atol=1e-12)


def test_side_selects_one_of_two_equal_solutions() -> None:
    """A third reference point 10 cm beside the line of the others hardly determines the side."""
    references = np.array([[0.0, 0.0], [4.0, 0.0], [2.0, 0.1]])
    point = np.array([2.1, 0.6])
    distances = ranges(point, references)
    sigmas = np.full(3, 0.1)
    for side, sign in (("left", 1), ("right", -1)):
        assert np.sign(multilaterate(references, distances, sigmas, side).point_m[1]) == sign
    # The distances give the side more reliably than the noted side.
    fine = multilaterate(references, distances, np.full(3, 0.001), "right")
    np.testing.assert_allclose(fine.point_m, point, atol=1e-6)
    np.testing.assert_allclose(multilaterate(references, distances, side="right").point_m, point, atol=1e-6)


def test_gross_contradiction_is_reported_and_not_refused() -> None:
    references, point = np.array([A, B, C]), np.array([2.0, 3.5])
    distances = ranges(point, references) + np.array([0.1, 0, 0])
    found = multilaterate(references, distances, np.full(3, 0.003))
    assert np.hypot(*(found.point_m - point)) < 0.1
    assert found.reduced_chi2 is not None
    assert found.reduced_chi2 > 100
    assert np.abs(found.residuals_m).max() > 0.02


def test_circles_that_just_miss_one_another() -> None:
    point = np.array([0.5, 2.4384])  # beyond A on the line AB: a slightly shorter distance gives no triangle
    two, three = np.array([A, B]), np.array([A, B, C])
    short = ranges(point, three) + np.array([-0.002, 0.002, 0])
    with pytest.raises(IpsysError, match="do not meet"):
        multilaterate(two, short[:2], side="left")
    assert np.hypot(*(multilaterate(three, short).point_m - point)) < 0.05


@pytest.mark.parametrize("side", ["left", "right"])
def test_three_reference_points_on_one_line_need_the_side(side: str) -> None:
    references = np.array([[0.0, 0.0], [1.0, 1.0], [3.0, 3.0]])
    left = np.array([0.5, 2.0])  # left or right of the line from the first point to the last
    right = left[::-1]
    distances = ranges(left, references) + np.array([0.001, -0.001, 0.001])
    assert are_collinear(references)
    with pytest.raises(IpsysError, match=r"3 reference points are on one line.*'left' or 'right'"):
        multilaterate(references, distances)
    found = multilaterate(references, distances, side=side)
    np.testing.assert_allclose(found.point_m, left if side == "left" else right, atol=0.005)
    # In the opposite direction of the line, left is right.
    other = multilaterate(references[::-1], distances[::-1], side="left")
    np.testing.assert_allclose(other.point_m, right, atol=0.005)


def test_one_reference_point_measured_twice() -> None:
    references = np.array([A, A, B])
    point = trilaterate(A, B, 1.7, 1.9, "left")
    found = multilaterate(references, np.array([1.698, 1.702, 1.9]), side="left")
    np.testing.assert_allclose(found.point_m, point, atol=1e-5)


def test_many_readings_are_as_good_as_their_mean() -> None:
    rng = np.random.default_rng(3)
    references = np.array([A] * 200 + [B] * 200)
    point = trilaterate(A, B, 1.7, 1.9, "right")
    distances = ranges(point, references) + rng.normal(0, 0.01, 400)
    found = multilaterate(references, distances, np.full(400, 0.01), "right")
    mean = trilaterate(A, B, float(distances[:200].mean()), float(distances[200:].mean()), "right")
    np.testing.assert_allclose(found.point_m, mean, atol=1e-8)
    assert found.covariance_m2 is not None
    alone = tape_covariance(point, np.array([A, B]), np.full(2, 0.01))
    np.testing.assert_allclose(found.covariance_m2, alone / 200, rtol=0.02)


@pytest.mark.parametrize("angle_deg", [5.0, 20.0, 45.0, 90.0, 135.0])
def test_covariance_of_two_tapes_depends_on_their_angle(angle_deg: float) -> None:
    angle, sigma = np.radians(angle_deg), 0.003
    # The references are 2 m and 3 m from the point, with this angle between them.
    references = -np.array([[2.0, 0.0], [3 * np.cos(angle), 3 * np.sin(angle)]])
    covariance = tape_covariance(np.zeros(2), references, np.full(2, sigma))
    spread = np.sqrt(np.linalg.eigvalsh(covariance))
    cosine = abs(np.cos(angle))
    np.testing.assert_allclose(spread, sigma / np.sqrt([1 + cosine, 1 - cosine]), rtol=1e-9)
    assert np.degrees(crossing_angle(np.zeros(2), references)) == pytest.approx(
        min(angle_deg, 180 - angle_deg)
    )


@given(st.tuples(*[coordinates] * 6))
def test_the_crossing_angle_by_the_law_of_cosines(numbers: tuple[float, ...]) -> None:
    a, b, point = np.array(numbers).reshape(3, 2)
    d1, d2 = ranges(point, np.array([a, b]))
    assume(min(d1, d2) > 0.1)
    cosine = abs(d1**2 + d2**2 - np.hypot(*(b - a)) ** 2) / (2 * d1 * d2)
    assume(cosine < 0.9999)
    assert np.cos(crossing_angle(point, np.array([a, b]))) == pytest.approx(cosine, abs=1e-9)


def test_best_crossing_angle_of_three_tapes_counts() -> None:
    middle = (A + B) / 2 + [0, 0.05]
    assert crossing_angle(middle, np.array([A, B])) < np.radians(6)
    assert crossing_angle(middle, np.array([A, B, middle + np.array([0, 1.0])])) > np.radians(87)


@pytest.mark.parametrize(
    ("point", "references"),
    [
        ((1.0, 4.0), (A, B)), ((3.2, 3.3), (A, B)), ((0.4, 1.9), (A, B)), ((1.0, 4.0), (A, B, C)),
        pytest.param((3.2, 3.3), (A, B, C), marks=pytest.mark.slow),
        pytest.param((0.4, 1.9), (A, B, C), marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_covariance_is_that_of_drawn_distances(
    point: tuple[float, float], references: tuple[Array, ...]
) -> None:
    rng = np.random.default_rng(5)
    known, sigmas = np.array(references), np.array([0.002, 0.004, 0.003])[: len(references)]
    side = "left" if point[1] > A[1] else "right"
    true = ranges(np.array(point), known)
    drawn = true + rng.normal(0, sigmas, (4000 if len(known) == 2 else 1200, len(known)))
    found = [multilaterate(known, distances, sigmas, side) for distances in drawn]
    sample = np.cov(np.array([one.point_m for one in found]).T)
    expected = multilaterate(known, true, sigmas, side).covariance_m2
    assert expected is not None
    # Standardised with the expected covariance, the sample covariance is the unit matrix within some per
    # cent.
    root = np.linalg.inv(np.linalg.cholesky(expected))
    np.testing.assert_allclose(root @ sample @ root.T, np.eye(2), atol=0.12)
    if len(known) == 3:
        assert np.mean([one.reduced_chi2 for one in found]) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("along", [-0.3, 0.4, 1.0, 1.5])
def test_covariance_on_the_line_is_finite_and_matches_samples(along: float) -> None:
    rng = np.random.default_rng(7)
    known, sigmas = np.array([A, B]), np.full(2, 0.003)
    point = A + along * (B - A)
    expected = tape_covariance(point, known, sigmas)
    assert np.isfinite(expected).all()
    assert np.linalg.eigvalsh(expected).min() > 0
    beside: list[float] = []
    while len(beside) < 2000:  # distances without a triangle are drawn again
        d1, d2 = ranges(point, known) + rng.normal(0, sigmas)
        try:
            beside.append(trilaterate(A, B, d1, d2, str(rng.choice(["left", "right"])))[1] - A[1])
        except IpsysError:
            continue
    assert 0.5 < np.std(beside) / np.sqrt(expected[1, 1]) < 2


@given(st.tuples(*[coordinates] * 6), st.floats(1e-4, 0.05))
def test_point_covariance_is_bounded(numbers: tuple[float, ...], sigma: float) -> None:
    a, b, point = np.array(numbers).reshape(3, 2)
    covariance = tape_covariance(point, np.array([a, b]), np.full(2, sigma))
    assert np.isfinite(covariance).all()
    small, large = np.linalg.eigvalsh(covariance)
    longest = ranges(point, np.array([a, b])).max()
    assert 0 < small <= sigma**2 * (1 + 1e-9)
    assert large <= 2 * sigma * (longest + sigma) + sigma**2 / 2


def test_both_sides_fit_nearly_collinear_reference_points() -> None:
    assert are_collinear(np.array([[0.0, 0.0], [2.0, 0.0], [4.0, 0.06]]))
    assert not are_collinear(np.array([[0.0, 0.0], [2.0, 0.3], [4.0, 0.0]]))


@pytest.mark.parametrize(
    ("references", "distances", "sigmas", "side", "said"),
    [
        ([A], [1.0], None, "left", "1 reference points and 1 distances"),
        ([A, B], [1.0, 2.0, 3.0], None, "left", "2 reference points and 3 distances"),
        ([A, A, A], [1.0, 1.0, 1.0], None, "left", "identical"),
        ([A, A], [1.0, 1.0], None, "left", "identical"),
        ([A, B], [1.7, 1.9], None, None, "2 reference points are on one line"),
        ([A, B], [1.7, 1.9], None, "above", "write 'left' or 'right'"),
        ([A, B, C], [1.7, 1.9, 1.9], None, "above", "write 'left' or 'right'"),
        ([A, B, C], [1.7, 0.0, 1.9], None, None, "not all above 0"),
        ([A, B, C], [1.7, np.nan, 1.9], None, None, "not all above 0"),
        ([A, B, C], [1.7, np.inf, 1.9], None, None, "not all above 0"),
        ([A, B], [np.nan, 1.9], None, "left", "do not meet"),
        ([A, B], [1.7, 1.9], [0.003, 0.0], "left", "sigmas"),
        ([A, B], [1.7, 1.9], [0.003, np.nan], "left", "sigmas"),
    ],
)
def test_distances_without_a_solution_are_refused(
    references: list[Array], distances: list[float], sigmas: list[float] | None, side: str | None, said: str
) -> None:
    with pytest.raises(IpsysError, match=said):
        multilaterate(
            np.array(references), np.array(distances), None if sigmas is None else np.array(sigmas), side
        )
