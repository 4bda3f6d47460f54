"""Expected errors over the floor as text, table and JSON: of a joint calibration, and of a measuring plan."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm, counted, means_cm, mm
from ipsys_log.live_runs.survey.floor_plan import PlannedFloor
from ipsys_log.live_runs.survey.lab_calibration import CameraResult, LabCalibration
from ipsys_log.units import CM_PER_M, MM_PER_M

if TYPE_CHECKING:
    from ipsys_log.statistics.joint_plan import PlannedDrive

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
        "goal_m": lab.goal_m,
        "mean_m": lab.mean_m,
        "p95_m": lab.p95_m,
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
        "drive": None if lab.gap is None or lab.is_enough else plain(lab.gap),
        "tape": [
            {
                "x_m": float(point.point_m[0]),
                "y_m": float(point.point_m[1]),
                "cameras": list(point.cameras),
                "mean_after_m": point.mean_after_m,
            }
            for point in lab.points
        ],
        "notes": list(lab.notes),
    }


def _camera_json(camera: CameraResult) -> dict[str, Any]:
    return {
        "camera": camera.camera,
        "mean_m": _finite(camera.mean_m),
        "p95_m": _finite(camera.p95_m),
        "covered": camera.covered,
        "points": camera.sightings[0],
        "moving": camera.sightings[1],
        "residual_px": _finite(camera.rmse_px),
        "clock_s": camera.clock_s,
        "row_time_s": camera.row_time_s,
        "nominal": camera.nominal,
        "gaps": plain(camera.gaps),
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def plan_table(found: PlannedFloor) -> Rows:
    """Return a table of the points to measure next, with their tapes and the error that remains."""
    places = found.plan.places
    means = means_cm(places[0].mean_before_m, *(place.mean_after_m for place in places))
    cells = []
    for number, place in enumerate(places, 1):
        x_m, y_m, z_m = place.point_m.tolist()
        tapes = [f"{name} {cm(value_m, 0)}" for name, value_m in found.distances_m(place.point_m).items()]
        side = found.side(place.point_m)
        tape = ", ".join([*tapes, *([side] if side else [])]) or "-"
        point = (cm(x_m, 0), cm(y_m, 0), f"{z_m * CM_PER_M:g}")
        change = f"{means[number - 1]} -> {means[number]}"
        cells.append([str(number), *point, tape, ", ".join(place.cameras), change])
    columns = (">", ">x cm", ">y cm", ">height cm", "tape cm", "seen by", ">mean error cm")
    return Rows(f"Next points to measure, for the model {found.model} of run {found.run}", columns, cells)


def plan_lines(found: PlannedFloor) -> Iterator[str]:
    """Yield the effect of the points; and of the drive that reduces the error most, without new points."""
    places, drive = found.plan.places, found.drive
    before, after = means_cm(places[0].mean_before_m, places[-1].mean_after_m)
    subject = "this point" if len(places) == 1 else f"these {len(places)} points"
    yield f"predicted mean error over the floor: {before} cm now, {after} cm with {subject}"
    if drive is None:
        return
    from ipsys_log.statistics.joint_plan import DRIVE_S  # late: most plans have no drive, and scipy takes 1 s

    if not drive.is_useful:
        yield "another drive changes little: most of the predicted error is that of the tape"
        return
    (x0, y0), (x1, y1) = (
        [cm(value_m, 0) for value_m in corner_m] for corner_m in (drive.low_m, drive.high_m)
    )
    before, after = means_cm(drive.mean_before_m, drive.mean_after_m)
    where = f"x {x0} to {x1}, y {y0} to {y1} cm (seen by {', '.join(drive.cameras)})"
    yield f"or drive a robot for {DRIVE_S:.0f} s, in curves, through {where}: {before} -> {after} cm"


def plan_json(found: PlannedFloor) -> dict[str, Any]:
    """Return the plan as plain data; the height of a marker is in ``height_m``."""
    places = [
        {
            "number": number,
            **dict(zip(("x_m", "y_m", "height_m"), place.point_m.tolist(), strict=True)),
            "distances_m": found.distances_m(place.point_m),
            "side": found.side(place.point_m),
            "cameras": list(place.cameras),
            "mean_before_m": place.mean_before_m,
            "mean_after_m": place.mean_after_m,
        }
        for number, place in enumerate(found.plan.places, 1)
    ]
    return {
        "model": found.model,
        "run": found.run,
        "marker_height_m": found.height_m,
        "mean_before_m": places[0]["mean_before_m"],
        "mean_after_m": places[-1]["mean_after_m"],
        "places": places,
        **({} if found.drive is None else {"drive": _drive_json(found.drive)}),
        "notes": list(found.notes),
    }


def _drive_json(drive: PlannedDrive) -> dict[str, Any]:
    from ipsys_log.statistics.joint_plan import DRIVE_S

    return {**plain(drive), "duration_s": DRIVE_S}
