"""Picture of the error over the floor: a row for each calibration, a column for each camera."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PathCollection
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).resolve().parent.parent))

from ipsys_log.app.report.figures import figure_bytes, style_axes
from ipsys_log.app.report.styles import shorten
from ipsys_log.capture.simulation.settings import FLOOR_M
from ipsys_log.statistics.floor_cameras import GRID_M
from tests.geometric.floor_error import SightingErrors

__all__ = ["draw_floor_map"]

Array = NDArray[np.float64]

# Colours from pale (small error) to dark (large error), readable with any colour vision.
_COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.05, 0.95, 256)))
_MM = 1000.0
# Arrows point from the true to the located position. They stand at every n-th node in both directions.
_EVERY, _ARROW_M = 6, 0.5


def draw_floor_map(
    path: Path, maps: Mapping[str, Sequence[SightingErrors]], measured_m: Array, title: str
) -> None:
    """Write a map of the errors of each calibration, with the measured points.

    Parameters
    ----------
    path : file, such as ``floor.png``.
    maps : errors at the nodes of the floor, by calibration and camera.
    measured_m : (p, 2), measured points.
    title : of the figure.
    """
    columns = len(next(iter(maps.values())))
    figure = Figure(figsize=(3.6 * columns + 1.2, 3.7 * len(maps)), layout="constrained")
    rows = figure.subplots(len(maps), columns, squeeze=False, sharex=True, sharey=True)
    lengths = [np.linalg.norm(one.errors_m, axis=1) for errors in maps.values() for one in errors]
    top_mm = _MM * float(np.nanpercentile(np.concatenate(lengths), 97))
    for row, (name, errors) in zip(rows, maps.items(), strict=True):
        for axes, one in zip(row, errors, strict=True):
            cloud = _draw(axes, one, measured_m, top_mm)
            mean_mm = _MM * float(np.nanmean(np.linalg.norm(one.errors_m, axis=1)))
            label = f"{shorten(name)}, {shorten(one.sightings.camera)}: mean {mean_mm:.2f} mm"
            axes.set_title(label, loc="left", fontsize=10)
        row[0].set_ylabel("y in m")
        figure.colorbar(cloud, ax=list(row), shrink=0.85, pad=0.02, extend="max", label="2D error in mm")
    for axes in rows[-1]:
        axes.set_xlabel("x in m")
    figure.suptitle(f"{title}: error over the floor, o measured points", x=0.01, ha="left", fontsize=11)
    path.write_bytes(figure_bytes(figure, path))


def _draw(axes: Axes, one: SightingErrors, measured_m: Array, top_mm: float) -> PathCollection:
    (x_m, y_m), errors_m = one.sightings.truth_m.T, one.errors_m
    lengths_mm = _MM * np.linalg.norm(errors_m, axis=1)
    cloud = axes.scatter(x_m, y_m, c=lengths_mm, cmap=_COLOURS, vmin=0, vmax=top_mm, s=16, marker="s", lw=0)
    steps = np.rint(one.sightings.truth_m / GRID_M).astype(int) % _EVERY
    some = (steps == 0).all(axis=1)
    axes.quiver(
        x_m[some], y_m[some], *errors_m[some].T, angles="xy", scale_units="xy",
        scale=top_mm / _MM / _ARROW_M, width=0.004, color="#0072B2", zorder=3,
    )  # fmt: skip
    axes.plot(*measured_m.T, "o", ms=3.5, mfc="none", mec="#000000", mew=0.8, zorder=4)
    axes.set(xlim=(0, FLOOR_M), ylim=(0, FLOOR_M), aspect="equal")
    style_axes(axes)
    return cloud
