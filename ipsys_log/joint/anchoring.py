"""Motion of a whole lab over its floor, so that its points fit to the tape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ipsys_log.arrays import Array
from ipsys_log.joint.parameters import State
from ipsys_log.joint.problem import Problem

# Residuals of readings above this many standard deviations get less weight.
_USUAL = 3.0


def anchor(problem: Problem, state: State) -> State:
    """Return the state after the rigid motion over the floor that fits best to the readings of the tape.

    The cameras of a hall fix each other much better than a few measured points fix all of them. A step of
    the fit then cannot turn the hall far, because the motion of a far camera is an arc and not a line. This
    motion is exact, and leaves all sightings as they are above a flat floor.

    Parameters
    ----------
    problem : the readings.
    state : cameras, points and paths that fit to each other.
    """
    from scipy.optimize import least_squares

    if len(state.positions_m) < 2:
        return state
    middle_m = state.positions_m[:, :2].mean(axis=0)

    def residuals(motion: Array) -> Array:
        found = problem.points.residuals(_move(problem, state, motion, middle_m), problem.layout)
        return np.concatenate([found.distances, found.places.ravel()])

    if not len(residuals(np.zeros(3))):
        return state
    # Lengths of a motion: 1 m, and the turn that moves a far point by about as much.
    reach_m = float(np.linalg.norm(state.positions_m[:, :2] - middle_m, axis=1).max())
    scales = [1 / max(reach_m, 1.0), 1.0, 1.0]
    best = least_squares(residuals, np.zeros(3), loss="cauchy", f_scale=_USUAL, x_scale=scales)
    return _move(problem, state, best.x, middle_m)


def _move(problem: Problem, state: State, motion: Array, middle_m: Array) -> State:
    """Return the state turned by ``motion[0]`` about a point, and shifted by ``motion[1:]``."""
    cos, sin = np.cos(motion[0]), np.sin(motion[0])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def move(points: Array) -> Array:
        moved = points.copy()
        moved[:, :2] = (points[:, :2] - middle_m) @ turn[:2, :2].T + middle_m + motion[1:]
        return moved

    values, knots = state.values.copy(), move(state.knots)
    knots[:, 2] += motion[0]
    for block in problem.layout.cameras:
        origin = slice(block.start + 3, block.start + 6)
        values[origin] = move(values[origin][None])[0]
    return replace(
        state,
        values=values,
        camera_turns=state.camera_turns @ turn.T,
        positions_m=move(state.positions_m),
        turns=turn @ state.turns,
        knots=knots,
    )
