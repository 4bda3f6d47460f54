"""Figure of a joint calibration: the expected error over the floor of each camera, with points and drives."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from ipsys_log.report.figures import figure_bytes, has_legend
from ipsys_log.report.files import write_files
from ipsys_log.report.styles import NOTE, REST, shorten
from ipsys_log.survey.lab_calibration import CameraResult, LabCalibration
from ipsys_log.units import MM_PER_M

# Colours from pale (small error) to dark, as in the figure of a plan.
_HEAT = LinearSegmentedColormap.from_list("heat", ["#FBFDFF", "#DCE6F2", "#B3CBE3", "#86A9D0", "#5C84B8"])
_LEFT_IN, _BOTTOM_IN = 0.7, 0.95
# Distance from the map to the walls.
_WALL_M = 0.25


class _Panels(NamedTuple):
    """The panels of a figure: columns, sizes and distances in inches, and the size of a point."""

    columns: int
    width_in: float
    gap_in: float
    height_in: float
    between_in: float
    point_pt: float

    @property
    def row_in(self) -> float:
        return self.height_in + self.between_in


def _panels(lab: LabCalibration, count: int) -> _Panels:
    """Return large panels for the cameras of a lab, or small ones with the shape of the floor for a hall."""
    if has_legend(count):
        return _Panels(min(count, 3), 4.0, 0.45, 4.0, 0.75, 6.0)
    width_m, depth_m = (float(np.ptp(places_m)) for places_m in (lab.grid.xs_m, lab.grid.ys_m))
    height_in = 2.4 * float(np.clip(depth_m / width_m, 0.3, 2.0))
    return _Panels(6, 2.4, 0.3, height_in, 0.55, 2.0)


def draw_lab(lab: LabCalibration, path: Path) -> None:
    """Draw the expected error over the floor, one panel for each camera."""
    shown = [camera for camera in lab.cameras if len(camera.expected.errors_m)]
    panels = _panels(lab, len(shown))
    rows = math.ceil(len(shown) / panels.columns)
    width_in = _LEFT_IN + panels.columns * (panels.width_in + panels.gap_in) + 1.1
    height_in = _BOTTOM_IN + rows * panels.row_in + 0.1
    figure = Figure(figsize=(width_in, height_in), dpi=100)
    errors_mm = np.concatenate([camera.expected.errors_m for camera in shown]) * MM_PER_M
    # A few nodes with large errors must not use most of the colour range.
    top_mm = float(np.quantile(errors_mm, 0.98))
    for number, camera in enumerate(shown):
        row, column = divmod(number, panels.columns)
        left_in = _LEFT_IN + column * (panels.width_in + panels.gap_in)
        bottom_in = _BOTTOM_IN + (rows - 1 - row) * panels.row_in
        frame = (
            left_in / width_in,
            bottom_in / height_in,
            panels.width_in / width_in,
            panels.height_in / height_in,
        )
        axes = figure.add_axes(frame)
        shades = _draw_camera(axes, lab, camera, top_mm, panels.point_pt)
        axes.set_ylabel("y in m" if column == 0 else "")
        if not has_legend(len(shown)):
            axes.set_xlabel("x in m" if number + panels.columns >= len(shown) else "")
            axes.tick_params(labelsize=8, labelleft=column == 0)
    right_in = _LEFT_IN + panels.columns * (panels.width_in + panels.gap_in) - 0.2
    bar_in = max(panels.height_in, min(4.0, rows * panels.row_in - panels.between_in))
    box = figure.add_axes((right_in / width_in, _BOTTOM_IN / height_in, 0.18 / width_in, bar_in / height_in))
    figure.colorbar(shades, cax=box, extend="max", label="expected 2D error in mm")
    title = f"Expected error over the floor: mean {lab.mean_m * MM_PER_M:.1f} mm, "
    title += f"for markers {lab.height_m * 100:.0f} cm above it"
    figure.text(_LEFT_IN / width_in, 1 - 0.28 / height_in, title, fontsize=12)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(
        handles,
        labels,
        loc=((_LEFT_IN - 0.15) / width_in, 0.08 / height_in),
        ncols=5,
        fontsize=9,
        frameon=False,
    )
    write_files(path.parent, {path.name: figure_bytes(figure, path, 100)})


def _draw_camera(
    axes: Axes, lab: LabCalibration, camera: CameraResult, top_mm: float, point_pt: float
) -> AxesImage:
    grid, half_m = lab.grid, lab.grid.step_m / 2
    map_mm = np.full(len(camera.expected.seen), np.nan)
    map_mm[camera.expected.seen] = camera.expected.errors_m * MM_PER_M
    (left, right), (low, high) = ((m[0] - half_m, m[-1] + half_m) for m in (grid.xs_m, grid.ys_m))
    shades = axes.imshow(
        map_mm.reshape(len(grid.ys_m), len(grid.xs_m)), cmap=_HEAT, vmin=0, vmax=top_mm, origin="lower",
        extent=(left, right, low, high), zorder=1,
    )  # fmt: skip
    # The map ends before the walls; points may be nearer to them.
    x0, x1, y0, y1 = left - _WALL_M, right + _WALL_M, low - _WALL_M, high + _WALL_M
    axes.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, ec=REST, lw=0.8, zorder=2))
    axes.plot(*camera.places_m.T, ".", color=NOTE, ms=1.5, zorder=3)
    axes.plot([], [], ".", color=NOTE, ms=5, label="a marker was here")
    axes.plot(
        *lab.points_m.T,
        "o",
        mfc="black",
        mec="white",
        ms=point_pt,
        mew=point_pt / 6,
        zorder=4,
        label="calibration point",
    )
    if lab.points:
        _draw_points(axes, lab, camera)
    if lab.gap is not None and not lab.is_enough and lab.gap.camera == camera.camera:
        x_m, y_m = lab.gap.low_m - half_m
        size_m = lab.gap.high_m - lab.gap.low_m + 2 * half_m
        axes.add_patch(Rectangle((x_m, y_m), *size_m, fill=False, ec="#D55E00", lw=1.8, ls="--", zorder=4))
    for point in lab.rig.reference_points:
        axes.plot(point.x_m, point.y_m, "+", color="black", ms=10, mew=1.6, zorder=4)
        axes.annotate(
            point.name, (point.x_m, point.y_m), (5, 5), textcoords="offset points", weight="bold", zorder=6
        )
    mean, covered = f"{camera.mean_m * MM_PER_M:.1f}", f"{camera.covered:.0%}"
    axes.set_title(f"{shorten(camera.camera)}: {mean} mm, {covered} covered", loc="left", fontsize=11)
    axes.set(xlim=(x0 - half_m, x1 + half_m), ylim=(y0 - half_m, y1 + half_m), xlabel="x in m")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
    axes.spines[:].set_visible(False)
    return shades


def _draw_points(axes: Axes, lab: LabCalibration, camera: CameraResult) -> None:
    """Draw the points to measure next that a camera sees, with their numbers."""
    axes.plot([], [], "o", ms=9, mfc="white", mec="black", mew=1.2, label="to measure, in this order")
    if lab.gap is not None:
        axes.plot([], [], "s", ms=9, mfc="none", mec="#D55E00", label="to drive through")
    for number, point in enumerate(lab.points, 1):
        if camera.camera in point.cameras:
            axes.plot(*point.point_m, "o", ms=14, mfc="white", mec="black", mew=1.3, zorder=5)
            axes.annotate(
                str(number),
                (point.point_m[0], point.point_m[1]),
                ha="center",
                va="center",
                fontsize=9,
                zorder=6,
            )
