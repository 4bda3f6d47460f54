"""A camera calibration as text, table, JSON and figure."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from rich.table import Table

from ipsys_log.calibration.calibrate import CalibrationResult
from ipsys_log.calibration.image_selection import ExcludedSighting
from ipsys_log.report.figures import NOTE, REST, shorten, style_axes

__all__ = ["calibration_figure", "calibration_json", "calibration_lines", "calibration_table"]

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


_SHOWN_DROPPED = 6


def calibration_table(found: CalibrationResult) -> Table:
    """Return a table of the intrinsics with their standard deviations."""
    title = f"{found.camera}: {found.lens.distortion_model}, {found.lens.width} x {found.lens.height} px"
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    table.add_column("", no_wrap=True)
    for name in ("value", "+- 1 sigma", ""):
        table.add_column(name, justify="left" if not name else "right", no_wrap=True)
    for n, name in enumerate(found.names):
        value, sigma = float(found.values[n]), float(found.sigmas[n])
        digits = 2 if n < 4 else 5
        note = "" if n >= 4 else "px"
        if n == 1 and found.square:
            note = "px, equal to fx: square pixels"
        spread = f"{sigma:.{digits}f}" if sigma > 0 else "not fitted"
        table.add_row(name, f"{value:.{digits}f}", spread, note)
    return table


def calibration_lines(found: CalibrationResult) -> list[str]:
    """Return lines on the quality of the result, and on the data that were left out."""
    coverage, counts = found.coverage, [f"{len(found.used)} used"]
    counts += [f"{len(found.dropped)} bad"] if found.dropped else []
    counts += [f"{len(found.spare)} not needed"] if found.spare else []
    lines = [
        f"reprojection error: RMS {found.rms_px:.3f} px, median {found.median_px:.3f} px, "
        f"{len(found.pixels)} corners",
        f"images: {found.examined_count} searched, board found in {found.seen}, {', '.join(counts)}",
        f"coverage: {coverage.share:.0%} of the image, up to {_degrees(coverage.widest_rad)} from the axis",
        f"          {coverage.position_count} board positions, "
        f"{coverage.tilted} tilted by 25 degrees or more",
    ]
    if found.outlier_corners:
        corners = "corner" if found.outlier_corners == 1 else "corners"
        lines.append(f"excluded: {found.outlier_corners} single {corners} with a large error")
    return lines + _dropped_lines(found.dropped, "excluded") + _dropped_lines(found.unseen, "board not found")


def _degrees(angle_rad: float | None) -> str:
    return "?" if angle_rad is None else f"{math.degrees(angle_rad):.0f} degrees"


def _dropped_lines(dropped: tuple[ExcludedSighting, ...], what: str) -> list[str]:
    """Return one line per reason for leaving out images, the most frequent reason first."""
    counts = Counter(drop.reason for drop in dropped)
    lines = []
    for reason, count in counts.most_common():
        names = [drop.name for drop in dropped if drop.reason == reason]
        shown = ", ".join(names[:3]) + (f" and {count - 3} more" if count > 3 else "")
        # The text of a reason is in the singular.
        text = re.sub("^is ", "are ", reason) if count > 1 else reason
        lines.append(f"{what}: {shown}: {text}")
    more = len(lines) - _SHOWN_DROPPED
    return lines if more <= 1 else [*lines[:_SHOWN_DROPPED], f"{what}: {more} more reasons (see --json)"]


def calibration_json(found: CalibrationResult) -> dict[str, Any]:
    """Return the result as plain data, without the single corners."""
    lens, coverage = found.lens, found.coverage
    return {
        "camera": found.camera,
        "width": lens.width,
        "height": lens.height,
        "distortion_model": lens.distortion_model,
        "parameters": dict(zip(found.names, found.values.tolist(), strict=True)),
        "standard_deviations": dict(zip(found.names, found.sigmas.tolist(), strict=True)),
        "square_pixels": found.square,
        "rms_px": found.rms_px,
        "median_px": found.median_px,
        "corners": len(found.pixels),
        "far_corners": found.outlier_corners,
        "pictures": {
            "looked_at": found.examined_count,
            "seen": found.seen,
            "used": [{"name": name, "rms_px": rms_px} for name, rms_px in found.used],
            "dropped": [drop._asdict() for drop in found.dropped],
            "not_needed": [drop._asdict() for drop in found.spare],
            "not_seen": [drop._asdict() for drop in found.unseen],
        },
        "coverage": {
            "share": coverage.share,
            "empty_sides": list(coverage.empty_sides),
            "places": coverage.position_count,
            "tilted": coverage.tilted,
            "widest_rad": coverage.widest_rad,
        },
        "notes": list(found.notes),
    }
