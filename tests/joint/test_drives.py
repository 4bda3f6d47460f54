"""Calibration by driving: paths, clocks and floor, from the messages of simulated sessions."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from ipsys_log.calibration.joint import solver
from ipsys_log.calibration.joint.diagnosis import find_faults
from ipsys_log.calibration.joint.fit import JointFit, fit_jointly, refit_without
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.observations import Observations, without_points
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.messages import CameraCalibration, Markers, Measurement, Message, Rig
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.joint.differences import jacobian_of, residuals_of

COARSE = JointSettings(floor_length_m=2.0)


def observe(lab: GeometricLab) -> Observations:
    """Return the observations of a session."""
    return gather(simulate_session(lab))


def gather(messages: Iterable[Message]) -> Observations:
    """Return the observations of a session from its messages."""
    markers: dict[str, list[Markers]] = {}
    calibrations: dict[str, CameraCalibration] = {}
    measurements = []
    for message in messages:
        if isinstance(message.payload, Markers):
            markers.setdefault(str(message.camera), []).append(message.payload)
        elif isinstance(message.payload, CameraCalibration):
            calibrations[str(message.camera)] = message.payload
        elif isinstance(message.payload, Measurement):
            measurements.append(message.payload)
        elif isinstance(message.payload, Rig):
            rig = message.payload
    return gather_observations(rig, calibrations, markers, measurements)


def make_drive(seconds: float = 30.0, points: int = 8, seed: int = 3) -> GeometricLab:
    lab = LabSettings(seed=seed, rate_hz=10.0, drive_s=seconds, markers=2, cameras=("red", "white"))
    delays_s = (0.0, 0.011)
    return build_lab(GeometricSettings(lab=lab, points=points, clock_offset_s=0.025, frame_delays_s=delays_s))


@pytest.fixture(scope="module")
def driven() -> tuple[GeometricLab, JointFit]:
    lab = make_drive()
    return lab, fit_jointly(observe(lab), COARSE)


def test_clock_offset_is_estimated(driven: tuple[GeometricLab, JointFit]) -> None:
    lab, fit = driven
    # A stamp is late by the offset, so that the true time of a sighting is earlier.
    true_s = 1e-9 * (lab.clock_offsets_ns["red"] - lab.clock_offsets_ns["white"])
    column = fit.problem.layout.cameras[1].edge + 1
    sigma_s = float(np.sqrt(fit.covariance[column, column]))
    assert sigma_s < 0.001
    assert abs(fit.state.values[column] - true_s) < 4 * sigma_s


def test_camera_positions_are_as_accurate_as_stated(driven: tuple[GeometricLab, JointFit]) -> None:
    lab, fit = driven
    for camera, block in zip(fit.observations.cameras, fit.problem.layout.cameras, strict=True):
        rows = slice(block.start + 3, block.start + 6)
        error_m = fit.state.values[rows] - lab.camera(camera.name).origin_m
        covariance = fit.covariance[rows, rows]
        assert error_m @ np.linalg.solve(covariance, error_m) < 22.0
        assert np.linalg.norm(error_m[:2]) < 0.005


def test_refit_without_points_is_a_fit_to_the_others(driven: tuple[GeometricLab, JointFit]) -> None:
    _, fit = driven
    left_out = {point.name for point in fit.observations.points[::3]}
    refit = refit_without(fit, left_out)
    anew = fit_jointly(without_points(fit.observations, left_out), COARSE)
    for block in fit.problem.layout.cameras:
        origin = slice(block.start + 3, block.start + 6)
        shift_m = np.abs(refit.state.values - anew.state.values)[origin]
        assert (shift_m < 0.02 * np.sqrt(anew.covariance.diagonal()[origin])).all()
    assert np.abs(refit.state.positions_m - anew.state.positions_m).max() < 1e-4


def test_exchanged_robots_are_named() -> None:
    observations = observe(make_drive(30.0, points=12))
    steps_m = (0.05, -0.05)
    wrong = tuple(
        replace(body, height_m=(body.height_m or 0.0) + step_m)
        for body, step_m in zip(observations.bodies, steps_m, strict=True)
    )
    faults = find_faults(fit_jointly(replace(observations, bodies=wrong), COARSE))
    assert {(fault.kind, fault.subject) for fault in faults} == {("robot_height", "0"), ("robot_height", "1")}
    assert "at 10.0 cm, not at 15.0 cm" in "".join(fault.text for fault in faults)


def test_slopes_of_paths_match_differences() -> None:
    fit = fit_jointly(observe(make_drive(4.0, points=6)), COARSE)
    problem, values = fit.problem, fit.state.values.copy()
    # The slopes leave out the effect of a knot on the speed within a frame: it is zero without a row time.
    values[[block.edge + 2 for block in problem.layout.cameras]] = 0.0
    state = replace(fit.state, values=values)
    normal = problem.linearise(state, 1e9)
    jacobian = jacobian_of(problem, state, lambda one: residuals_of(problem, one, 1e9))
    free = problem.layout.free
    count = int(free.sum())
    squares = jacobian.T @ jacobian
    scale = np.sqrt(squares.diagonal())
    squares /= np.outer(scale, scale)
    dense = normal.dense[np.ix_(free, free)] / np.outer(scale[:count], scale[:count])
    assert np.abs(dense - squares[:count, :count]).max() < 1e-5
    mixed = normal.mixed[:, free] / np.outer(scale[count:], scale[:count])
    assert np.abs(mixed - squares[count:, :count]).max() < 1e-5
    for below, diagonal in enumerate(normal.band):
        rows = np.arange(len(diagonal) - below)
        units = scale[count + below + rows] * scale[count + rows]
        banded = diagonal[: len(rows)] / units
        assert np.abs(banded - squares[count + below + rows, count + rows]).max() < 1e-5


def test_fit_twice_is_identical() -> None:
    observations = observe(make_drive(5.0, points=6))
    first, second = (fit_jointly(observations, COARSE) for _ in range(2))
    assert first.state.values.tobytes() == second.state.values.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


@pytest.mark.slow
def test_short_drive_without_chessboard_converges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four cameras, nominal intrinsics, three points and 10 s; the last camera saw one marker alone.

    Focal lengths, distortions and heights then have a curved valley, in which straight steps are too short.
    Rounding decides if 200 straight steps are enough, so fewer are allowed here: then long steps must follow.
    """
    usual_steps = 100
    monkeypatch.setattr(solver, "_MOST_STEPS", usual_steps)
    cameras = ("a", "b", "c", "d")
    settings = LabSettings(seed=6, rate_hz=10.0, drive_s=10.0, markers=1, cameras=cameras)
    lab = build_lab(GeometricSettings(lab=settings, points=3, intrinsics="nominal", clock_offset_s=0.025))
    observations = observe(lab)
    nominal = replace(
        observations, cameras=tuple(replace(camera, nominal=True) for camera in observations.cameras)
    )
    steps: list[int] = []
    fit = fit_jointly(nominal, progress=lambda step, cost: steps.append(step))
    assert max(steps) > usual_steps
    # The last camera is uncertain; the others are near their places.
    for number, camera in enumerate(lab.cameras[:3]):
        start = fit.problem.layout.cameras[number].start + 3
        error_m = fit.state.values[start : start + 3] - camera.origin_m
        covariance_m2 = fit.covariance[start : start + 3, start : start + 3]
        assert error_m @ np.linalg.solve(covariance_m2, error_m) < 25.0
