"""Poses of cameras as text, table and JSON: advice on their alignment, and their drift over several logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from ipsys_log.app.report.alignment import AlignedLab
from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import Rows, cm, mm
from ipsys_log.statistics.alignment import LEVEL_M, Alignment
from ipsys_log.statistics.camera_moves import CameraState, MarkerMove, Move
from ipsys_log.statistics.coverage import FloorCoverage, Overlap, Patch
from ipsys_log.statistics.drift import LEAST_SHIFT_M, Motion
from ipsys_log.units import CM_PER_M, format_time

if TYPE_CHECKING:
    from ipsys_log.live_runs.survey.drift_reading import DriftReading

_GOOD, _BAD = "green", "red"
_LEVEL_CM = f"{LEVEL_M * CM_PER_M:g} cm"
# Smaller turns of a camera are not practical.
_LEAST_DEG = 0.05
_MOST_PATCHES = 4


def advise(alignment: Alignment) -> str:
    """Return the advice on one camera, as text.

    Examples
    --------
    >>> advise(Alignment("red", ()))[:32]
    'put four or more markers on the '
    """
    if len(alignment.floor_markers) < 2:
        count, reason = (
            ("three", "one is not enough")
            if alignment.floor_markers
            else ("four", "none is stationary there")
        )
        return f"put {count} or more markers on the floor, up to the edges of its image: {reason}"
    if alignment.axes == 0:
        return "put its markers further apart, up to the edges of its image"
    if alignment.axes == 1 and alignment.level is None:
        return (
            f"put a marker beside the line of its markers: along this line, the spread is under {_LEVEL_CM}"
        )
    aside = "; the tilt is known only along the line of its markers: put a marker beside the line"
    rest = aside if alignment.axes == 1 else ""
    if alignment.level:
        return f"nothing: the camera is level, its spread is under {_LEVEL_CM}"
    turns = _turns(alignment)
    if alignment.remaining_m is not None and alignment.remaining_m >= LEVEL_M:
        text = (
            f"{turns}, but a spread of {cm(alignment.remaining_m, 1)} cm remains"
            if turns
            else "no turn of the camera corrects the spread"
        )
        return (
            f"{text}: check that the markers are flat on the floor, or repeat the intrinsic calibration{rest}"
        )
    return f"{turns}{rest}"


def _turns(alignment: Alignment) -> str:
    """Return the turns of a camera as text, one direction after the other; empty if both are too small."""
    names = (("right", "left"), ("bottom", "top"))
    parts: list[str] = []
    for turn_rad, (more, less) in zip(alignment.turns_rad, names, strict=True):
        if abs(turn := math.degrees(turn_rad)) >= _LEAST_DEG:
            suffix = "" if parts else " of its image"
            parts.append(f"{abs(turn):.1f} degrees towards the {more if turn_rad > 0 else less}{suffix}")
    shift = _on_floor(alignment)
    return f"turn the camera {' and '.join(parts)}{shift}" if parts else ""


def _on_floor(alignment: Alignment) -> str:
    """Return the shift of the principal point on the floor as text; it is easier to see than an angle."""
    if alignment.height_m is None or alignment.tilt_rad is None:
        return ""
    return f" ({cm(alignment.height_m * math.tan(alignment.tilt_rad), 0)} cm on the floor)"


def alignment_table(lab: AlignedLab) -> Rows:
    """Return a table with one row per camera: green if the spread is under 5 cm, else red."""
    cells: list[list[str | Text]] = []
    for alignment in lab.alignments:
        colour = {None: "", True: _GOOD, False: _BAD}[alignment.level]
        used = len(alignment.floor_markers)
        total = used + len(alignment.raised_markers)
        count = f"{used} of {total}" if alignment.raised_markers else str(total)
        spread, advice = Text(cm(alignment.spread_m, 1), style=colour), Text(advise(alignment), style=colour)
        cells.append([alignment.camera, count, spread, _tilt(alignment), advice])
    columns = ("camera", ">markers", ">spread cm", ">tilt deg", "what to do")
    return Rows("Alignment of the cameras", columns, cells)


def _tilt(one: Alignment) -> str:
    if one.tilt_rad is None or one.sigma_rad is None:
        return "-"
    least = "over " if one.axes == 1 else ""
    return f"{least}{math.degrees(one.tilt_rad):.1f} ± {math.degrees(one.sigma_rad):.1f}"


def coverage_lines(lab: AlignedLab) -> list[tuple[str, bool]]:
    """Return lines on the floor and on neighbouring cameras; True marks a good result."""
    floor = _floor_lines(lab.coverage) if lab.coverage is not None else []
    return floor + [
        _overlap_line(overlap, lab.diagonal_m, lab.coverage is not None) for overlap in lab.overlaps
    ]


def _floor_lines(coverage: FloorCoverage) -> list[tuple[str, bool]]:
    floor_m2 = coverage.floor.width_m * coverage.floor.depth_m
    size = f"a marker of {cm(coverage.diagonal_m / math.sqrt(2), 0)} cm"
    if coverage.height_m:
        size += f", {cm(coverage.height_m, 0)} cm above the floor,"
    return [
        _patch_line(coverage.unseen, floor_m2, "every part of the floor is in an image", "in no image"),
        _patch_line(
            coverage.gaps, floor_m2, f"an image shows all of {size} at every position",
            f"no image shows all of {size} with its centre on",
        ),
    ]  # fmt: skip


def _patch_line(patches: Sequence[Patch], floor_m2: float, good: str, bad: str) -> tuple[str, bool]:
    if not patches:
        return good, True
    total_m2 = sum(patch.area_m2 for patch in patches)
    position = "; ".join(
        f"x {p.low_m[0]:.2f} to {p.high_m[0]:.2f}, y {p.low_m[1]:.2f} to {p.high_m[1]:.2f}"
        for p in patches[:_MOST_PATCHES]
    )
    more = f"; {len(patches) - _MOST_PATCHES} more" if len(patches) > _MOST_PATCHES else ""
    area = f"{total_m2:.2f} m² of the floor ({100 * total_m2 / floor_m2:.2g} %)"
    return (f"{bad} {area}" if " with " in bad else f"{area} are {bad}") + f": {position}{more}", False


def _overlap_line(overlap: Overlap, diagonal_m: float, placed: bool) -> tuple[str, bool]:
    names, (x_m, y_m) = " and ".join(overlap.cameras), overlap.at_m.tolist()
    needed = f"a marker needs {cm(diagonal_m, 0)} cm, its diagonal"
    if overlap.width_m >= diagonal_m:
        return f"{names} overlap by {cm(overlap.width_m, 0)} cm or more. This is enough: {needed}", True
    gap = f"leave a gap of {cm(-overlap.width_m, 0)} cm"
    fault = f"overlap by only {cm(overlap.width_m, 0)} cm" if overlap.width_m > 0 else gap
    end = "neither image shows all of a marker between them"
    position = f", at x {x_m:.2f}, y {y_m:.2f}" if placed else ""
    return f"{names} {fault}{position}: {needed}; {end}", False


def alignment_json(lab: AlignedLab) -> dict[str, Any]:
    """Return the alignment as plain data; None for unknown values."""
    coverage = lab.coverage
    return {
        "run": lab.run,
        "level_below_m": LEVEL_M,
        "cameras": [_camera_json(alignment) for alignment in lab.alignments],
        "coverage": None
        if coverage is None
        else {
            "marker_height_m": coverage.height_m,
            "unseen": plain(coverage.unseen),
            "whole_in_no_picture": plain(coverage.gaps),
        },
        "marker_diagonal_m": lab.diagonal_m,
        "overlaps": [
            {
                "cameras": list(overlap.cameras),
                "width_m": overlap.width_m,
                "at_m": None if coverage is None else overlap.at_m.tolist(),
                "enough": overlap.width_m >= lab.diagonal_m,
            }
            for overlap in lab.overlaps
        ],
        "notes": list(lab.notes),
    }


def _camera_json(one: Alignment) -> dict[str, Any]:
    right_rad, bottom_rad = one.turns_rad if one.down is not None else (None, None)
    return {
        "camera": one.camera,
        "places": len(one.floor_markers),
        "markers": sorted({marker.marker_id for marker in one.floor_markers}),
        "raised": [
            {"marker": marker.marker_id, "above_m": above_m} for marker, above_m in one.raised_markers
        ],
        "spread_m": one.spread_m,
        "spread_after_m": one.remaining_m,
        "level": one.level,
        "tilt_rad": one.tilt_rad,
        "tilt_sigma_rad": one.sigma_rad,
        "look_further_right_rad": right_rad,
        "look_further_down_rad": bottom_rad,
        "known_directions": one.axes,
        "height_m": one.height_m,
        "advice": advise(one),
    }


# A normal distribution has 95 % within this many standard deviations.
_NORMAL_95 = 1.96


def drift_lines(reading: DriftReading) -> list[tuple[str, bool]]:
    """Return the result as sentences, each with a mark whether it is good."""
    drift = reading.drift
    lines = [line for move in drift.moves for line in _move_lines(move)]
    lines += [(_marker_line(move), False) for move in drift.marker_moves]
    if not lines:
        text = f"No camera has moved: the mean shift of each floor map is below {mm(LEAST_SHIFT_M)} mm."
        lines = [(text, True)]
    return lines


def _marker_line(move: MarkerMove) -> str:
    return (
        f"Marker {move.marker_id} was moved at about {format_time(move.time_ns)[:19]} UTC ({move.log}). "
        "It is used again from its new place."
    )


def _move_lines(move: Move) -> list[tuple[str, bool]]:
    low, high = map(mm, _band_m(move.motion))
    before, after = format_time(move.before_ns)[:19], format_time(move.after_ns)[:19]
    when = f"at {after} UTC" if before == after else f"between {before} and {after} UTC"
    logs = f"in {move.after}" if move.before == move.after else f"after {move.before}, before {move.after}"
    how = "gradually " if move.gradual else ""
    text = (
        f"Camera {move.camera} moved {how}{when} ({logs}). The mean shift of its floor map is "
        f"{mm(move.motion.mean_shift_m)} mm (95 % band {low} to {high} mm)."
    )
    lines = [(text, False)]
    if move.motion.is_unclear or len(move.motion.markers) == 1:
        markers = " or ".join(str(one) for one in move.motion.markers)
        lines.append((f"It is also possible that reference marker {markers} moved instead.", False))
    split = move.motion.why_no_split
    if split is None:
        lines.append((f"Size (standard deviation): {_split_text(move.motion)}.", False))
    else:
        lines.append((f"{split[0].upper()}{split[1:]}.", False))
    return lines


def _band_m(motion: Motion) -> tuple[float, float]:
    half_m = _NORMAL_95 * motion.sigma_m
    return max(motion.mean_shift_m - half_m, 0.0), motion.mean_shift_m + half_m


def _split_text(motion: Motion) -> str:
    """Return the lengths of turn and shift as text, each with its standard deviation in brackets."""
    lengths = []
    for part in (slice(0, 3), slice(3, 6)):
        vector, covariance = motion.motion[part], motion.covariance[part, part]
        length = float(np.linalg.norm(vector))
        unit = vector / length if length else np.zeros(3)
        lengths += [length, float(np.sqrt(unit @ covariance @ unit))]
    turn, turn_sigma, shift, shift_sigma = lengths
    digits = 2 if np.degrees(turn_sigma) > 0.01 else 3
    degrees = f"turn {np.degrees(turn):.{digits}f} ({np.degrees(turn_sigma):.{digits}f}) degrees"
    return f"{degrees}, shift {mm(shift)} ({mm(shift_sigma)}) mm"


def drift_table(reading: DriftReading) -> Rows:
    """Return a table with the mean shift of each floor map since the baseline, one row for each log."""
    cameras = sorted(reading.drift.baselines)
    cells = []
    for name in reading.names:
        states = {state.camera: state for state in reading.drift.states if state.log == name}
        if states:
            time = format_time(min(state.time_ns for state in states.values()))[:16]
            cells.append([name, time, *(_cell(states.get(camera)) for camera in cameras)])
    title = f"Mean shift of the floor maps since {reading.since}, in mm"
    return Rows(title, ("log", "end (UTC)", *(f">{camera}" for camera in cameras)), cells)


def _cell(state: CameraState | None) -> str:
    if state is None or state.motion is None:
        return "-"
    low, high = map(mm, _band_m(state.motion))
    return f"{mm(state.motion.mean_shift_m)} ({low}-{high})"


def drift_json(reading: DriftReading) -> dict[str, Any]:
    """Return the drift as plain data, in m, rad and ns."""
    drift = reading.drift
    return {
        "baseline": str(reading.paths[0]),
        "logs": [str(path) for path in reading.paths],
        "model": {"name": reading.model, "log": str(reading.source[0]), "topic": reading.source[1]},
        "moves": [
            {
                "camera": move.camera,
                "before": {"log": move.before, "time_ns": move.before_ns},
                "after": {"log": move.after, "time_ns": move.after_ns},
                "gradual": move.gradual,
                **_motion_json(move.motion),
            }
            for move in drift.moves
        ],
        "marker_moves": [
            {"marker": move.marker_id, "log": move.log, "time_ns": move.time_ns}
            for move in drift.marker_moves
        ],
        "states": [
            {"camera": s.camera, "log": s.log, "time_ns": s.time_ns}
            | (_motion_json(s.motion) if s.motion else {})
            for s in drift.states
        ],
        "remarks": reading.remarks,
    }


def _motion_json(motion: Motion) -> dict[str, Any]:
    low_m, high_m = _band_m(motion)
    result: dict[str, Any] = {
        "moved": motion.is_moved,
        "mean_shift_m": motion.mean_shift_m,
        "low_m": low_m,
        "high_m": high_m,
        "markers": list(motion.markers),
        "unclear": motion.is_unclear,
    }
    if motion.why_no_split is not None:
        return {**result, "why_no_split": motion.why_no_split}
    sigmas = np.sqrt(motion.covariance.diagonal()).tolist()
    values = motion.motion.tolist()
    return {
        **result,
        "turn_rad": values[:3],
        "turn_sigma_rad": sigmas[:3],
        "shift_m": values[3:],
        "shift_sigma_m": sigmas[3:],
    }
