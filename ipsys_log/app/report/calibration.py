"""Calibrations as text, table and JSON: of a camera, of a whole lab, and the points to measure next."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm, counted, means_cm, mm, wrap_text
from ipsys_log.plain_text import join_names
from ipsys_log.units import CM_PER_M, MM_PER_M, NS_PER_S

if TYPE_CHECKING:
    from ipsys_log.calibration.board_search import ExcludedSighting
    from ipsys_log.calibration.calibrate import CalibrationResult
    from ipsys_log.live_runs.survey.floor_plan import PlannedFloor
    from ipsys_log.live_runs.survey.lab_calibration import CameraResult, LabCalibration
    from ipsys_log.tools.carried_lab import CarriedLab

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
        # The text of a reason is in the singular.
        text = re.sub("^is ", "are ", reason) if count > 1 else reason
        lines.append(f"{what}: {join_names(names, 3)}: {text}")
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


def carried_table(lab: CarriedLab) -> Rows:
    """Return a table of the cameras that a carried body has calibrated."""
    cells = []
    for camera in _carried_cameras(lab):
        numbers = [*camera["origin_m"], 1000 * max(camera["origin_sigmas_m"])]
        clock = "reference" if not camera["clock_sigma_s"] else f"{1000 * camera['clock_s']:.2f}"
        cells.append(
            [
                camera["camera"],
                *(f"{number:.3f}" for number in numbers[:3]),
                f"{numbers[3]:.1f}",
                f"{camera['focal_px'][0]:.1f}",
                clock,
                f"{1000 * camera['clock_sigma_s']:.2f}",
                "-" if camera["held_out_rmse_px"] is None else f"{camera['held_out_rmse_px']:.2f}",
            ]
        )
    heads = ("camera", ">x m", ">y m", ">z m", ">± mm", ">focal px", ">clock ms", ">±", ">held out px")
    note = "Held out: RMSE of the corners in frames that were not in the fit"
    return Rows(f"Cameras by {lab.robot}", heads, cells, note)


def carried_lines(lab: CarriedLab) -> Iterator[str]:
    """Yield lines on the coordinates of the lab, and on what contradicts them."""
    if lab.rest is not None:
        seconds = (lab.rest.end - lab.rest.start) / NS_PER_S
        yield wrap_text(
            f"Coordinates: those of {lab.robot} at rest, for {seconds:.1f} s. They are level to about 1 mm "
            "for each metre; measured points are better for robots on the floor."
        )
    elif lab.fit.is_certain:
        yield "Coordinates: those of the measured points."
    if len(lab.distance_errors_m):
        rms_m = float(np.sqrt(np.mean(lab.distance_errors_m**2)))
        yield wrap_text(
            f"Squares of the board, measured by two cameras at held-out instants: RMS error {mm(rms_m, 2)} "
            f"mm in {len(lab.distance_errors_m)} distances."
        )
    settings = lab.fit.settings
    yield wrap_text(
        f"Motion: jerk {settings.jerk_density:.1g} m/s^2.5; jitter of the stamps "
        f"{1000 * settings.stamp_jitter_s:.2g} ms."
    )
    for remark in lab.remarks:
        yield wrap_text(f"Warning: {remark}.")


def carried_json(lab: CarriedLab) -> dict[str, Any]:
    """Return the same as JSON, in SI units."""
    return {
        "body": lab.robot,
        "rest": None if lab.rest is None else plain(lab.rest),
        "stamp_jitter_s": lab.fit.settings.stamp_jitter_s,
        "jerk_density": lab.fit.settings.jerk_density,
        "cameras": _carried_cameras(lab),
        "distance_errors_m": lab.distance_errors_m.tolist(),
        "remarks": list(lab.remarks),
    }


def _carried_cameras(lab: CarriedLab) -> list[dict[str, Any]]:
    fit, rows = lab.fit, []
    sigmas = np.sqrt(fit.covariance.diagonal())
    for number, (name, errors_px) in enumerate(lab.held_out_px.items()):
        block, values = fit.problem.layout.cameras[number], fit.state.values
        origin = slice(block.start + 3, block.start + 6)
        lengths_px = np.linalg.norm(errors_px, axis=2)
        lengths_px = lengths_px[np.isfinite(lengths_px)]
        rows.append(
            {
                "camera": name,
                "sightings": len(fit.observations.sightings[number]),
                "origin_m": values[origin].tolist(),
                "origin_sigmas_m": sigmas[origin].tolist(),
                "camera_from_world": fit.state.camera_turns[number].tolist(),
                "focal_px": values[block.lens][:2].tolist(),
                "principal_point_px": values[block.lens][2:4].tolist(),
                "distortion": values[block.lens][4:].tolist(),
                "clock_s": float(values[block.edge + 1]),
                "clock_sigma_s": float(sigmas[block.edge + 1]),
                "row_time_s": float(values[block.edge + 2]),
                "held_out_rmse_px": float(np.sqrt(np.mean(lengths_px**2))) if len(lengths_px) else None,
                "held_out_median_px": float(np.median(lengths_px)) if len(lengths_px) else None,
            }
        )
    return rows


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
    drive: dict[str, Any] = {}
    if found.drive is not None:
        from ipsys_log.statistics.joint_plan import DRIVE_S

        drive = {"drive": {**plain(found.drive), "duration_s": DRIVE_S}}
    return {
        "model": found.model,
        "run": found.run,
        "marker_height_m": found.height_m,
        "mean_before_m": places[0]["mean_before_m"],
        "mean_after_m": places[-1]["mean_after_m"],
        "places": places,
        **drive,
        "notes": list(found.notes),
    }
