"""The smoother agrees with one Gaussian of all states, conditioned on all sightings at once."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.models.tracking.filter import Sightings, States, start
from ipsys_log.models.tracking.motion import LEVEL, MotionNoise, transition
from ipsys_log.models.tracking.smoothed_poses import smooth_track

Array = NDArray[np.float64]

# The acceleration does not grow with the speed, which the smoother estimates.
NOISE, MODES = MotionNoise(acceleration_m_s2=3.0, bend_rad_s=0.0), 3


def make_sightings(seed: int, count: int) -> tuple[Array, Sightings]:
    """Return durations in s, and sightings of a robot on a bend, with the errors of three amplitudes."""
    rng = np.random.default_rng(seed)
    durations_s = rng.choice([0.0, 0.011, 0.022, 0.4], count - 1)
    times_s = np.concatenate([[0.0], durations_s.cumsum()])
    poses = np.stack([np.cos(times_s), np.sin(times_s), 0.1 + 0 * times_s, times_s + np.pi / 2], axis=1)
    modes = rng.normal(0.0, 0.001, (count, 4, MODES))
    sigmas = np.array([1e-4, 1e-4, 1e-3, 2e-3])
    poses += (modes @ rng.normal(size=MODES)[:, None])[:, :, 0] + rng.normal(size=(count, 4)) * sigmas
    noise = np.broadcast_to(np.diag(sigmas**2), (count, 4, 4))
    return durations_s, Sightings(poses, noise, modes, np.zeros((count, MODES)))


def condition_all(durations_s: Array, sightings: Sightings) -> tuple[Array, Array]:
    """Return means (n, s) and covariances (n, s, s): one Gaussian of all states and all sightings."""
    first = start(sightings.take(np.array([0])), NOISE)
    count, size = len(durations_s) + 1, LEVEL.size + MODES
    means, joint = np.zeros((count, size)), np.zeros((count, size, count, size))
    means[0, : LEVEL.size] = first.means[0]
    joint[0, :, 0] = np.block([[first.covariances[0], -first.cross[0]], [-first.cross[0].T, np.eye(MODES)]])
    for n, duration_s in enumerate(durations_s):
        (motion,), (spread,) = transition(np.array([duration_s]), np.zeros(1), NOISE)
        forward = np.eye(size)
        forward[: LEVEL.size, : LEVEL.size] = motion
        means[n + 1] = forward @ means[n]
        for other in range(n + 1):
            joint[n + 1, :, other] = forward @ joint[n, :, other]
            joint[other, :, n + 1] = joint[n + 1, :, other].T
        joint[n + 1, :, n + 1] = forward @ joint[n, :, n] @ forward.T
        joint[n + 1, : LEVEL.size, n + 1, : LEVEL.size] += spread
    prior = joint.reshape(count * size, count * size)
    rows = np.zeros((count - 1, 4, count, size))
    for n in range(1, count):
        rows[n - 1, :, n, LEVEL.pose] = np.eye(4)
        rows[n - 1, :, n, LEVEL.size :] = sightings.sensitivities[n]
    observed = rows.reshape(-1, count * size)
    white = np.zeros((count - 1, 4, count - 1, 4))
    for n in range(1, count):
        white[n - 1, :, n - 1] = sightings.noise[n]
    total = observed @ prior @ observed.T + white.reshape(len(observed), -1)
    gain = np.linalg.solve(total, observed @ prior).T
    best = means.reshape(-1) + gain @ (sightings.poses[1:].reshape(-1) - observed @ means.reshape(-1))
    posterior = (prior - gain @ observed @ prior).reshape(count, size, count, size)
    own = np.arange(count)
    return best.reshape(count, size)[:, : LEVEL.size], posterior[own, :, own][:, : LEVEL.size, : LEVEL.size]


def smooth_whole(sightings: Sightings, durations_s: Array, block: int = 5) -> States:
    """Return the smoothed states of all sightings in order; few sightings make several blocks."""
    blocks = list(smooth_track(sightings, durations_s, NOISE, block=block))[::-1]
    names = ("means", "covariances", "cross")
    return States(*(np.concatenate([getattr(one, name) for one in blocks]) for name in names))


@pytest.mark.parametrize("seed", range(3))
def test_smoothed_track_equals_a_batch_solution(seed: int) -> None:
    durations_s, sightings = make_sightings(seed, 12)
    smoothed = smooth_whole(sightings, durations_s)
    means, covariances = condition_all(durations_s, sightings)
    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    # In units of the standard deviations: the state has metres, radians and amplitudes.
    assert np.abs((smoothed.means - means) / sigmas).max() < 1e-5
    scale = sigmas[:, :, None] * sigmas[:, None]
    assert np.abs((smoothed.covariances - covariances) / scale).max() < 1e-5


def test_heading_is_smoothed_across_the_turn_of_pi() -> None:
    durations_s, sightings = make_sightings(5, 12)
    turned = sightings.poses.copy()
    turned[:, 3] += np.pi - turned[5:7, 3].mean()
    wrapped = turned.copy()
    wrapped[:, 3] = (turned[:, 3] + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(np.diff(wrapped[:, 3])).max() > 6
    results = [
        smooth_whole(one, durations_s).means[:, 3]
        for one in (
            Sightings(poses, sightings.noise, sightings.sensitivities, sightings.clock_s)
            for poses in (turned, wrapped)
        )
    ]
    assert np.abs(np.exp(1j * results[0]) - np.exp(1j * results[1])).max() < 1e-9


def test_common_error_is_not_reduced_by_smoothing() -> None:
    count = 40
    durations_s = np.full(count - 1, 0.02)
    poses = np.zeros((count, 4))
    modes = np.zeros((count, 4, MODES))
    modes[:, 0, 0] = 0.002  # the same error of x everywhere
    noise = np.broadcast_to(np.diag([1e-8, 1e-8, 1e-8, 1e-8]), (count, 4, 4))
    sightings = Sightings(poses, noise, modes, np.zeros((count, MODES)))
    smoothed = smooth_whole(sightings, durations_s)
    sigmas_m = np.sqrt(np.diagonal(smoothed.covariances, axis1=1, axis2=2))
    assert sigmas_m[:, 0] == pytest.approx(0.002, rel=0.02)
    assert sigmas_m[:, 1].max() < 1e-4


@pytest.mark.parametrize("block", [1, 7, 20, 39, 40, 1000])
def test_size_of_a_block_changes_no_bit(block: int) -> None:
    durations_s, sightings = make_sightings(6, 40)
    whole, parts = (smooth_whole(sightings, durations_s, size) for size in (40, block))
    for name in ("means", "covariances", "cross"):
        assert getattr(whole, name).tobytes() == getattr(parts, name).tobytes()
