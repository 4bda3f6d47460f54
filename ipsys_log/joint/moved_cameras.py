"""Cameras that were moved during a session, from the observations before and after a time."""

from __future__ import annotations

from dataclasses import dataclass

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
        steps = [_motion(fit, camera, time_s) for time_s in times_s.tolist()]
        best = max(steps, key=lambda motion: motion.chi2)
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


def _motion(fit: JointFit, camera: int, time_s: float) -> CameraMotion:
    problem, layout = fit.problem, fit.problem.layout
    local, count = problem.trajectories.local_count, len(layout.mean)
    extra = NormalEquations(local, 6, problem.trajectories.bandwidth)
    between = np.zeros((count, 6))
    for factors in problem.sightings:
        if factors.camera != camera:
            continue
        rows = factors.weighted_rows(fit.state, layout, problem.trajectories)
        after = factors.sightings.times_s > time_s
        by_motion = rows.by_global[:, :, :6] * after[:, None, None]
        extra.add_mixed(rows.starts, rows.by_local, slice(0, 6), by_motion)
        extra.add_global(np.arange(6), by_motion, rows.residuals)
        flat = by_motion.reshape(-1, 6)
        between[factors.columns(layout)] += rows.by_global.reshape(len(flat), -1).T @ flat
        if rows.modes is not None and layout.floor.count:
            lifted = (by_motion * rows.by_height[:, :, None]).sum(axis=1)
            between[layout.modes] += rows.modes.T @ lifted
    factorisation = fit.solution.factorisation
    mixed = factorisation.forward(extra.mixed)
    coupling = between[layout.free] - factorisation.pull(mixed)
    information = extra.dense - mixed.T @ mixed - coupling.T @ factorisation.solve_reduced(coupling)
    step: Array = -np.linalg.pinv(information, rcond=1e-9, hermitian=True) @ extra.global_gradient
    return CameraMotion(
        fit.observations.cameras[camera].name,
        time_s,
        float(np.linalg.norm(step[:3])),
        step[3:],
        float(-step @ extra.global_gradient),
    )
