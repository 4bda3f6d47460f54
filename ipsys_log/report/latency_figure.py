"""The latency ledger as a picture: how the steps share the time from a frame to its position."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ipsys_log.report.files import write_files
from ipsys_log.report.palette import NOTE
from ipsys_log.report.pictures import png, strip

__all__ = ["draw_latency"]

_COLOURS = {"detected": "#0072B2", "located": "#E69F00", "fused": "#009E73", "published": "#CC79A7"}


def draw_latency(times_s: Mapping[str, NDArray[np.float64]], path: Path) -> None:
    """Draw, into a PNG of 1200 x 600, what share of frames is through within which time, and each step of it.

    Parameters
    ----------
    times_s : of :func:`ipsys_log.latency.step_times_s`.
    """
    figure = Figure(figsize=(12, 6), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    total_ms = np.sort(times_s["total"]) * 1e3
    share = 100 * np.arange(1, len(total_ms) + 1) / len(total_ms)
    left.step(total_ms, share, where="post", color="black")
    for percent in (50, 99):
        at_ms = float(np.percentile(total_ms, percent))
        left.axvline(at_ms, color=NOTE, lw=0.8, ls="--")
        left.annotate(
            f"{percent} %: {at_ms:.1f} ms", (at_ms, 4), rotation=90, ha="right", va="bottom", fontsize=9
        )
    left.set(xlabel="ms from the arrival of a frame to its position", ylabel="% of positions", ylim=(0, 101))
    left.set_xlim(0, float(total_ms[-1]) * 1.05)
    strip(left)
    medians_ms = {step: float(np.median(times_s[step])) * 1e3 for step in _COLOURS}
    far_ms = {step: float(np.percentile(times_s[step], 99)) * 1e3 for step in _COLOURS}
    rows = np.arange(len(_COLOURS))
    right.barh(rows, list(far_ms.values()), color="#DDDDDD", label="99 %")
    right.barh(rows, list(medians_ms.values()), color=list(_COLOURS.values()), height=0.5, label="median")
    right.set_yticks(rows, list(_COLOURS))
    right.invert_yaxis()
    right.set(xlabel="ms for the step; grey: 99 % of positions")
    strip(right, "x")
    figure.suptitle(f"Latency of {len(total_ms)} positions", x=0.01, ha="left", fontsize=12)
    write_files(path.parent, {path.name: png(figure, 100)})
