"""Figure of a measuring plan: the predicted error over the floor, before and after."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter

from ipsys_log.analysis.joint_plan import PlannedDrive
from ipsys_log.arrays import Array
from ipsys_log.report.figures import figure_bytes, legend_label, name_cameras
from ipsys_log.report.files import write_files
from ipsys_log.report.rows import means_cm
from ipsys_log.report.styles import NOTE, REST, camera_styles
from ipsys_log.survey.floor_plan import PlannedFloor, mesh
from ipsys_log.units import CM_PER_M

# Colours from pale (small error) to dark. They differ from the camera colours, and are distinct in grey too.
_HEAT = LinearSegmentedColormap.from_list("heat", ["#FBFDFF", "#DCE6F2", "#B3CBE3", "#86A9D0", "#5C84B8"])
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
        axes = figure.add_axes((left_in / 14, 0.93 / 7, _SIDE_IN / 14, _SIDE_IN / 7))
        shades = _draw_floor(axes, found, error_m * CM_PER_M, top_cm)
        axes.set_title(f"{heading}: {mean_cm} cm", loc="left", fontsize=11)
    box = figure.add_axes((12.7 / 14, 0.93 / 7, 0.18 / 14, _SIDE_IN / 7))
    figure.colorbar(shades, cax=box, extend="max", label="predicted 2D error in cm")
    title = f"Points to measure next: predicted mean error of model {found.model} over the floor, "
    title += f"for markers {found.height_m * CM_PER_M:.0f} cm above it"
    figure.text(0.6 / 14, 6.7 / 7, title, fontsize=12)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc=(0.035, 0.01), ncols=8, fontsize=9, frameon=False)
    write_files(path.parent, {path.name: figure_bytes(figure, path, 100)})


def _draw_floor(axes: Axes, found: PlannedFloor, error_cm: Array, top_cm: float) -> AxesImage:
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
