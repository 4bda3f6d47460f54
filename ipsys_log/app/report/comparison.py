"""Paths of other systems beside the tracks, as text and JSON: scored estimates, and imported ground truth."""

import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm, counted, percent, wrap_text
from ipsys_log.exchange.import_truth import TEXTS, ImportedTruth
from ipsys_log.messages import Run
from ipsys_log.statistics.accuracy import root_mean_square_m
from ipsys_log.statistics.estimate_scores import FIRST_POSE, NONE, SE3, SIM3, YAW, EstimateScore, ScoreRow
from ipsys_log.statistics.path_alignment import sigma_name
from ipsys_log.tools.comparison import Comparison, number_in
from ipsys_log.units import CM_PER_M

_ALIGNMENTS = {
    NONE: "no alignment",
    FIRST_POSE: "first pose",
    YAW: "yaw, translation",
    SE3: "SE3",
    SIM3: "Sim3, with scale",
}
# A NEES within these factors of 1 is consistent: the errors along a path are alike, so it scatters.
_CONSISTENT = (0.5, 2.0)
_US_PER_S, _DEGREES = 1e6, math.degrees(1)


def comparison_table(found: Comparison) -> Rows:
    """Return the errors of an estimate; the roles are in the title."""
    cells = []
    for row in found.score.rows():
        name = f"ATE, {_ALIGNMENTS[row.alignment]}" if row.alignment else f"RPE, {row.delta}"
        own = row.space
        values_m = (root_mean_square_m(own), own.mean_m, own.median_m, own.p95_m, own.max_m)
        floor = cm(None if row.floor is None else root_mean_square_m(row.floor))
        cells.append([name, str(own.count), *map(cm, values_m), floor, _degrees(row.rotation_rmse_rad)])
    heads = ["error", ">n", ">RMSE", ">mean", ">median", ">p95", ">max", ">2D RMSE", f">{found.score.turn}"]
    note = f"Lengths in cm, in 3D; {found.score.turn}: RMSE in degrees"
    return Rows(title(found), heads, cells, note)


def title(found: Comparison) -> str:
    """Return what is scored against what."""
    parameters = found.record.parameters
    body = f" ({parameters['body']})" if parameters.get("body", found.robot) != found.robot else ""
    # The same estimate can be scored with other options.
    is_named = found.record.run == Path(parameters["file"]).stem.lower()
    run = "" if is_named else f" (run {found.record.run})"
    return (
        f"{parameters['file']}{body}{run}: estimate of {found.robot}, against its tracks of run "
        f"{', '.join(found.record.input_runs)} (the ground truth)"
    )


def comparison_lines(found: Comparison) -> Iterator[str]:
    """Yield the error with its part of the tracks, the clock, the frames, the coverage and the remarks."""
    for line in _lines(found):
        yield wrap_text(line)


def _lines(found: Comparison) -> Iterator[str]:
    parameters = found.record.parameters
    row = found.score.after(found.alignment)
    tracks = "the tracks have no covariances"
    if found.score.tracks_m is not None:
        tracks = f"the tracks explain at most {cm(found.score.tracks_m)} cm of it"
    yield f"ATE {cm(root_mean_square_m(row.errors.absolute_3d))} cm, {_ALIGNMENTS[row.alignment]} ({tracks})."
    yield from alignment_lines(found.record, "the estimate", {"": ""})
    if found.with_scale:
        yield f"Scale, applied: {_value(found.record, 'scale', 1, '', 5)}."
    yield from _score_lines(found.score)
    for remark in parameters.get("remarks", "").splitlines():
        yield f"Remark on the alignment: {remark}."


def alignment_lines(record: Run, what: str, bodies: Mapping[str, str]) -> Iterator[str]:
    """Yield the clock, the bodies and the frames in the record of a run, with their standard deviations.

    ``bodies`` has, by the start of the names of its parameters, a text that tells a body from the others.
    """
    offset = _value(record, "time_offset_s", 1, "s", 6) or "0 s"
    yield f"Time offset: {offset}, added to the times of {what}."
    if drift := _value(record, "clock_drift", _US_PER_S, "us/s", 1):
        yield f"Drift of the clock: {drift}."
    for start, name in bodies.items():
        if pivot := _vector(record, start + "pivot_{}_m", CM_PER_M, "cm", 2):
            yield f"Pivot{name}, from the marker to the body: {pivot}."
        if turn := _value(record, f"{start}body_turn_rad", _DEGREES, "deg", 2):
            yield f"Turn{name}, from the axes of the marker to those of the body: {turn}."
    turns = _vector(record, "rotation_{}_rad", _DEGREES, "deg", 3)
    shift = _vector(record, "translation_{}_m", CM_PER_M, "cm", 2)
    parts = [f"{name} {text}" for name, text in (("rotation", turns), ("translation", shift)) if text]
    yield f"Alignment {record.parameters['align']}{': ' * bool(parts)}{'; '.join(parts)}."
    if "axes" in record.parameters:
        yield f"Axes of {what}: {record.parameters['axes']}."


