"""Every error of every model and camera, in cm, as points with their mean, and the figures beside."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from ipsys_log.messages import ErrorStatistics
from ipsys_log.report.accuracy import Accuracy
from ipsys_log.units import CM_PER_M

__all__ = ["count_rows", "draw_errors"]

_TRACKS = "tracks"
# Beyond this ratio of the largest error to the usual one, the small ones need a logarithm to be seen.
_LOG_RATIO = 15.0
_GAP = 0.7  # between models, in rows
_MOST_ROW_IN = 0.42


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A line of the picture: ``errors_cm`` (n,), empty where only the statistics are known."""

    model: str
    name: str
    against: str
    errors_cm: NDArray[np.float64]
    statistics: ErrorStatistics


def _rows(accuracies: Sequence[Accuracy]) -> list[_Row]:
    rows = []
    for accuracy in accuracies:
        evaluation = accuracy.evaluation
        model = evaluation.model if evaluation else accuracy.run
        # Two runs of one model are told apart by their names.
        name = model if accuracy.run == model.replace("+", "_") else f"{model} ({accuracy.run})"
        for row in evaluation.cameras if evaluation else ():
            offsets_m = np.array([r.predicted_m - r.world_m for r in row.residuals]).reshape(-1, 3)
            errors_cm = np.linalg.norm(offsets_m, axis=1) * CM_PER_M
            rows.append(_Row(name, row.camera, row.against, errors_cm, row.error_3d))
        if accuracy.tracks is not None:
            rows.append(_Row(name, _TRACKS, "truth", np.zeros(0), accuracy.tracks[0]))
    return rows


def count_rows(accuracies: Sequence[Accuracy]) -> int:
    """How many lines the panel has, with the spaces between models."""
    rows = _rows(accuracies)
    return len(rows) + round(_GAP * len({row.model for row in rows}))


def draw_errors(
    figure: Figure,
    accuracies: Sequence[Accuracy],
    styles: Mapping[str, tuple[str, str]],
    left_in: float,
    top_in: float,
) -> None:
    """Draw the panel into the right of a figure.

    Parameters
    ----------
    accuracies : with at least one error.
    styles : colour and marker shape by camera.
    left_in, top_in : where the axes begin, in inches; the names are on the left of it.
    """
    rows = _rows(accuracies)
    heights = _heights(rows)
    axes, row_in = _add_axes(figure, heights[-1] + 1.6, left_in, top_in)
    size = float(np.clip(0.62 * 72 * row_in, 5.5, 9))
    for y, row in zip(heights, rows, strict=True):
        _draw_row(axes, y, row, *styles.get(row.name, ("#0072B2", "|")), size)
    _name_models(axes, rows, heights, size)
    _scale(axes, rows)
    axes.set_ylim(heights[-1] + 0.8, -0.8)
    axes.set_yticks(heights, [_name(row) for row in rows], fontsize=size)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="#E6E6E6", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    _print_figures(axes, rows, heights, size)
    axes.set_title("Errors in space on held-out places", loc="left", fontsize=10, pad=size + 8)
    axes.annotate(
        _note(rows), (0, 0), (0, -38), xycoords="axes fraction", textcoords="offset points", fontsize=8,
        color="#505050", va="top",
    )  # fmt: skip


def _add_axes(figure: Figure, rows: float, left_in: float, top_in: float) -> tuple[Axes, float]:
    """Axes for so many rows, and the height of a row in inches: few rows are not drawn far apart."""
    width, height = figure.get_size_inches()
    row_in = min((height - top_in - 0.95) / rows, _MOST_ROW_IN)
    low_in = height - top_in - row_in * rows
    return figure.add_axes((left_in / width, low_in / height, 2.75 / width, row_in * rows / height)), row_in


def _note(rows: Sequence[_Row]) -> str:
    note = "each place a point, | the mean"
    if any(row.against == "truth" and len(row.errors_cm) for row in rows):
        note += "; hollow: against the truth"
    if any(row.name == _TRACKS for row in rows):
        note += "\ntracks: mean and standard deviation"
    return note


