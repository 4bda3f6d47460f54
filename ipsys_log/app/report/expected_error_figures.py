"""Figures of the expected error over the floor: of a joint calibration, and of a measuring plan."""

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
from scipy.ndimage import gaussian_filter

from ipsys_log.app.report.figures import add_panel, has_legend, legend_label, name_cameras, save_figure
from ipsys_log.app.report.floor_figure import draw_references
from ipsys_log.app.report.rows import means_cm
from ipsys_log.app.report.styles import NOTE, REST, camera_styles, shorten
from ipsys_log.live_runs.survey.floor_plan import PlannedFloor, mesh
from ipsys_log.live_runs.survey.lab_calibration import CameraResult, LabCalibration
from ipsys_log.messages import Array
from ipsys_log.statistics.joint_plan import PlannedDrive
from ipsys_log.units import CM_PER_M, MM_PER_M

# Colours from pale (small error) to dark. They differ from the camera colours, and are distinct in grey too.
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
        axes = add_panel(figure, left_in, bottom_in, panels.width_in, panels.height_in)
        shades = _draw_camera(axes, lab, camera, top_mm, panels.point_pt)
        axes.set_ylabel("y in m" if column == 0 else "")
        if not has_legend(len(shown)):
            axes.set_xlabel("x in m" if number + panels.columns >= len(shown) else "")
            axes.tick_params(labelsize=8, labelleft=column == 0)
    right_in = _LEFT_IN + panels.columns * (panels.width_in + panels.gap_in) - 0.2
    bar_in = max(panels.height_in, min(4.0, rows * panels.row_in - panels.between_in))
    box = add_panel(figure, right_in, _BOTTOM_IN, 0.18, bar_in)
    figure.colorbar(shades, cax=box, extend="max", label="expected 2D error in mm")
    title = f"Expected error over the floor: mean {lab.mean_m * MM_PER_M:.1f} mm, "
    title += f"for markers {lab.height_m * 100:.0f} cm above it"
    figure.text(_LEFT_IN / width_in, 1 - 0.28 / height_in, title, fontsize=12)
    handles, labels = axes.get_legend_handles_labels()
    location = ((_LEFT_IN - 0.15) / width_in, 0.08 / height_in)
    figure.legend(handles, labels, loc=location, ncols=5, fontsize=9, frameon=False)
    save_figure(figure, path)


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
        *lab.points_m.T, "o", mfc="black", mec="white", ms=point_pt, mew=point_pt / 6, zorder=4,
        label="calibration point",
    )  # fmt: skip
    if lab.points:
        _draw_points(axes, lab, camera)
    if lab.gap is not None and not lab.is_enough and lab.gap.camera == camera.camera:
        x_m, y_m = lab.gap.low_m - half_m
        size_m = lab.gap.high_m - lab.gap.low_m + 2 * half_m
        axes.add_patch(Rectangle((x_m, y_m), *size_m, fill=False, ec="#D55E00", lw=1.8, ls="--", zorder=4))
    draw_references(axes, lab.rig.reference_points)
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
            x_m, y_m = point.point_m
            axes.plot(x_m, y_m, "o", ms=14, mfc="white", mec="black", mew=1.3, zorder=5)
            axes.annotate(str(number), (x_m, y_m), ha="center", va="center", fontsize=9, zorder=6)


_SIDE_IN = 5.35
# Points that are closer than this share of the floor have a common ring.
_RING = 0.04


def draw_plan(found: PlannedFloor, path: Path) -> None:
    """Draw the predicted error over the floor, now and with the planned points.

    A file in pixels has 1400 x 700 pixels.
    """
    figure = Figure(figsize=(14, 7), dpi=100)
    plan, count = found.plan, len(found.plan.places)
    after_title = "With this point" if count == 1 else f"With these {count} points"
    # A few cells with large errors must not use most of the colour range.
    top_cm = float(np.nanquantile(plan.before_m, 0.98)) * CM_PER_M
    means = means_cm(plan.places[0].mean_before_m, plan.places[-1].mean_after_m)
    panels = zip((0.6, 6.9), (plan.before_m, plan.after_m), ("Now", after_title), means, strict=True)
    for left_in, error_m, heading, mean_cm in panels:
        axes = add_panel(figure, left_in, 0.93, _SIDE_IN, _SIDE_IN)
        shades = _draw_plan_map(axes, found, error_m * CM_PER_M, top_cm)
        axes.set_title(f"{heading}: {mean_cm} cm", loc="left", fontsize=11)
    box = add_panel(figure, 12.7, 0.93, 0.18, _SIDE_IN)
    figure.colorbar(shades, cax=box, extend="max", label="predicted 2D error in cm")
    title = f"Points to measure next: predicted mean error of model {found.model} over the floor, "
    title += f"for markers {found.height_m * CM_PER_M:.0f} cm above it"
    figure.text(0.6 / 14, 6.7 / 7, title, fontsize=12)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc=(0.035, 0.01), ncols=8, fontsize=9, frameon=False)
    save_figure(figure, path)


