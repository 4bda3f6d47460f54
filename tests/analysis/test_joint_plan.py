"""Plans for a joint calibration: the effect of points and drives, against other ways to compute it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ipsys_log.analysis.drive_plan import choose_drive
from ipsys_log.analysis.expected_error import ExpectedErrors, FloorGrid, expect_errors
from ipsys_log.analysis.joint_plan import plan_joint_points
from ipsys_log.analysis.taped_points import choose_points, posterior_root
from ipsys_log.errors import IpsysError
from ipsys_log.joint.fit import JointFit, fit_jointly
from ipsys_log.joint.model import JointModel, build_models
from tests.joint.small_lab import LENGTH_M, Array, make_lab

GRID = FloorGrid.over(np.zeros(2), np.array([4.8, 4.8]), 0.2)
HEIGHT_M = 0.1


@pytest.fixture(scope="module")
def fit() -> JointFit:
    return fit_jointly(make_lab(4, points=8)[0])


@pytest.fixture(scope="module")
def models(fit: JointFit) -> dict[str, JointModel]:
    return build_models(fit)


@pytest.fixture(scope="module")
def sizes_px(models: dict[str, JointModel]) -> dict[str, tuple[int, int]]:
    return dict.fromkeys(models, (1920, 1080))


@pytest.fixture(scope="module")
def expected(models: dict[str, JointModel], sizes_px: dict[str, tuple[int, int]]) -> list[ExpectedErrors]:
    return expect_errors(models, sizes_px, GRID, HEIGHT_M, LENGTH_M)


def tape_m2(points_m: Array) -> Array:
    return np.broadcast_to(0.003**2 * np.eye(2), (len(points_m), 2, 2))


@settings(max_examples=30, deadline=None)
@given(arrays(np.float64, (2, 3, 5), elements=st.floats(-3, 3, width=32)))
def test_two_updates_give_the_information_of_both(slopes: Array) -> None:
    """The covariance after two observations is the inverse of the sum of their information."""
    noise = np.diag([0.5, 1.0, 2.0])
    first = posterior_root(slopes[0], noise)
    both = first @ posterior_root(slopes[1] @ first, noise)
    weights = np.linalg.inv(noise)
    information = np.eye(5) + sum(one.T @ weights @ one for one in slopes)
    assert np.abs(both @ both.T - np.linalg.inv(information)).max() < 1e-9


def test_no_point_is_planned_twice(
    models: dict[str, JointModel], sizes_px: dict[str, tuple[int, int]], expected: list[ExpectedErrors]
) -> None:
    candidates_m = np.array([[2.0, 2.0], [2.4, 2.4], [2.8, 2.6], [90.0, 90.0]])
    points = choose_points(models, sizes_px, expected, candidates_m, tape_m2, LENGTH_M, 0.0, 5)
    assert sorted(point.point_m.tolist() for point in points) == candidates_m[:3].tolist()


def test_planned_points_reduce_the_error_at_every_node(
    models: dict[str, JointModel], sizes_px: dict[str, tuple[int, int]], expected: list[ExpectedErrors]
) -> None:
    candidates_m = np.array([[x, y, z] for x in (0.8, 2.4, 4.0) for y in (1.2, 3.2) for z in (0.0, 0.2)])
    plan = plan_joint_points(models, sizes_px, expected, candidates_m, tape_m2, LENGTH_M, 3)
    seen = np.isfinite(plan.before_m)
    assert (plan.after_m[seen] <= plan.before_m[seen]).all()
    means_m = [plan.places[0].mean_before_m, *(place.mean_after_m for place in plan.places)]
    assert means_m[0] == pytest.approx(float(np.nanmean(plan.before_m)))
    assert means_m[-1] == pytest.approx(float(np.nanmean(plan.after_m)))
    assert means_m == sorted(means_m, reverse=True)
    assert means_m[-1] < 0.95 * means_m[0]


def test_plan_outside_of_all_images_is_refused(
    models: dict[str, JointModel], sizes_px: dict[str, tuple[int, int]], expected: list[ExpectedErrors]
) -> None:
    with pytest.raises(IpsysError, match="no camera sees a whole marker"):
        plan_joint_points(models, sizes_px, expected, np.array([[90.0, 90.0, 0.0]]), tape_m2, LENGTH_M, 1)


def test_planned_drive_is_seen_and_reduces_the_error(
    models: dict[str, JointModel], sizes_px: dict[str, tuple[int, int]], expected: list[ExpectedErrors]
) -> None:
    drive = choose_drive(models, sizes_px, expected, np.zeros(2), np.full(2, 4.8), HEIGHT_M, LENGTH_M)
    assert drive is not None
    assert drive.is_useful
    assert ((drive.high_m - drive.low_m) > 0.5).all()
    assert set(drive.cameras) <= set(models)
    beside = choose_drive(models, sizes_px, expected, np.full(2, 90.0), np.full(2, 92.0), HEIGHT_M, LENGTH_M)
    assert beside is None
