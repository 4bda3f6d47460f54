"""Figures of comparisons: the paths over the floor, and the errors over time and over distance."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ipsys_log.app.report.figures import PAGE_IN, new_figure, save_figure, style_axes
from ipsys_log.app.report.floor_figure import draw_ground
from ipsys_log.app.report.html_figures import Picture, picture
from ipsys_log.app.report.styles import NOTE, robot_colour, robot_line, shorten
from ipsys_log.messages import Array, Rig
from ipsys_log.statistics.path_pairs import gap_limit_s
from ipsys_log.tools.comparison import Comparison
from ipsys_log.units import CM_PER_M, NS_PER_S


def draw_comparisons(found: Sequence[Comparison], rig: Rig | None, path: Path) -> None:
    """Draw the paths of estimates and of their robots, and the errors, into a figure of 1400 x 700 pixels."""
    figure = Figure(figsize=(14, 7), dpi=100, layout="constrained")
    places = figure.subplot_mosaic([["floor", "time"], ["floor", "distance"]], width_ratios=(1, 1))
    _draw_paths(places["floor"], found, rig)
    _draw_errors(places["time"], found, "time")
    _draw_errors(places["distance"], found, "distance")
    if any(one.score.tracks_m is not None for one in found):
        places["floor"].plot([], [], ":", color=NOTE, lw=0.8, label="expected error of the tracks")
    figure.legend(
        *places["floor"].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False
    )
    save_figure(figure, path)


def comparison_pictures(found: Sequence[Comparison], rig: Rig | None) -> list[Picture]:
    """Return the same figures for a page."""
    floor, axes = new_figure(5.4)
    _draw_paths(axes, found, rig)
    floor.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    errors = Figure(figsize=(PAGE_IN, 5.4), layout="constrained")
    for axes, over in zip(errors.subplots(2), ("time", "distance"), strict=True):
        _draw_errors(axes, found, over)
    return [
        picture(floor, "Estimates after their alignment, and the tracks as ground truth, seen from above"),
        picture(errors, "Absolute error of each estimate over time and over the distance, in 3D"),
    ]


def _draw_paths(axes: Axes, found: Sequence[Comparison], rig: Rig | None) -> None:
    draw_ground(axes, rig, [one.score.true_m[:, :2] for one in found])
    for number, one in enumerate(found):
        aligned_m = one.score.after(one.alignment).points_m
        label = None if number else "tracks (ground truth)"
        axes.plot(
            *_broken(one, one.score.true_m)[:, :2].T, "--", color="black", lw=0.9, label=label, zorder=2.5
        )
        colour, line = robot_colour(number), robot_line(number)
        drawn_m = _broken(one, aligned_m)[:, :2]
        axes.plot(*drawn_m.T, line, marker=".", ms=2.2, color=colour, lw=1.6, label=shorten(_name(one)))


def _draw_errors(axes: Axes, found: Sequence[Comparison], over: str) -> None:
    start_ns = min(int(one.score.times_ns[0]) for one in found)
    for number, one in enumerate(found):
        score = one.score
        errors_cm = CM_PER_M * np.linalg.norm(score.after(one.alignment).errors.offsets_m, axis=1)
        along = (score.times_ns - start_ns) / NS_PER_S if over == "time" else score.passed_m
        rows = _broken(one, np.column_stack([along, errors_cm]))
        # The dots show single poses, which have no visible line.
        axes.plot(*rows.T, robot_line(number), marker=".", ms=2.2, color=robot_colour(number), lw=1.2)
        if score.tracks_m is not None:
            axes.axhline(CM_PER_M * score.tracks_m, color=NOTE, lw=0.8, ls=":")
    unit = "time in s" if over == "time" else "distance in m"
    axes.set(xlabel=unit, ylabel="error in cm", ylim=(0, None))
    axes.tick_params(labelsize=8)
    style_axes(axes)


def _broken(one: Comparison, rows: Array) -> Array:
    """Return rows (n, k) with NaN where the tracks or the estimate have a gap."""
    times_s = one.score.times_ns / NS_PER_S
    gaps = np.flatnonzero(np.diff(times_s) > gap_limit_s(times_s)) + 1
    return np.insert(rows, gaps, np.nan, axis=0)


def _name(one: Comparison) -> str:
    return f"{one.record.run}: {one.robot}"
