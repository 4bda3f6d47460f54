"""Figures of a joint calibration: camera poses, clock offsets, and the corner residuals in each image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from ipsys_log.analysis.calibrated_cameras import CalibratedCamera
from ipsys_log.messages import Rig
from ipsys_log.report.figures import has_legend, name_cameras, style_axes
from ipsys_log.report.floor_figure import draw_ground
from ipsys_log.report.styles import NOTE, camera_styles, shorten

_MM_PER_M = 1000.0
_MS_PER_S = 1000.0
# Colours from pale (small residual) to dark, readable with any colour vision.
_COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.2, 0.95, 256)))
_WIDTH_IN = 4.7
# A page with many cameras shows so many images first.
_MOST_IMAGES = 4
# A residual that is usual in the image has an arrow of this share of the image's width.
_ARROW = 0.04


def poses_figure(cameras: Sequence[CalibratedCamera], rig: Rig | None) -> Figure:
    """Draw the cameras from above and from the side, each with its field of view on the floor."""
    if not has_legend(len(cameras)):
        return _many_poses_figure(cameras, rig)
    figure = Figure(figsize=(_WIDTH_IN, 7.0), layout="constrained")
    above, beside = figure.subplots(2, 1, height_ratios=[3.2, 1.4])
    _draw_above(above, cameras, rig)
    # Seen along the shorter direction, cameras in a row do not hide one another.
    axis = int(np.argmax(np.ptp([camera.origin_m[:2] for camera in cameras], axis=0)))
    _draw_beside(beside, cameras, axis)
    beside.set_xlim(above.get_ylim() if axis else above.get_xlim())
    for axes in (above, beside):
        axes.tick_params(labelsize=8)
    figure.legend(loc="outside lower center", frameon=False, fontsize=8)
    return figure


def _many_poses_figure(cameras: Sequence[CalibratedCamera], rig: Rig | None) -> Figure:
    """Draw many cameras from above, and their heights and uncertainties side by side.

    Their views overlap, so that only the shade shows how many cameras see a place.
    """
    figure = Figure(figsize=(_WIDTH_IN, 7.6), layout="constrained")
    above, heights, sigmas = figure.subplots(3, 1, height_ratios=[3.2, 1.0, 1.0])
    _draw_many_above(above, cameras, rig)
    places = range(len(cameras))
    sigmas_mm = np.array([camera.sigmas_m for camera in cameras]) * _MM_PER_M
    heights_m = [float(camera.origin_m[2]) for camera in cameras]
    heights.errorbar(
        places, heights_m, 2 * sigmas_mm[:, 2] / _MM_PER_M, fmt="o", color=NOTE, ms=3.5, capsize=2
    )
    heights.set_title("Height in m, with two standard deviations", loc="left", fontsize=10)
    sigmas.plot(places, np.hypot(*sigmas_mm[:, :2].T), "o", color=NOTE, ms=3.5)
    sigmas.set_title("Standard deviation of the place in mm", loc="left", fontsize=10)
    sigmas.set_ylim(bottom=0.0)
    names = [shorten(camera.camera) for camera in cameras]
    for axes in (heights, sigmas):
        axes.set_xticks(places, names, rotation=90)
        axes.ticklabel_format(axis="y", useOffset=False)
        style_axes(axes)
    for axes in (above, heights, sigmas):
        axes.tick_params(labelsize=8)
    return figure


def _draw_many_above(axes: Axes, cameras: Sequence[CalibratedCamera], rig: Rig | None) -> None:
    draw_ground(axes, rig, [camera.origin_m[None, :2] for camera in cameras])
    for camera in cameras:
        if len(camera.outline_m):
            axes.add_patch(Polygon(camera.outline_m, fc=NOTE, ec="none", alpha=0.05, zorder=1.1))
        axes.plot(*camera.origin_m[:2], "o", color=NOTE, ms=4, zorder=4)
        _draw_axis(axes, camera, NOTE)
    beside_m = 0.03 * float(np.ptp(axes.get_ylim()))
    places_m = {camera.camera: camera.origin_m[:2] - [0.0, beside_m] for camera in cameras}
    name_cameras(axes, places_m, dict.fromkeys(places_m, NOTE))
    axes.set_title("From above", loc="left", fontsize=10)


def _draw_above(axes: Axes, cameras: Sequence[CalibratedCamera], rig: Rig | None) -> None:
    around_m = [part for camera in cameras for part in (camera.outline_m, camera.origin_m[None, :2])]
    draw_ground(axes, rig, [part for part in around_m if len(part)])
    styles = camera_styles(camera.camera for camera in cameras)
    for camera in cameras:
        colour, shape = styles[camera.camera]
        if len(camera.outline_m):
            axes.add_patch(Polygon(camera.outline_m, fill=False, ec=colour, lw=1.5))
        x_m, y_m, _ = camera.origin_m.tolist()
        axes.plot(x_m, y_m, shape, color=colour, ms=8, label=_pose_label(camera), zorder=4)
        _draw_axis(axes, camera, colour)
    axes.set_title("From above", loc="left", fontsize=10)


def _draw_beside(axes: Axes, cameras: Sequence[CalibratedCamera], axis: int) -> None:
    """Draw heights over x (axis 0) or y (axis 1), with the outermost rays to the floor."""
    styles = camera_styles(camera.camera for camera in cameras)
    for camera in cameras:
        colour, shape = styles[camera.camera]
        across_m, height_m = camera.origin_m[[axis, 2]].tolist()
        axes.plot(across_m, height_m, shape, color=colour, ms=8, zorder=4)
        for end_m in _ends_m(camera, axis):
            axes.plot([across_m, end_m], [height_m, 0.0], color=colour, lw=1.0)
    axes.axhline(0.0, color=NOTE, lw=1.2)
    axes.set(xlabel=f"{'xy'[axis]} in m", ylabel="height in m")
    axes.set_ylim(bottom=0.0, top=1.15 * max(float(camera.origin_m[2]) for camera in cameras))
    axes.set_title(f"From the side, along {'yx'[axis]}", loc="left", fontsize=10)
    style_axes(axes)


def _pose_label(camera: CalibratedCamera) -> str:
    flat_mm = float(np.hypot(*camera.sigmas_m[:2])) * _MM_PER_M
    return (
        f"{shorten(camera.camera)}: height {camera.origin_m[2]:.3f} m ± {camera.sigmas_m[2] * _MM_PER_M:.1f} "
        f"mm, place ± {flat_mm:.1f} mm"
    )


def _draw_axis(axes: Axes, camera: CalibratedCamera, colour: str) -> None:
    """Draw an arrow from the camera to the point of the floor on its optical axis."""
    if camera.axis[2] >= 0:
        return
    start_m = camera.origin_m[:2]
    end_m = start_m - camera.axis[:2] * camera.origin_m[2] / camera.axis[2]
    axes.annotate("", tuple(end_m), tuple(start_m), arrowprops={"arrowstyle": "->", "color": colour})


def _ends_m(camera: CalibratedCamera, axis: int) -> list[float]:
    """Return the x or y of the outermost points of the field of view."""
    if not len(camera.outline_m):
        return []
    return [float(camera.outline_m[:, axis].min()), float(camera.outline_m[:, axis].max())]


def has_clocks(cameras: Sequence[CalibratedCamera]) -> bool:
    """Return whether a drive determined a clock offset."""
    return any(camera.clock_sigma_s > 0 for camera in cameras)


def clocks_figure(cameras: Sequence[CalibratedCamera]) -> Figure:
    """Draw the clock offset of each camera with two standard deviations."""
    # The labels of many cameras have one line.
    between, row_in = ("\n", 0.32) if has_legend(len(cameras)) else ("  ", 0.2)
    figure = Figure(figsize=(_WIDTH_IN, 1.3 + row_in * len(cameras)), layout="constrained")
    axes = figure.add_subplot()
    styles = camera_styles(camera.camera for camera in cameras)
    labels = []
    for row, camera in enumerate(cameras):
        colour, shape = styles[camera.camera]
        offset_ms, sigma_ms = camera.clock_s * _MS_PER_S, camera.clock_sigma_s * _MS_PER_S
        axes.errorbar(offset_ms, row, xerr=2 * sigma_ms, fmt=shape, color=colour, ms=6, capsize=3)
        text = f"{offset_ms:+.2f} ± {sigma_ms:.2f} ms" if sigma_ms else "constant"
        labels.append(f"{shorten(camera.camera)}{between}{text}")
    axes.axvline(0.0, color=NOTE, lw=1.0)
    axes.set_yticks(range(len(cameras)), labels)
    axes.set_ylim(len(cameras) - 0.5, -0.5)
    axes.set_xlabel("time to add to the stamps, in ms")
    style_axes(axes, "x")
    axes.tick_params(labelsize=8)
    return figure


def residuals_figure(camera: CalibratedCamera, most_px: float) -> Figure:
    """Draw the mean corner residuals over the image of a camera.

    Parameters
    ----------
    camera : with residuals.
    most_px : residual of the last colour; the same for all cameras.
    """
    assert camera.residuals is not None
    assert camera.size_px is not None
    (width, height), residuals = camera.size_px, camera.residuals
    figure = Figure(figsize=(_WIDTH_IN, 0.95 + _WIDTH_IN * height / width), layout="constrained")
    axes = figure.add_subplot()
    axes.add_patch(Rectangle((0, 0), width, height, fill=False, ec="black", lw=1.0))
    x_px, y_px = residuals.cells_px.T
    arrows = axes.quiver(
        x_px, y_px, *residuals.means_px.T, residuals.rms_px, cmap=_COLOURS, angles="xy",
        scale_units="xy", scale=most_px / (_ARROW * width), width=0.005, zorder=3,
    )  # fmt: skip
    arrows.set_clim(0.0, most_px)
    axes.scatter(x_px, y_px, c=residuals.rms_px, cmap=_COLOURS, vmin=0.0, vmax=most_px, s=5, zorder=4)
    axes.set(xlim=(-0.02 * width, 1.02 * width), ylim=(1.02 * height, -0.02 * height), aspect="equal")
    axes.set_xticks([0, width])
    axes.set_yticks([0, height])
    axes.tick_params(labelsize=8)
    axes.spines[:].set_visible(False)
    label = f"{shorten(camera.camera)}: {residuals.total_rms_px:.3f} px RMS, {residuals.corners} corners"
    axes.set_title(label, loc="left", fontsize=9)
    bar = figure.colorbar(arrows, ax=axes, location="bottom", shrink=0.75, pad=0.02, extend="max", aspect=30)
    bar.set_label("residual in px, RMS of a cell", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()
    return figure


def first_residuals(cameras: Sequence[CalibratedCamera]) -> list[str]:
    """Return the cameras whose residuals a page shows first: of many, those with the largest ones."""
    rms_px = {one.camera: one.residuals.total_rms_px for one in cameras if one.residuals is not None}
    if has_legend(len(rms_px)):
        return list(rms_px)
    return sorted(rms_px, key=lambda name: (-rms_px[name], name))[:_MOST_IMAGES]


def residual_limit_px(cameras: Sequence[CalibratedCamera]) -> float:
    """Return the residual of the last colour for all cameras: few cells have a larger one."""
    rms_px = [camera.residuals.rms_px for camera in cameras if camera.residuals is not None]
    everything = np.concatenate(rms_px) if rms_px else np.zeros(0)
    return float(np.quantile(everything, 0.95)) if len(everything) else 1.0
