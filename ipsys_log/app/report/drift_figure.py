"""Figure of the drift: the mean shift of the floor map of each camera over time, with its 95 % band."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from ipsys_log.app.report.figures import save_figure, style_axes
from ipsys_log.app.report.styles import NOTE, camera_styles, shorten
from ipsys_log.live_runs.survey.drift_reading import DriftReading
from ipsys_log.statistics.camera_moves import CameraState
from ipsys_log.statistics.drift import LEAST_SHIFT_M
from ipsys_log.units import MM_PER_M, NS_PER_S

_NORMAL_95 = 1.96
# Rows of the legend; further cameras are in further columns.
_ROWS = 8


def draw_drift(reading: DriftReading, path: Path) -> None:
    """Draw one line for each camera over the logs, with its 95 % band and the times of the moves.

    A file in pixels has 1200 x 600 pixels.
    """
    figure = Figure(figsize=(12, 6), dpi=100, layout="constrained")
    axes = figure.add_subplot()
    drift = reading.drift
    styles = camera_styles(drift.baselines)
    for camera in sorted(drift.baselines):
        states = [state for state in drift.of_camera(camera) if state.motion is not None]
        if states:
            _draw_camera(axes, camera, states, styles[camera])
    for move in drift.moves:
        moment = datetime.fromtimestamp(move.after_ns / NS_PER_S, UTC)
        axes.axvline(moment, color=styles[move.camera][0], ls=":", lw=1.4)  # type: ignore[arg-type]
        axes.annotate(
            f"{shorten(move.camera)} moved", (moment, 1.0), (3, -4), xycoords=("data", "axes fraction"),
            textcoords="offset points", va="top", ha="left", rotation=90, fontsize=8,
        )  # fmt: skip
    least_mm = LEAST_SHIFT_M * MM_PER_M
    axes.axhline(least_mm, color=NOTE, lw=1, ls="--", label=f"least reported shift, {least_mm:.1f} mm")
    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]
    axes.set(ylabel="mean shift of the floor map in mm", ylim=(0, None))
    axes.set_title(
        f"Drift of the cameras since {shorten(reading.names[0])}; bands: 95 %", loc="left", fontsize=11
    )
    style_axes(axes)
    columns = -(-len(drift.baselines) // _ROWS)
    axes.legend(loc="upper left", fontsize=9 if columns == 1 else 7, ncols=columns, frameon=False)
    save_figure(figure, path)


def _draw_camera(axes: Axes, camera: str, states: Sequence[CameraState], style: tuple[str, str]) -> None:
    """Draw the line of a camera, with its band."""
    colour, shape = style
    times = np.array([datetime.fromtimestamp(state.time_ns / NS_PER_S, UTC) for state in states])
    motions = [state.motion for state in states if state.motion]
    means_mm = np.array([motion.mean_shift_m for motion in motions]) * MM_PER_M
    half_mm = np.array([motion.sigma_m for motion in motions]) * MM_PER_M * _NORMAL_95
    low_mm = np.maximum(means_mm - half_mm, 0.0)
    axes.fill_between(times, low_mm, means_mm + half_mm, color=colour, alpha=0.18, lw=0)
    axes.plot(times, means_mm, "-" + shape, color=colour, ms=6, lw=1.6, label=shorten(camera))
