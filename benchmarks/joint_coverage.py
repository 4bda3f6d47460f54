"""Statistics of joint calibration over many simulated labs: are its stated covariances those of its errors?

Each lab is one draw. The tape readings move all cameras together, so the errors of a lab have few degrees of
freedom. The normalised squared error of one lab has a standard deviation of 0.6: the mean of 20 labs is
uncertain by 0.14, that of 200 labs by 0.045.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from geometric_labs import SCENES, Scene, fit_session, joint_locator, make_session, shares_by_place

from ipsys_log.joint.fit import JointFit
from ipsys_log.simulation.geometric_lab import GeometricLab
from ipsys_log.units import NS_PER_S

__all__ = ["COVERAGE_SCENES", "coverage_table", "measure_coverage"]

_MS = 1000.0
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
    return (*rows, scenes["drive and 16, clocks"], scenes["drive and 16, 1.5 mm"])


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
        rows.append(row)
    return rows


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
