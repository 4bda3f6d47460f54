"""Figures of the poses of cameras: the alignment on the floor and in the images, and the drift over time."""

import math
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter
from matplotlib.figure import Figure

from ipsys_log.app.report.alignment import AlignedLab
from ipsys_log.app.report.figures import add_panel, legend_label, name_cameras, save_figure, style_axes
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.styles import NOTE, REST, camera_styles, shorten
from ipsys_log.live_runs.survey.drift_reading import DriftReading
from ipsys_log.messages import CameraCalibration
from ipsys_log.statistics.alignment import Alignment
from ipsys_log.statistics.camera_moves import CameraState
from ipsys_log.statistics.coverage import FloorCoverage
from ipsys_log.statistics.drift import LEAST_SHIFT_M
from ipsys_log.units import CM_PER_M, MM_PER_M, NS_PER_S
from ipsys_log.vision.lenses import project

_DPI = 100
_FLOOR_IN, _PANEL_IN, _GAP_IN = 5.6, 3.4, 0.55
_ROWS, _ROW_IN = 3, 2.4
# Colours of the floor where a marker is whole in one image, in several images, and in none.
_ONE, _MORE, _NONE = "#EAF1F8", "#C3D6E8", "#F2B8A0"
_LEVEL, _TILTED = "#00734D", "#B3261E"
_NEAR, _FAR = "#0072B2", "#D55E00"


