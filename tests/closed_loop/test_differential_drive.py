"""The motion of a robot with two wheels, against closed forms."""

from math import exp, hypot, pi, remainder

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ipsys_log.capture.simulation.robot_lab import STEP_NS, Chassis, DifferentialDrive, Pose2d
from ipsys_log.units import NS_PER_S

IDEAL = Chassis(slip=0.0, slip_sigma=0.0, noise=0.0)
START_NS = 1_700_000_000 * NS_PER_S


def driven(
    left_m_s: float, right_m_s: float, seconds: float, chassis: Chassis = IDEAL, seed: int = 0
) -> Pose2d:
    """Return the pose after a constant command, which is repeated before the watchdog ends it."""
    robot = DifferentialDrive(Pose2d(1.0, 2.0, 0.5), START_NS, np.random.default_rng(seed), chassis)
    end_ns = START_NS + round(seconds * NS_PER_S)
    for time_ns in range(START_NS, end_ns, NS_PER_S // 2):
        robot.command(left_m_s, right_m_s)
        robot.advance(min(time_ns + NS_PER_S // 2, end_ns))
    return robot.pose_at(end_ns)


def test_straight_drive_has_the_length_of_a_lagging_motor() -> None:
    pose = driven(0.2, 0.2, 3.0)
    lag_s = IDEAL.lag_s
    length_m = 0.2 * (3.0 - lag_s * (1 - exp(-3.0 / lag_s)))
    assert hypot(pose.x_m - 1, pose.y_m - 2) == pytest.approx(length_m, abs=0.2 * STEP_NS / NS_PER_S)
    assert pose.heading_rad == pytest.approx(0.5)


@settings(max_examples=20)
@given(st.floats(0.05, 0.25), st.floats(-0.2, 0.2))
def test_arc_stays_on_its_circle(left_m_s: float, difference_m_s: float) -> None:
    right_m_s = float(np.clip(left_m_s + difference_m_s, -0.26, 0.26))
    pose = driven(left_m_s, right_m_s, 4.0)
    turn_rad, forward_m = (right_m_s - left_m_s) / IDEAL.track_m, (left_m_s + right_m_s) / 2
    driven_s = 4.0 - IDEAL.lag_s * (1 - exp(-4.0 / IDEAL.lag_s))
    assert remainder(pose.heading_rad - 0.5 - turn_rad * driven_s, 2 * pi) == pytest.approx(0, abs=0.02)
    # The chord of the arc; both wheels have the same lag, so the circle is that of the constant speeds.
    half_rad = turn_rad * driven_s / 2
    chord_m = abs(forward_m * driven_s * np.sinc(half_rad / pi))
    assert hypot(pose.x_m - 1, pose.y_m - 2) == pytest.approx(chord_m, abs=0.004)


def test_wheels_are_never_faster_than_their_limit() -> None:
    noisy = Chassis(slip=0.0, slip_sigma=0.0)
    pose = driven(9.0, 9.0, 2.0, noisy)
    assert hypot(pose.x_m - 1, pose.y_m - 2) < 0.26 * 2.0


def test_slip_shortens_the_path_by_its_mean() -> None:
    lengths_m = [
        hypot((pose := driven(0.2, 0.2, 5.0, Chassis(), seed)).x_m - 1, pose.y_m - 2) for seed in range(20)
    ]
    ideal_m = hypot((pose := driven(0.2, 0.2, 5.0)).x_m - 1, pose.y_m - 2)
    # The heading drifts too, so the distance is a little shorter than the path.
    assert 1 - np.mean(lengths_m) / ideal_m == pytest.approx(Chassis().slip, abs=0.01)
    assert np.std(lengths_m) > 0.001


def test_robot_without_commands_stops() -> None:
    robot = DifferentialDrive(Pose2d(0, 0, 0), START_NS, np.random.default_rng(0), Chassis())
    robot.command(0.2, 0.2)
    robot.advance(START_NS + 3 * NS_PER_S)
    before = robot.pose_at(START_NS + 3 * NS_PER_S)
    robot.advance(START_NS + 9 * NS_PER_S)
    after = robot.pose_at(START_NS + 9 * NS_PER_S)
    assert before.x_m < 0.2 * (Chassis().watchdog_s + 0.2)
    assert after.x_m == pytest.approx(before.x_m, abs=1e-6)


def test_poses_of_the_past_are_interpolated() -> None:
    robot = DifferentialDrive(Pose2d(0, 0, 0), START_NS, np.random.default_rng(0), IDEAL)
    robot.command(0.2, 0.2)
    steps_m = []
    for number in range(1, 101):
        robot.advance(START_NS + number * STEP_NS)
        steps_m.append(robot.pose_at(START_NS + number * STEP_NS).x_m)
    for number in (0, 17, 98):
        between = robot.pose_at(START_NS + (number + 1) * STEP_NS + STEP_NS // 2).x_m
        assert between == pytest.approx((steps_m[number] + steps_m[number + 1]) / 2, abs=1e-12)
        assert robot.pose_at(START_NS + (number + 1) * STEP_NS).x_m == pytest.approx(
            steps_m[number], abs=1e-15
        )