def _score_lines(score: EstimateScore) -> Iterator[str]:
    coverage = score.coverage
    longest = f"; {counted(coverage.gaps, 'gap')}, the longest {coverage.longest_gap_s:.2f} s"
    yield (
        f"Coverage: {percent(coverage.time_share, 1)} of the time of the tracks, "
        f"{percent(coverage.area_share)} of their area{longest * bool(coverage.gaps)}."
    )
    if (drift := score.drift) is not None:
        turns_rad = drift.errors_rad
        turned = "" if turns_rad is None else f", {_DEGREES * turns_rad.mean() / drift.delta:.2f} deg/m"
        share = percent(float(drift.errors_m.mean()) / drift.delta, 2)
        yield f"Drift: {share} of the distance{turned}, over {drift.delta:g} m."
    if score.nees is not None:
        low, high = _CONSISTENT
        verdict = "consistent" if low <= score.nees <= high else "over" if score.nees > high else "under"
        verdict += "confident" * (verdict != "consistent")
        yield f"NEES: {score.nees:.2f} by degree of freedom on the floor (1 expected): {verdict} covariances."


def _value(record: Run, name: str, factor: float, unit: str, digits: int) -> str:
    """Return a parameter with its sigma; empty if it is 0 and was not estimated."""
    value, sigma = (factor * number_in(record, one) for one in (name, sigma_name(name)))
    if not (value or sigma):
        return ""
    return f"{value:.{digits}f} {unit}".strip() + (f" (sigma {sigma:.{digits}f})" if sigma else "")


def _vector(record: Run, name: str, factor: float, unit: str, digits: int) -> str:
    """Return the axes that were estimated or are not 0, with their sigmas together: 80 columns are narrow."""
    names = {axis: name.format(axis) for axis in "xyz"}
    rows = {
        axis: [factor * number_in(record, one) for one in (text, sigma_name(text))]
        for axis, text in names.items()
    }
    rows = {axis: row for axis, row in rows.items() if any(row)}
    values = ", ".join(f"{axis} {value:.{digits}f}" for axis, (value, _) in rows.items())
    sigmas = ", ".join(f"{sigma:.{digits}f}" if sigma else "-" for _, sigma in rows.values())
    return f"{values} {unit}" * bool(rows) + f" (sigma {sigmas})" * any(sigma for _, sigma in rows.values())


def _degrees(angle_rad: float | None) -> str:
    return "-" if angle_rad is None else f"{math.degrees(angle_rad):.2f}"


def comparison_json(found: Comparison) -> dict[str, Any]:
    """Return a comparison as plain data, in SI units; the names of the alignment are those of its run."""
    rows, turn = found.score.rows(), found.score.turn
    return {
        **found.summary(),
        "ate": {row.alignment: _row_json(row, turn) for row in rows if row.alignment},
        "rpe": [{"delta": row.delta, **_row_json(row, turn)} for row in rows if row.delta],
    }


def _row_json(row: ScoreRow, turn: str) -> dict[str, Any]:
    pairs = {"3d": row.space, "2d": row.floor}
    found = {name: {**plain(one), "rmse_m": root_mean_square_m(one)} for name, one in pairs.items() if one}
    return {**found, **plain({f"{turn}_rmse_rad": row.rotation_rmse_rad})}


def truth_lines(imported: ImportedTruth) -> Iterator[str]:
    """Yield the estimates with their standard deviations, and the residuals, for a terminal."""
    poses = ", ".join(f"{count} poses of {robot}" for robot, count in imported.poses.items())
    yield wrap_text(f"Ground truth: {poses}.")
    bodies = {f"{robot}_": f" of {robot}" for robot in imported.poses}
    for line in alignment_lines(imported.record, "the file", bodies):
        yield wrap_text(line)
    if (residuals := imported.residuals) is not None:
        count = residuals.outliers
        outliers = f"; {counted(count, 'outlier')} not used for the estimate" if count else ""
        yield wrap_text(
            f"Residuals against run {imported.tracks_run}: RMSE {cm(residuals.rmse_2d_m)} cm on "
            f"the floor, {cm(residuals.rmse_3d_m)} cm in 3D, at {residuals.instants} instants"
            f"{outliers}."
        )
    if (found := imported.alignment) is not None:
        for remark in found.remarks:
            yield wrap_text(f"Remark: {remark}.")
        what = "offset" if imported.record.parameters["align"] == "none" else "offset and alignment"
        yield wrap_text(
            f"Estimated from these tracks, {what} hide their constant errors: scores show the others only."
        )


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
