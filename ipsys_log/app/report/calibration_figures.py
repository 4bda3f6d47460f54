"""Figures of calibrations: residuals in the images of a camera; poses and clocks of a joint calibration."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from ipsys_log.app.report import figures
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.styles import NOTE, REST, camera_styles, shorten
from ipsys_log.calibration.calibrate import CalibrationResult
from ipsys_log.messages import Rig
from ipsys_log.statistics.calibrated_cameras import CalibratedCamera
from ipsys_log.units import MM_PER_M

_MS_PER_S = 1000.0
# A page with many cameras shows so many images first.
_MOST_IMAGES = 4
# A residual that is usual in the image has an arrow of this share of the image's width.
_ARROW = 0.04


def poses_figure(cameras: Sequence[CalibratedCamera], rig: Rig | None) -> Figure:
    """Draw the cameras from above and from the side, each with its field of view on the floor."""
    if not figures.has_legend(len(cameras)):
        return _many_poses_figure(cameras, rig)
    figure = Figure(figsize=(figures.PAGE_IN, 7.0), layout="constrained")
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
    figure = Figure(figsize=(figures.PAGE_IN, 7.6), layout="constrained")
    above, heights, sigmas = figure.subplots(3, 1, height_ratios=[3.2, 1.0, 1.0])
    _draw_many_above(above, cameras, rig)
    places = range(len(cameras))
    sigmas_mm = np.array([camera.sigmas_m for camera in cameras]) * MM_PER_M
    heights_m = [float(camera.origin_m[2]) for camera in cameras]
    heights.errorbar(
        places, heights_m, 2 * sigmas_mm[:, 2] / MM_PER_M, fmt="o", color=NOTE, ms=3.5, capsize=2
    )
    heights.set_title("Height in m, with two standard deviations", loc="left", fontsize=10)
    sigmas.plot(places, np.hypot(*sigmas_mm[:, :2].T), "o", color=NOTE, ms=3.5)
    sigmas.set_title("Standard deviation of the place in mm", loc="left", fontsize=10)
    sigmas.set_ylim(bottom=0.0)
    names = [shorten(camera.camera) for camera in cameras]
    for axes in (heights, sigmas):
        axes.set_xticks(places, names, rotation=90)
        axes.ticklabel_format(axis="y", useOffset=False)
        figures.style_axes(axes)
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
    figures.name_cameras(axes, places_m, dict.fromkeys(places_m, NOTE))
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
    figures.style_axes(axes)


def _pose_label(camera: CalibratedCamera) -> str:
    flat_mm = float(np.hypot(*camera.sigmas_m[:2])) * MM_PER_M
    return (
        f"{shorten(camera.camera)}: height {camera.origin_m[2]:.3f} m ± {camera.sigmas_m[2] * MM_PER_M:.1f} "
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
    between, row_in = ("\n", 0.32) if figures.has_legend(len(cameras)) else ("  ", 0.2)
    figure, axes = figures.new_figure(1.3 + row_in * len(cameras))
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
    figures.style_axes(axes, "x")
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
    figure, axes = figures.new_figure(0.95 + figures.PAGE_IN * height / width)
    axes.add_patch(Rectangle((0, 0), width, height, fill=False, ec="black", lw=1.0))
    x_px, y_px = residuals.cells_px.T
    arrows = axes.quiver(
        x_px, y_px, *residuals.means_px.T, residuals.rms_px, cmap=figures.ERROR_COLOURS, angles="xy",
        scale_units="xy", scale=most_px / (_ARROW * width), width=0.005, zorder=3,
    )  # fmt: skip
    arrows.set_clim(0.0, most_px)
    axes.scatter(
        x_px, y_px, c=residuals.rms_px, cmap=figures.ERROR_COLOURS, vmin=0.0, vmax=most_px, s=5, zorder=4
    )
    axes.set(xlim=(-0.02 * width, 1.02 * width), ylim=(1.02 * height, -0.02 * height), aspect="equal")
    axes.set_xticks([0, width])
    axes.set_yticks([0, height])
    axes.spines[:].set_visible(False)
    label = f"{shorten(camera.camera)}: {residuals.total_rms_px:.3f} px RMS, {residuals.corners} corners"
    axes.set_title(label, loc="left", fontsize=9)
    bar = figures.add_bar(figure, arrows, axes, "residual in px, RMS of a cell", size=8)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()
    return figure


def first_residuals(cameras: Sequence[CalibratedCamera]) -> list[str]:
    """Return the cameras whose residuals a page shows first: of many, those with the largest ones."""
    rms_px = {one.camera: one.residuals.total_rms_px for one in cameras if one.residuals is not None}
    if figures.has_legend(len(rms_px)):
        return list(rms_px)
    return sorted(rms_px, key=lambda name: (-rms_px[name], name))[:_MOST_IMAGES]


def residual_limit_px(cameras: Sequence[CalibratedCamera]) -> float:
    """Return the residual of the last colour for all cameras: few cells have a larger one."""
    rms_px = [camera.residuals.rms_px for camera in cameras if camera.residuals is not None]
    everything = np.concatenate(rms_px) if rms_px else np.zeros(0)
    return float(np.quantile(everything, 0.95)) if len(everything) else 1.0


# Length of the arrow of a usual error, as a share of the image's width.
_USUAL_ARROW = 0.014
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
_MOST_NAMED = 30


def calibration_figure(found: Sequence[CalibrationResult]) -> Figure:
    """Return a figure with a row per camera: residuals in the image, as a scatter plot, and by image."""
    figure = Figure(figsize=(13.5, 4.4 * len(found)), layout="constrained")
    rows = figure.subplots(len(found), 3, squeeze=False, width_ratios=(1.5, 1.0, 1.2))
    for (image, cloud, pictures), calibrated in zip(rows, found, strict=True):
        _draw_image(image, calibrated)
        _draw_cloud(cloud, calibrated)
        _draw_pictures(pictures, calibrated)
    return figure


def _draw_image(axes: Axes, found: CalibrationResult) -> None:
    """Draw every detected corner, with an arrow to its projection by the fitted intrinsics."""
    width, height = found.lens.width, found.lens.height
    lengths = np.linalg.norm(found.residuals_px, axis=1)
    ideal = _USUAL_ARROW * width / max(float(np.median(lengths)), 1e-9)
    factor = max((f for f in _FACTORS if f <= ideal), default=1)
    top = float(np.quantile(lengths, 0.98))
    order = np.argsort(lengths, kind="stable")
    arrows = axes.quiver(
        *found.pixels[order].T, *found.residuals_px[order].T, lengths[order], cmap=figures.ERROR_COLOURS,
        clim=(0, top), angles="xy", scale_units="xy", scale=1 / factor, width=0.0028, headwidth=3.5, zorder=3,
    )  # fmt: skip
    x, y = found.pixels[order].T
    axes.scatter(x, y, c=lengths[order], cmap=figures.ERROR_COLOURS, vmin=0, vmax=top, s=5, lw=0, zorder=2)
    axes.plot(found.values[2], found.values[3], "+", color=NOTE, ms=12, zorder=4)
    axes.set(
        xlim=(-0.5, width - 0.5),
        ylim=(height - 0.5, -0.5),
        aspect="equal",
        xlabel="x in px",
        ylabel="y in px",
    )
    title = f"{shorten(found.camera)}: {found.coverage.share:.0%} of the image covered\n"
    axes.set_title(f"{title}arrows {factor} times true length, + principal point", loc="left", fontsize=10)
    assert axes.figure is not None
    axes.figure.colorbar(arrows, ax=axes, shrink=0.8, pad=0.02, extend="max", label="error in px")


def _draw_cloud(axes: Axes, found: CalibrationResult) -> None:
    lengths = np.linalg.norm(found.residuals_px, axis=1)
    reach = 1.15 * max(float(np.quantile(lengths, 0.99)), 2 * found.rms_px)
    inside = lengths <= reach
    axes.plot(*found.residuals_px[inside].T, "o", ms=2.5, color="#0072B2", mew=0, alpha=0.6)
    turn = np.linspace(0, 2 * np.pi, 100)
    axes.plot(found.rms_px * np.cos(turn), found.rms_px * np.sin(turn), color="#D55E00", lw=1.2)
    axes.axhline(0, color=REST, lw=0.7, zorder=0)
    axes.axvline(0, color=REST, lw=0.7, zorder=0)
    axes.set(
        xlim=(-reach, reach),
        ylim=(reach, -reach),
        aspect="equal",
        xlabel="error in x, px",
        ylabel="error in y, px",
    )
    outside = int((~inside).sum())
    title = f"RMS {found.rms_px:.3f} px (circle), median {found.median_px:.3f}"
    axes.set_title(title + (f"\n{outside} outside this plot" if outside else "\n"), loc="left", fontsize=10)
    figures.style_axes(axes)


def _draw_pictures(axes: Axes, found: CalibrationResult) -> None:
    """Draw the RMS of each image, the largest on top."""
    ranked = sorted(found.used, key=lambda used: used[1])[-_MOST_NAMED:]
    positions = np.arange(len(ranked))
    axes.barh(positions, [rms_px for _, rms_px in ranked], color="#56B4E9", height=0.75)
    size = float(np.clip(210 / len(ranked), 7, 9))
    axes.set_yticks(positions, [shorten(name) for name, _ in ranked], fontsize=size)
    axes.set(ylim=(-0.7, len(ranked) - 0.3), xlabel="RMS of an image in px")
    suffix = f", the worst {len(ranked)}" if len(ranked) < len(found.used) else ""
    axes.set_title(
        f"{len(found.used)} of {found.examined_count} images used{suffix}\n", loc="left", fontsize=10
    )
    figures.style_axes(axes, "x")
