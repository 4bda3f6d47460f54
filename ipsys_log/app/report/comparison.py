"""Comparisons of estimates with the tracks of their robots, as text, as JSON and as figures."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm, counted, percent, wrap_text
from ipsys_log.statistics.accuracy import root_mean_square_m
from ipsys_log.statistics.estimate_scores import FIRST_POSE, NONE, SE3, SIM3, YAW, EstimateScore, ScoreRow
from ipsys_log.tools.comparison import Comparison
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
        cells.append([name, str(own.count), *map(cm, values_m), floor, _degrees(row.heading_rmse_rad)])
    heads = ["error", ">n", ">RMSE", ">mean", ">median", ">p95", ">max", ">2D RMSE", ">heading"]
    return Rows(title(found), heads, cells, "Lengths in cm, in 3D; headings: RMSE in degrees")


def title(found: Comparison) -> str:
    """Return what is scored against what."""
    parameters = found.record.parameters
    body = f" ({parameters['body']})" if parameters.get("body", found.robot) != found.robot else ""
    return (
        f"{parameters['file']}{body}: estimate of {found.robot}, against its tracks of run "
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
    yield f"Time offset: {_value(found, 'time_offset_s', 1, 's', 6)}, added to the times of the estimate."
    if drift := _value(found, "clock_drift", _US_PER_S, "us/s", 1):
        yield f"Drift of the clock: {drift}."
    if pivot := _vector(found, "pivot_{}_m", CM_PER_M, "cm", 2):
        yield f"Pivot, from the marker to the body: {pivot}."
    if turn := _value(found, "body_turn_rad", _DEGREES, "deg", 2):
        yield f"Turn, from the axes of the marker to those of the body: {turn}."
    turns = _vector(found, "rotation_{}_rad", _DEGREES, "deg", 3)
    shift = _vector(found, "translation_{}_m", CM_PER_M, "cm", 2)
    if moved := "; ".join(
        f"{name} {text}" for name, text in (("rotation", turns), ("translation", shift)) if text
    ):
        yield f"Alignment {parameters['align']}: {moved}."
    if "axes" in parameters:
        yield f"Axes of the estimate: {parameters['axes']}."
    if found.with_scale:
        yield f"Scale, applied: {_value(found, 'scale', 1, '', 5)}."
    yield from _score_lines(found.score)
    for remark in parameters.get("remarks", "").splitlines():
        yield f"Remark on the alignment: {remark}."


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


def _value(found: Comparison, name: str, factor: float, unit: str, digits: int) -> str:
    """Return a parameter with its sigma; empty if it is 0 and was not estimated."""
    value, sigma = factor * found.number(name), factor * found.sigma(name)
    if not (value or math.isfinite(sigma)):
        return ""
    text = f"{value:.{digits}f} {unit}".strip()
    return f"{text} (sigma {sigma:.{digits}f})" if math.isfinite(sigma) else text


def _vector(found: Comparison, name: str, factor: float, unit: str, digits: int) -> str:
    values = {axis: _value(found, name.format(axis), factor, unit, digits) for axis in "xyz"}
    return ", ".join(f"{axis} {text}" for axis, text in values.items() if text)


def _degrees(angle_rad: float | None) -> str:
    return "-" if angle_rad is None else f"{math.degrees(angle_rad):.2f}"


def comparison_json(found: Comparison) -> dict[str, Any]:
    """Return a comparison as plain data, in SI units; the names of the alignment are those of its run."""
    rows = found.score.rows()
    return {
        **found.summary(),
        "ate": {row.alignment: _row_json(row) for row in rows if row.alignment},
        "rpe": [{"delta": row.delta, **_row_json(row)} for row in rows if row.delta],
    }


def _row_json(row: ScoreRow) -> dict[str, Any]:
    pairs = {"3d": row.space, "2d": row.floor}
    found = {name: {**plain(one), "rmse_m": root_mean_square_m(one)} for name, one in pairs.items() if one}
    return {**found, **plain({"heading_rmse_rad": row.heading_rmse_rad})}