def _heights(rows: Sequence[_Row]) -> list[float]:
    heights, y = [], 0.0
    for number, row in enumerate(rows):
        if number:
            y += 1 if row.model == rows[number - 1].model else 1 + _GAP
        heights.append(y)
    return heights


def _name(row: _Row) -> str:
    return row.name if row.against == "tape" else f"{row.name}, {row.against}"


def _draw_row(axes: Axes, y: float, row: _Row, colour: str, shape: str, size: float) -> None:
    mean_cm = row.statistics.mean_m * CM_PER_M
    if len(row.errors_cm):
        fill = {"mfc": "none"} if row.against == "truth" else {"alpha": 0.55}
        points = np.full(len(row.errors_cm), y)
        axes.plot(row.errors_cm, points, shape, color=colour, ms=0.55 * size, mew=0.9, ls="none", **fill)
    elif row.statistics.std_m is not None:
        spread_cm = row.statistics.std_m * CM_PER_M
        low_cm = max(mean_cm - spread_cm, row.statistics.min_m * CM_PER_M)
        axes.plot([low_cm, mean_cm + spread_cm], [y, y], color=colour, lw=2.5, alpha=0.5)
    axes.plot(mean_cm, y, "|", color=colour, ms=1.5 * size, mew=2.2, zorder=4)


def _name_models(axes: Axes, rows: Sequence[_Row], heights: Sequence[float], size: float) -> None:
    """The model once beside its rows, with a line along them."""
    for model in dict.fromkeys(row.model for row in rows):
        here = [y for y, row in zip(heights, rows, strict=True) if row.model == model]
        along = axes.get_yaxis_transform()
        # Clear of the names of the rows, of which the longest is known only when it is drawn.
        x = -0.34 - 0.018 * size / 9 * max(0, max(len(_name(row)) for row in rows) - 12)
        axes.plot(
            [x, x], [here[0] - 0.4, here[-1] + 0.4], color="black", lw=1, transform=along, clip_on=False
        )
        axes.text(
            x - 0.03, (here[0] + here[-1]) / 2, model, transform=along, fontsize=size + 1, weight="bold",
            ha="right", va="center",
        )  # fmt: skip


def _scale(axes: Axes, rows: Sequence[_Row]) -> None:
    shown = [row.errors_cm for row in rows] + [np.array([row.statistics.mean_m * CM_PER_M]) for row in rows]
    errors_cm = np.concatenate(shown)
    largest, usual = float(errors_cm.max()), float(np.median(errors_cm))
    axes.set_xlabel("cm", fontsize=9)
    if usual > 0 and largest > _LOG_RATIO * usual:
        axes.set_xscale("log")
        axes.set_xlim(max(float(errors_cm[errors_cm > 0].min()) / 1.3, usual / 100), largest * 1.3)
        axes.set_xlabel("cm (logarithmic)", fontsize=9)
    else:
        axes.set_xlim(0, max(1.06 * largest, 1e-3))


def _print_figures(axes: Axes, rows: Sequence[_Row], heights: Sequence[float], size: float) -> None:
    columns = {"mean": 1.17, "std": 1.32, "max": 1.47, "n": 1.60}
    along = axes.get_yaxis_transform()
    for title, x in columns.items():
        axes.text(x, -0.9, title, transform=along, fontsize=size, color="#505050", ha="right", va="bottom")
    for y, row in zip(heights, rows, strict=True):
        found = row.statistics
        values_m = {"mean": found.mean_m, "std": found.std_m, "max": found.max_m}
        cells = {name: "-" if m is None else f"{m * CM_PER_M:.2f}" for name, m in values_m.items()}
        for name, text in {**cells, "n": str(found.count)}.items():
            weight = "bold" if name == "mean" else "normal"
            axes.text(
                columns[name], y, text, transform=along, fontsize=size, ha="right", va="center", weight=weight
            )
