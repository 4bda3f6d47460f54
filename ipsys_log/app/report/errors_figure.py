"""Panel of all errors by model and camera, in cm: points with their mean, and the statistics as numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from matplotlib.transforms import Transform, blended_transform_factory
from numpy.typing import NDArray

from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.figures import add_panel
from ipsys_log.app.report.findings import in_space
from ipsys_log.app.report.rows import cm
from ipsys_log.messages import ErrorStatistics
from ipsys_log.statistics.accuracy import POOLED
from ipsys_log.units import CM_PER_M

_TRACKS = "tracks"
# Instants at which a marker does not have the height that its model takes it to be at.
_OTHER_HEIGHTS = "other heights"
# Above this ratio of the largest error to the median, a logarithmic scale makes the small errors visible.
_LOG_RATIO = 15.0
_GAP = 0.7  # between models, in rows
# Horizontal layout of the figure: right end of the axes, their smallest width, and right end of each column.
_RIGHT_IN = 11.75
_LEAST_IN = 1.5
_COLUMNS_IN = {"mean": 12.25, "std": 12.7, "max": 13.15, "n": 13.6}


@dataclass(frozen=True, slots=True, eq=False)
class _Row:
    """A row of the panel; ``errors_cm`` (n,) is empty if only the statistics are known."""

    model: str
    name: str
    against: str
    errors_cm: NDArray[np.float64]
    statistics: ErrorStatistics


def _rows(accuracies: Sequence[Accuracy]) -> list[_Row]:
    rows = []
    space = in_space(accuracies)
    for accuracy in accuracies:
        evaluation = accuracy.evaluation
        model = evaluation.model if evaluation else accuracy.run
        # A second run of the same model shows the name of the run.
        name = (
            model
            if accuracy.run == model.replace("+", "_").replace("-", "_")
            else f"{model} ({accuracy.run})"
        )
        for row in accuracy.rows(False):
            errors = row.error_3d if space else row.error_2d
            if row.camera == POOLED or errors is None:
                continue
            offsets_m = np.array([r.predicted_m - r.world_m for r in row.residuals]).reshape(-1, 3)
            errors_cm = np.linalg.norm(offsets_m[:, : 3 if space else 2], axis=1) * CM_PER_M
            rows.append(_Row(name, row.camera, row.against, errors_cm, errors))
        if accuracy.tracks is not None:
            rows.append(
                _Row(
                    name,
                    _TRACKS,
                    "truth",
                    np.zeros(0),
                    accuracy.tracks.space if space else accuracy.tracks.floor,
                )
            )
            if accuracy.tracks.others is not None:
                others = accuracy.tracks.others[0 if space else 1]
                rows.append(_Row(name, _OTHER_HEIGHTS, "truth", np.zeros(0), others))
    return rows


def count_rows(accuracies: Sequence[Accuracy]) -> int:
    """Return the number of rows of the panel, with the spaces between models."""
    rows = _rows(accuracies)
    return len(rows) + round(_GAP * len({row.model for row in rows}))


def draw_errors(
    figure: Figure,
    accuracies: Sequence[Accuracy],
    styles: Mapping[str, tuple[str, str]],
    left_in: float,
    top_in: float,
) -> None:
    """Draw the panel on the right side of a figure.

    Parameters
    ----------
    figure : figure to draw into.
    accuracies : accuracies with at least one error.
    styles : colour and marker shape by camera.
    left_in, top_in : left end of the names and top of the axes, in inches.
    """
    rows = _rows(accuracies)
    heights = _heights(rows)
    _, height = figure.get_size_inches()
    row_in = (height - top_in - 1.05) / (heights[-1] + 1.6)
    size = float(np.clip(0.62 * 72 * row_in, 5.5, 9))
    models_in, names_in = _name_widths(rows, size)
    bar_in = left_in + models_in + 0.08
    axes = _add_axes(figure, bar_in + 0.12 + names_in, top_in, row_in * (heights[-1] + 1.6))
    for y, row in zip(heights, rows, strict=True):
        _draw_row(axes, y, row, *styles.get(row.name, ("#0072B2", "|")), size)
    _scale(axes, rows)
    axes.set_ylim(heights[-1] + 0.8, -0.8)
    axes.set_yticks(heights, [_name(row) for row in rows], fontsize=size)
    _name_models(axes, rows, heights, size, bar_in)
    _print_figures(axes, rows, heights, size)
    kind = "3D" if in_space(accuracies) else "2D"
    axes.set_title(f"{kind} errors at held-out points", loc="left", fontsize=10, pad=size + 12)
    axes.annotate(
        _note(rows), (0, 0), (0, -38), xycoords="axes fraction", textcoords="offset points", fontsize=8,
        color="#505050", va="top",
    )  # fmt: skip


def _name_widths(rows: Sequence[_Row], size: float) -> tuple[float, float]:
    """Return the widths of the longest name of a model and of the longest name of a row, in inches."""
    bold, plain = FontProperties(weight="bold"), FontProperties()
    models = [TextPath((0, 0), row.model, size=size + 1, prop=bold).get_extents().width for row in rows]
    names = [TextPath((0, 0), _name(row), size=size, prop=plain).get_extents().width for row in rows]
    return max(models) / 72, max(names) / 72


def _add_axes(figure: Figure, left_in: float, top_in: float, high_in: float) -> Axes:
    """Add axes that end at the columns of numbers, for names of any length."""
    left_in = min(left_in, _RIGHT_IN - _LEAST_IN)
    low_in = figure.get_size_inches()[1] - top_in - high_in
    axes = add_panel(figure, left_in, low_in, _RIGHT_IN - left_in, high_in)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="#E6E6E6", lw=0.7)
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    return axes


def _beside(axes: Axes) -> Transform:
    """Return a transform with x in inches of the figure and y in rows."""
    figure = axes.get_figure(root=True)
    assert figure is not None
    return blended_transform_factory(figure.dpi_scale_trans, axes.transData)


def _note(rows: Sequence[_Row]) -> str:
    note = "mark: one point, |: mean"
    if any(row.against == "truth" and len(row.errors_cm) for row in rows):
        note += "; hollow: against ground truth"
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


def _name_models(
    axes: Axes, rows: Sequence[_Row], heights: Sequence[float], size: float, bar_in: float
) -> None:
    """Write each model once beside its rows, with a line along the rows."""
    beside = _beside(axes)
    for model in dict.fromkeys(row.model for row in rows):
        row_heights = [y for y, row in zip(heights, rows, strict=True) if row.model == model]
        ends = [row_heights[0] - 0.4, row_heights[-1] + 0.4]
        axes.plot([bar_in, bar_in], ends, color="black", lw=1, transform=beside, clip_on=False)
        axes.text(
            bar_in - 0.08, sum(ends) / 2, model, transform=beside, fontsize=size + 1, weight="bold",
            ha="right", va="center",
        )  # fmt: skip


def _bar(row: _Row) -> NDArray[np.float64]:
    """Return mean, and mean plus standard deviation, of a row without single points, in cm."""
    mean_m, std_m = row.statistics.mean_m, row.statistics.std_m or 0.0
    return np.array([mean_m, mean_m + std_m]) * CM_PER_M


def _scale(axes: Axes, rows: Sequence[_Row]) -> None:
    shown = [row.errors_cm if len(row.errors_cm) else _bar(row) for row in rows]
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
    beside = _beside(axes)
    for title, x in _COLUMNS_IN.items():
        axes.text(x, -0.9, title, transform=beside, fontsize=size, color="#505050", ha="right", va="bottom")
    for y, row in zip(heights, rows, strict=True):
        statistics = row.statistics
        lengths = map(cm, (statistics.mean_m, statistics.std_m, statistics.max_m))
        for (name, x), text in zip(_COLUMNS_IN.items(), (*lengths, str(statistics.count)), strict=True):
            axes.text(
                x, y, text, transform=beside, fontsize=size, ha="right", va="center",
                weight="bold" if name == "mean" else "normal",
            )  # fmt: skip