def draw_alignment(lab: AlignedLab, path: Path) -> None:
    """Draw the alignment of a lab into a file.

    On the left is the floor map, if the coverage is known. On the right is the image of each camera with its
    markers. Each marker shows the difference of its Zc from the median. An arrow shows the direction to turn
    the camera.
    """
    floor = lab.coverage is not None
    columns = -(-len(lab.alignments) // _ROWS)
    left_in = _FLOOR_IN + 1.5 if floor else 0.4
    rows = _ROWS if floor else min(len(lab.alignments), _ROWS)
    size = (left_in + columns * (_PANEL_IN + _GAP_IN), 0.3 + _ROW_IN * rows)
    figure = Figure(figsize=size, dpi=_DPI)
    if lab.coverage is not None:
        axes = add_panel(figure, 0.65, 1.0, _FLOOR_IN, _FLOOR_IN)
        _draw_floor(axes, lab, lab.coverage)
        handles, labels = axes.get_legend_handles_labels()
        location = (0.5 / size[0], 0.05 / size[1])
        figure.legend(handles, labels, loc=location, ncols=3, fontsize=8, frameon=False)
    for number, alignment in enumerate(lab.alignments):
        column, row = divmod(number, _ROWS)
        x_in, y_in = left_in + column * (_PANEL_IN + _GAP_IN), size[1] - 0.15 - (row + 1) * _ROW_IN
        panel = add_panel(figure, x_in, y_in, _PANEL_IN, _PANEL_IN * 9 / 16)
        _draw_picture(panel, alignment, lab.lenses)
    save_figure(figure, path)


def _draw_floor(axes: Axes, lab: AlignedLab, coverage: FloorCoverage) -> None:
    draw_ground(axes, lab.rig, [])
    axes.grid(visible=False)
    counts = np.sum([*coverage.whole.values()], axis=0)
    half_m = (coverage.xs_m[1] - coverage.xs_m[0]) / 2
    frame = (
        coverage.xs_m[0] - half_m, coverage.xs_m[-1] + half_m,
        coverage.ys_m[0] - half_m, coverage.ys_m[-1] + half_m,
    )  # fmt: skip
    shades = ListedColormap([_NONE, _ONE, _MORE])
    # A marker that would extend over the edge of the floor does not need to be seen.
    shown = np.ma.masked_where((counts == 0) & ~coverage.fits, np.minimum(counts, 2))
    axes.imshow(shown, cmap=shades, vmin=0, vmax=2, origin="lower", extent=frame, zorder=0.5)
    for colour, text in ((_ONE, "whole in one image"), (_MORE, "in two or more"), (_NONE, "in none")):
        axes.plot([], [], "s", ms=9, mfc=colour, mec=REST, label=text)
    styles = camera_styles(mounted.name for mounted in lab.mounted_cameras)
    for mounted in lab.mounted_cameras:
        colour, shape = styles[mounted.name]
        # The area outside of the floor has no data, so the edge of the floor closes the outline.
        seen = np.pad(coverage.whole[mounted.name].astype(float), 1)
        around_m = [
            np.concatenate([[v[0] - half_m], v, [v[-1] + half_m]]) for v in (coverage.xs_m, coverage.ys_m)
        ]
        axes.contour(*around_m, seen, levels=[0.5], colors=[colour], linewidths=1.8, zorder=3)
        label = legend_label(shorten(mounted.name), len(styles))
        axes.plot(*mounted.foot_m, shape, color=colour, ms=7, mec="white", zorder=5, label=label)
    beside_m = 0.03 * float(np.ptp(axes.get_ylim()))
    places_m = {one.name: np.array(one.foot_m) - [0.0, beside_m] for one in lab.mounted_cameras}
    name_cameras(axes, places_m, {name: colour for name, (colour, _) in styles.items()})
    for overlap in coverage.overlaps:
        good, width_cm = overlap.width_m >= coverage.diagonal_m, overlap.width_m * CM_PER_M
        text = f"overlap {width_cm:.0f} cm" if width_cm > 0 else f"gap of {-width_cm:.0f} cm"
        axes.annotate(
            text, overlap.at_m.tolist(), ha="center", va="center",
            fontsize=8, color=_LEVEL if good else _TILTED, weight="bold", zorder=6,
            bbox={"boxstyle": "round,pad=0.2", "fc": "white", "ec": "none", "alpha": 0.85},
        )  # fmt: skip
    height = f", {coverage.height_m * CM_PER_M:.0f} cm above the floor" if coverage.height_m else ""
    axes.set_title(f"Images with a whole marker, by the marker's centre{height}", loc="left", fontsize=10)


def _draw_picture(axes: Axes, one: Alignment, lenses: Mapping[str, CameraCalibration]) -> None:
    colour = {None: "black", True: _LEVEL, False: _TILTED}[one.level]
    state = {None: "tilt not known", True: "level", False: "not level"}[one.level]
    spread = "" if one.spread_m is None else f", spread {one.spread_m * CM_PER_M:.1f} cm"
    axes.set_title(f"{shorten(one.camera)}: {state}{spread}", loc="left", fontsize=10, color=colour)
    axes.set(xticks=[], yticks=[])
    lens = lenses.get(one.camera)
    if lens is None:
        axes.annotate("no calibration", (0.5, 0.5), xycoords="axes fraction", ha="center", color=NOTE)
        return
    axes.set(xlim=(0, lens.width), ylim=(lens.height, 0), aspect="equal")
    # The principal point: the optical axis has to be vertical on the floor.
    axes.plot(*lens.K[:2, 2], "+", color=REST, ms=12, zorder=1)
    if one.floor_markers:
        _draw_depths(axes, one, lens)
    for marker, _ in one.raised_markers:
        x, y = project(marker.point_m[None], lens)[0]
        axes.plot(x, y, "x", color=NOTE, ms=6, zorder=3)
        axes.annotate(
            f"{marker.marker_id} not used", (x, y), (7, 0), textcoords="offset points", va="center",
            fontsize=8, color=NOTE,
        )  # fmt: skip
    if one.level is False and one.down is not None:
        _draw_arrow(axes, one, lens)


def _draw_depths(axes: Axes, one: Alignment, lens: CameraCalibration) -> None:
    points_m = np.array([marker.point_m for marker in one.floor_markers])
    depths_m = points_m[:, 2] + np.array([marker.height_m for marker in one.floor_markers])
    off_cm = ((depths_m - np.median(depths_m)) * CM_PER_M).round(1) + 0.0  # no -0.0
    few = len(off_cm) <= 12
    for (x, y), cm, marker in zip(project(points_m, lens), off_cm, one.floor_markers, strict=True):
        colour = REST if abs(cm) < 0.5 else _FAR if cm > 0 else _NEAR
        axes.plot(x, y, "o", color=colour, ms=5 if few else min(9, 2 + 0.7 * abs(cm)), alpha=0.9, zorder=2)
        if few:
            up = y > lens.height / 2
            axes.annotate(
                f"{marker.marker_id}: {cm:+.1f}", (x, y), (0, 6 if up else -6), textcoords="offset points",
                ha="center", va="bottom" if up else "top", fontsize=8, color=NOTE, annotation_clip=False,
            )  # fmt: skip
    axes.annotate(
        "Zc minus its median in cm: orange farther, blue nearer", (0, -0.02), xycoords="axes fraction",
        va="top", fontsize=7, color=NOTE,
    )  # fmt: skip


def _draw_arrow(axes: Axes, one: Alignment, lens: CameraCalibration) -> None:
    """Draw the arrow in the direction to turn the camera; its length has no meaning."""
    assert one.down is not None
    assert one.tilt_rad is not None
    start = lens.K[:2, 2]
    direction = one.down[:2] / max(float(np.hypot(*one.down[:2])), 1e-9)
    end = start + 0.3 * lens.height * direction
    axes.annotate(
        "", end.tolist(), start.tolist(), zorder=4,
        arrowprops={"arrowstyle": "-|>", "color": _TILTED, "lw": 2.2, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip
    beyond = start + 0.4 * lens.height * direction
    axes.annotate(
        f"{math.degrees(one.tilt_rad):.1f}°", beyond.tolist(), ha="center", va="center", fontsize=9,
        color=_TILTED, weight="bold", zorder=5,
        bbox={"boxstyle": "round,pad=0.15", "fc": "white", "ec": "none"},
    )  # fmt: skip


_NORMAL_95 = 1.96
# Rows of the legend; further cameras are in further columns.
_LEGEND_ROWS = 8


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
        f"Drift of the cameras since {shorten(reading.since)}; bands: 95 %", loc="left", fontsize=11
    )
    style_axes(axes)
    columns = -(-len(drift.baselines) // _LEGEND_ROWS)
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
