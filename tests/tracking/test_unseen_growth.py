"""Regions of unseen robots follow the accelerations that the robot had while it was seen."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.models.tracking.motion import LEVEL, MotionNoise, displacement, transition
from ipsys_log.models.tracking.tracks import RobotTracks, TrackSettings
from ipsys_log.units import NS_PER_S
from tests.tracking.driving import MS, NOISE_M, NOISE_RAD, START_NS, arrays, follow, sight

Array = NDArray[np.float64]

USUAL = MotionNoise(acceleration_m_s2=0.5, bend_rad_s=0.0)
ROBOTS, STEP_S = 60, 1 / 30


@pytest.mark.parametrize("duration_s", [0.01, 0.1, 0.4, 0.6, 1.0])
def test_displacement_is_that_of_the_transition(duration_s: float) -> None:
    noise = MotionNoise(acceleration_m_s2=1.0, bend_rad_s=0.0)
    (forward,), (spread,) = transition(np.array([duration_s]), np.zeros(1), noise)
    by_acceleration_m, variance_m2 = displacement(duration_s, noise.hold_s)
    assert by_acceleration_m == pytest.approx(forward[0, 8], rel=1e-9)
    assert variance_m2 == pytest.approx(spread[0, 0], rel=1e-6)


def drive_at_random(acceleration_m_s2: float, count: int, rng: np.random.Generator) -> Array:
    """Return the states (count, ROBOTS, 10) of robots with a random acceleration of Singer's model."""
    (forward,), (spread,) = transition(
        np.array([STEP_S]), np.zeros(1), MotionNoise(acceleration_m_s2, 0.0, turn_rad_s2=1e-3)
    )
    root = np.linalg.cholesky(spread + 1e-18 * np.eye(LEVEL.size))
    states = np.zeros((count, ROBOTS, LEVEL.size))
    states[0, :, 8:10] = acceleration_m_s2 * rng.standard_normal((ROBOTS, 2))
    for step in range(1, count):
        states[step] = states[step - 1] @ forward.T + rng.standard_normal((ROBOTS, LEVEL.size)) @ root.T
    return states


def coast_after(acceleration_m_s2: float, seen_s: float, unseen_s: float = 0.6) -> Array:
    """Return the squared errors (ROBOTS,) of predictions, in units of their covariances."""
    rng, seen = np.random.default_rng(5), round(seen_s / STEP_S)
    states = drive_at_random(acceleration_m_s2, seen + round(unseen_s / STEP_S), rng)
    tracks, robots = RobotTracks(TrackSettings(motion=USUAL)), [(f"robot_{n}", n) for n in range(ROBOTS)]
    for step in range(seen):
        noise = rng.normal(0.0, [NOISE_M, NOISE_M, NOISE_M, NOISE_RAD], (ROBOTS, 4))
        time_ns = START_NS + round(step * STEP_S * NS_PER_S)
        sightings = arrays(list(states[step, :, :4] + noise))
        tracks.observe("red", robots, [time_ns] * ROBOTS, sightings, [True] * ROBOTS, [True] * ROBOTS)
    poses = tracks.coast(START_NS + round((len(states) - 1) * STEP_S * NS_PER_S))
    assert [pose.robot for pose in poses] == robots
    errors_m = np.array([pose.states.means[pose.state, :2] for pose in poses]) - states[-1, :, :2]
    spreads_m2 = np.array([pose.states.covariances[pose.state, :2, :2] for pose in poses])
    squares: Array = (errors_m * np.linalg.solve(spreads_m2, errors_m[:, :, None])[:, :, 0]).sum(axis=1)
    return squares


@pytest.mark.parametrize("acceleration_m_s2", [0.25, 0.5, 1.0])
def test_region_is_that_of_the_robots_own_accelerations(acceleration_m_s2: float) -> None:
    """Without the own accelerations, the mean of the squares is 0.5, 2 and 8."""
    squares = coast_after(acceleration_m_s2, 20.0)
    # True is 2, with a standard error of 0.26. The usual motion has a weight of a fifth.
    assert 1.0 < squares.mean() < 3.0
    assert (squares < 5.99).mean() > 0.88


def test_region_of_a_new_track_is_that_of_the_usual_motion() -> None:
    assert coast_after(0.25, 0.4).mean() < 0.8


def size_after(seen_s: float) -> float:
    """Return the standard deviation along x of a prediction over 0.5 s, after a straight drive."""

    def drive(time_ns: int) -> Array:
        return np.array([0.26 * (time_ns - START_NS) / NS_PER_S, 2.0, 0.1, 0.0])

    tracks = RobotTracks()
    follow(sight(drive, seen_s, ("red",)), tracks=tracks)
    (pose,) = tracks.coast(START_NS + round(seen_s * NS_PER_S) + 500 * MS)
    return float(np.sqrt(pose.states.covariances[pose.state, 0, 0]))


def test_region_of_a_smooth_robot_shrinks_to_a_third_at_most() -> None:
    """The least scale of the variance is 0.1: a robot can always brake."""
    young, old, oldest = size_after(0.6), size_after(8.0), size_after(40.0)
    assert young > old > oldest
    assert np.sqrt(0.1) <= oldest / young < 0.5
