"""The way and the speed of robots that stop and start again."""

import importlib
from typing import Any

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid

from ipsys_log.capture.simulation.cameras import mount_cameras
from ipsys_log.capture.simulation.drive import plan_drive
from ipsys_log.capture.simulation.settings import LabSettings
from tests.conftest import ROOT
from tests.geometric.lab import poses_over

STOPS = {"legs_s": 2.0, "stands_s": 1.0, "acceleration_m_s2": 2.5}


@pytest.fixture
def stops(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    return importlib.import_module("stops")


def test_way_of_a_pace_is_the_integral_of_its_speed(stops: Any) -> None:
    pace = stops.draw_pace(stops.Stops(**STOPS), 0.26, 60.0, np.random.default_rng(1))
    times_s = np.linspace(0.0, 60.0, 600_001)
    shares = pace.share_at(times_s)
    np.testing.assert_allclose(
        pace.driven_s(times_s), cumulative_trapezoid(shares, times_s, initial=0), atol=1e-5
    )
    assert shares.min() == 0.0
    assert shares.max() == 1.0
    # A third of the time is for the stands, within the chance of some twenty stops.
    assert 0.5 < shares.mean() < 0.8


def test_robot_with_stops_brakes_with_its_acceleration(stops: Any) -> None:
    lab = LabSettings(drive_s=20.0, drive_speed_m_s=0.26, markers=2)
    steady = plan_drive(lab, mount_cameras(lab))
    drive = stops.pace_drive(
        steady, {0: stops.draw_pace(stops.Stops(**STOPS), 0.26, 20.0, np.random.default_rng(2))}
    )
    times_s = np.arange(2.0, 20.0, 0.01)
    velocities_m_s = stops.velocities_over(drive, 0, times_s)
    points_m = poses_over(drive, 0, times_s)[:, :2]
    moved_m = np.diff(points_m, axis=0)
    np.testing.assert_allclose(moved_m / 0.01, (velocities_m_s[1:] + velocities_m_s[:-1]) / 2, atol=0.02)
    speeds_m_s = np.linalg.norm(velocities_m_s, axis=1)
    assert speeds_m_s.min() == 0.0
    assert 2.2 < np.abs(np.diff(speeds_m_s)).max() / 0.01 < 2.6
    # The other robot drives on.
    np.testing.assert_array_equal(poses_over(drive, 1, times_s), poses_over(steady, 1, times_s))


@pytest.mark.parametrize("speed_m_s", [0.26, 1.0])
def test_velocity_of_a_drive_is_the_slope_of_its_path(speed_m_s: float, stops: Any) -> None:
    settings = LabSettings(seed=4, markers=2, drive_speed_m_s=speed_m_s)
    drive, step_s = plan_drive(settings, mount_cameras(settings)), 1e-3
    # The times include the acceleration at the start and a second lap of the path.
    times_s = np.linspace(0.01, 1.2 * drive.times_s[-1], 500)
    for marker_id in drive.ahead_s:
        after, before = (poses_over(drive, marker_id, times_s + side * step_s / 2) for side in (1, -1))
        slopes_m_s = (after - before)[:, :2] / step_s
        velocities_m_s = stops.velocities_over(drive, marker_id, times_s)
        assert np.abs(velocities_m_s - slopes_m_s).max() < 1e-3 * speed_m_s
    assert stops.velocities_over(drive, 0, np.array([-1.0, 0.0])).tolist() == [[0.0, 0.0], [0.0, 0.0]]
