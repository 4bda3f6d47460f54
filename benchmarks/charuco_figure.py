"""Figure of the models of the ChArUco videos: errors of each camera, and clock offsets."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ipsys_log.app.report.figures import figure_bytes, style_axes
from ipsys_log.app.report.styles import REST, camera_styles, model_styles

__all__ = ["draw_errors"]

_MODELS = ("simultaneous", "timed")
_WIDTH = 0.38


def draw_errors(path: Path, figures: Mapping[str, Any]) -> None:
    """Write the errors of both models, in sample and held out, and the clock offsets.

    Parameters
    ----------
    path : file, such as ``errors.png``.
    figures : results of the benchmark ``charuco_videos``.
    """
    figure = Figure(figsize=(10.0, 3.4), layout="constrained")
    in_sample, held_out, clocks = figure.subplots(1, 3)
    titles = {"in_sample": "frames of the fit", "held_out": "held-out frames"}
    for axes, part in ((in_sample, "in_sample"), (held_out, "held_out")):
        _draw_bars(axes, figures, part)
        axes.set_title(titles[part], loc="left", fontsize=10)
    in_sample.set_ylabel("reprojection RMSE in px")
    _draw_clocks(clocks, figures)
    path.write_bytes(figure_bytes(figure, path))


def _draw_bars(axes: Axes, figures: Mapping[str, Any], part: str) -> None:
    cameras = figures["cameras"]
    colours = {"simultaneous": REST, "timed": model_styles(["joint"])["joint"].colour}
    for number, model in enumerate(_MODELS):
        errors = figures[model][part]
        x = np.arange(len(cameras)) + (number - 0.5) * _WIDTH
        label = f"{model}: {errors['rmse_px']:.2f} px"
        axes.bar(x, errors["by_camera_px"], _WIDTH, color=colours[model], label=label, zorder=2)
    axes.set_xticks(range(len(cameras)), cameras)
    axes.legend(frameon=False, fontsize=9, loc="upper right")
    axes.set_ylim(0, 1.3 * axes.get_ylim()[1])
    style_axes(axes)


def _draw_clocks(axes: Axes, figures: Mapping[str, Any]) -> None:
    cameras, timed = figures["cameras"], figures["timed"]
    styles = camera_styles(cameras)
    for number, camera in enumerate(cameras):
        colour, shape = styles[camera]
        offset_ms, sigma_ms = timed["clocks_ms"][number], timed["clock_sigmas_ms"][number]
        axes.errorbar(number, offset_ms, sigma_ms, fmt=shape, color=colour, ms=7, capsize=3, zorder=3)
        text = "reference" if number == 0 else f"{offset_ms:.0f} ± {sigma_ms:.1f}"
        axes.annotate(text, (number, offset_ms), (0, 9), textcoords="offset points", ha="center", fontsize=9)
    axes.axhline(0, color=REST, lw=0.8, zorder=1)
    axes.margins(x=0.15, y=0.2)
    axes.set_xticks(range(len(cameras)), cameras)
    axes.set_ylabel("clock offset in ms")
    axes.set_title("clocks of the cameras, timed model", loc="left", fontsize=10)
    style_axes(axes)
