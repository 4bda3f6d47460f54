"""Drift of the cameras over several logs: reading of the logs, sentences, table and JSON."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from ipsys_log.analysis.camera_moves import DriftLog, LabDrift, MarkerMove, Move, find_drift
from ipsys_log.analysis.drift import LEAST_SHIFT_M, Motion
from ipsys_log.analysis.floor_cameras import FloorCamera, read_floor_cameras
from ipsys_log.analysis.reference_markers import image_sizes, read_windows
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Rig
from ipsys_log.messages.channels import MARKERS, RIG
from ipsys_log.report.tables import plain_table
from ipsys_log.runs.mended_model import find_model
from ipsys_log.runs.provenance import newest_run
from ipsys_log.units import MM_PER_M, format_time

__all__ = ["DriftReading", "drift_json", "drift_lines", "drift_table", "read_drift"]

# A normal distribution has 95 % within this many standard deviations.
_NORMAL_95 = 1.96
_SEPARATE = "turn {turn:.2f} ({turn_sigma:.2f}) degrees, shift {shift:.1f} ({shift_sigma:.1f}) mm"


@dataclass(slots=True, eq=False)
class DriftReading:
    """The drift over logs, and its sources.

    Attributes
    ----------
    paths : the logs in order of time; the first is the baseline.
    model : name of the model with the camera poses; ``source`` are its log and its topic.
    remarks : on logs that were left out, and others.
    """

    drift: LabDrift
    paths: list[Path]
    model: str
    source: tuple[Path, str]
    remarks: list[str] = field(default_factory=list)

    def moved(self) -> dict[str, Motion]:
        """Return the motions since the baseline of the cameras that have moved at the end of the logs."""
        motions = {}
        for camera in sorted(self.drift.baselines):
            motion = next((s.motion for s in reversed(self.drift.of_camera(camera)) if s.motion), None)
            if motion is not None and motion.is_moved:
                motions[camera] = motion
        return motions


def read_drift(
    paths: Sequence[Path],
    baseline: Path | None = None,
    model_from: Path | None = None,
    rig: Rig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> DriftReading:
    """Find the moves of the cameras over logs.

    Parameters
    ----------
    paths : the logs, in any order.
    baseline : the log before all moves; None: the first by time.
    model_from : a log with a fitted model; None: the baseline, or else the first log with a model.
    rig : used instead of the rigs of the logs.
    progress : called with the number of logs done, and of all logs.

    Raises
    ------
    IpsysError
        No rig has reference markers, a log has no markers or is of other cameras, or no log has a model.
    """
    starts_ns = {path: _start_ns(path) for path in dict.fromkeys([*paths, *([baseline] if baseline else [])])}
    first = baseline or min(starts_ns, key=starts_ns.__getitem__)
    order = sorted(starts_ns, key=lambda path: (path != first, starts_ns[path]))
    remarks = [
        f"{path}: is older than the baseline; it is left out"
        for path in order
        if starts_ns[path] < starts_ns[first]
    ]
    order = [path for path in order if starts_ns[path] >= starts_ns[first]]
    logs, read, lab = [], [], None
    for number, path in enumerate(order):
        progress(number, len(order))
        one = _read_log(path, rig)
        lab = lab or one
        _check_same(one, lab)
        if one.windows.windows:
            logs.append(one.windows)
            read.append(path)
        elif path == first:
            raise IpsysError(f"{path}: {_unseen(one.rig)}; give another log with --baseline")
        else:
            remarks.append(f"{path}: {_unseen(one.rig)}; it is left out")
    progress(len(order), len(order))
    assert lab is not None
    model, source, cameras = _cameras([model_from] if model_from else read, starts_ns[first])
    lengths_m = {marker.id: lab.rig.length_of(marker.id) for marker in lab.rig.reference_markers}
    drift = find_drift(logs, cameras, lengths_m, lab.rig.floor)
    seen = {camera for log in logs for window in log.windows for camera in window.corners}
    remarks += [f"camera {name}: {source[0]} has no model of it" for name in sorted(seen - set(cameras))]
    remarks += [
        f"camera {name}: sees no reference marker; it is not watched" for name in sorted(set(cameras) - seen)
    ]
    if len(read) == 1:
        remarks.append("one log shows only moves during its recording; add earlier logs")
    return DriftReading(drift, read, model, source, remarks)


@dataclass(slots=True, eq=False)
class _Log:
    path: Path
    rig: Rig
    sizes_px: Mapping[str, tuple[int, int]]
    windows: DriftLog


def _start_ns(path: Path) -> int:
    with Session([path]) as session:
        return session.start_ns


def _read_log(path: Path, rig: Rig | None) -> _Log:
    with Session([path]) as session:
        rigs = [rig] if rig is not None else session.payloads(session.topics(RIG))
        if not rigs or not rigs[-1].reference_markers:
            raise IpsysError(
                f"{path}: its rig has no reference markers; fix markers to the floor, add "
                "[[reference_markers]] with their ids to lab.toml, and give --rig lab.toml for older logs"
            )
        run = newest_run(session, MARKERS)
        if run is None:
            raise IpsysError(f"{path}: has no detected markers; to detect them: ipsys detect {path}")
        ids = {marker.id for marker in rigs[-1].reference_markers}
        windows = DriftLog(path.name, read_windows(session, run, ids))
        return _Log(path, rigs[-1], image_sizes(session, run), windows)


def _unseen(rig: Rig) -> str:
    ids = ", ".join(str(marker.id) for marker in rig.reference_markers)
    return f"no camera sees a reference marker ({ids}) in it, or its markers were detected with an older rig"


def _check_same(log: _Log, first: _Log) -> None:
    """Check that a log is of the same cameras as the baseline."""
    if not set(log.sizes_px) & set(first.sizes_px):
        raise IpsysError(
            f"{log.path}: has the cameras {', '.join(sorted(log.sizes_px))}, but {first.path} has "
            f"{', '.join(sorted(first.sizes_px))}; compare only logs of one lab"
        )
    for camera, (width, height) in sorted(log.sizes_px.items()):
        before = first.sizes_px.get(camera, (width, height))
        if before != (width, height):
            raise IpsysError(
                f"{log.path}: camera {camera} has images of {width} x {height} px, but in {first.path} of "
                f"{before[0]} x {before[1]} px; compare only logs with the same image size"
            )


def _cameras(paths: Sequence[Path], until_ns: int) -> tuple[str, tuple[Path, str], dict[str, FloorCamera]]:
    """Return the name and the source of the first model with camera poses, and its cameras."""
    for path in paths:
        with Session([path]) as session:
            model = find_model(session, until_ns)
            lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
        if model is not None and (cameras := read_floor_cameras(model[0], lenses)):
            return model[0].name, (path, model[1]), cameras
    raise IpsysError(
        f"{paths[0]}: has no fitted model with camera poses and intrinsics; give the log of the calibration "
        "with --model-from LOG"
    )


def drift_lines(reading: DriftReading) -> list[tuple[str, bool]]:
    """Return the result as sentences, each with a mark whether it is good."""
    drift = reading.drift
    lines = [line for move in drift.moves for line in _move_lines(move)]
    lines += [(_marker_line(move), False) for move in drift.marker_moves]
    if not lines:
        least_mm = LEAST_SHIFT_M * MM_PER_M
        lines = [(f"No camera has moved: the mean shift of each floor map is below {least_mm:.1f} mm.", True)]
    return lines


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


def drift_table(reading: DriftReading) -> Table:
    """Return a table with the mean shift of each floor map since the baseline, one row for each log."""
    drift = reading.drift
    cameras = sorted(drift.baselines)
    first = reading.paths[0].name
    table = plain_table(f"Mean shift of the floor maps since {first}, in mm", ["log", "start (UTC)"], cameras)
    for path in reading.paths:
        states = {state.camera: state for state in drift.states if state.log == path.name}
        if states:
            time = format_time(min(state.time_ns for state in states.values()))[:16]
            table.add_row(path.name, time, *(_cell(states.get(camera)) for camera in cameras))
    return table


def _cell(state: Any) -> str:
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
