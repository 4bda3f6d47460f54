"""Tell whether pictures are of one camera, by what two lenses explain that one lens does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle import Corners, Fit, adjust, normal_equations, residuals
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.start import fitted_basis

Array = NDArray[np.float64]
Group = NDArray[np.bool_]

_LEAST = 4
_ROUNDS, _STEPS, _POSE_STEPS = 8, 8, 4


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Pictures of the second camera (f,), and the squared residuals with one and with two lenses, by picture."""

    second: Group
    one: Array
    two: Array
    lenses: tuple[Array, Array]


def part(fit: Fit, corners: Corners, group: Group) -> tuple[Fit, Corners]:
    kept, _ = corners.keep(group[corners.picture])
    return Fit(fit.lens, fit.rotations[group], fit.places_m[group]), kept


def seeds(model, fit, corners, basis, scale):
    normal = normal_equations(model, fit, corners, basis, scale)
    sol = np.linalg.solve(normal.poses, np.concatenate([normal.between, normal.pose_gradient[..., None]], axis=2))
    tr = normal.between.transpose(0, 2, 1)
    each = normal.lens - tr @ sol[:, :, :-1]
    g = normal.lens_gradient - (tr @ sol[:, :, -1:])[..., 0]
    whole = each.sum(axis=0) + normal.pull
    w, v = np.linalg.eigh(whole)
    white = g @ (v / np.sqrt(np.maximum(w, w.max() * 1e-12)))
    u, s, vt = np.linalg.svd(white, full_matrices=False)
    return [u[:, k] > 0 for k in range(min(3, u.shape[1]))]


def split(model: LensModel, fit: Fit, corners: Corners, scale: float, starts=()) -> Split | None:
    basis = fitted_basis(model, square=True)
    best = None
    one = cost_by_picture(residuals(model, fit, corners), corners, scale)
    for second in [*starts, *seeds(model, fit, corners, basis, scale)]:
        r = refine(model, fit, corners, basis, scale, second)
        if r is not None and (best is None or r[1].sum() < best[1].sum()):
            best = r
    if best is None:
        return None
    return Split(best[0], one, best[1], best[2])


def cost_by_picture(missed, corners, scale):
    sq = (missed**2).sum(axis=1)
    return corners.sums(scale**2 * np.log1p(sq / scale**2))


def refine(model, fit, corners, basis, scale, second):
    posed = [fit, fit]
    for _ in range(_ROUNDS):
        if min(second.sum(), (~second).sum()) < _LEAST:
            return None
        costs, full = [], []
        for k, group in enumerate((~second, second)):
            f, c = part(posed[k], corners, group)
            f = adjust(model, f, c, basis, scale, _STEPS)
            rot, pl = posed[k].rotations.copy(), posed[k].places_m.copy()
            rot[group], pl[group] = f.rotations, f.places_m
            whole = adjust(model, Fit(f.lens, rot, pl), corners, basis[:, :0], scale, _POSE_STEPS)
            full.append(whole)
            costs.append(cost_by_picture(residuals(model, whole, corners), corners, scale))
        posed = full
        anew = costs[1] < costs[0]
        if (anew == second).all():
            break
        second = anew
    if min(second.sum(), (~second).sum()) < _LEAST:
        return None
    return second, np.where(second, costs[1], costs[0]), (posed[0].lens, posed[1].lens)
