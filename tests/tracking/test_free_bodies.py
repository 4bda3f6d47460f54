"""Free bodies: their filter and their smoother know how wrong they are, while the body turns over."""

from __future__ import annotations

import numpy as np

from ipsys_log.models.tracking.filter import Sightings, States, compare, predict, start, update
from ipsys_log.models.tracking.motion import FREE, MotionNoise, transition
from ipsys_log.models.tracking.smoothed_poses import smooth_track
from ipsys_log.vision.poses import rotate, rotation_vectors
from tests.joint.small_lab import Array

# The acceleration does not grow with the speed, which the smoother estimates.
NOISE, MODES = MotionNoise(acceleration_m_s2=2.0, bend_rad_s=0.0, turn_rad_s2=3.0), 4
SIGMAS = np.repeat([3e-4, 2e-3], 3)
STEP_S, COUNT, STEPS = 0.03, 300, 40


def simulate() -> tuple[list[Sightings], Array, Array]:
    """Return the sightings of tumbling bodies with common errors, and their true points and rotations."""
    rng = np.random.default_rng(0)
    amplitudes, table = rng.standard_normal((COUNT, MODES)), rng.normal(0, 5e-4, (6, MODES))
    motion = np.zeros((COUNT, FREE.size))
    motion[:, 6:] = rng.standard_normal((COUNT, 9)) * [0.5, 0.5, 0.05, 2.0, 2.0, 2.0, 1.5, 1.5, 1.5]
    turns = rotate(rng.normal(0, 1.5, (COUNT, 3)))
    (forward,), (spread,) = transition(np.array([STEP_S]), np.zeros(1), NOISE, layout=FREE)
    root = np.linalg.cholesky(spread + 1e-18 * np.eye(FREE.size))
    # A rolling shutter shows a body elsewhere, by its velocity.
    by_rates = rng.normal(0, 0.004, (COUNT, 6, 6))
    seen, points_m, rotations = [], [], []
    for _ in range(STEPS):
        errors = amplitudes @ table.T + rng.standard_normal((COUNT, 6)) * SIGMAS
        errors += (by_rates @ motion[:, 6:12, None])[:, :, 0]
        poses = np.concatenate([motion[:, :3] + errors[:, :3], np.zeros((COUNT, 3))], axis=1)
        noise = np.broadcast_to(np.diag(SIGMAS**2), (COUNT, 6, 6))
        modes = np.broadcast_to(table, (COUNT, 6, MODES))
        seen_turns = rotate(errors[:, 3:]) @ turns
        seen.append(Sightings(poses, noise, modes, np.zeros((COUNT, MODES)), seen_turns, by_rates))
        points_m.append(motion[:, :3])
        rotations.append(turns)
        motion = motion @ forward.T + rng.standard_normal((COUNT, FREE.size)) @ root.T
        turns, motion[:, 3:6] = rotate(motion[:, 3:6]) @ turns, 0.0
    return seen, np.array(points_m), np.array(rotations)


def chi2(states: States, points_m: Array, rotations: Array) -> Array:
    """Return the squared errors of poses in units of their covariances, by degree of freedom."""
    assert states.turns is not None
    turned = rotation_vectors(states.turns @ rotations.swapaxes(1, 2))
    errors = np.concatenate([states.means[:, :3] - points_m, turned], axis=1)
    solved = np.linalg.solve(states.covariances[:, :6, :6], errors[:, :, None])
    return np.asarray((errors[:, None] @ solved)[:, 0, 0] / 6)


def test_covariance_of_tumbling_bodies_is_that_of_their_errors() -> None:
    seen, points_m, rotations = simulate()
    states = start(seen[0], NOISE)
    values = []
    for number in range(1, STEPS):
        states = predict(states, np.full(COUNT, STEP_S), NOISE)
        states = update(states, seen[number], compare(states, seen[number]))
        values.append(chi2(states, points_m[number], rotations[number]).mean())
    assert 0.9 < np.mean(values[5:]) < 1.1
    # A hundred of them turn over in each second.
    assert (rotations[:, :, 2, 2].min(axis=0) < 0).sum() > 50


def test_smoother_of_tumbling_bodies_knows_its_errors() -> None:
    seen, points_m, rotations = simulate()
    values, spans = [], []
    for body in range(60):
        rows = np.array([body])
        parts = [one.take(rows) for one in seen]
        own = Sightings(
            np.concatenate([part.poses for part in parts]),
            np.concatenate([part.noise for part in parts]),
            np.concatenate([part.sensitivities for part in parts]),
            np.concatenate([part.clock_s for part in parts]),
            np.concatenate([part.turns for part in parts if part.turns is not None]),
            np.concatenate([part.by_rates for part in parts if part.by_rates is not None]),
        )
        for block in (7, STEPS):
            (*_, first) = smooth_track(own, np.full(STEPS - 1, STEP_S), NOISE, block=block)
            spans.append(first.means[0, :3])
        (states,) = smooth_track(own, np.full(STEPS - 1, STEP_S), NOISE, block=STEPS)
        values.append(chi2(states, points_m[:, body], rotations[:, body])[10:30])
    assert 0.85 < np.mean(values) < 1.15
    # The size of a block has no effect.
    np.testing.assert_allclose(spans[0::2], spans[1::2], atol=1e-9)
