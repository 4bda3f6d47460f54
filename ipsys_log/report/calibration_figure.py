"""Figure of a camera calibration: residuals in the image, as a scatter plot, and by image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from ipsys_log.calibration.calibrate import CalibrationResult
from ipsys_log.report.figures import style_axes
from ipsys_log.report.styles import NOTE, REST, shorten

# Colours from pale (small error) to dark (large error), readable with any colour vision.
_COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.2, 0.95, 256)))
# Length of the arrow of a usual error, as a share of the image's width.
_ARROW = 0.014
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
    ideal = _ARROW * width / max(float(np.median(lengths)), 1e-9)
    factor = max((f for f in _FACTORS if f <= ideal), default=1)
    top = float(np.quantile(lengths, 0.98))
    order = np.argsort(lengths, kind="stable")
    arrows = axes.quiver(
        *found.pixels[order].T, *found.residuals_px[order].T, lengths[order], cmap=_COLOURS, clim=(0, top),
        angles="xy", scale_units="xy", scale=1 / factor, width=0.0028, headwidth=3.5, zorder=3,
    )  # fmt: skip
    x, y = found.pixels[order].T
    axes.scatter(x, y, c=lengths[order], cmap=_COLOURS, vmin=0, vmax=top, s=5, lw=0, zorder=2)
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
    style_axes(axes)


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
    style_axes(axes, "x")
