"""Evidence of moved cameras and of wrong row times, by one step of least squares from a fit without them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.joint.fit import JointFit
from ipsys_log.joint.normal import NormalEquations
from ipsys_log.joint.sighting_factors import SightingFactors, WeightedRows
from ipsys_log.joint.trajectories import Kind

__all__ = ["CameraMotion", "find_moved_cameras", "find_row_times"]

Array = NDArray[np.float64]

_CANDIDATES = 12
# On either side of the time there are at least so many sightings.
_LEAST_SIGHTINGS = 3
# A camera without motion exceeds this chi2, with six degrees of freedom, once in a million sessions.
_MOVED = 60.0
# A row time that is right exceeds this chi2, with one degree of freedom, once in ten million sessions.
_WRONG_ROWS = 30.0
# Unknowns of a pose: a turn and a shift.
_POSE = 6

# Derivatives (n, 2 p, k) of the residuals of sightings by k additional unknowns.
_Slopes = Callable[[SightingFactors, WeightedRows], Array]


@dataclass(frozen=True, slots=True, eq=False)
class CameraMotion:
    """A motion of a camera at about ``time_s``, in the time of the sightings.

    ``turn_rad`` is the angle of the turn, ``shift_m`` (3,) the motion in the world. ``chi2`` is the decrease
    of the cost if the camera has another pose after this time.
    """

    camera: str
    time_s: float
    turn_rad: float
    shift_m: Array
    chi2: float


def find_moved_cameras(fit: JointFit) -> list[CameraMotion]:
    """Return cameras whose pose changed, each with the most likely time.

    For each candidate time, the camera gets six additional unknowns: the change of its pose after that time.
    One step of the least-squares fit shows by how much the cost falls.
    """
    motions = []
    for camera, prior in enumerate(fit.observations.cameras):
        times_s = _sighting_times(fit, camera)
        cuts = _cuts(_LEAST_SIGHTINGS, len(times_s) - _LEAST_SIGHTINGS)
        if prior.is_former or not len(cuts):
            continue
        best = _best_motion(fit, camera, times_s, cuts)[1]
        if best.chi2 > _MOVED:
            motions.append(_best_motion(fit, camera, times_s, _near(times_s, cuts, best.time_s))[1])
    return motions


def find_row_times(fit: JointFit) -> list[str]:
    """Return the names of the cameras whose row time, which the fit does not estimate, explains residuals."""
    layout, wrong = fit.problem.layout, []
    for camera, (prior, block) in enumerate(zip(fit.observations.cameras, layout.cameras, strict=True)):
        moving = any(one.camera == camera and one.kind is Kind.FLOOR for one in fit.problem.sightings)
        if not moving or layout.free[block.edge + 2]:
            continue
        column = block.edge + 2 - block.start

        def slopes(_: SightingFactors, rows: WeightedRows, column: int = column) -> Array:
            return np.asarray(rows.by_global[:, :, column, None])

        gradient, information = _add_unknowns(fit, camera, 1, slopes)
        if information[0, 0] > 0 and gradient[0] ** 2 / information[0, 0] > _WRONG_ROWS:
            wrong.append(prior.name)
    return wrong


def _sighting_times(fit: JointFit, camera: int) -> Array:
    return np.sort(
        np.concatenate(
            [factors.sightings.times_s for factors in fit.problem.sightings if factors.camera == camera]
            or [np.zeros(0)]
        )
    )


def _cuts(first: int, last: int) -> NDArray[np.intp]:
    """Return numbers of sightings before a motion, from ``first`` to ``last``."""
    if first > last:
        return np.zeros(0, dtype=np.intp)
    return np.unique(np.linspace(first, last, _CANDIDATES).astype(np.intp))


def _near(times_s: Array, cuts: NDArray[np.intp], time_s: float) -> NDArray[np.intp]:
    """Return finer cuts, between those beside a time."""
    number = int(np.searchsorted(times_s[cuts - 1], time_s)) - 1
    return _cuts(int(cuts[max(number - 1, 0)]), int(cuts[min(number + 1, len(cuts) - 1)]))


def _best_motion(
    fit: JointFit, camera: int, times_s: Array, cuts: NDArray[np.intp]
) -> tuple[int, CameraMotion]:
    """Return the number of the cut with the most evidence, and the motion of the camera there."""
    between_s = (times_s[cuts - 1] + times_s[np.minimum(cuts, len(times_s) - 1)]) / 2
    motions = _motions(fit, camera, between_s)
    best = max(range(len(motions)), key=lambda number: motions[number].chi2)
    return int(cuts[best]), motions[best]


def _motions(fit: JointFit, camera: int, times_s: Array) -> list[CameraMotion]:
    """Return the motion of a camera at each of the times (k,)."""

    def slopes(factors: SightingFactors, rows: WeightedRows) -> Array:
        after = factors.sightings.times_s[:, None] > times_s
        by_motion = after[:, None, :, None] * rows.by_global[:, :, None, :_POSE]
        return np.asarray(by_motion.reshape(*rows.residuals.shape, -1))

    gradients, information = _add_unknowns(fit, camera, _POSE * len(times_s), slopes)
    motions = []
    for number, time_s in enumerate(times_s.tolist()):
        part = slice(_POSE * number, _POSE * (number + 1))
        gradient = gradients[part]
        step: Array = -np.linalg.pinv(information[part, part], rcond=1e-9, hermitian=True) @ gradient
        turn_rad, chi2 = float(np.linalg.norm(step[:3])), float(-step @ gradient)
        name = fit.observations.cameras[camera].name
        motions.append(CameraMotion(name, time_s, turn_rad, step[3:], chi2))
    return motions


def _add_unknowns(fit: JointFit, camera: int, count: int, slopes: _Slopes) -> tuple[Array, Array]:
    """Return the gradient (k,) and the information (k, k) of additional unknowns of a camera.

    The information is that after the elimination of all other unknowns. Only the blocks in which the camera
    has sightings have columns for these unknowns. In a hall, these are few, so the time for all cameras grows
    with the sightings and not with their square.
    """
    problem, layout, factorisation = fit.problem, fit.problem.layout, fit.solution.factorisation
    blocks = tuple(
        replace(block, columns=np.arange(count if seen else 0))
        for block, seen in zip(factorisation.blocks, _blocks_with(fit, camera), strict=True)
    )
    trajectories = problem.trajectories
    extra = NormalEquations(trajectories.local_count, count, trajectories.bandwidth, blocks)
    between = np.zeros((len(layout.mean), count))
    for factors in problem.sightings:
        if factors.camera != camera:
            continue
        rows = factors.weighted_rows(fit.state, layout, trajectories)
        own = slopes(factors, rows)
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
    for whitened in mixed:
        if whitened.shape[1]:
            information -= whitened.T @ whitened
    return extra.global_gradient, information


def _blocks_with(fit: JointFit, camera: int) -> list[bool]:
    """Return for each block of local unknowns whether the camera has sightings in it."""
    layout = fit.problem.layout
    column = int(layout.free[: layout.cameras[camera].start].sum())
    return [bool((block.columns == column).any()) for block in fit.solution.factorisation.blocks]
