"""Eq. (25) compared with points at known distances."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from ipsys_log.errors import IpsysError
from ipsys_log.vision.trilateration import trilaterate

A, B = np.array([1.2192, 2.4384]), np.array([3.6576, 2.4384])
coordinates = st.floats(-5, 10)


@given(st.tuples(*[coordinates] * 6))
def test_the_point_is_found_from_its_distances(numbers: tuple[float, ...]) -> None:
    a, b, point = np.array(numbers).reshape(3, 2)
    ab, ap = b - a, point - a
    assume(np.hypot(*ab) > 0.1)
    across = float(ab[0] * ap[1] - ab[1] * ap[0]) / float(np.hypot(*ab))
    assume(abs(across) > 0.05)  # a flat triangle loses half of the digits
    side = "left" if across > 0 else "right"
    found = trilaterate(a, b, float(np.hypot(*ap)), float(np.hypot(*(point - b))), side)
    np.testing.assert_allclose(found, point, atol=1e-9)


def test_above_ab_is_left() -> None:
    above, below = (trilaterate(A, B, 1.7, 1.9, side) for side in ("left", "right"))
    assert above[1] > 2.4384 > below[1]
    assert above[0] == below[0]


def test_a_flat_triangle_lies_on_ab() -> None:
    np.testing.assert_allclose(trilaterate(A, B, 1.0, 1.4384, "left"), [2.2192, 2.4384], atol=1e-7)


@pytest.mark.parametrize("distances", [(0.5, 0.5), (4.0, 1.0), (1.0, 4.0), (0.0, 2.4384), (-1.0, 2.0)])
def test_an_impossible_triangle_is_refused_with_its_numbers(distances: tuple[float, float]) -> None:
    with pytest.raises(IpsysError) as refused:
        trilaterate(A, B, *distances, "left")
    for number in (2.4384, *distances):
        assert f"{number:.4f}" in str(refused.value)


def test_zero_distance_is_not_a_measurement() -> None:
    for distances in ((0.0, 2.0), (2.0, 0.0)):
        with pytest.raises(IpsysError, match="do not meet"):
            trilaterate(np.array([0.0, 0.0]), np.array([2.0, 0.0]), *distances, "left")


def test_equal_reference_points_are_refused() -> None:
    with pytest.raises(IpsysError, match="identical"):
        trilaterate(A, A, 1.0, 1.0, "left")
    with pytest.raises(IpsysError, match="write 'left' or 'right'"):
        trilaterate(A, B, 1.7, 1.9, "above")
