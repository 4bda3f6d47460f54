"""Figure of the latency: the time from a frame to its position, and the parts of the steps."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ipsys_log.app.report.figures import save_figure, style_axes
from ipsys_log.app.report.styles import NOTE

_STEPS = ("detected", "located", "fused", "published")
_NEAR, _FAR = "#0072B2", "#D3D7DB"
# The axis ends at this many times the 99th percentile. A few late positions would make it too long.
_SHOWN = 1.6


def draw_latency(times_s: Mapping[str, NDArray[np.float64]], path: Path) -> None:
    """Draw the cumulative distribution of the latency, and the duration of each step.

    A file in pixels has 1200 x 600 pixels.
    """
    figure = Figure(figsize=(12, 6), dpi=100)
    left = figure.add_axes((0.07, 0.11, 0.42, 0.73))
    right = figure.add_axes((0.6, 0.11, 0.37, 0.73))
    total_ms = np.sort(times_s["total"]) * 1e3
    draw_shares(left, total_ms)
    draw_steps(right, times_s)
    figure.text(0.07, 0.94, f"Latency of {len(total_ms)} positions", fontsize=12)
    save_figure(figure, path)


def draw_shares(axes: Axes, total_ms: NDArray[np.float64], is_narrow: bool = False) -> None:
    """Draw the share of positions within a latency.

    Parameters
    ----------
    total_ms : (n,), latencies in ascending order.
    is_narrow : the figure is as wide as a phone; the legend gets a line for each entry.
    """
    share = 100 * np.arange(1, len(total_ms) + 1) / len(total_ms)
    axes.step(
        total_ms, share, where="post", color="black", label=f"all positions; longest {total_ms[-1]:.1f} ms"
    )
    median_ms, far_ms = np.percentile(total_ms, [50, 99]).tolist()
    for name, value_ms, dashes in (("median", median_ms, "--"), ("99 %", far_ms, ":")):
        axes.axvline(value_ms, color=NOTE, lw=1.2, ls=dashes, label=f"{name} {value_ms:.1f} ms")
    axes.set(
        xlabel="latency in ms" if is_narrow else "latency in ms, from the arrival of a frame to its position",
        ylabel="positions in %",
        ylim=(0, 101),
    )
    axes.set_xlim(0, min(float(total_ms[-1]) * 1.05, _SHOWN * far_ms))
    style_axes(axes)
    _key(axes, 1 if is_narrow else 3)


def draw_steps(axes: Axes, times_s: Mapping[str, NDArray[np.float64]]) -> None:
    """Draw the median and the 99th percentile of the duration of each step."""
    rows = np.arange(len(_STEPS))
    steps_ms = np.array([np.percentile(times_s[step], [50, 99]) for step in _STEPS]) * 1e3
    axes.barh(rows, steps_ms[:, 1], color=_FAR, label="99 % of positions")
    axes.barh(rows, steps_ms[:, 0], color=_NEAR, height=0.5, label="median")
    for row, (median_ms, far_ms) in enumerate(steps_ms):
        text = f"{median_ms:.1f}, 99 %: {far_ms:.1f}"
        axes.annotate(text, (far_ms, row), (5, 0), textcoords="offset points", va="center", fontsize=9)
    axes.set_xlim(0, 1.5 * float(steps_ms[:, 1].max()))
    axes.set_yticks(rows, _STEPS)
    axes.invert_yaxis()
    axes.set(xlabel="duration of the step in ms")
    style_axes(axes, "x")
    _key(axes)


def _key(axes: Axes, columns: int = 3) -> None:
    """Draw the legend above the axes, outside of the data."""
    axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.0), ncols=columns, fontsize=9, frameon=False)
