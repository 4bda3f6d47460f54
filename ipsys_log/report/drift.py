"""Drift of the cameras over several logs: sentences, table and JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from ipsys_log.analysis.camera_moves import CameraState, MarkerMove, Move
from ipsys_log.analysis.drift import LEAST_SHIFT_M, Motion
from ipsys_log.report.rows import Rows, wrap_text
from ipsys_log.survey.drift_reading import DriftReading
from ipsys_log.units import MM_PER_M, format_time

# A normal distribution has 95 % within this many standard deviations.
_NORMAL_95 = 1.96
_SEPARATE = "turn {turn:.2f} ({turn_sigma:.2f}) degrees, shift {shift:.1f} ({shift_sigma:.1f}) mm"


def drift_lines(reading: DriftReading) -> list[tuple[str, bool]]:
    """Return the result as sentences, each with a mark whether it is good."""
    drift = reading.drift
    lines = [line for move in drift.moves for line in _move_lines(move)]
    lines += [(_marker_line(move), False) for move in drift.marker_moves]
    if not lines:
        least_mm = LEAST_SHIFT_M * MM_PER_M
        lines = [(f"No camera has moved: the mean shift of each floor map is below {least_mm:.1f} mm.", True)]
    return [(wrap_text(text), is_good) for text, is_good in lines]


def _marker_line(move: MarkerMove) -> str:
    return (
        f"Reference marker {move.marker_id} was moved at about {format_time(move.time_ns)[:19]} UTC "
        f"({move.log}). It is used again from its new place."
    )


def _move_lines(move: Move) -> list[tuple[str, bool]]:
    low_mm, high_mm = _band_mm(move.motion)
    when = f"between {format_time(move.before_ns)[:19]} and {format_time(move.after_ns)[:19]} UTC"
    logs = f"in {move.after}" if move.before == move.after else f"after {move.before}, before {move.after}"
    how = "gradually " if move.gradual else ""
    text = (
        f"Camera {move.camera} moved {how}{when} ({logs}). The mean shift of its floor map is "
        f"{move.motion.mean_shift_m * MM_PER_M:.1f} mm (95 % band {low_mm:.1f} to {high_mm:.1f} mm)."
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


def _band_mm(motion: Motion) -> tuple[float, float]:
    half_m = _NORMAL_95 * motion.sigma_m
    return (
        max(motion.mean_shift_m - half_m, 0.0) * MM_PER_M,
        (motion.mean_shift_m + half_m) * MM_PER_M,
    )


def _lengths(motion: Motion) -> dict[str, float]:
    """Return the lengths of turn and shift in rad and m, and their standard deviations."""
    lengths = {}
    for name, part in (("turn", slice(0, 3)), ("shift", slice(3, 6))):
        vector, covariance = motion.motion[part], motion.covariance[part, part]
        length = float(np.linalg.norm(vector))
        unit = vector / length if length else np.zeros(3)
        lengths[name], lengths[f"{name}_sigma"] = length, float(np.sqrt(unit @ covariance @ unit))
    return lengths


def _split_text(motion: Motion) -> str:
    lengths = _lengths(motion)
    return _SEPARATE.format(
        turn=np.degrees(lengths["turn"]),
        turn_sigma=np.degrees(lengths["turn_sigma"]),
        shift=lengths["shift"] * MM_PER_M,
        shift_sigma=lengths["shift_sigma"] * MM_PER_M,
    )


def drift_table(reading: DriftReading) -> Rows:
    """Return a table with the mean shift of each floor map since the baseline, one row for each log."""
    cameras = sorted(reading.drift.baselines)
    cells = []
    for name in reading.names:
        states = {state.camera: state for state in reading.drift.states if state.log == name}
        if states:
            time = format_time(min(state.time_ns for state in states.values()))[:16]
            cells.append([name, time, *(_cell(states.get(camera)) for camera in cameras)])
    title = f"Mean shift of the floor maps since {reading.names[0]}, in mm"
    return Rows(title, ("log", "end (UTC)", *(f">{camera}" for camera in cameras)), cells)


def _cell(state: CameraState | None) -> str:
    if state is None or state.motion is None:
        return "-"
    low_mm, high_mm = _band_mm(state.motion)
    return f"{state.motion.mean_shift_m * MM_PER_M:.1f} ({low_mm:.1f}-{high_mm:.1f})"


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
    half_m = _NORMAL_95 * motion.sigma_m
    result: dict[str, Any] = {
        "moved": motion.is_moved,
        "mean_shift_m": motion.mean_shift_m,
        "low_m": max(motion.mean_shift_m - half_m, 0.0),
        "high_m": motion.mean_shift_m + half_m,
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
