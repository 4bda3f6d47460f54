"""Statistics of joint calibration over many simulated labs: are its stated covariances those of its errors?

The part of the tape readings in the stated covariance says how much of it is no choice of the estimate.

Each lab is one draw. The tape readings move all cameras together, so the errors of a lab have few degrees of
freedom. The normalised squared error of one lab has a standard deviation of 0.6: the mean of 20 labs is
uncertain by 0.14, that of 200 labs by 0.045.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from geometric_labs import (
    SCENES,
    Scene,
    Session,
    fit_session,
    joint_locator,
    make_session,
    nodes_of,
    shares_by_place,
)
from numpy.typing import NDArray

from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.calibration.joint.parameters import CameraBlock, Layout
from ipsys_log.units import NS_PER_S
from tests.geometric.lab import GeometricLab

__all__ = ["COVERAGE_SCENES", "coverage_table", "error_sources", "measure_coverage"]

Array = NDArray[np.float64]

_MS = 1000.0
# Every n-th node of the grid gives the sources of the errors accurately enough.
_EVERY_NODE = 10
_EXACT_PX2 = 1e-6
_UNEVEN_M = 0.0015


def _scenes() -> tuple[Scene, ...]:
    scenes = {scene.name: scene for scene in SCENES}
    rows = []
    for name in ("75 points", "16 points", "drive and 8"):
        for ending, intrinsics in (("", "calibrated"), (", nominal", "nominal")):
            settings = replace(scenes[name].settings, intrinsics=intrinsics)
            rows.append(Scene(f"{name}, flat{ending}", settings))
            uneven = replace(settings, floor_rms_m=_UNEVEN_M)
            rows.append(Scene(f"{name}, 1.5 mm{ending}", uneven))
    others = ("16 points, 3 mm", "drive and 16, clocks", "drive and 16, 1.5 mm")
    return (*rows, *(scenes[name] for name in others))


# Calibration points or a drive, on a flat and on an uneven floor; the last two have clock offsets.
COVERAGE_SCENES = _scenes()


def measure_coverage(scene: Scene, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Return the figures of each lab: its seed, the shares inside the regions by place, and its clocks."""
    rows = []
    for seed in seeds:
        session = make_session(scene, seed)
        fit = fit_session(session)
        row: dict[str, Any] = {"seed": seed, **shares_by_place(session, joint_locator(fit, session))}
        row["clocks_s"] = _clock_errors(fit, session.lab)
        row["sources"] = error_sources(fit, session)
        rows.append(row)
    return rows


def error_sources(fit: JointFit, session: Session) -> dict[str, float]:
    """Return the parts of observations and priors in the stated covariance of the grid; their sum is 1.

    An estimate is a linear function of all observations and priors, near the optimum. So its covariance is
    a sum over them. A part is the mean over nodes of trace(C^-1 C_part) / 2. If the errors of a source are k
    times as large as stated, the expected NEES changes by (k^2 - 1) times its part.
    """
    layout = fit.problem.layout
    models = build_models(fit)
    slopes, covariances = [], []
    for block, nodes in zip(layout.cameras, nodes_of(session.lab), strict=True):
        model, corners_px = models[nodes.camera], nodes.corners_px[::_EVERY_NODE]
        count = len(corners_px)
        exact = np.broadcast_to(_EXACT_PX2 * np.eye(8), (count, 8, 8))
        lengths_m = np.full(count, session.rig.marker_length_m)
        located = locate_markers(
            _by_unknowns(model, layout, block),
            corners_px,
            exact,
            nodes.heights_m[:count],
            lengths_m,
            0.0,
            0.0,
        )
        by_unknown = located.modes_m[:, :2]
        slopes.append(by_unknown)
        covariances.append(by_unknown @ fit.covariance @ by_unknown.swapaxes(1, 2))
    by_unknown = np.concatenate(slopes)
    roots = np.linalg.inv(np.linalg.cholesky(np.concatenate(covariances)))
    # Rows in units of the stated standard deviation: a part is half the sum of the squares of a node.
    pulls = (roots @ by_unknown).reshape(-1, by_unknown.shape[2]) @ fit.covariance
    parts = {"tape": float((_tape_pulls(fit, pulls) ** 2).sum())}
    sigma = layout.sigma
    scales = np.where(np.isfinite(sigma) & (sigma > 0), 1 / np.where(sigma > 0, sigma, 1.0), 0.0)
    by_prior = ((pulls * scales) ** 2).sum(axis=0)
    parts["tape scale"] = float(by_prior[layout.tape].sum())
    parts["floor"] = float(by_prior[layout.modes].sum())
    parts["intrinsics"] = float(sum(by_prior[block.lens].sum() for block in layout.cameras))
    parts = {name: part / len(pulls) for name, part in parts.items()}
    return {**parts, "rest": 1 - sum(parts.values())}


