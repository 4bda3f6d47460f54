"""Trajectory metrics of tracks against ground truth, as a sentence and as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rich.table import Table

from ipsys_log.analysis.trajectory_errors import DELTAS, ErrorSummary, TrajectoryErrors, pool_trajectories
from ipsys_log.report.accuracy import Accuracy
from ipsys_log.report.advice import label
from ipsys_log.report.tables import name_cell, plain_table
from ipsys_log.units import CM_PER_M

TRAJECTORY_COLUMNS = (
    *("n", "ATE RMSE", "mean", "median", "std", "p95", "max"),
    *(f"RPE {delta:g} {unit}" for delta, unit in DELTAS),
)
_ALL = "(all)"


def trajectory_lines(accuracy: Accuracy) -> Iterator[str]:
    """Yield the RMSE of the absolute trajectory error and of the relative pose errors of all robots."""
    if not accuracy.trajectories:
        return
    pooled = pool_trajectories(accuracy.trajectories)
    space_cm, floor_cm = (errors.rmse_m * CM_PER_M for errors in (pooled.absolute_3d, pooled.absolute_2d))
    text = f"Absolute trajectory error (ATE): RMSE {space_cm:.2f} cm in 3D, {floor_cm:.2f} cm on the floor"
    relative = [
        f"{errors.summary.rmse_m * CM_PER_M:.2f} cm over {errors.delta:g} {errors.unit}"
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
        rows.append(pool_trajectories(rows)._replace(robot=_ALL))
    return [("" if number else name, row.robot, _cells(row)) for number, row in enumerate(rows)]


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


def _cells(trajectory: TrajectoryErrors) -> list[str]:
    ate = trajectory.absolute_3d
    values = (ate.rmse_m, ate.mean_m, ate.median_m, ate.std_m, ate.p95_m, ate.max_m)
    relative = {(errors.delta, errors.unit): errors.summary for errors in trajectory.relative}
    return [str(ate.count), *map(_cm, values), *(_rmse(relative.get(delta)) for delta in DELTAS)]


def _rmse(errors: ErrorSummary | None) -> str:
    return "-" if errors is None else _cm(errors.rmse_m)


def _cm(value_m: float) -> str:
    value_cm = value_m * CM_PER_M
    return f"{value_cm:.2f}" if value_cm < 100 else f"{value_cm:.0f}"
