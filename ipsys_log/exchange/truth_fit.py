"""Gauss-Newton estimate of the time offset and the rigid motion between two recordings of the same paths."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.messages.arrays import Array, Mask
from ipsys_log.statistics.path_pairs import CommonInstants, PathPair, common_instants
from ipsys_log.vision.poses import cross, rotate


class Freedom(NamedTuple):
    """The axes of rotation and translation that an alignment estimates, and the axes of its residuals."""

    turns: tuple[int, ...]
    shifts: tuple[int, ...]
    compared: tuple[int, ...]


ALIGNMENTS = {
    "2d": Freedom((2,), (0, 1), (0, 1)),
    "3d": Freedom((0, 1, 2), (0, 1, 2), (0, 1, 2)),
    "none": Freedom((), (), (0, 1)),
}
# The median length of a vector with normal components of unit variance, by their number.
_MEDIAN_LENGTH = {2: 1.1774, 3: 1.5382}
# Residuals above 5 sigma are outliers.
_OUTLIER = 5.0
# A smaller sigma than 0.1 mm is none of a camera.
_LEAST_SCALE_M = 1e-4
_ROUNDS = 40
# After so many rounds, the limit of the outliers stays: otherwise an instant at the limit can alternate.
_FREE_ROUNDS = 15
# Below this step, the estimate is exact to rounding.
_CONVERGED_M = 1e-11
# The velocity of a path holds for a short time only.
_LARGEST_OFFSET_STEP_S = 0.3
LEAST_INSTANTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion:
    """A rotation (3, 3) and a translation (3,) in m, from the truth's coordinates to those of the lab."""

    rotation: Array
    shift_m: Array

    def apply(self, points_m: Array) -> Array:
        """Return points (n, 3) in the coordinates of the lab."""
        return points_m @ self.rotation.T + self.shift_m


class Fit(NamedTuple):
    """An estimate; the alignment rotates about ``pivot_m``, so ``centre_m`` is the image of the pivot."""

    offset_s: float
    rotation: Array
    centre_m: Array
    pivot_m: Array
    median_m: float
    cut_m: float

    @property
    def motion(self) -> RigidMotion:
        return RigidMotion(self.rotation, self.centre_m - self.rotation @ self.pivot_m)


def fit_truth(pairs: Sequence[PathPair], kind: str, start_s: float, free_offset: bool) -> Fit | None:
    """Estimate offset and alignment from a coarse offset; None with too few common instants."""
    common = common_instants(pairs, start_s)
    if len(common.track_m) < LEAST_INSTANTS:
        return None
    fit = _start(common, kind, start_s)
    for round_ in range(_ROUNDS):
        common = common_instants(pairs, fit.offset_s)
        if len(common.track_m) < LEAST_INSTANTS:
            return None
        fit = _weighed(common, fit, kind, keeps_cut=round_ >= _FREE_ROUNDS)
        kept, jacobian, residual = linearize(common, fit, kind, free_offset)
        if not jacobian.shape[2]:
            break
        step = _step(jacobian[kept], residual[kept])
        if free_offset:
            step *= min(1.0, _LARGEST_OFFSET_STEP_S / max(abs(float(step[0])), 1e-12))
        fit = _moved(fit, step, kind, free_offset)
        if np.abs(step).max() < _CONVERGED_M:
            break
    return _weighed(common_instants(pairs, fit.offset_s), fit, kind, keeps_cut=True)


def _step(jacobian: Array, residual: Array) -> Array:
    """Return the Gauss-Newton step (k,) by the scaled normal equations."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    norms = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    normal = (rows.T @ rows) / np.outer(norms, norms)
    solution = np.linalg.lstsq(normal, (rows.T @ residual.reshape(-1)) / norms, rcond=1e-12)[0]
    return np.asarray(solution / norms)


def _start(common: CommonInstants, kind: str, offset_s: float) -> Fit:
    """Return the best rotation and translation at an offset, after three rounds without outliers."""
    axes = list(ALIGNMENTS[kind].turns and ALIGNMENTS[kind].compared)
    kept = np.ones(len(common.track_m), dtype=np.bool_)
    pivot_m = np.median(common.true_m, axis=0)
    fit = Fit(offset_s, np.eye(3), pivot_m, pivot_m, np.inf, np.inf)
    for _ in range(3 if axes else 0):
        true_m, track_m = common.true_m[kept][:, axes], common.track_m[kept][:, axes]
        middle_m, target_m = true_m.mean(axis=0), track_m.mean(axis=0)
        u, _, v = np.linalg.svd((true_m - middle_m).T @ (track_m - target_m))
        signs = np.ones(len(axes))
        signs[-1] = np.sign(np.linalg.det(u @ v))
        rotation = np.eye(3)
        rotation[np.ix_(axes, axes)] = (v.T * signs) @ u.T
        pivot_m, centre_m = pivot_m.copy(), pivot_m.copy()
        pivot_m[axes], centre_m[axes] = middle_m, target_m
        fit = _weighed(common, Fit(offset_s, rotation, centre_m, pivot_m, np.inf, np.inf), kind, False)
        kept = _lengths_m(common, fit, kind) <= fit.cut_m
    return fit


def _lengths_m(common: CommonInstants, fit: Fit, kind: str) -> Array:
    residual_m = common.track_m - fit.motion.apply(common.true_m)
    return np.asarray(np.linalg.norm(residual_m[:, list(ALIGNMENTS[kind].compared)], axis=1))


def _weighed(common: CommonInstants, fit: Fit, kind: str, keeps_cut: bool) -> Fit:
    """Return the fit with its median residual, and the length above which a residual is an outlier."""
    median_m = float(np.median(_lengths_m(common, fit, kind))) if len(common.track_m) else np.inf
    scale_m = median_m / _MEDIAN_LENGTH[len(ALIGNMENTS[kind].compared)]
    cut_m = fit.cut_m if keeps_cut else _OUTLIER * max(scale_m, _LEAST_SCALE_M)
    return fit._replace(median_m=median_m, cut_m=cut_m)


def linearize(common: CommonInstants, fit: Fit, kind: str, free_offset: bool) -> tuple[Mask, Array, Array]:
    """Return which instants are no outliers, the derivatives (n, d, k) and the residuals (n, d)."""
    freedom = ALIGNMENTS[kind]
    arms_m = (common.true_m - fit.pivot_m) @ fit.rotation.T
    columns = [-common.velocity_m_s @ fit.rotation.T] if free_offset else []
    columns += [cross(np.broadcast_to(np.eye(3)[axis], arms_m.shape), arms_m) for axis in freedom.turns]
    columns += [np.broadcast_to(np.eye(3)[axis], arms_m.shape) for axis in freedom.shifts]
    axes = list(freedom.compared)
    residual = (common.track_m - arms_m - fit.centre_m)[:, axes]
    jacobian = np.stack(columns, axis=2)[:, axes] if columns else np.zeros((*residual.shape, 0))
    return np.linalg.norm(residual, axis=1) <= fit.cut_m, jacobian, residual


def _moved(fit: Fit, step: Array, kind: str, free_offset: bool) -> Fit:
    freedom = ALIGNMENTS[kind]
    first = 1 if free_offset else 0
    turn, shift = np.zeros(3), np.zeros(3)
    turn[list(freedom.turns)] = step[first : first + len(freedom.turns)]
    shift[list(freedom.shifts)] = step[first + len(freedom.turns) :]
    return fit._replace(
        offset_s=fit.offset_s + (float(step[0]) if free_offset else 0.0),
        rotation=rotate(turn[None])[0] @ fit.rotation,
        centre_m=fit.centre_m + shift,
    )