def _draw_plan_map(axes: Axes, found: PlannedFloor, error_cm: Array, top_cm: float) -> AxesImage:
    shape, half_m = (len(found.ys_m), len(found.xs_m)), (found.xs_m[1] - found.xs_m[0]) / 2
    (left, right), (low, high) = ((m[0] - half_m, m[-1] + half_m) for m in (found.xs_m, found.ys_m))
    frame = (left, right, low, high)
    shades = axes.imshow(
        error_cm.reshape(shape), cmap=_HEAT, vmin=0, vmax=top_cm, origin="lower", extent=frame, zorder=1
    )
    axes.add_patch(Rectangle((left, low), right - left, high - low, fill=False, ec="black", lw=1.2, zorder=2))
    _draw_views(axes, found, shape, half_m)
    if np.isnan(error_cm).any():
        axes.plot([], [], "s", ms=9, mfc="white", mec=REST, label="seen by no camera")
    axes.plot(*found.measured_m[:, :2].T, "o", color=NOTE, ms=3, zorder=3, label="measured")
    axes.plot([], [], "o", ms=9, mfc="white", mec="black", mew=1.2, label="to measure, in this order")
    # On a large floor, the map shows only the part that the cameras see.
    seen_m = mesh(found.xs_m, found.ys_m, [0.0])[~np.isnan(error_cm), :2]
    shown_m = np.vstack([seen_m - half_m, seen_m + half_m, found.measured_m[:, :2]])
    middle_m, span_m = (shown_m.max(axis=0) + shown_m.min(axis=0)) / 2, float(np.ptp(shown_m, axis=0).max())
    _draw_rings(axes, found, _RING * span_m)
    if found.drive is not None and found.drive.is_useful:
        axes.add_patch(_drive_area(found.drive))
    (x0, y0), (x1, y1) = middle_m - 0.52 * span_m, middle_m + 0.52 * span_m
    axes.set(xlim=(x0, x1), ylim=(y0, y1), xlabel="x in m", ylabel="y in m")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(7, steps=[1, 2, 5, 10]))
    axes.spines[:].set_visible(False)
    return shades


def _drive_area(drive: PlannedDrive) -> Rectangle:
    width_m, depth_m = (drive.high_m - drive.low_m).tolist()
    corner_m = float(drive.low_m[0]), float(drive.low_m[1])
    return Rectangle(
        corner_m, width_m, depth_m, fill=False, ec=NOTE, lw=1.8, ls="--", zorder=4, label="or drive here"
    )


def _draw_views(axes: Axes, found: PlannedFloor, shape: tuple[int, int], half_m: float) -> None:
    """Draw the outline of each camera's field of view, smoothed to hide the steps of the cells."""
    around_m = [np.array([m[0] - 2 * half_m, *m, m[-1] + 2 * half_m]) for m in (found.xs_m, found.ys_m)]
    styles = camera_styles(found.plan.seen)
    places_m = mesh(found.xs_m, found.ys_m, [0.0])[:, :2]
    middles_m = {name: places_m[seen].mean(axis=0) for name, seen in found.plan.seen.items() if seen.any()}
    name_cameras(axes, middles_m, {name: colour for name, (colour, _) in styles.items()})
    for camera, (colour, _) in styles.items():
        seen = gaussian_filter(found.plan.seen[camera].reshape(shape).astype(float), 2.0, mode="nearest")
        axes.contour(*around_m, np.pad(seen, 1), levels=[0.5], colors=[colour], linewidths=1.8, zorder=3)
        axes.plot([], [], color=colour, lw=1.8, label=legend_label(f"seen by {camera}", len(styles)))


def _draw_rings(axes: Axes, found: PlannedFloor, width_m: float) -> None:
    """Draw the numbers of the planned points, and the names of the reference points beside these numbers."""
    rings: list[tuple[Array, str]] = []
    for number, place in enumerate(found.plan.places, 1):
        center_m = place.point_m[:2]
        near = [n for n, (other_m, _) in enumerate(rings) if np.hypot(*(center_m - other_m)) < width_m]
        if near:
            rings[near[0]] = (rings[near[0]][0], f"{rings[near[0]][1]},{number}")
        else:
            rings.append((center_m, str(number)))
    for (x_m, y_m), text in rings:
        axes.plot(x_m, y_m, "o", ms=15, mfc="white", mec="black", mew=1.4, zorder=5)
        size = 9 if len(text) < 3 else 20 / len(text)
        axes.annotate(text, (x_m, y_m), ha="center", va="center", fontsize=size, zorder=6)
    for point in found.rig.reference_points:
        axes.plot(point.x_m, point.y_m, "+", color="black", ms=11, mew=1.6, zorder=4)
        away_m = min((np.array([point.x_m, point.y_m]) - m for m, _ in rings), key=lambda m: np.hypot(*m))
        x, y = (1 if d >= -1e-9 else -1 for d in away_m)
        axes.annotate(
            point.name, (point.x_m, point.y_m), (6 * x, 6 * y), textcoords="offset points", weight="bold",
            ha="left" if x > 0 else "right", va="bottom" if y > 0 else "top", zorder=6,
        )  # fmt: skip
