"""Evidence of moved cameras and of wrong row times, by one step of least squares from a fit without them.

All residuals count with their squares. The robust loss of a contradicted fit makes outliers of those
sightings that show the contradiction.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.normal import Factorisation, NormalEquations
from ipsys_log.calibration.joint.trajectories import Kind
from ipsys_log.messages import Array

_CANDIDATES = 12
# With so many candidates between the neighbours of the last time, three searches find one of 400 sightings.
_SEARCHES = 3
# On either side of the time there are at least ten sightings of moving markers: the last sightings of a robot
# often show how it is lifted from the floor.
_LEAST = 10
# A sighting of a stationary marker counts as so many.
_STATIONARY = 5
# A motion or wrong row times need a larger chi2. In 59 honest simulated labs with a wobble of 0.6 degrees,
# 2.6 times its sigma, the largest one is 69,
_CONTRADICTED = 80.0
# but 118 if only a few sightings of moving markers, which share a few tilts, are on one side of the time.
_FEW, _CONTRADICTED_BY_FEW = 40, 200.0
# Unknowns of a pose: a turn and a shift.
_POSE = 6
# A larger turn is that of a few outliers, which any pose explains.
_MOST_TURN_RAD = 0.17
# A smaller motion, as a shift of the floor map, is one by temperature: 0.2 px of an image are about 0.9 mm.
_LEAST_MOTION_M = 0.0003
# A factor on the limits of the loss with which no residual is an outlier.
_NO_LIMIT = 1e12
# In simulated labs, true motions achieve at least 1.9 times the promised decrease; outliers at one instant
# achieve at most 0.25 times.
_ACHIEVED = 0.7
# Rounding errors of a cost.
_SAME_COST = 1e-9


class CameraMotion(NamedTuple):
    """A motion of a camera, by its number, at about ``time_s`` in the time of the sightings.

    ``chi2`` is the decrease of the sum of squares if the camera has another pose after this time.
    ``turn_rad`` is the angle of the turn, ``shift_m`` the length of the shift.
    """

    camera: int
    time_s: float
    chi2: float
    turn_rad: float
    shift_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Squares:
    """The sum of the squares of all residuals near a fit, as a quadratic function of the unknowns.

    ``lowest`` is its least value. ``pulled`` is the whitened gradient of the local unknowns, ``gradient``
    that of the free global unknowns after the elimination of the local ones.
    """

    fit: JointFit
    normal: NormalEquations
    factorisation: Factorisation
    pulled: Array
    gradient: Array
    lowest: float


def explains_squares(fit: JointFit, divided: JointFit, motion: CameraMotion) -> bool:
    """Return whether a motion decreases the sum of squares by nearly as much as one step promised.

    Outliers of another cause also promise a decrease, but the fit with the motion does not remove them.
    """
    before, after = (2 * one.problem.cost(one.state, _NO_LIMIT) for one in (fit, divided))
    return before - after > _ACHIEVED * motion.chi2


def sum_squares(fit: JointFit) -> Squares:
    """Return the sum of squares near a fit."""
    normal, factorisation, free = fit.solution.normal, fit.solution.factorisation, fit.problem.layout.free
    if fit.problem.cost(fit.state, _NO_LIMIT) > normal.cost * (1 + _SAME_COST):
        # The fit has outliers.
        normal = fit.problem.linearise(fit.state, _NO_LIMIT)
        factorisation = Factorisation(normal, free)
    pulled = factorisation.forward(normal.local_gradient[:, None])[:, 0]
    gradient = normal.global_gradient[free] - factorisation.pull(pulled)
    return Squares(fit, normal, factorisation, pulled, gradient, _lowest(normal, factorisation))


def _lowest(normal: NormalEquations, factorisation: Factorisation) -> float:
    return 2 * normal.cost - normal.expect(*factorisation.step(normal))


def find_motion(squares: Squares, camera: int) -> CameraMotion | None:
    """Return the most likely motion of a camera; None without evidence.

    For each candidate time, the camera gets six additional unknowns: the change of its pose after that time.
    One step of the least-squares fit shows by how much the cost falls.
    """
    times_s, worths = _sighting_times(squares.fit, camera)
    before = np.cumsum(worths)
    possible = np.flatnonzero((before >= _LEAST) & (before[-1:] - before >= _LEAST)) + 1
    if not len(possible):
        return None
    cuts = _cuts(int(possible[0]), int(possible[-1]))
    best = _best_motion(squares, camera, times_s, cuts)
    for _ in range(_SEARCHES - 1):
        if best.chi2 <= _CONTRADICTED:
            return None
        cuts = _near(times_s, cuts, best.time_s)
        best = _best_motion(squares, camera, times_s, cuts)
    is_later = times_s > best.time_s
    has_few = any(len(side) < _FEW and side.max() == 1 for side in (worths[is_later], worths[~is_later]))
    is_shown = best.chi2 > (_CONTRADICTED_BY_FEW if has_few else _CONTRADICTED)
    height_m = abs(float(squares.fit.state.values[squares.fit.problem.layout.cameras[camera].start + 5]))
    is_shown &= best.turn_rad * height_m + best.shift_m > _LEAST_MOTION_M
    return best if is_shown and best.turn_rad < _MOST_TURN_RAD else None


def row_time_evidence(squares: Squares) -> float:
    """Return the decrease of the sum of squares by free row times of all cameras; 0 without evidence."""
    problem = squares.fit.problem
    free = problem.layout.free.copy()
    for factors in problem.sightings:
        if factors.kind is Kind.FLOOR:
            free[problem.layout.cameras[factors.camera].edge + 2] = True
    if (free == problem.layout.free).all():
        return 0.0
    chi2 = squares.lowest - _lowest(squares.normal, Factorisation(squares.normal, free))
    return chi2 if chi2 > _CONTRADICTED else 0.0


def _sighting_times(fit: JointFit, camera: int) -> tuple[Array, NDArray[np.intp]]:
    """Return the times (n,) of the sightings of a camera, in order, and what each is worth."""
    times_s, worths = [np.zeros(0)], [np.zeros(0, dtype=np.intp)]
    for factors in fit.problem.sightings:
        if factors.camera == camera:
            times_s.append(factors.sightings.times_s)
            worth = _STATIONARY if factors.kind is Kind.STATIONARY else 1
            worths.append(np.full(len(times_s[-1]), worth))
    order = np.argsort(np.concatenate(times_s), kind="stable")
    return np.concatenate(times_s)[order], np.concatenate(worths)[order]


def _cuts(first: int, last: int) -> NDArray[np.intp]:
    """Return numbers of sightings before a motion, from ``first`` to ``last``."""
    return np.unique(np.linspace(first, last, _CANDIDATES).astype(np.intp))


def _near(times_s: Array, cuts: NDArray[np.intp], time_s: float) -> NDArray[np.intp]:
    """Return finer cuts, between those beside a time."""
    number = int(np.searchsorted(times_s[cuts - 1], time_s)) - 1
    return _cuts(int(cuts[max(number - 1, 0)]), int(cuts[min(number + 1, len(cuts) - 1)]))


def _best_motion(squares: Squares, camera: int, times_s: Array, cuts: NDArray[np.intp]) -> CameraMotion:
    """Return the motion of the camera at the cut with the most evidence."""
    between_s = (times_s[cuts - 1] + times_s[cuts]) / 2
    gradients, information = _add_motions(squares, camera, between_s)
    motions = []
    for number, time_s in enumerate(between_s.tolist()):
        part = slice(_POSE * number, _POSE * (number + 1))
        inverse = np.linalg.pinv(information[part, part], rcond=1e-9, hermitian=True)
        step = -inverse @ gradients[part]
        turn_rad, shift_m = float(np.linalg.norm(step[:3])), float(np.linalg.norm(step[3:]))
        motions.append(CameraMotion(camera, time_s, float(-step @ gradients[part]), turn_rad, shift_m))
    return max(motions, key=lambda one: one.chi2)


def _add_motions(squares: Squares, camera: int, times_s: Array) -> tuple[Array, Array]:
    """Return the gradient (6 k,) and the information (6 k, 6 k) of the motions of a camera at times (k,).

    The information is that after the elimination of all other unknowns. Only the blocks in which the camera
    has sightings have columns for these unknowns. In a hall, these are few, so the time for all cameras grows
    with the sightings and not with their square.
    """
    fit, factorisation, count = squares.fit, squares.factorisation, _POSE * len(times_s)
    problem, layout, trajectories = fit.problem, fit.problem.layout, fit.problem.trajectories
    blocks = tuple(
        replace(block, columns=np.arange(count if seen else 0))
        for block, seen in zip(factorisation.blocks, _blocks_with(squares, camera), strict=True)
    )
    extra = NormalEquations(trajectories.local_count, count, trajectories.bandwidth, blocks)
    between = np.zeros((len(layout.mean), count))
    for factors in problem.sightings:
        if factors.camera != camera:
            continue
        rows = factors.weighted_rows(fit.state, layout, trajectories, _NO_LIMIT)
        after = factors.sightings.times_s[:, None] > times_s
        own = after[:, None, :, None] * rows.by_global[:, :, None, :_POSE]
        own = own.reshape(*rows.residuals.shape, -1)
        extra.add_mixed(rows.starts, rows.by_local, slice(0, count), own)
        extra.add_global(np.arange(count), own, rows.residuals)
        flat = own.reshape(-1, count)
        between[factors.columns(layout)] += rows.by_global.reshape(len(flat), -1).T @ flat
        if rows.modes is not None and layout.floor.count:
            lifted = (own * rows.by_height[:, :, None]).sum(axis=1)
            between[layout.modes] += rows.modes.T @ lifted
    mixed, pulled = factorisation.whiten(extra.coupling)
    coupling = between[layout.free] - pulled
    information = extra.dense - coupling.T @ factorisation.solve_reduced(coupling)
    gradient = extra.global_gradient - coupling.T @ factorisation.solve_reduced(squares.gradient)
    for block, whitened in zip(factorisation.blocks, mixed, strict=True):
        if whitened.shape[1]:
            information -= whitened.T @ whitened
            gradient -= whitened.T @ squares.pulled[block.rows]
    return gradient, information


def _blocks_with(squares: Squares, camera: int) -> list[bool]:
    """Return for each block of local unknowns whether the camera has sightings in it."""
    layout = squares.fit.problem.layout
    column = int(layout.free[: layout.cameras[camera].start].sum())
    return [bool((block.columns == column).any()) for block in squares.factorisation.blocks]
