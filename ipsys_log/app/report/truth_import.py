"""The result of an import of ground truth, as text and as JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from ipsys_log.app.report.rows import cm, counted, mm, wrap_text
from ipsys_log.exchange.import_truth import TEXTS, ImportedTruth
from ipsys_log.statistics.path_alignment import BodyFrame
from ipsys_log.units import NS_PER_S

_MS_PER_S, _US_PER_S = 1e3, 1e6


def truth_lines(imported: ImportedTruth) -> Iterator[str]:
    """Yield the estimates with their standard deviations, and the residuals, for a terminal."""
    poses = ", ".join(f"{count} poses of {robot}" for robot, count in imported.poses.items())
    yield wrap_text(f"Ground truth: {poses}.")
    found = imported.alignment
    offset = f"Time offset: {imported.time_offset_ns / NS_PER_S:.6f} s"
    sigma_s = math.nan if found is None else found.offset_sigma_s
    known = f"sigma {sigma_s * _MS_PER_S:.3f} ms" if math.isfinite(sigma_s) else "given"
    yield wrap_text(f"{offset} ({known}), added to the times of the file.")
    align = imported.record.parameters["align"]
    if found is None or align == "none":
        yield "Alignment: none."
    else:
        yield wrap_text(f"Alignment {align}: {_motion_text(imported)}.")
    if found is not None:
        if found.axes:
            yield f"Axes of the file: {found.axes}."
        if math.isfinite(found.drift_sigma):
            drift = f"{_US_PER_S * found.drift:.2f} us/s (sigma {_US_PER_S * found.drift_sigma:.2f})"
            yield f"Drift of its clock: {drift}."
        for robot, body in zip(found.names, found.bodies, strict=True):
            yield wrap_text(_body_text(robot, body))
    if (residuals := imported.residuals) is not None:
        count = residuals.outliers
        outliers = f"; {counted(count, 'outlier')} not used for the estimate" if count else ""
        yield wrap_text(
            f"Residuals against run {imported.tracks_run}: RMSE {cm(residuals.rmse_2d_m)} cm on "
            f"the floor, {cm(residuals.rmse_3d_m)} cm in 3D, at {residuals.instants} instants"
            f"{outliers}."
        )
    if found is not None:
        for remark in found.remarks:
            yield wrap_text(f"Remark: {remark}.")
        what = "offset" if align == "none" else "offset and alignment"
        yield wrap_text(
            f"Estimated from these tracks, {what} hide their constant errors: scores show the others only."
        )


def _motion_text(imported: ImportedTruth) -> str:
    found = imported.alignment
    assert found is not None
    parts = [
        f"rotation {name} {math.degrees(turn):.3f} deg (sigma {math.degrees(sigma):.3f})"
        for name, turn, sigma in zip("xyz", found.turn_rad, found.turn_sigmas_rad, strict=True)
        if np.isfinite(sigma)
    ]
    parts += [
        f"{name} {cm(shift)} cm (sigma {mm(sigma)} mm)"
        for name, shift, sigma in zip("xyz", found.motion.shift_m, found.shift_sigmas_m, strict=True)
        if np.isfinite(sigma)
    ]
    return ", ".join(parts)


def _body_text(robot: str, body: BodyFrame) -> str:
    """Return where the body of the other system is on its robot."""
    pivot = ", ".join(
        f"{name} {cm(value)} cm (sigma {mm(sigma)} mm)"
        for name, value, sigma in zip("xyz", body.pivot_m, body.pivot_sigmas_m, strict=True)
        if np.isfinite(sigma)
    )
    turn = f"turned by {math.degrees(body.turn_rad):.2f} deg" if np.isfinite(body.turn_sigma_rad) else ""
    place = ", ".join(part for part in (pivot and f"from the marker to its origin: {pivot}", turn) if part)
    return f"Body of {robot}: {place or 'its origin is taken as the marker'}."


def truth_json(imported: ImportedTruth) -> dict[str, Any]:
    """Return the result as plain data, in SI units; the names are those of the record of the run."""
    numbers = {
        name: int(text) if text.isdigit() else float(text)
        for name, text in imported.record.parameters.items()
        if name not in TEXTS
    }
    summary: dict[str, Any] = {
        "log": str(imported.path),
        "run": imported.record.run,
        "poses": imported.poses,
        "align": imported.record.parameters["align"],
    }
    summary |= {
        name: text for name, text in imported.record.parameters.items() if name in ("axes", "remarks")
    }
    compared = {} if imported.tracks_run is None else {"tracks_run": imported.tracks_run}
    return summary | compared | numbers
