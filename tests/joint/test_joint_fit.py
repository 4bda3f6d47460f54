"""The joint fit: its derivatives, its optimum by another method, and its accuracy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint.fit import JointFit, fit_jointly
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import build_models
from ipsys_log.calibration.joint.parameters import State
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.calibration.joint.solver import solve
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import pose_facing_up, transform
from tests.geometric.lab import GeometricSettings, build_lab
from tests.joint.differences import descend, jacobian_of, minimise, residuals_of, split_step, step_sizes
from tests.joint.small_lab import LENGTH_M, Array, Truth, make_lab
from tests.joint.test_drives import observe

COARSE = JointSettings(floor_length_m=2.0)


def disturb(fit: JointFit, seed: int, size: float) -> State:
    """Return a state away from the optimum, by ``size`` prior deviations or mm."""
    sizes = step_sizes(fit.problem)
    step = np.random.default_rng(seed).normal(0, size, len(sizes)) * sizes
    return fit.state.moved(fit.problem.layout, *split_step(fit.problem, step))


def floor_errors_m(fit: JointFit, truth: Truth) -> Array:
    """Return 2D errors of noise-free markers on a grid in the middle of the floor, of all cameras."""
    grid = [(x, y, 0.1, 0.0) for x in np.arange(1.6, 3.3, 0.4) for y in np.arange(1.6, 3.3, 0.4)]
    corners_m = [transform(pose_facing_up(*pose), marker_corners(LENGTH_M)) for pose in grid]
    errors = []
    for model, lens, pose in zip(
        build_models(fit).values(), truth.lenses, truth.camera_from_world, strict=True
    ):
        pixels = np.stack([project(transform(pose, corners), lens) for corners in corners_m])
        count = len(grid)
        noise = np.tile(1e-6 * np.eye(8), (count, 1, 1))
        found = locate_markers(model, pixels, noise, np.full(count, 0.1), np.full(count, LENGTH_M))
        errors.append(found.points_m[:, :2] - np.array(grid)[:, :2])
    return np.concatenate(errors)


def test_normal_equations_match_differences() -> None:
    observations, _ = make_lab(1, points=6)
    fit = fit_jointly(observations, COARSE)
    state = disturb(fit, 1, 0.01)
    problem = fit.problem
    normal = problem.linearise(state, 1e9)
    jacobian = jacobian_of(problem, state, lambda one: residuals_of(problem, one, 1e9))
    residuals = residuals_of(problem, state, 1e9)
    free = problem.layout.free
    count = int(free.sum())
    gradient = np.concatenate([normal.global_gradient[free], normal.local_gradient])
    squares = jacobian.T @ jacobian
    scale = np.sqrt(squares.diagonal())
    assert (
        np.abs(
            normal.dense[np.ix_(free, free)] / np.outer(scale, scale)[:count, :count]
            - (squares / np.outer(scale, scale))[:count, :count]
        ).max()
        < 1e-5
    )
    mixed = normal.mixed[:, free] / np.outer(scale[count:], scale[:count])
    assert np.abs(mixed - (squares / np.outer(scale, scale))[count:, :count]).max() < 1e-5
    assert np.abs(gradient - jacobian.T @ residuals).max() / np.abs(gradient).max() < 1e-5
    for below, diagonal in enumerate(normal.band):
        rows = np.arange(len(diagonal) - below)
        expected = squares[count + below + rows, count + rows]
        units = scale[count + below + rows] * scale[count + rows]
        assert np.abs((diagonal[: len(rows)] - expected) / units).max() < 1e-5


def test_fit_agrees_with_scipy_from_another_start() -> None:
    observations, _ = make_lab(2, points=8)
    fit = fit_jointly(observations, COARSE)
    other = minimise(fit.problem, disturb(fit, 5, 0.5))
    again = solve(fit.problem, other)
    assert abs(again.cost - fit.solution.cost) < 1e-6
    moved_m = np.abs(other.positions_m - fit.state.positions_m).max()
    assert moved_m < 1e-5
    for block in fit.problem.layout.cameras:
        here, there = (one.values[block.start + 3 : block.start + 6] for one in (fit.state, other))
        assert np.abs(here - there).max() < 1e-5


def floor_maps_m(fit: JointFit, corners_px: Array) -> Array:
    """Return the positions of the same markers by each camera, (c, n, 2)."""
    count = len(corners_px)
    rows = np.tile(1e-6 * np.eye(8), (count, 1, 1)), np.full(count, 0.1), np.full(count, LENGTH_M)
    models = build_models(fit).values()
    return np.stack([locate_markers(model, corners_px, *rows).points_m[:, :2] for model in models])


@pytest.mark.slow
def test_fit_of_a_drive_agrees_with_scipy_from_another_start() -> None:
    lab = LabSettings(seed=3, rate_hz=5.0, drive_s=12.0, markers=1, cameras=("red", "white"))
    settings = GeometricSettings(lab=lab, points=6, clock_offset_s=0.025, floor_rms_m=0.001)
    fit = fit_jointly(observe(build_lab(settings)), COARSE)
    assert len(fit.problem.trajectories.paths)
    other = descend(fit.problem, disturb(fit, 5, 0.3))
    centres_px = np.stack(np.meshgrid([600.0, 960.0, 1320.0], [350.0, 540.0, 730.0]), axis=-1).reshape(
        -1, 1, 2
    )
    corners_px = centres_px + 58.0 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    again = replace(fit, solution=replace(fit.solution, state=other))
    assert np.abs(floor_maps_m(again, corners_px) - floor_maps_m(fit, corners_px)).max() < 1e-5


def test_fit_of_exact_observations_is_exact() -> None:
    observations, truth = make_lab(3, points=12, noise_px=1e-6, tape_sigma_m=1e-7, ruler_sigma_m=0.0)
    settings = JointSettings(corner_floor_px=1e-4, floor_sigma_m=0.0)
    assert np.abs(floor_errors_m(fit_jointly(observations, settings), truth)).max() < 2e-4


@pytest.mark.parametrize("tilt_deg", [2.0, 30.0])
def test_fit_with_16_points_is_accurate(tilt_deg: float) -> None:
    means = []
    for seed in range(4):
        observations, truth = make_lab(seed, points=16, tilt_deg=tilt_deg)
        means.append(np.linalg.norm(floor_errors_m(fit_jointly(observations), truth), axis=1).mean())
    assert np.median(means) < 0.003
