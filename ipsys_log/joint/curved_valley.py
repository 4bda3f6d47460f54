"""Long steps along a curved valley of the cost, for fits that the usual steps do not finish.

With nominal intrinsics and a short drive, focal length, lens distortion and height of a camera have such a
valley: they compensate each other along a curve. A straight step is exact only near its start, so the damping
keeps the usual steps short.
"""

from __future__ import annotations

import numpy as np

from ipsys_log.joint.normal import Factorisation, NormalEquations
from ipsys_log.joint.parameters import State
from ipsys_log.joint.problem import Problem

# The strict loss; before it, fits move fast.
_STRICT = 1.0
_LEAST_DAMPING, _MOST_DAMPING, _MORE = 1e-12, 1e-2, 10.0
# Steps back to the bottom of the valley. Each must halve the excess of the cost.
_RETURN_STEPS, _RETURNING = 5, 0.5
# A decrease of this size is that of rounding errors.
_ROUNDING = 1e-6


def leap_along_valley(
    problem: Problem, state: State, normal: NormalEquations
) -> tuple[State, float, float] | None:
    """Take a long step, and return to the bottom of the valley by a few more.

    The cost rises in between, but it is smaller at the end.

    Parameters
    ----------
    problem : factors and unknowns.
    state : the start.
    normal : its normal equations.

    Returns
    -------
    The next state, its cost, and the decrease of twice the cost that the first step would have in a straight
    valley, with the least damping. None if no step decreases the cost.

    References
    ----------
    Grippo, Lampariello and Lucidi, A nonmonotone line search technique for Newton's method, 1986.
    """
    decrement, damping = None, _LEAST_DAMPING
    while damping < _MOST_DAMPING:
        try:
            steps = Factorisation(normal, problem.layout.free, damping).step(normal)
        except np.linalg.LinAlgError:
            damping *= _MORE
            continue
        decrement = normal.expect(*steps) if decrement is None else decrement
        end = _return_to_bottom(problem, state.moved(problem.layout, *steps), normal.cost, damping)
        if end is not None:
            return *end, decrement
        if decrement <= _ROUNDING:
            return state, normal.cost, 0.0
        damping *= _MORE
    return None


def _return_to_bottom(
    problem: Problem, state: State, below: float, damping: float
) -> tuple[State, float] | None:
    """Return a state of at most the cost ``below``, and its cost; None if a few steps do not reach it."""
    excess = np.inf
    for _ in range(_RETURN_STEPS):
        if not problem.permits(state):
            return None
        with np.errstate(all="ignore"):
            normal = problem.linearise(state, _STRICT)
        if normal.cost <= below:
            return state, normal.cost
        if not normal.cost - below < _RETURNING * excess:
            return None
        excess = normal.cost - below
        try:
            steps = Factorisation(normal, problem.layout.free, damping).step(normal)
        except (np.linalg.LinAlgError, ValueError):
            return None
        state = state.moved(problem.layout, *steps)
    return None
