"""Figures of the disagreement of cameras in their overlap: over the floor, and over time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.patches import Rectangle

from ipsys_log.analysis.disagreement import PairDisagreement, divide_floor, divide_time
from ipsys_log.messages import Rig
from ipsys_log.report.figures import style_axes
from ipsys_log.report.floor_figure import draw_ground
from ipsys_log.report.html_figures import new_figure, picture
from ipsys_log.report.styles import robot_colour, shorten
from ipsys_log.units import CM_PER_M, MM_PER_M, NS_PER_S

_CELL_M = 0.25
# Lines of more pairs cannot be told apart.
_MOST_PAIRS = 6


def overlap_pictures(pairs: Sequence[PairDisagreement], rig: Rig | None) -> list[dict[str, Any]]:
    """Return the floor map of the median disagreement, and its time course for each pair of cameras."""
    return [_floor_picture(pairs, rig), _time_picture(pairs)]


def _floor_picture(pairs: Sequence[PairDisagreement], rig: Rig | None) -> dict[str, Any]:
    figure, axes = new_figure(5.4)
    draw_ground(axes, rig, [pair.points_m for pair in pairs])
    cells = divide_floor(pairs, _CELL_M)
    values_mm = np.array([cell.median_m for cell in cells]) * MM_PER_M
    # A few large values would hide the differences of the others.
    top_mm = float(np.percentile(values_mm, 95)) if len(cells) else 1.0
    shades = axes.scatter([], [], c=[], cmap="viridis_r", vmin=0.0, vmax=top_mm)
    for cell, value_mm in zip(cells, values_mm.tolist(), strict=True):
        corner = cell.x_m - _CELL_M / 2, cell.y_m - _CELL_M / 2
        axes.add_patch(Rectangle(corner, _CELL_M, _CELL_M, fc=shades.to_rgba(value_mm), lw=0, zorder=2))
    bar = figure.colorbar(shades, ax=axes, location="bottom", shrink=0.75, pad=0.02, extend="max", aspect=30)
    bar.set_label("median difference of two cameras in mm", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    return picture(
        figure,
        f"Disagreement of the cameras over the floor, all pairs, in cells of {_CELL_M * CM_PER_M:g} cm",
    )


def _time_picture(pairs: Sequence[PairDisagreement]) -> dict[str, Any]:
    figure, axes = new_figure(2.8)
    start_ns = min(int(pair.times_ns[0]) for pair in pairs)
    worst = sorted(pairs, key=lambda pair: -pair.median_m)[:_MOST_PAIRS]
    shown = [pair for pair in pairs if any(pair is one for one in worst)]
    for number, pair in enumerate(shown):
        intervals = divide_time(pair)
        times_s = np.array([one.time_ns - start_ns for one in intervals]) / NS_PER_S
        medians_mm = np.array([one.median_m for one in intervals]) * MM_PER_M
        p95_mm = np.array([one.p95_m for one in intervals]) * MM_PER_M
        colour, name = robot_colour(number), shorten(" and ".join(pair.cameras))
        axes.plot(times_s, medians_mm, ".-", color=colour, lw=1.4, ms=4, label=name)
        axes.plot(times_s, p95_mm, "--", color=colour, lw=0.9)
    axes.set(xlabel="time in s", ylabel="difference in mm", ylim=(0, None))
    style_axes(axes)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    few = (
        f". Shown are the {len(shown)} of {len(pairs)} pairs with the largest medians"
        if len(shown) < len(pairs)
        else ""
    )
    text = "Disagreement of the cameras over time: median (line) and 95 % limit (dashed)"
    return picture(figure, text + few)
