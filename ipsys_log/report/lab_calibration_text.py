"""Result of a joint calibration of a lab as text, table and JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from ipsys_log.analysis.expected_error import FloorGap
from ipsys_log.report.rows import Rows, cm, counted, mm
from ipsys_log.survey.lab_calibration import CameraResult, LabCalibration
from ipsys_log.units import CM_PER_M, MM_PER_M

_MOST_FAULTS = 8


def lab_headline(lab: LabCalibration) -> Iterator[str]:
    """Yield the answer in one line, and the probable faults, which come before all figures."""
    worst = lab.worst
    if lab.causes:
        yield "Not enough: correct the faults of the observations first."
        yield from lab.contradictions
    elif lab.missing:
        yield f"Not enough: camera {', '.join(lab.missing)} has no model."
    elif lab.is_enough:
        yield f"Enough: the expected mean error of each camera is {mm(worst.mean_m)} mm or less."
    else:
        yield (
            f"Not enough: the expected mean error of {worst.camera} is {mm(worst.mean_m)} mm; the goal is "
            f"{lab.goal_m * MM_PER_M:g} mm."
        )
    if lab.faults:
        count = len(lab.faults)
        yield f"{counted(count, 'probable fault')} of the observations:"
        for fault in lab.faults[:_MOST_FAULTS]:
            yield f"  {fault.text}"
        if count > _MOST_FAULTS:
            yield f"  and {count - _MOST_FAULTS} more; --json prints all"


def lab_table(lab: LabCalibration) -> Rows:
    """Return a table with the expected errors, coverage and residuals of each camera."""
    cells = []
    for camera in lab.cameras:
        seen = len(camera.expected.errors_m)
        expected = (mm(camera.mean_m), mm(camera.p95_m), f"{camera.covered:.0%}") if seen else ("-", "-", "-")
        clock = "-" if camera.clock_s is None else f"{camera.clock_s * 1000:+.2f}"
        row_time = "-" if camera.row_time_s is None else f"{camera.row_time_s * 1e6:.1f}"
        counts = map(str, camera.sightings)
        cells.append([camera.camera, *expected, *counts, f"{camera.rmse_px:.3f}", clock, row_time])
    cells.append(["all", mm(lab.mean_m), mm(lab.p95_m), "", str(len(lab.points_m))])
    names = ("mean mm", "p95 mm", "covered", "points", "drive", "residual px", "clock ms", "row us")
    title = f"Expected 2D error over the floor, {lab.height_m * CM_PER_M:g} cm above it, by run {lab.run}"
    return Rows(title, ("camera", *(f">{name}" for name in names)), cells)


def lab_advice(lab: LabCalibration) -> Iterator[str]:
    """Yield the part of the floor to drive through and the points to tape; nothing if the goal is reached."""
    if lab.is_enough:
        return
    yield ""
    if lab.tape_advice:
        yield lab.tape_advice
    if lab.gap is not None:
        low, high = ([cm(value_m, 0) for value_m in corner_m] for corner_m in (lab.gap.low_m, lab.gap.high_m))
        yield (
            f"Drive a robot through x {low[0]} to {high[0]}, y {low[1]} to {high[1]} cm: camera "
            f"{lab.gap.camera} saw no marker there."
        )
    for number, point in enumerate(lab.points):
        x_cm, y_cm = (cm(value_m, 0) for value_m in point.point_m)
        tapes = ", ".join(
            f"{p.name} {cm(math.hypot(point.point_m[0] - p.x_m, point.point_m[1] - p.y_m), 0)}"
            for p in lab.rig.reference_points
        )
        yield (
            f"{'Tape' if number == 0 else 'Then'} a point near x {x_cm}, y {y_cm} cm ({tapes}), seen by "
            f"{', '.join(point.cameras)}: {mm(point.mean_after_m)} mm."
        )


def lab_json(lab: LabCalibration) -> dict[str, Any]:
    """Return the result as plain data for JSON; an error without a value is None."""
    return {
        "enough": lab.is_enough,
        "goal_mm": lab.goal_m * MM_PER_M,
        "mean_mm": lab.mean_m * MM_PER_M,
        "p95_mm": lab.p95_m * MM_PER_M,
        "run": lab.run,
        "marker_height_m": lab.height_m,
        "calibration_points": len(lab.points_m),
        "cameras": [_camera_json(camera) for camera in lab.cameras],
        "missing": list(lab.missing),
        "ignored_sightings": lab.ignored,
        "contradictions": list(lab.contradictions),
        "faults": [
            {"kind": f.kind, "subject": f.subject, "score": f.score, "text": f.text} for f in lab.faults
        ],
        "drive": None if lab.gap is None or lab.is_enough else _gap_json(lab.gap),
        "tape": [
            {
                "x_m": float(point.point_m[0]),
                "y_m": float(point.point_m[1]),
                "cameras": list(point.cameras),
                "mean_after_mm": point.mean_after_m * MM_PER_M,
            }
            for point in lab.points
        ],
        "notes": list(lab.notes),
    }


def _camera_json(camera: CameraResult) -> dict[str, Any]:
    return {
        "camera": camera.camera,
        "mean_mm": _finite(camera.mean_m * MM_PER_M),
        "p95_mm": _finite(camera.p95_m * MM_PER_M),
        "covered": camera.covered,
        "points": camera.sightings[0],
        "moving": camera.sightings[1],
        "residual_px": _finite(camera.rmse_px),
        "clock_ms": None if camera.clock_s is None else camera.clock_s * 1000,
        "row_time_us": None if camera.row_time_s is None else camera.row_time_s * 1e6,
        "nominal": camera.nominal,
        "gaps": [_gap_json(gap) for gap in camera.gaps],
    }


def _gap_json(gap: FloorGap) -> dict[str, Any]:
    return {
        "camera": gap.camera,
        "area_m2": gap.area_m2,
        "low_m": gap.low_m.tolist(),
        "high_m": gap.high_m.tolist(),
        "error_mm": gap.error_m * MM_PER_M,
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
