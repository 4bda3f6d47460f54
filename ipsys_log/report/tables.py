"""Tables of an evaluation, and cells that fit a terminal of 80 columns."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, repeat
from textwrap import wrap

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from ipsys_log.analysis.accuracy import POOLED, root_mean_square_m
from ipsys_log.analysis.trajectory_errors import DELTAS, TrajectoryErrors, pool_trajectories
from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.plain_text import plain_text
from ipsys_log.report.accuracy import Accuracy, gather_outliers
from ipsys_log.report.advice import GROUPS, HEIGHT_NOTE, Advice, Choice, advise, label, uses_height
from ipsys_log.units import CM_PER_M

_WIDTH = 80
TRAJECTORY_COLUMNS = (
    *("n", "ATE RMSE", "mean", "median", "std", "p95", "max"),
    *(f"RPE {delta:g} {unit}" for delta, unit in DELTAS),
)
_ALL_ROBOTS = "(all)"


def plain_table(title: str, names: Iterable[str], figures: Iterable[str] = ()) -> Table:
    """Return a table without lines: left-aligned columns of names, right-aligned columns of numbers."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    table.padding = (0, 1, 0, 0)
    for column in names:
        table.add_column(column, overflow="fold")
    for column in figures:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def name_cell(text: str) -> Text:
    """Return a name from a log, without control characters for a terminal or a table."""
    return Text(plain_text(text))


def wrap_text(text: str, indent: str = "") -> str:
    """Wrap lines between words; later lines have the indentation of the first."""
    parts = (
        wrap(part, _WIDTH, initial_indent=indent, subsequent_indent=indent) for part in text.splitlines()
    )
    return "\n".join(line for lines in parts for line in lines)


def format_interval(errors: ErrorStatistics) -> str:
    """Format the 95 % confidence interval of a mean in cm, or return a dash."""
    if errors.mean_low_m is None or errors.mean_high_m is None:
        return "-"
    digits = 2 if errors.mean_high_m * CM_PER_M < 100 else 0
    return f"{errors.mean_low_m * CM_PER_M:.{digits}f}-{errors.mean_high_m * CM_PER_M:.{digits}f}"


def means_cm(*means_m: float) -> list[str]:
    """Format mean errors in cm with two decimals; with three if some values look equal otherwise.

    Examples
    --------
    >>> means_cm(0.0062, 0.0051), means_cm(0.00184, 0.00177, 0.00176)
    (['0.62', '0.51'], ['0.184', '0.177', '0.176'])
    """
    short, long = (
        [f"{mean_m * CM_PER_M:.{digits}f}" if mean_m < 1 else "over 100" for mean_m in means_m]
        for digits in (2, 3)
    )
    return short if len(set(short)) == len(set(long)) else long


# A longer model name continues in the next line, if there is one.
_NAME_WIDTH = 14


_FOUND_BY_WIDTH = 18


# The camera of a row over all cameras.
_ALL = "(all)"


def accuracy_tables(accuracies: Sequence[Accuracy]) -> list[Table | Group]:
    """Return all tables; for several models, the cross-validated errors are those over all cameras."""
    tables: list[Table] = []
    if any(accuracy.rows(False) or accuracy.tracks for accuracy in accuracies):
        tables.append(_held_out_table(accuracies))
    if any(accuracy.rows(True) for accuracy in accuracies):
        tables.append(_cross_validation_table(accuracies))
    if tables and any(uses_height(accuracy.model) for accuracy in accuracies):
        caption = Text(wrap_text(HEIGHT_NOTE))
        tables[-1].caption, tables[-1].caption_justify, tables[-1].caption_style = caption, "left", ""
    if any(accuracy.evaluation and accuracy.evaluation.suspects for accuracy in accuracies):
        tables.append(_suspects_table(accuracies))
    if advice := advise([accuracy.evaluation for accuracy in accuracies if accuracy.evaluation]):
        return [*tables, _advice_table(advice)]
    return [*tables]


# A row of a table: model, camera, reference (tape or truth), and cells with numbers.
_Line = tuple[str, str, str, list[str]]


def trajectory_lines(accuracy: Accuracy) -> Iterator[str]:
    """Yield the RMSE of the absolute trajectory error and of the relative pose errors of all robots."""
    if not accuracy.trajectories:
        return
    pooled = pool_trajectories(accuracy.trajectories)
    space_cm, floor_cm = (
        root_mean_square_m(errors) * CM_PER_M for errors in (pooled.absolute_3d, pooled.absolute_2d)
    )
    text = f"Absolute trajectory error (ATE): RMSE {space_cm:.2f} cm in 3D, {floor_cm:.2f} cm on the floor"
    relative = [
        f"{root_mean_square_m(errors.summary) * CM_PER_M:.2f} cm over {errors.delta:g} {errors.unit}"
        for errors in pooled.relative
    ]
    yield f"{text}; relative pose error (RPE): RMSE {', '.join(relative)}." if relative else f"{text}."


