"""The tables of an evaluation: errors of models and tracks, outliers, and the model to use."""

import re
from collections.abc import Iterable, Sequence
from textwrap import wrap

import numpy as np

from ipsys_log.app.report.accuracy import Accuracy, ErrorRow, gather_outliers
from ipsys_log.app.report.advice import GROUPS, HEIGHT_NOTE, Advice, Choice, advise, label, uses_height
from ipsys_log.app.report.findings import in_space, overall_row, rank, ranking_errors
from ipsys_log.app.report.rows import Rows, cm
from ipsys_log.messages import CameraEvaluation
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, POOLED, root_mean_square_m
from ipsys_log.statistics.ground_truth import DELTAS, TrajectoryErrors, pool_trajectories

_TRUTH = "truth"
# The camera of a row over all cameras, and the robot of a row over all robots.
_ALL = "(all)"
# A longer name of a model continues in the next line of a cell.
_NAME_WIDTH = 14
_FOUND_BY_WIDTH = 18


def height_note(models: Iterable[str]) -> str:
    """Return the meaning of the mark at the names of some models; empty if no model has it."""
    return HEIGHT_NOTE if any(map(uses_height, models)) else ""


def short_heads(columns: Sequence[str]) -> list[str]:
    """Return the heads of columns of errors: ``3D`` and ``2D`` stand once, at the first of several columns.

    Examples
    --------
    >>> short_heads(["n", "3D mean", "3D max", "2D mean"])
    ['>n', '>3D mean', '>max', '>2D mean']
    """
    kinds = [column[:2] for column in columns]
    return [
        f">{column[3:] if number and kind == kinds[number - 1] else column}"
        for number, (kind, column) in enumerate(zip(kinds, columns, strict=True))
    ]


def models_table(accuracies: Sequence[Accuracy]) -> Rows | None:
    """Return a table with one row per model, the best first; None without rows.

    For a single model, it has one row per camera.
    """
    space = in_space(accuracies)
    several = len(accuracies) > 1
    lines = [(accuracy, rows) for accuracy in rank(accuracies) for rows in _schemes(accuracy, several)]
    if not lines:
        return None
    crossed = any(rows[True] for _, rows in lines)
    kind, scheme = "3D" if space else "2D", "cross-validated" if crossed else "held out"
    columns = [f"{kind} {name}" for name in ("mean", "95 % CI", "RMSE", "p95", *([] if space else ["max"]))]
    columns += ["2D mean", "2D RMSE"] if space else []
    excluded = any(accuracy.evaluation and accuracy.evaluation.with_excluded for accuracy, _ in lines)
    held_out = crossed and any(rows[False] for _, rows in lines) and not excluded
    last = [f">held out {kind}"] if held_out else [f">{kind}, all points"] if excluded else []
    cells = []
    for accuracy, rows in lines:
        row = rows[crossed] or rows[False]
        assert row is not None
        name = label(accuracy.model) if several else row.camera or _ALL
        other = rows[False] if held_out else _with_excluded(accuracy, row) if excluded else None
        errors = accuracy.errors_of(row)
        end = [cm(ranking_errors(other, space).mean_m if other else None)] if last else []
        cells.append([name, *(errors.text(column) for column in columns), *end])
    note = height_note(accuracy.model for accuracy, _ in lines) if several else ""
    heads = ["model" if several else "camera", *short_heads(columns), *last]
    return Rows(f"Errors in cm, {scheme}", heads, cells, note)


def _schemes(accuracy: Accuracy, several: bool) -> list[dict[bool, CameraEvaluation | None]]:
    """Return rows against the tape, by cross-validation (True or False): over all cameras, or by camera."""
    if several:
        pooled = {crossed: overall_row(accuracy, crossed) for crossed in (True, False)}
        return [pooled] if any(pooled.values()) else []
    by_camera: dict[str, dict[bool, CameraEvaluation | None]] = {}
    for crossed in (True, False):
        for row in accuracy.rows(crossed):
            if row.against != _TRUTH:
                by_camera.setdefault(row.camera, {True: None, False: None})[crossed] = row
    return list(by_camera.values())


def _with_excluded(accuracy: Accuracy, row: CameraEvaluation) -> CameraEvaluation | None:
    """Return the row of the same camera and scheme with the gross outliers."""
    rows = accuracy.rows_with_excluded(row.scheme == CROSS_VALIDATION)
    return next((one for one in rows if (one.camera, one.against) == (row.camera, row.against)), None)


def accuracy_tables(accuracies: Sequence[Accuracy]) -> list[Rows]:
    """Return all tables; for several models, the cross-validated errors are those over all cameras."""
    tables: list[Rows] = []
    note = height_note(accuracy.model for accuracy in accuracies)
    held_out = [(accuracy, _held_out(accuracy)) for accuracy in accuracies]
    columns = ("n", "3D mean", "3D RMSE", "3D min", "3D max", "3D std", "2D mean", "2D max")
    tables += _error_table("Errors in cm, held-out points", held_out, columns, note)
    crossed = [(accuracy, _cross_validated(accuracy, len(accuracies))) for accuracy in accuracies]
    columns = ("n", "3D mean", "3D 95 % CI", "3D RMSE", "3D median", "3D p95", "3D max", "2D mean")
    tables += _error_table("Errors in cm, cross-validated", crossed, columns, note)
    if any(accuracy.evaluation and accuracy.evaluation.suspects for accuracy in accuracies):
        tables.append(suspects_table(accuracies))
    advice = advise([accuracy.evaluation for accuracy in accuracies if accuracy.evaluation])
    return [*tables, advice_table(advice)] if advice else tables


