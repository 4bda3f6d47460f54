"""The filter of robots equals linear estimation by other roads."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad_vec
from scipy.linalg import expm

from ipsys_log.models.tracking.filter import UNKNOWN_RAD2, Sightings, States, compare, predict, start, update
from ipsys_log.models.tracking.motion import LEVEL, MotionNoise, transition

Array = NDArray[np.float64]

LINEAR = MotionNoise(bend_rad_s=0.0, acceleration_m_s2=2.0)


@pytest.mark.parametrize("duration_s", [1e-4, 0.011, 0.3, 1.0])
def test_transition_solves_the_differential_equation(duration_s: float) -> None:
    noise = MotionNoise()
    slope = np.zeros((LEVEL.size, LEVEL.size))
    slope[:4, 4:8] = np.eye(4)
    slope[4, 8] = slope[5, 9] = 1.0
    slope[8, 8] = slope[9, 9] = -1 / noise.hold_s
    variance = noise.acceleration_m_s2**2 + (noise.bend_rad_s * 0.7) ** 2
    density = np.zeros(LEVEL.size)
    density[6:] = noise.climb_m_s2**2, noise.turn_rad_s2**2, *[2 * variance / noise.hold_s] * 2

    def growth(time_s: float) -> Array:
        moved = expm(slope * time_s)
        return np.asarray((moved * density) @ moved.T)

    forward, spread = transition(np.array([duration_s]), np.array([0.7]), noise)
    np.testing.assert_allclose(forward[0], expm(slope * duration_s), atol=1e-12)
    np.testing.assert_allclose(spread[0], quad_vec(growth, 0, duration_s)[0], rtol=1e-7, atol=1e-18)


def drawn_sightings(rng: np.random.Generator, count: int, modes: int) -> Sightings:
    root = 1e-3 * rng.standard_normal((count, 4, 4))
    return Sightings(
        np.array([1.0, 2.0, 0.1, 0.5]) + 1e-3 * rng.standard_normal((count, 4)),
        root @ root.swapaxes(1, 2) + 1e-7 * np.eye(4),
        2e-3 * rng.standard_normal((count, 4, modes)),
        np.zeros((count, modes)),
    )


def test_filter_equals_the_conditional_mean_of_all_states() -> None:
    """Stack all states: their joint normal distribution, conditioned on all sightings, gives the last one."""
    rng, count = np.random.default_rng(1), 12
    seen, durations_s = drawn_sightings(rng, count, 0), rng.uniform(0.0, 0.05, count - 1)
    states = start(seen.take(np.array([0])), LINEAR)
    mean, covariance = states.means[0], states.covariances[0]
    forward, spread = transition(durations_s, np.zeros(count - 1), LINEAR)
    for row in range(1, count):
        one = seen.take(np.array([row]))
        states = predict(states, durations_s[row - 1 : row], LINEAR)
        states = update(states, one, compare(states, one))
        mean = np.concatenate([mean, forward[row - 1] @ mean[-LEVEL.size :]])
        across = covariance[:, -LEVEL.size :] @ forward[row - 1].T
        corner = (
            forward[row - 1] @ covariance[-LEVEL.size :, -LEVEL.size :] @ forward[row - 1].T + spread[row - 1]
        )
        covariance = np.block([[covariance, across], [across.T, corner]])
    look = np.zeros((4 * (count - 1), len(mean)))
    noise = np.zeros((len(look), len(look)))
    for row in range(1, count):
        rows = slice(4 * row - 4, 4 * row)
        look[rows, LEVEL.size * row : LEVEL.size * row + 4] = np.eye(4)
        noise[rows, rows] = seen.noise[row]
    gain = np.linalg.solve(look @ covariance @ look.T + noise, look @ covariance).T
    expected = mean + gain @ (seen.poses[1:].ravel() - look @ mean)
    remaining = covariance - gain @ look @ covariance
    np.testing.assert_allclose(states.means[0], expected[-LEVEL.size :], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(
        states.covariances[0], remaining[-LEVEL.size :, -LEVEL.size :], rtol=1e-5, atol=1e-12
    )


def simulate(count: int, steps: int) -> tuple[States, Array, Array]:
    """Filter tracks with common errors of the calibration: final states, true states, and amplitudes."""
    rng, m = np.random.default_rng(2), 3
    amplitudes = rng.standard_normal((count, m))
    true = np.zeros((count, LEVEL.size))
    true[:, 4:] = rng.normal(0.0, [1.0, 1.0, 0.05, 2.0, 1.5, 1.5], (count, 6))
    tables = 1e-3 * rng.standard_normal((2, 4, m))
    noise = np.broadcast_to(np.diag([1e-4, 1e-4, 1e-4, 1e-3]) ** 2, (count, 4, 4))
    states: States | None = None
    for step in range(steps):
        if step:
            forward, spread = transition(np.array([0.02]), np.zeros(1), LINEAR)
            kick = (
                rng.standard_normal((count, LEVEL.size))
                @ np.linalg.cholesky(spread[0] + 1e-18 * np.eye(10)).T
            )
            true = true @ forward[0].T + kick
        modes = np.broadcast_to(tables[step // 3 % 2], (count, 4, m))
        poses = true[:, LEVEL.pose] + amplitudes @ tables[step // 3 % 2].T
        poses = poses + rng.normal(0.0, [1e-4, 1e-4, 1e-4, 1e-3], (count, 4))
        seen = Sightings(poses, noise, modes, np.zeros((count, m)))
        if states is None:
            states = start(seen, LINEAR)
        else:
            states = predict(states, np.full(count, 0.02), LINEAR)
            states = update(states, seen, compare(states, seen))
    assert states is not None
    return states, true, amplitudes


def test_covariance_is_that_of_the_errors_with_common_biases() -> None:
    count = 4000
    states, true, amplitudes = simulate(count, 9)
    errors = states.means - true
    errors[:, 3] = (errors[:, 3] + np.pi) % (2 * np.pi) - np.pi
    stated = states.covariances[0]
    scale = np.sqrt(stated.diagonal())
    seen = errors.T @ errors / count
    np.testing.assert_allclose(seen / np.outer(scale, scale), stated / np.outer(scale, scale), atol=0.1)
    np.testing.assert_allclose(
        errors.T @ amplitudes / count / scale[:, None], states.cross[0] / scale[:, None], atol=0.1
    )


def test_late_clock_makes_the_position_uncertain_along_the_path() -> None:
    modes, moving = np.zeros((1, 4, 1)), np.zeros((1, LEVEL.size))
    moving[0, 4] = 1.0
    states = States(moving, 1e-8 * np.eye(LEVEL.size)[None], np.zeros((1, LEVEL.size, 1)))
    seen = Sightings(np.zeros((1, 4)), 1e-8 * np.eye(4)[None], modes, np.array([[0.001]]))
    spread = compare(states, seen).covariances[0].diagonal()
    np.testing.assert_allclose(spread, [1e-6 + 2e-8, 2e-8, 2e-8, 2e-8], rtol=1e-9)


def test_heading_is_followed_through_the_half_turn() -> None:
    noise = np.diag([1e-4, 1e-4, 1e-4, 1e-3])[None] ** 2
    no_modes = np.zeros((1, 4, 0)), np.zeros((1, 0))
    states = start(Sightings(np.array([[0, 0, 0, np.pi - 0.02]]), noise, *no_modes), LINEAR)
    for turn in range(1, 5):
        heading = (np.pi - 0.02 + 0.01 * turn + np.pi) % (2 * np.pi) - np.pi
        seen = Sightings(np.array([[0, 0, 0, heading]]), noise, *no_modes)
        states = predict(states, np.array([0.01]), LINEAR)
        states = update(states, seen, compare(states, seen))
    assert states.means[0, 3] == pytest.approx(np.pi + 0.02, abs=2e-3)
    assert states.means[0, 7] == pytest.approx(1.0, abs=0.2)


def test_missing_heading_changes_no_heading() -> None:
    noise = np.diag([1e-8, 1e-8, 1e-8, UNKNOWN_RAD2])[None]
    known = np.diag([1e-8, 1e-8, 1e-8, 1e-6])[None]
    no_modes = np.zeros((1, 4, 0)), np.zeros((1, 0))
    states = start(Sightings(np.array([[0, 0, 0, 1.0]]), known, *no_modes), LINEAR)
    seen = Sightings(np.array([[1e-4, 0, 0, 0.0]]), noise, *no_modes)
    after = update(states, seen, compare(states, seen))
    assert after.means[0, 3] == pytest.approx(1.0, abs=1e-9)
    assert after.covariances[0, 3, 3] == pytest.approx(states.covariances[0, 3, 3], rel=1e-6)
    assert after.means[0, 0] > 0


def test_covariance_stays_definite_over_many_exact_sightings() -> None:
    rng = np.random.default_rng(3)
    noise = np.broadcast_to(np.diag([1e-12, 1e-6, 1e-12, 1e-12]), (1, 4, 4))
    modes = np.broadcast_to(1e-3 * rng.standard_normal((4, 6)), (1, 4, 6))
    seen = Sightings(np.zeros((1, 4)), noise, modes, np.zeros((1, 6)))
    states = start(seen, LINEAR)
    for _ in range(3000):
        states = predict(states, np.array([0.001]), LINEAR)
        states = update(states, seen, compare(states, seen))
    joint = np.block([[states.covariances[0], states.cross[0]], [states.cross[0].T, np.eye(6)]])
    scale = np.sqrt(joint.diagonal())
    assert np.linalg.eigvalsh(joint / np.outer(scale, scale))[0] > -1e-9
    assert (states.covariances[0] == states.covariances[0].T).all()