def trajectory_rows(accuracies: Sequence[Accuracy]) -> list[tuple[str, str, list[str]]]:
    """Return model, robot and cells of each robot in cm, and of all robots together if there are several."""
    return [row for one in accuracies for row in rows_of_run(label(one.model), one.trajectories)]


def rows_of_run(name: str, trajectories: Sequence[TrajectoryErrors]) -> list[tuple[str, str, list[str]]]:
    """Return the same rows for one run; the first has its name or that of its model."""
    rows = [*trajectories]
    if len(rows) > 1:
        rows.append(pool_trajectories(rows)._replace(robot=_ALL_ROBOTS))
    return [("" if number else name, row.robot, _trajectory_cells(row)) for number, row in enumerate(rows)]


def trajectory_table(accuracies: Sequence[Accuracy]) -> Table | None:
    """Return the table of the metrics in 3D; None without ground truth."""
    rows = trajectory_rows(accuracies)
    if not rows:
        return None
    several = len({model for model, _, _ in rows if model}) > 1
    names = ("model", "robot") if several else ("robot",)
    table = plain_table("Tracks against the ground truth, 3D errors in cm", names, TRAJECTORY_COLUMNS)
    for model, robot, cells in rows:
        table.add_row(*([name_cell(model)] if several else []), name_cell(robot), *cells)
    table.caption = "RPE: RMSE over this distance or time"
    table.caption_justify, table.caption_style = "left", ""
    return table


def _held_out_table(accuracies: Sequence[Accuracy]) -> Table:
    lines: list[_Line] = []
    for accuracy in accuracies:
        rows = [row for row in accuracy.rows(False) if row.camera != POOLED]
        errors = [(row.camera, row.against, _held_out_cells(accuracy, row)) for row in rows]
        if accuracy.tracks is not None:
            errors.append(("(tracks)", "truth", _track_cells(accuracy.tracks.space, accuracy.tracks.floor)))
            if accuracy.tracks.others is not None:
                errors.append(("(other heights)", "truth", _track_cells(*accuracy.tracks.others)))
        lines += _named(accuracy, errors)
    figures = ("n", "3D mean", "RMSE", "min", "max", "std", "2D mean", "max")
    return _filled("Errors in cm, held-out points", lines, figures)


def _cross_validation_table(accuracies: Sequence[Accuracy]) -> Table:
    """Return a table with one row per model; for a single model, with one row per camera."""
    lines: list[_Line] = []
    for accuracy in accuracies:
        rows = _cross_validated(accuracy, len(accuracies))
        cells = [(row.camera or _ALL, row.against, _crossed_cells(accuracy, row)) for row in rows]
        lines += _named(accuracy, cells)
    figures = ("n", "3D mean", "95 % CI", "RMSE", "p50", "p95", "max", "2D mean")
    return _filled("Errors in cm, cross-validated", lines, figures)


def _named(accuracy: Accuracy, rows: Sequence[tuple[str, str, list[str]]]) -> list[_Line]:
    """Add the model's name to the first of several rows; a long name continues in the next rows."""
    names = _break(label(accuracy.model), len(rows))
    return [(name, *row) for name, row in zip(chain(names, repeat("")), rows, strict=False)]


def _break(name: str, lines: int) -> list[str]:
    """Break a long name after ``+`` and ``-`` into the given number of lines."""
    parts = re.findall(r"[^+-]+[+-]?", name)
    if len(name) <= _NAME_WIDTH or lines < 2 or len(parts) < 2:
        return [name]
    broken = [parts[0]]
    for part in parts[1:]:
        if len(broken[-1] + part) > _NAME_WIDTH and len(broken) < lines:
            broken.append(part)
        else:
            broken[-1] += part
    return broken


def _filled(title: str, lines: Sequence[_Line], figures: Sequence[str]) -> Table:
    """Return a table of rows, without the columns that hold no information."""
    several = len({against for _, _, against, _ in lines}) > 1
    shown = [True, any(camera != _ALL for _, camera, _, _ in lines), several]
    names = [name for name, show in zip(("model", "camera", "against"), shown, strict=True) if show]
    table = plain_table(title, names, figures)
    for *labels, cells in lines:
        table.add_row(
            *(name_cell(str(text)) for text, show in zip(labels, shown, strict=True) if show), *cells
        )
    return table