def _held_out(accuracy: Accuracy) -> list[ErrorRow]:
    rows = [accuracy.errors_of(row) for row in accuracy.rows(False) if row.camera != POOLED]
    if accuracy.tracks is not None:
        rows.append(ErrorRow("(tracks)", _TRUTH, accuracy.tracks.space, accuracy.tracks.floor))
        if accuracy.tracks.others is not None:
            rows.append(ErrorRow("(other heights)", _TRUTH, *accuracy.tracks.others))
    return rows


def _cross_validated(accuracy: Accuracy, models: int) -> list[ErrorRow]:
    rows = accuracy.rows(True)
    pooled = [row for row in rows if row.camera == POOLED]
    return [accuracy.errors_of(row) for row in (pooled if models > 1 and pooled else rows)]


def _error_table(
    title: str, models: Sequence[tuple[Accuracy, Sequence[ErrorRow]]], columns: Sequence[str], note: str
) -> list[Rows]:
    """Return a table of errors without the columns that hold no information; empty without rows."""
    rows = [row for _, rows in models for row in rows]
    several, by_camera = len({row.against for row in rows}) > 1, any(row.camera != POOLED for row in rows)
    cells = []
    for accuracy, rows_of_model in models:
        for number, row in enumerate(rows_of_model):
            name = label(accuracy.model) if number == 0 else ""
            names = [_broken(name) if several or by_camera else name]
            names += [row.camera or _ALL] if by_camera else []
            names += [row.against] if several else []
            cells.append([*names, *(row.text(column, 3) for column in columns)])
    heads = ["model", *(["camera"] if by_camera else []), *(["against"] if several else [])]
    return [Rows(title, [*heads, *short_heads(columns)], cells, note)] if rows else []


def _broken(name: str) -> str:
    """Break a long name after its last ``+`` or ``-``."""
    return name if len(name) <= _NAME_WIDTH else re.sub(r"^(.*[+-])", r"\1\n", name)


def suspects_table(accuracies: Sequence[Accuracy], is_wide: bool = False) -> Rows:
    """Return a table of the outliers, the worst first, each with the models that found it.

    A wide table, for a page, also has the correction that would explain an outlier, and its score.
    """
    columns = ["point", ">error cm", "found by", "possible cause"]
    cells = []
    for suspect, models in gather_outliers(accuracies):
        error = cm(float(np.linalg.norm(suspect.residual_m)), 1)
        found_by = "\n".join(wrap(", ".join(models), _FOUND_BY_WIDTH))
        row = [suspect.measurement, error, found_by, suspect.text or "none found"]
        if is_wide:
            corrected = () if suspect.corrected_m is None else suspect.corrected_m
            row += [", ".join(cm(value_m, 1) for value_m in corrected), _signed(suspect.residual_m)]
            row += [f"{suspect.score:.1f}", ", ".join(suspect.cameras)]
        cells.append(row)
    columns += ["corrected x, y, z", ">error in x, y, z", ">score", "cameras"] if is_wide else []
    return Rows("Outliers, the worst first: measure these again", columns, cells)


def _signed(offset_m: Iterable[float]) -> str:
    return ", ".join(("+" if value_m >= 0 else "") + cm(value_m, 1) for value_m in offset_m)


def advice_table(advice: Advice) -> Rows:
    """Return a table of the model to use by the number of points."""
    choices = [row.get(group) for row in advice.choices.values() for group in advice.groups]
    lower = any(choice is not None and choice.lowest != choice.model for choice in choices)
    note = "In brackets: the model with the lowest mean error, if a simpler model is within its noise."
    return Rows(
        "Model by the number of points per camera, mean error in cm",
        [">points", *(GROUPS[group] for group in advice.groups)],
        [
            [str(places), *(_choice(row.get(group)) for group in advice.groups)]
            for places, row in advice.choices.items()
        ],
        note if lower else "",
    )


def _choice(choice: Choice | None) -> str:
    if choice is None:
        return "-"
    lowest = f"\n({choice.lowest} {cm(choice.lowest_mean_m)})" if choice.lowest != choice.model else ""
    return f"{choice.model} {cm(choice.mean_m)}{lowest}"


def trajectory_table(accuracies: Sequence[Accuracy]) -> Rows | None:
    """Return the metrics of tracks in 3D, by model and robot; None without ground truth."""
    cells = []
    for accuracy in accuracies:
        rows = [*accuracy.trajectories]
        if len(rows) > 1:
            rows.append(pool_trajectories(rows)._replace(robot=_ALL))
        names = [label(accuracy.model), *[""] * len(rows)]
        cells += [[name, row.robot, *_metrics(row)] for name, row in zip(names, rows, strict=False)]
    if not cells:
        return None
    columns = ["model", "robot", ">n", ">ATE RMSE", ">mean", ">median", ">std", ">p95", ">max"]
    columns += [f">RPE {delta:g} {unit}" for delta, unit in DELTAS]
    first = 1 if len({row[0] for row in cells if row[0]}) < 2 else 0
    return Rows(
        "Tracks against the ground truth, 3D errors in cm",
        columns[first:],
        [row[first:] for row in cells],
        "RPE: RMSE over this distance or time",
    )


def _metrics(trajectory: TrajectoryErrors) -> list[str]:
    ate = trajectory.absolute_3d
    values = (root_mean_square_m(ate), ate.mean_m, ate.median_m, ate.std_m, ate.p95_m, ate.max_m)
    relative = {
        (errors.delta, errors.unit): root_mean_square_m(errors.summary) for errors in trajectory.relative
    }
    return [str(ate.count), *map(cm, values), *(cm(relative.get(delta)) for delta in DELTAS)]