def _by_unknowns(model: JointModel, layout: Layout, block: CameraBlock) -> JointModel:
    """Return the model with one mode for each global unknown, so that modes are derivatives."""
    own, floor = block.stop - block.start, layout.floor.count
    modes = np.zeros((own + 1, len(layout.mean)))
    modes[:own, block.start : block.stop] = np.eye(own)
    modes[own, layout.scales] = 1 / layout.bodies
    floor_modes = np.zeros((floor, len(layout.mean)))
    floor_modes[:, layout.modes] = np.eye(floor)
    return replace(model, modes=modes, floor_modes=floor_modes)


def _tape_pulls(fit: JointFit, pulls: Array) -> Array:
    """Return the effects (n, d) of d tape distances, from those of the global unknowns (n, g)."""
    points, layout = fit.problem.points, fit.problem.layout
    by_point, by_tape = points.distance_slopes(fit.state, layout)
    columns = 6 * points.distance_points[:, None] + np.arange(2)
    by_local = np.zeros((fit.problem.trajectories.local_count, len(by_point)))
    np.put_along_axis(by_local.T, columns, by_point / points.distance_sigmas_m[:, None], axis=1)
    # The local unknowns follow the global ones by -inv(local) mixed.
    factorisation = fit.solution.factorisation
    whitened = factorisation.forward(by_local)
    free = factorisation.free
    by_scales = pulls[:, layout.tape] @ (by_tape / points.distance_sigmas_m[:, None]).T
    return np.asarray(by_scales - pulls[:, free] @ factorisation.pull(whitened))


def _clock_errors(fit: JointFit, lab: GeometricLab) -> list[tuple[float, float]]:
    """Return the error and the stated standard deviation of each estimated clock offset, in s."""
    layout = fit.problem.layout
    columns = {
        camera.name: block.edge + 1
        for camera, block in zip(fit.observations.cameras, layout.cameras, strict=True)
    }
    if not any(layout.free[column] for column in columns.values()):
        return []
    reference = next(name for name, column in columns.items() if not layout.free[column])
    errors = []
    for name, column in columns.items():
        if layout.free[column]:
            # A stamp is late by the offset, so that the true time of a sighting is earlier.
            true_ns = lab.clock_offsets_ns[reference] - lab.clock_offsets_ns[name]
            error_s = float(fit.state.values[column]) - true_ns / NS_PER_S
            errors.append((error_s, float(np.sqrt(fit.covariance[column, column]))))
    return errors


def coverage_table(name: str, labs: Sequence[dict[str, Any]]) -> str:
    """Return the means over labs with their standard errors, as lines of text."""
    lines = [f"{name}, {len(labs)} labs", f"  {'':<8}{'% in 68 %':>14}{'% in 95 %':>14}{'NEES':>16}"]
    for place in ("grid", "points", "drive"):
        shares = [lab[place] for lab in labs]
        cells = [
            f"{_with_error([100 * one[key] for one in shares], 1):>14}" for key in ("inside_68", "inside_95")
        ]
        lines.append(f"  {place:<8}{''.join(cells)}{_with_error([one['nees'] for one in shares], 2):>16}")
    parts = {
        name: 100 * float(np.mean([lab["sources"][name] for lab in labs])) for name in labs[0]["sources"]
    }
    lines.append("  sources: " + ", ".join(f"{name} {part:.0f} %" for name, part in parts.items()))
    clocks = np.array([clock for lab in labs for clock in lab["clocks_s"]]).reshape(-1, 2)
    if len(clocks):
        ratio = np.sqrt(np.mean((clocks[:, 0] / clocks[:, 1]) ** 2))
        error_ms, stated_ms = _MS * np.sqrt((clocks**2).mean(axis=0))
        lines.append(f"  clocks: RMS error {error_ms:.3f} ms, stated {stated_ms:.3f} ms, ratio {ratio:.2f}")
    return "\n".join(lines)


def _with_error(values: Sequence[float], digits: int) -> str:
    mean = f"{np.mean(values):.{digits}f}"
    if len(values) < 2:
        return mean
    return f"{mean} ± {np.std(values, ddof=1) / np.sqrt(len(values)):.{digits}f}"
