"""Derivatives and least squares of a joint calibration by other means: oracles for tests."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lstsq
from scipy.optimize import least_squares

from ipsys_log.calibration.joint.parameters import State
from ipsys_log.calibration.joint.problem import Problem
from ipsys_log.calibration.joint.robust import limit_of, robust_loss

Array = NDArray[np.float64]

# The limit of the loss in each step, in limits of normal errors.
_PLAIN_STEPS, _ROBUST_STEPS = (1e9,) * 4, (1.0,) * 2


def residuals_of(problem: Problem, state: State, ease: float = 1.0) -> Array:
    """Return all residuals, scaled so that the sum of their squares is the robust loss."""
    layout, trajectories = problem.layout, problem.trajectories
    parts = []
    for factors in problem.sightings:
        residuals = factors.residuals(state, layout, trajectories)
        parts.append(_robust(residuals, factors.limit * ease))
    points = problem.points.residuals(state, layout)
    one, two = ease * float(limit_of(1.0)), ease * float(limit_of(2.0))
    parts += [
        _robust(points.distances[:, None], one),
        _robust(points.heights[:, None], one),
        _robust(points.places, two),
        points.tilts.ravel(),
        trajectories.smoothness_residuals(state),
    ]
    prior = problem.prior_residuals(state)
    bodies = slice(layout.scales.start, layout.heights.stop)
    prior[bodies] = _robust(prior[bodies][:, None], float(limit_of(1.0)))
    parts.append(prior)
    return np.concatenate(parts)


def _robust(residuals: Array, limit: Array | float) -> Array:
    chi2 = (residuals**2).sum(axis=1)
    loss, _ = robust_loss(chi2, limit)
    return np.asarray((residuals * np.sqrt(loss / np.maximum(chi2, 1e-300))[:, None]).ravel())


def split_step(problem: Problem, step: Array) -> tuple[Array, Array]:
    """Return the step of the global and of the local unknowns from a step of the free ones."""
    by_global = np.zeros(len(problem.layout.mean))
    free = problem.layout.free
    by_global[free] = step[: free.sum()]
    return by_global, step[free.sum() :]


def step_sizes(problem: Problem) -> Array:
    """Return typical sizes of the free unknowns, for differences and scales."""
    sigma = problem.layout.sigma
    sizes = np.where(np.isfinite(sigma), sigma, 1e-3)[problem.layout.free]
    return np.concatenate([sizes, np.full(problem.trajectories.local_count, 1e-3)])


def jacobian_of(problem: Problem, state: State, function: Callable[[State], Array]) -> Array:
    """Return the derivatives of a function of the state by central differences."""
    columns = []
    sizes = step_sizes(problem)
    for number, size in enumerate(sizes):
        step = np.zeros(len(sizes))
        step[number] = 1e-3 * size
        ahead, behind = (
            function(state.moved(problem.layout, *split_step(problem, sign * step))) for sign in (1, -1)
        )
        columns.append((ahead - behind) / (2e-3 * size))
    return np.stack(columns, axis=1)


def minimise(problem: Problem, start: State) -> State:
    """Return the optimum by scipy's trust-region method, with derivatives by differences."""
    sizes = step_sizes(problem)

    def function(step: Array) -> Array:
        return residuals_of(problem, start.moved(problem.layout, *split_step(problem, step * sizes)))

    solved = least_squares(
        function, np.zeros(len(sizes)), "2-point", xtol=1e-12, ftol=1e-14, gtol=1e-12, method="trf"
    )
    return start.moved(problem.layout, *split_step(problem, solved.x * sizes))


def descend(problem: Problem, start: State) -> State:
    """Return the optimum by Gauss-Newton steps of scipy's dense least squares, with central differences.

    A drive has unknowns that are hardly determined: derivatives of one side end at another place. The first
    steps have plain squares, because everything is an outlier at the start.
    """
    state = start
    for ease in (*_PLAIN_STEPS, *_ROBUST_STEPS):
        residuals = residuals_of(problem, state, ease)
        jacobian = jacobian_of(problem, state, partial(residuals_of, problem, ease=ease))
        scales = np.linalg.norm(jacobian, axis=0)
        step = lstsq(jacobian / scales, -residuals, cond=1e-14)[0] / scales
        state = state.moved(problem.layout, *split_step(problem, step))
    return state
