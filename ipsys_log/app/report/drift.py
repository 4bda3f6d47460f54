"""Drift of the cameras over several logs: sentences, table and JSON."""

from __future__ import annotations

from typing import Any

import numpy as np

from ipsys_log.app.report.rows import Rows, mm, wrap_text
from ipsys_log.live_runs.survey.drift_reading import DriftReading
from ipsys_log.statistics.camera_moves import CameraState, MarkerMove, Move
from ipsys_log.statistics.drift import LEAST_SHIFT_M, Motion
from ipsys_log.units import format_time

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
    return [(wrap_text(text), is_good) for text, is_good in lines]


def _marker_line(move: MarkerMove) -> str:
    return (
        f"Reference marker {move.marker_id} was moved at about {format_time(move.time_ns)[:19]} UTC "
        f"({move.log}). It is used again from its new place."
    )


def _move_lines(move: Move) -> list[tuple[str, bool]]:
    low, high = map(mm, _band_m(move.motion))
    when = f"between {format_time(move.before_ns)[:19]} and {format_time(move.after_ns)[:19]} UTC"
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
    degrees = f"turn {np.degrees(turn):.2f} ({np.degrees(turn_sigma):.2f}) degrees"
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
    title = f"Mean shift of the floor maps since {reading.names[0]}, in mm"
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
