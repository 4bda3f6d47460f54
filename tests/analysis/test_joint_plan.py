"""Plans for a joint calibration: the effect of points and drives, against other ways to compute it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.locate import edge_motion, linearise_corners, marker_arms
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.errors import IpsysError
from ipsys_log.statistics.expected_error import (
    ExpectedErrors,
    VisibleMarkers,
    choose_points,
    expect_errors,
    mean_error,
    posterior_root,
    see_markers,
    some_modes,
)
from ipsys_log.statistics.floor_cameras import FloorGrid
from ipsys_log.statistics.joint_plan import choose_drive, plan_joint_points
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
def expected(models: dict[str, JointModel]) -> list[ExpectedErrors]:
    return expect_errors(models, dict.fromkeys(models, (1920, 1080)), GRID, HEIGHT_M, LENGTH_M)


def tape_m2(points_m: Array) -> Array:
    return np.broadcast_to(0.003**2 * np.eye(2), (len(points_m), 2, 2))


def test_some_modes_are_those_of_every_nth_node(expected: list[ExpectedErrors]) -> None:
    """The nodes of all cameras are counted together."""
    few = [
        replace(one, view=VisibleMarkers(one.view.seen, *(a[:301] for a in one.view[1:]))) for one in expected
    ]
    few = [replace(one, errors_m=one.errors_m[:301]) for one in few] * 5
    every = sum(len(one.errors_m) for one in few) // 800
    assert every > 1
    modes_m = np.concatenate([one.modes_m() for one in few])[::every]
    assert np.allclose(some_modes(few), modes_m, rtol=1e-9, atol=1e-15)


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


def test_no_point_is_planned_twice(expected: list[ExpectedErrors]) -> None:
    candidates_m = np.array([[2.0, 2.0], [2.4, 2.4], [2.8, 2.6], [90.0, 90.0]])
    points = choose_points(expected, candidates_m, tape_m2, 0.0, 5)
    assert sorted(point.point_m.tolist() for point in points) == candidates_m[:3].tolist()


def test_planned_points_reduce_the_error_at_every_node(expected: list[ExpectedErrors]) -> None:
    candidates_m = np.array([[x, y, z] for x in (0.8, 2.4, 4.0) for y in (1.2, 3.2) for z in (0.0, 0.2)])
    plan = plan_joint_points(expected, candidates_m, tape_m2, 3)
    seen = np.isfinite(plan.before_m)
    assert (plan.after_m[seen] <= plan.before_m[seen]).all()
    means_m = [plan.places[0].mean_before_m, *(place.mean_after_m for place in plan.places)]
    assert means_m[0] == pytest.approx(float(np.nanmean(plan.before_m)))
    assert means_m[-1] == pytest.approx(float(np.nanmean(plan.after_m)))
    assert means_m == sorted(means_m, reverse=True)
    assert means_m[-1] < 0.95 * means_m[0]


def test_plan_outside_of_all_images_is_refused(expected: list[ExpectedErrors]) -> None:
    with pytest.raises(IpsysError, match="no camera sees a whole marker"):
        plan_joint_points(expected, np.array([[90.0, 90.0, 0.0]]), tape_m2, 1)


def test_effect_of_a_drive_is_that_of_all_its_unknowns(
    models: dict[str, JointModel], expected: list[ExpectedErrors]
) -> None:
    """A robot at one place: one large system with its x, y and heading gives the same error."""
    place_m, around_m = np.array([2.4, 2.4]), np.full(2, 0.15)
    drive = choose_drive(expected, place_m - around_m, place_m + around_m, HEIGHT_M)
    assert drive is not None
    assert drive.cameras == ("c0", "c1")
    count = next(iter(models.values())).modes.shape[1]
    information = np.diag(np.r_[np.ones(count + 1), np.zeros(3)])
    for model in models.values():
        view = see_markers(model, (1920, 1080), place_m[None], HEIGHT_M, LENGTH_M)
        inward, sizes_m = edge_motion(view.corners_px), np.array([LENGTH_M * model.scale])
        now = linearise_corners(
            model, view.corners_px, inward, view.centres_m, marker_arms(view.turns, sizes_m)
        )
        _, floor_slopes, floor_modes = model.floor.evaluate(view.centres_m, model.amplitudes)
        by_height = now.by_pose[0, :, 2]
        by_modes = now.by_camera[0] @ model.modes
        by_floor = floor_modes[0] @ model.floor_modes
        by_modes[:, : len(by_floor)] += np.outer(by_height, by_floor)
        by_place = now.by_pose[0, :, :2] + np.outer(by_height, floor_slopes[0])
        slopes = np.column_stack([by_modes, 0.001 * by_height, by_place, now.by_pose[0, :, 5]])
        tilts = 0.004 * now.by_pose[0, :, 3:5]
        noise_px2 = 0.02**2 * np.eye(8) + tilts @ tilts.T
        information += 300 * slopes.T @ np.linalg.solve(noise_px2, slopes)
    root = np.linalg.cholesky(np.linalg.inv(information)[:count, :count])
    assert drive.mean_before_m == pytest.approx(mean_error(some_modes(expected)))
    assert drive.mean_after_m == pytest.approx(mean_error(some_modes(expected) @ root), rel=1e-4)


def test_planned_drive_is_seen_and_reduces_the_error(
    models: dict[str, JointModel], expected: list[ExpectedErrors]
) -> None:
    drive = choose_drive(expected, np.zeros(2), np.full(2, 4.8), HEIGHT_M)
    assert drive is not None
    assert drive.is_useful
    assert ((drive.high_m - drive.low_m) > 0.5).all()
    assert set(drive.cameras) <= set(models)
    beside = choose_drive(expected, np.full(2, 90.0), np.full(2, 92.0), HEIGHT_M)
    assert beside is None
