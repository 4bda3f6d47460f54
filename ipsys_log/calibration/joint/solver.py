"""Levenberg-Marquardt method for the joint calibration, with a robust loss that becomes strict in steps.

In a hall, motions of the whole lab over its floor fit its points to the tape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ipsys_log.calibration.joint.normal import Factorisation, NormalEquations
from ipsys_log.calibration.joint.parameters import State
from ipsys_log.calibration.joint.problem import Problem
from ipsys_log.errors import FitError
from ipsys_log.messages import Array

COLD_DAMPING = 1e-4
# The same near the optimum, where more damping only slows the weak directions.
WARM_DAMPING = 1e-8
# Limits of the damping.
_LEAST_DAMPING = 1e-12
_MOST_DAMPING = 1e8
_MOST_STEPS = 200
# Share of the standard deviation: the optimum is exact to a thousandth of its uncertainty.
SHORT = 1e-3
# Before the loss is strict, a step need not be so exact.
_ROUGH = 0.3
_TOLERABLE = 0.03
# A relative change of the cost this small is no progress.
_STALLED = 1e-9
# In a hall, steps and motions of the whole lab that oppose each other may also alternate without end.
_MOST_EASY_STEPS = 100
# After the usual steps, long ones follow a curved valley.
_MOST_LEAPS = 100
_NOT_CONVERGED = (
    f"the joint fit did not converge in {_MOST_STEPS} steps; look at the residuals of the sightings, and "
    "remove wrong measurements"
)
_UNDETERMINED = "the observations do not determine the cameras; add calibration points, spread over the floor"
# The strict loss; before it, fits move fast.
_STRICT = 1.0
# Dampings of a leap, from the least to the most by this factor: the least one that leads on is taken.
_LEAST_LEAP_DAMPING = 1e-12
_MOST_LEAP_DAMPING = 1e-2
_MORE_LEAP_DAMPING = 10.0
# Steps back to the bottom of the valley.
_RETURN_STEPS = 5
# Each must halve the excess of the cost.
_RETURNING = 0.5
# A decrease of this size is that of rounding errors.
_ROUNDING = 1e-6
# Residuals of readings above this many standard deviations get less weight.
_USUAL_SIGMAS = 3.0


class ConvergenceError(FitError):
    """The method does not converge; ``problem`` and ``state`` are the last ones."""

    def __init__(self, text: str, problem: Problem, state: State) -> None:
        super().__init__(text)
        self.problem, self.state = problem, state


@dataclass(frozen=True, eq=False)
class Solution:
    """The state of least cost, the number of steps, and the normal equations and their factors."""

    problem: Problem
    state: State
    cost: float
    steps: int

    @cached_property
    def normal(self) -> NormalEquations:
        """The normal equations at the state."""
        return self.problem.linearise(self.state, _STRICT)

    @cached_property
    def factorisation(self) -> Factorisation:
        """Their factors; FitError if the observations do not determine the unknowns."""
        try:
            return Factorisation(self.normal, self.problem.layout.free)
        except np.linalg.LinAlgError as error:
            raise FitError(_UNDETERMINED) from error


def solve(
    problem: Problem,
    state: State,
    progress: Callable[[int, float], None] = lambda step, cost: None,
    short: float = SHORT,
    patient: bool = False,
    follows_valleys: bool = True,
    damping: float = COLD_DAMPING,
) -> Solution:
    """Minimise the cost of a problem, from a start.

    Outliers in the start are unknown. At first, the loss treats errors up to twice the median as normal. The
    limit then falls with the median until it is that of the noise.

    Parameters
    ----------
    problem : factors and unknowns.
    state : the start.
    progress : called with the number of steps and the cost after each step.
    short : the fit has converged if a full step is shorter than this share of the standard deviation.
    patient : whether the limit falls only after convergence; until then, the whole lab moves to its measured
        points before each step. In a hall, the sightings fit long before the cameras fit to the few measured
        points, which would then count as outliers.
    follows_valleys : whether long steps along a curved valley follow the usual ones; they may take minutes.
    damping : of the first step.

    Raises
    ------
    FitError
        The method does not converge, or the observations do not determine the unknowns.

    References
    ----------
    Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment - a modern synthesis, 2000.
    """
    state = anchor(problem, state) if patient else state
    ease, last_cost = problem.ease(state), np.inf
    normal = problem.linearise(state, ease)
    for step in range(_MOST_STEPS):
        state, cost, decrement, damping = _descend(problem, state, normal, damping, ease)
        progress(step + 1, cost)
        # A step that only reverses the last motion of the whole lab is the last one before the limit falls.
        stalled = patient and ease > 1.0
        stalled &= step >= _MOST_EASY_STEPS or abs(last_cost - cost) <= _STALLED * cost
        last_cost = cost
        if patient and ease > 1.0:
            state = anchor(problem, state)
        long = short if ease == 1.0 else _ROUGH
        settled = stalled or decrement <= long**2
        if settled and ease == 1.0:
            return Solution(problem, state, cost, step + 1)
        if ease > 1.0 and (settled or (step % 3 == 2 and not patient)):
            ease = min(ease, problem.ease(state))
            # The last stage is strict, even if more than half of the sightings have errors above the noise.
            ease = ease / 4 if settled else ease
            ease = 1.0 if ease < 2.0 else ease
        normal = problem.linearise(state, ease)
    if ease == 1.0 and decrement <= _TOLERABLE**2:
        # Outliers at the limit of the loss slow the last steps, without an effect on the result.
        return Solution(problem, state, cost, _MOST_STEPS)
    if ease == 1.0 and follows_valleys:
        return _follow_valley(problem, state, normal, progress, short)
    raise ConvergenceError(_NOT_CONVERGED, problem, state)


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
    best = least_squares(residuals, np.zeros(3), loss="cauchy", f_scale=_USUAL_SIGMAS, x_scale=scales)
    return _move(problem, state, best.x, middle_m)


def _follow_valley(
    problem: Problem,
    state: State,
    normal: NormalEquations,
    progress: Callable[[int, float], None],
    short: float,
) -> Solution:
    """Continue with long steps along a curved valley of the cost, where the usual steps are too short."""
    for step in range(_MOST_STEPS, _MOST_STEPS + _MOST_LEAPS):
        leap = _leap_along_valley(problem, state, normal)
        if leap is None:
            break
        state, cost, decrement = leap
        progress(step + 1, cost)
        if decrement <= short**2:
            return Solution(problem, state, cost, step + 1)
        normal = problem.linearise(state, 1.0)
    raise ConvergenceError(_NOT_CONVERGED, problem, state)


def _descend(
    problem: Problem, state: State, normal: NormalEquations, damping: float, ease: float
) -> tuple[State, float, float, float]:
    """Return the next state, its cost, the expected decrease of twice the cost, and the damping."""
    while True:
        try:
            by_global, by_local = Factorisation(normal, problem.layout.free, damping).step(normal)
        except np.linalg.LinAlgError:
            damping = _more(damping)
            continue
        expected = normal.expect(by_global, by_local)
        trial = state.moved(problem.layout, by_global, by_local)
        with np.errstate(all="ignore"):
            cost = problem.cost(trial, ease) if problem.permits(trial) else np.inf
        if np.isfinite(cost) and cost <= normal.cost:
            # A short step by strong damping is no sign of a minimum.
            decrement = expected if damping <= COLD_DAMPING else np.inf
            # Weak directions converge only without damping: a step as good as expected ends it soon.
            relief = 100.0 if normal.cost - cost > 0.25 * expected else 3.0
            return trial, cost, decrement, max(damping / relief, _LEAST_DAMPING)
        if expected <= SHORT**2:
            # Rounding errors hide the decrease: this is the minimum.
            return state, normal.cost, 0.0, damping
        damping = _more(damping)


def _more(damping: float) -> float:
    if damping >= _MOST_DAMPING:
        raise FitError(_UNDETERMINED)
    return max(damping * 8, 1e-8)


def _leap_along_valley(
    problem: Problem, state: State, normal: NormalEquations
) -> tuple[State, float, float] | None:
    """Take a long step, and return to the bottom of the valley by a few more.

    The cost rises in between, but it is smaller at the end. With nominal intrinsics and a short drive, focal
    length, lens distortion and height of a camera have such a valley: they compensate each other along a
    curve. A straight step is exact only near its start, so the damping keeps the usual steps short.

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
    decrement, damping = None, _LEAST_LEAP_DAMPING
    while damping < _MOST_LEAP_DAMPING:
        try:
            steps = Factorisation(normal, problem.layout.free, damping).step(normal)
        except np.linalg.LinAlgError:
            damping *= _MORE_LEAP_DAMPING
            continue
        decrement = normal.expect(*steps) if decrement is None else decrement
        end = _return_to_bottom(problem, state.moved(problem.layout, *steps), normal.cost, damping)
        if end is not None:
            return *end, decrement
        if decrement <= _ROUNDING:
            return state, normal.cost, 0.0
        damping *= _MORE_LEAP_DAMPING
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