def _held_out_cells(accuracy: Accuracy, row: CameraEvaluation) -> list[str]:
    return _cells(row.error_3d, row.error_2d, accuracy.rmse_m(row, row.error_3d))


def _track_cells(space: ErrorStatistics, floor: ErrorStatistics) -> list[str]:
    return _cells(space, floor, root_mean_square_m(space))


def _cells(error_3d: ErrorStatistics | None, error_2d: ErrorStatistics, rmse_3d_m: float | None) -> list[str]:
    in_space: tuple[float | None, ...] = (None,) * 5
    if error_3d is not None:
        in_space = (error_3d.mean_m, rmse_3d_m, error_3d.min_m, error_3d.max_m, error_3d.std_m)
    return [str(error_2d.count), *map(_cm, (*in_space, error_2d.mean_m, error_2d.max_m))]


def _cm(value_m: float | None) -> str:
    """Format a length in cm with three decimals, as in the paper, or without if a column is too narrow."""
    if value_m is None:
        return "-"
    value_cm = value_m * CM_PER_M
    return f"{value_cm:.3f}" if value_cm < 1000 else f"{value_cm:.0f}"


def _cross_validated(accuracy: Accuracy, models: int) -> list[CameraEvaluation]:
    rows = accuracy.rows(True)
    pooled = [row for row in rows if row.camera == POOLED]
    return pooled if models > 1 and pooled else rows


def _crossed_cells(accuracy: Accuracy, row: CameraEvaluation) -> list[str]:
    space, floor = row.error_3d, row.error_2d
    figures: list[float | None] = [None] * 5
    if space is not None:
        rmse_m = accuracy.rmse_m(row, space)
        figures = [space.mean_m, rmse_m, space.median_m, space.p95_m, space.max_m]
    mean, *others = map(_cm, figures)
    return [str(floor.count), mean, format_interval(space) if space else "-", *others, _cm(floor.mean_m)]


def _suspects_table(accuracies: Sequence[Accuracy]) -> Table:
    """Return a table of the outliers, each with the models that found it."""
    table = plain_table("Outliers, the worst first: measure these again", ("point",), ("error cm",))
    table.add_column("found by", overflow="fold", max_width=_FOUND_BY_WIDTH)
    table.add_column("possible cause", overflow="fold")
    for suspect, models in gather_outliers(accuracies):
        length_cm = float(np.linalg.norm(suspect.residual_m)) * CM_PER_M
        found_by, text = ", ".join(models), suspect.text or "none found"
        table.add_row(
            name_cell(suspect.measurement), f"{length_cm:.1f}", name_cell(found_by), name_cell(text)
        )
    return table


def _advice_table(advice: Advice) -> Group:
    """Return a table of the model to use by the number of points; its title may be wider than the table."""
    title = Text("Model by the number of points per camera, mean error in cm", style="bold")
    table = plain_table("", (), ("points",))
    for group in advice.groups:
        table.add_column(GROUPS[group], overflow="fold")
    for places, choices in advice.choices.items():
        table.add_row(
            str(places), *(_choice(choices[group]) if group in choices else "-" for group in advice.groups)
        )
    lower = any(
        choice.lowest != choice.model for choices in advice.choices.values() for choice in choices.values()
    )
    note = "In brackets: the model with the lowest mean error, if a simpler model is within its noise."
    return Group(title, table, *([Text(wrap_text(note))] if lower else []))


def _choice(choice: Choice) -> str:
    other = choice.lowest != choice.model
    lowest = f"\n({choice.lowest} {choice.lowest_mean_m * CM_PER_M:.2f})" if other else ""
    return f"{choice.model} {choice.mean_m * CM_PER_M:.2f}{lowest}"


def _trajectory_cells(trajectory: TrajectoryErrors) -> list[str]:
    ate = trajectory.absolute_3d
    values = (root_mean_square_m(ate), ate.mean_m, ate.median_m, ate.std_m, ate.p95_m, ate.max_m)
    relative = {(errors.delta, errors.unit): errors.summary for errors in trajectory.relative}
    return [str(ate.count), *map(_error_cm, values), *(_rmse_cm(relative.get(delta)) for delta in DELTAS)]


def _rmse_cm(errors: ErrorStatistics | None) -> str:
    return "-" if errors is None else _error_cm(root_mean_square_m(errors))


def _error_cm(value_m: float | None) -> str:
    if value_m is None:
        return "-"
    value_cm = value_m * CM_PER_M
    return f"{value_cm:.2f}" if value_cm < 100 else f"{value_cm:.0f}"
