"""Cameras that were moved during a session, from the observations before and after a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.joint.fit import JointFit
from ipsys_log.joint.normal import NormalEquations

__all__ = ["CameraMotion", "find_moved_cameras"]

Array = NDArray[np.float64]

_CANDIDATES = 12
# On either side of the time there are at least so many sightings.
_LEAST_SIGHTINGS = 3
# A camera without motion exceeds this chi2, with six degrees of freedom, once in a million sessions.
_MOVED = 60.0
# Unknowns of a pose: a turn and a shift.
_POSE = 6


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
    for camera in range(len(fit.observations.cameras)):
        times_s = _candidates(fit, camera)
        if not len(times_s):
            continue
        best = max(_motions(fit, camera, times_s), key=lambda motion: motion.chi2)
        if best.chi2 > _MOVED:
            motions.append(best)
    return motions


def _candidates(fit: JointFit, camera: int) -> Array:
    times_s = np.sort(
        np.concatenate(
            [factors.sightings.times_s for factors in fit.problem.sightings if factors.camera == camera]
            or [np.zeros(0)]
        )
    )
    first, last = _LEAST_SIGHTINGS, len(times_s) - _LEAST_SIGHTINGS
    if first > last:
        return np.zeros(0)
    cuts = np.unique(np.linspace(first, last, _CANDIDATES).astype(int))
    return np.asarray((times_s[cuts - 1] + times_s[np.minimum(cuts, len(times_s) - 1)]) / 2)


def _motions(fit: JointFit, camera: int, times_s: Array) -> list[CameraMotion]:
    """Return the motion of a camera at each of the times (k,)."""
    extra, between = _add_motions(fit, camera, times_s)
    factorisation = fit.solution.factorisation
    mixed, pulled = factorisation.whiten(extra.coupling)
    coupling = between[fit.problem.layout.free] - pulled
    information = extra.dense - coupling.T @ factorisation.solve_reduced(coupling)
    for own in mixed:
        if own.shape[1]:
            information -= own.T @ own
    motions = []
    for number, time_s in enumerate(times_s.tolist()):
        part = slice(_POSE * number, _POSE * (number + 1))
        gradient = extra.global_gradient[part]
        step: Array = -np.linalg.pinv(information[part, part], rcond=1e-9, hermitian=True) @ gradient
        turn_rad, chi2 = float(np.linalg.norm(step[:3])), float(-step @ gradient)
        name = fit.observations.cameras[camera].name
        motions.append(CameraMotion(name, time_s, turn_rad, step[3:], chi2))
    return motions


def _add_motions(fit: JointFit, camera: int, times_s: Array) -> tuple[NormalEquations, Array]:
    """Return normal equations with six unknowns for each time, and their part with the global ones (g, 6 k).

    Only the blocks in which the camera has sightings have columns for these unknowns. In a hall, these are
    few, so the time for all cameras grows with the sightings and not with their square.
    """
    problem, layout = fit.problem, fit.problem.layout
    count = _POSE * len(times_s)
    blocks = tuple(
        replace(block, columns=np.arange(count if seen else 0))
        for block, seen in zip(fit.solution.factorisation.blocks, _blocks_with(fit, camera), strict=True)
    )
    trajectories = problem.trajectories
    extra = NormalEquations(trajectories.local_count, count, trajectories.bandwidth, blocks)
    between = np.zeros((len(layout.mean), count))
    for factors in problem.sightings:
        if factors.camera != camera:
            continue
        rows = factors.weighted_rows(fit.state, layout, trajectories)
        after = factors.sightings.times_s[:, None] > times_s
        by_motion = after[:, None, :, None] * rows.by_global[:, :, None, :_POSE]
        by_motion = by_motion.reshape(*rows.residuals.shape, count)
        extra.add_mixed(rows.starts, rows.by_local, slice(0, count), by_motion)
        extra.add_global(np.arange(count), by_motion, rows.residuals)
        flat = by_motion.reshape(-1, count)
        between[factors.columns(layout)] += rows.by_global.reshape(len(flat), -1).T @ flat
        if rows.modes is not None and layout.floor.count:
            lifted = (by_motion * rows.by_height[:, :, None]).sum(axis=1)
            between[layout.modes] += rows.modes.T @ lifted
    return extra, between


def _blocks_with(fit: JointFit, camera: int) -> list[bool]:
    """Return for each block of local unknowns whether the camera has sightings in it."""
    layout = fit.problem.layout
    column = int(layout.free[: layout.cameras[camera].start].sum())
    return [bool((block.columns == column).any()) for block in fit.solution.factorisation.blocks]
