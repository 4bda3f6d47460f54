"""A camera calibration as text, table and JSON."""

from __future__ import annotations

import math
import re
from collections import Counter
from typing import Any

from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, counted, mm
from ipsys_log.calibration.board_search import ExcludedSighting
from ipsys_log.calibration.calibrate import CalibrationResult

_SHOWN_DROPPED = 6


def calibration_table(found: CalibrationResult) -> Rows:
    """Return a table of the intrinsics with their standard deviations."""
    cells = []
    for n, name in enumerate(found.names):
        value, sigma = float(found.values[n]), float(found.sigmas[n])
        digits, unit = (2, "px") if n < 4 else (5, "")
        note = "px, equal to fx: square pixels" if n == 1 and found.square else unit
        spread = f"{sigma:.{digits}f}" if sigma > 0 else "not fitted"
        cells.append([name, f"{value:.{digits}f}", spread, note])
    title = f"{found.camera}: {found.lens.distortion_model}, {found.lens.width} x {found.lens.height} px"
    return Rows(title, ("", ">value", ">+- 1 sigma", ""), cells)


def calibration_lines(found: CalibrationResult) -> list[str]:
    """Return lines on the quality of the result, and on the data that were left out."""
    coverage, counts = found.coverage, [f"{len(found.used)} used"]
    counts += [f"{len(found.dropped)} bad"] if found.dropped else []
    counts += [f"{len(found.spare)} not needed"] if found.spare else []
    bending = " and ".join(
        f"{mm(value, 2)} +- {mm(sigma, 2)} mm in {axis}"
        for axis, value, sigma in zip("xy", found.bending_m, found.bending_sigma_m, strict=True)
    )
    lines = [
        f"reprojection error: RMS {found.rms_px:.3f} px, median {found.median_px:.3f} px, "
        f"{len(found.pixels)} corners",
        f"images: {found.examined_count} searched, board found in {found.seen}, {', '.join(counts)}",
        f"coverage: {coverage.share:.0%} of the image, up to {_degrees(coverage.widest_rad)} from the axis",
        f"          {coverage.position_count} board positions, "
        f"{coverage.tilted} tilted by 25 degrees or more",
        f"bending of the board: {bending}",
    ]
    if found.outlier_corners:
        lines.append(f"excluded: {counted(found.outlier_corners, 'single corner')} with a large error")
    return lines + _dropped_lines(found.dropped, "excluded") + _dropped_lines(found.unseen, "board not found")


def _degrees(angle_rad: float | None) -> str:
    return "?" if angle_rad is None else f"{math.degrees(angle_rad):.0f} degrees"


def _dropped_lines(dropped: tuple[ExcludedSighting, ...], what: str) -> list[str]:
    """Return one line per reason for leaving out images, the most frequent reason first."""
    counts = Counter(drop.reason for drop in dropped)
    lines = []
    for reason, count in counts.most_common():
        names = [drop.name for drop in dropped if drop.reason == reason]
        shown = ", ".join(names[:3]) + (f" and {count - 3} more" if count > 3 else "")
        # The text of a reason is in the singular.
        text = re.sub("^is ", "are ", reason) if count > 1 else reason
        lines.append(f"{what}: {shown}: {text}")
    more = len(lines) - _SHOWN_DROPPED
    return lines if more <= 1 else [*lines[:_SHOWN_DROPPED], f"{what}: {more} more reasons (see --json)"]


def calibration_json(found: CalibrationResult) -> dict[str, Any]:
    """Return the result as plain data, without the single corners."""
    lens, coverage = found.lens, found.coverage
    return {
        "camera": found.camera,
        "width": lens.width,
        "height": lens.height,
        "distortion_model": lens.distortion_model,
        "parameters": dict(zip(found.names, found.values.tolist(), strict=True)),
        "standard_deviations": dict(zip(found.names, found.sigmas.tolist(), strict=True)),
        "square_pixels": found.square,
        "board_bending_m": found.bending_m.tolist(),
        "board_bending_standard_deviations_m": found.bending_sigma_m.tolist(),
        "rms_px": found.rms_px,
        "median_px": found.median_px,
        "corners": len(found.pixels),
        "far_corners": found.outlier_corners,
        "pictures": {
            "looked_at": found.examined_count,
            "seen": found.seen,
            "used": [{"name": name, "rms_px": rms_px} for name, rms_px in found.used],
            "dropped": plain(found.dropped),
            "not_needed": plain(found.spare),
            "not_seen": plain(found.unseen),
        },
        "coverage": {
            "share": coverage.share,
            "empty_sides": list(coverage.empty_sides),
            "places": coverage.position_count,
            "tilted": coverage.tilted,
            "widest_rad": coverage.widest_rad,
        },
        "notes": list(found.notes),
    }
