"""Cameras from a board in free motion, seen in part, by cameras with clocks of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting
from ipsys_log.calibration.joint.carried_observations import gather_board
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held
from ipsys_log.calibration.joint.held_out import predict_errors
from ipsys_log.calibration.joint.lab_frame import apply_frame, find_frame
from ipsys_log.calibration.joint.observations import (
    Body,
    CalibrationPoint,
    CameraPrior,
    Observations,
    Sightings,
)
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.errors import FitError
from ipsys_log.messages import CameraCalibration
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import project
from ipsys_log.vision.poses import make_pose, rotation, transform
from tests.joint.differences import jacobian_of, residuals_of
from tests.joint.small_lab import Array

BOARD_M = np.array([(0.05 * (n % 3 - 1), 0.05 * (n // 3 - 1.5), 0.0) for n in range(12)])
CLOCKS_S = (0.0, 0.02, -0.015)
FIXED = JointSettings(
    focal_sigma=0.0,
    centre_sigma=0.0,
    distortion_sigma=0.0,
    edge_sigma_px=0.0,
    corner_floor_px=0.0,
    acceleration_sigma=5.0,
    turn_sigma=30.0,
)


def make_cameras() -> list[Array]:
    """Return ``camera_from_world``; the first camera is the origin."""
    cameras = [np.eye(4)]
    for side in (-1.0, 1.0):
        turn = rotation(np.array([0.1, 0.5 * side, 0.05]))
        cameras.append(make_pose(turn, np.array([-0.5 * side, 0.02, 0.15])))
    return cameras


def board_pose(time_s: float) -> Array:
    """Return ``world_from_board`` of a board that is waved about."""
    turn = rotation(
        np.array([0.4 * np.sin(1.3 * time_s), 0.5 * np.sin(time_s + 1), 0.6 * np.sin(0.7 * time_s)])
    )
    place_m = np.array([0.2 * np.sin(time_s), 0.15 * np.cos(1.1 * time_s), 1.0 + 0.1 * np.sin(0.8 * time_s)])
    return make_pose(turn, place_m)


def wave_board(moving: bool, noise_px: float = 0.05, least: int = 6) -> Observations:
    rng = np.random.default_rng(8)
    K = np.array([[800.0, 0, 640], [0, 805.0, 360], [0, 0, 1]])
    lens = CameraCalibration(0, "", 1280, 720, "plumb_bob", np.array([0.1, -0.2, 1e-3, -1e-3, 0.05]), K)
    sightings = []
    for clock_s, camera in zip(CLOCKS_S, make_cameras(), strict=True):
        rows = []
        for index in range(60):
            time_s = index * 0.1 + rng.uniform(0, 0.01) * moving
            pixels = project(transform(camera @ board_pose(time_s), BOARD_M), lens)
            pixels += rng.normal(0, noise_px, pixels.shape)
            pixels[rng.uniform(size=12) < 0.2] = np.nan
            if np.isfinite(pixels[:, 0]).sum() >= least:
                rows.append((-1 if moving else index, time_s - clock_s * moving, pixels))
        sightings.append(
            Sightings(
                np.zeros(len(rows), dtype=np.intp),
                np.array([row[0] for row in rows], dtype=np.intp),
                np.array([row[1] for row in rows]),
                np.array([row[2] for row in rows]),
                np.tile(noise_px**2 * np.eye(24), (len(rows), 1, 1)),
            )
        )
    points = () if moving else tuple(CalibrationPoint(str(n), 0) for n in range(60))
    cameras = tuple(CameraPrior(f"c{n}", lens) for n in range(3))
    return Observations(cameras, (Body("0", BOARD_M, 0.0),), points, tuple(sightings))


def test_board_at_rest_with_its_face_up_is_below_the_cameras() -> None:
    lens = wave_board(moving=True).cameras[0].lens
    cameras, board = make_cameras(), Board(4, 5, 0.05, 0.75)
    sightings = {
        f"c{n}": [
            (
                round((10.0 + 0.1 * index) * NS_PER_S),
                BoardSighting("", np.arange(12), pixels, 1.0, pixels[[0, 2, 11, 9]]),
            )
            for index in range(70)
            for pixels in [project(transform(camera @ board_pose(min(0.1 * index, 4.0)), BOARD_M), lens)]
        ]
        for n, camera in enumerate(cameras)
    }
    lenses = {f"c{n}": lens for n in range(3)}
    observations, targets, rest = gather_board(lenses, (), sightings, board)
    assert rest is not None
    assert rest.start == pytest.approx(14.2 * NS_PER_S, abs=1e8)
    fit = fit_hand_held(observations, FIXED)
    lab = apply_frame(fit, find_frame(fit, targets), 0.0, 0.0, np.zeros(3))
    lab_from_world = np.diag([1.0, -1.0, -1.0, 1.0]) @ np.linalg.inv(board_pose(4.0))
    for block, camera in zip(lab.problem.layout.cameras, cameras, strict=True):
        origin_m = lab.state.values[block.start + 3 : block.start + 6]
        assert origin_m == pytest.approx((lab_from_world @ np.linalg.inv(camera))[:3, 3], abs=1e-3)
        assert origin_m[2] > 0.5


def camera_errors(fit: JointFit) -> Array:
    """Return the errors of the camera positions, in units of their standard deviations."""
    errors = []
    for block, camera in zip(fit.problem.layout.cameras[1:], make_cameras()[1:], strict=True):
        rows = slice(block.start + 3, block.start + 6)
        error_m = fit.state.values[rows] + camera[:3, :3].T @ camera[:3, 3]
        errors.append(np.abs(error_m) / np.sqrt(fit.covariance.diagonal()[rows]))
    return np.concatenate(errors)


def test_board_in_motion_gives_cameras_and_clocks() -> None:
    fit = fit_hand_held(wave_board(moving=True), FIXED)
    assert camera_errors(fit).max() < 4.0
    for block, clock_s in zip(fit.problem.layout.cameras, CLOCKS_S, strict=True):
        sigma_s = float(np.sqrt(fit.covariance[block.edge + 1, block.edge + 1]))
        assert sigma_s < 0.001
        assert abs(fit.state.values[block.edge + 1] - clock_s) <= 4 * sigma_s


def test_board_at_rest_gives_cameras() -> None:
    fit = fit_hand_held(wave_board(moving=False), FIXED)
    assert camera_errors(fit).max() < 4.0


def test_slopes_of_free_paths_match_differences() -> None:
    observations = wave_board(moving=True)
    short = tuple(one.select(one.times_s < 0.6) for one in observations.sightings)
    fit = fit_hand_held(replace(observations, sightings=short), FIXED)
    problem, state = fit.problem, fit.state
    values = state.values.copy()
    values[[block.edge + 2 for block in problem.layout.cameras]] = 0.0
    state = replace(state, values=values)
    normal = problem.linearise(state, 1e9)
    jacobian = jacobian_of(problem, state, lambda one: residuals_of(problem, one, 1e9))
    free = problem.layout.free
    count = int(free.sum())
    squares = jacobian.T @ jacobian
    scale = np.sqrt(squares.diagonal())
    squares /= np.outer(scale, scale)
    mixed = normal.mixed[:, free] / np.outer(scale[count:], scale[:count])
    assert np.abs(mixed - squares[count:, :count]).max() < 1e-5
    for below, diagonal in enumerate(normal.band):
        rows = np.arange(len(diagonal) - below)
        units = scale[count + below + rows] * scale[count + rows]
        banded = diagonal[: len(rows)] / units
        assert np.abs(banded - squares[count + below + rows, count + rows]).max() < 1e-5


def test_camera_that_shares_no_view_is_refused() -> None:
    observations = wave_board(moving=True)
    first, second, third = observations.sightings
    late = replace(third, times_s=third.times_s + 100.0)
    with pytest.raises(FitError, match="camera c2: it never sees the body at the same time"):
        fit_hand_held(replace(observations, sightings=(first, second, late)), FIXED)


def test_known_cameras_remain_constant() -> None:
    fit = fit_hand_held(wave_board(moving=False), FIXED, camera_poses=make_cameras())
    assert not fit.problem.layout.free.any()
    for turn, camera in zip(fit.state.camera_turns, make_cameras(), strict=True):
        assert np.array_equal(turn, camera[:3, :3])
    errors_px = [predict_errors(fit, n, own) for n, own in enumerate(fit.observations.sightings)]
    # Six unknowns of each pose fit a part of the noise of 0.05 px.
    assert 0.04 < np.sqrt(np.nanmean(np.concatenate(errors_px) ** 2)) < 0.05


def test_errors_of_frames_out_of_the_fit_are_noise() -> None:
    observations = wave_board(moving=True)
    *others, last = observations.sightings
    out = np.arange(len(last)) % 2 == 0
    fit = fit_hand_held(replace(observations, sightings=(*others, last.select(~out))), FIXED)
    errors_px = predict_errors(fit, 2, last.select(out))
    assert np.array_equal(np.isnan(errors_px), np.isnan(last.select(out).pixels))
    assert 0.045 < np.sqrt(np.nanmean(errors_px**2)) < 0.075
