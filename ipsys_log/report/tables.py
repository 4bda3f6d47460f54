"""What is printed after an evaluation: tables of at most 80 columns."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import chain, repeat
from textwrap import wrap

import numpy as np
from rich.console import Group
from rich.table import Table
from rich.text import Text

from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.offline.errors import POOLED
from ipsys_log.plain_text import plain_text
from ipsys_log.report.accuracy import Accuracy, gather_suspects
from ipsys_log.report.advice import GROUPS, TOLD_NOTE, Advice, Choice, advise, label, told_height
from ipsys_log.units import CM_PER_M

__all__ = ["accuracy_tables"]

_WIDTH = 80
# A longer name of a model goes on in a second line, where there is one.
_NAME_WIDTH = 18


def accuracy_tables(accuracies: Sequence[Accuracy]) -> list[Table | Group]:
    """The summary; of many models the errors by cross-validation only of all cameras together."""
    tables: list[Table] = []
    if any(accuracy.rows(False) or accuracy.tracks for accuracy in accuracies):
        tables.append(_held_out_table(accuracies))
    if any(accuracy.rows(True) for accuracy in accuracies):
        tables.append(_cross_validation_table(accuracies))
    if tables and any(told_height(accuracy.model) for accuracy in accuracies):
        _note(tables[-1], TOLD_NOTE)
    if any(accuracy.evaluation and accuracy.evaluation.suspects for accuracy in accuracies):
        tables.append(_suspects_table(accuracies))
    if advice := advise([accuracy.evaluation for accuracy in accuracies if accuracy.evaluation]):
        return [*tables, _advice_table(advice)]
    return [*tables]


def _table(title: str, names: Iterable[str], figures: Iterable[str] = ()) -> Table:
    table = Table(title=title, title_justify="left", title_style="bold", box=None, pad_edge=False)
    table.padding = (0, 1, 0, 0)
    for column in names:
        table.add_column(column, overflow="fold")
    for column in figures:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def _note(table: Table, text: str) -> None:
    table.caption, table.caption_justify, table.caption_style = Text(_wrapped(text)), "left", ""


def _wrapped(text: str) -> str:
    return "\n".join(line for part in text.splitlines() for line in wrap(part, _WIDTH))


def _name(text: str) -> Text:
    """A name out of a log, with nothing in it that a terminal or a table would obey."""
    return Text(plain_text(text))


def _held_out_table(accuracies: Sequence[Accuracy]) -> Table:
    lines: list[tuple[str, str, str, list[str]]] = []
    for accuracy in accuracies:
        rows = [row for row in accuracy.rows(False) if row.camera != POOLED]
        errors = [(row.camera, row.against, _cells(row.error_3d, row.error_2d)) for row in rows]
        if accuracy.tracks is not None:
            errors.append(("(tracks)", "truth", _cells(*accuracy.tracks)))
        # The name once, a long one over two lines.
        names = _break(label(accuracy.model), len(errors))
        lines += [(name, *line) for name, line in zip(chain(names, repeat("")), errors, strict=False)]
    several = len({against for _, _, against, _ in lines}) > 1
    figures = ("n", "3D mean", "min", "max", "std", "2D mean", "max")
    table = _table(
        "Errors in cm, on places held out", ("model", "camera", *(["against"] if several else [])), figures
    )
    for model, camera, against, cells in lines:
        names = [model, camera, *([against] if several else [])]
        table.add_row(*map(_name, names), *cells)
    return table


def _break(name: str, lines: int) -> list[str]:
    """A long name in two parts, where there are lines for both."""
    first, plus, second = name.partition("+")
    return [first + plus, second] if plus and len(name) > _NAME_WIDTH and lines > 1 else [name]


def _cells(error_3d: ErrorStatistics | None, error_2d: ErrorStatistics) -> list[str]:
    in_space = (error_3d.mean_m, error_3d.min_m, error_3d.max_m, error_3d.std_m) if error_3d else (None,) * 4
    return [str(error_2d.count), *map(_cm, (*in_space, error_2d.mean_m, error_2d.max_m))]


def _cm(value_m: float | None) -> str:
    """Three digits behind the point, as the paper has them, and fewer where a column would burst."""
    if value_m is None:
        return "-"
    value_cm = value_m * CM_PER_M
    return f"{value_cm:.3f}" if value_cm < 1000 else f"{value_cm:.0f}"


def _cross_validation_table(accuracies: Sequence[Accuracy]) -> Table:
    """A row for each model, or for each camera of the only one."""
    rows = [(accuracy, row) for accuracy in accuracies for row in _cross_validated(accuracy, len(accuracies))]
    cameras = any(row.camera != POOLED for _, row in rows)
    several = len({row.against for _, row in rows}) > 1
    names = ["model", *(["camera"] if cameras else []), *(["against"] if several else [])]
    figures = ("n", "3D mean", "95 % CI", "p50", "p95", "max", "2D mean")
    table = _table("By cross-validation, in cm, on places not fitted on", names, figures)
    for accuracy, row in rows:
        cells = [label(accuracy.model)]
        cells += [row.camera or "(all)"] if cameras else []
        cells += [row.against] if several else []
        table.add_row(*map(_name, cells), *_crossed_cells(row))
    return table


def _cross_validated(accuracy: Accuracy, models: int) -> list[CameraEvaluation]:
    rows = accuracy.rows(True)
    pooled = [row for row in rows if row.camera == POOLED]
    return pooled if models > 1 and pooled else rows


def _crossed_cells(row: CameraEvaluation) -> list[str]:
    space, floor = row.error_3d, row.error_2d
    figures = [space.mean_m, space.median_m, space.p95_m, space.max_m] if space else [None] * 4
    mean, *others = map(_cm, figures)
    return [str(floor.count), mean, _interval(space) if space else "-", *others, _cm(floor.mean_m)]


def _interval(errors: ErrorStatistics) -> str:
    if errors.mean_low_m is None or errors.mean_high_m is None:
        return "-"
    digits = 2 if errors.mean_high_m * CM_PER_M < 100 else 0
    return f"{errors.mean_low_m * CM_PER_M:.{digits}f}-{errors.mean_high_m * CM_PER_M:.{digits}f}"


def _suspects_table(accuracies: Sequence[Accuracy]) -> Table:
    """Each suspect once, with the models that say so."""
    table = _table("Suspect measurements, the worst first: measure these again", ("place",), ("off by cm",))
    table.add_column("found by", overflow="fold", max_width=_NAME_WIDTH)
    table.add_column("what would explain it", overflow="fold")
    for suspect, models in gather_suspects(accuracies):
        length_cm = float(np.linalg.norm(suspect.residual_m)) * CM_PER_M
        found_by, text = ", ".join(models), suspect.text or "nothing simple"
        table.add_row(_name(suspect.measurement), f"{length_cm:.1f}", _name(found_by), _name(text))
    return table


def _advice_table(advice: Advice) -> Group:
    """What to use with how many places, and the same in words below; the title of a table is no wider."""
    title = Text("Which model with how many places for each camera, mean error in cm", style="bold")
    table = _table("", (), ("places",))
    for group in advice.groups:
        table.add_column(GROUPS[group], overflow="fold")
    for places, found in advice.choices.items():
        table.add_row(
            str(places), *(_choice(found[group]) if group in found else "-" for group in advice.groups)
        )
    lower = any(one.lowest != one.model for found in advice.choices.values() for one in found.values())
    note = ["In brackets: the lowest mean error, where a simpler model is as good within the noise."] * lower
    return Group(title, table, Text(_wrapped("\n".join([*note, *advice.sentences]))))


def _choice(choice: Choice) -> str:
    other = choice.lowest != choice.model
    lowest = f"\n({choice.lowest} {choice.lowest_mean_m * CM_PER_M:.2f})" if other else ""
    return f"{choice.model} {choice.mean_m * CM_PER_M:.2f}{lowest}"
