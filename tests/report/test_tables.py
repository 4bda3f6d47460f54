"""The tables of an evaluation fit a terminal, and control characters from a log have no effect."""

import io
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console

from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.findings import Findings
from ipsys_log.app.report.tables import accuracy_tables
from ipsys_log.messages import Suspect
from tests.report.conftest import ALL_MODELS, many_models, only, rename_cameras, scale


def printed(accuracies: Sequence[Accuracy], width: int = 80) -> str:
    """Print as on a terminal that does not wrap."""
    file = io.StringIO()
    console = Console(file=file, width=width, highlight=False, soft_wrap=True)
    for table in accuracy_tables(accuracies):
        console.print(table)
    return file.getvalue()


def with_truth(accuracy: Accuracy) -> Accuracy:
    assert accuracy.evaluation is not None
    rows = accuracy.evaluation.cameras
    both = (*rows, *(replace(row, against="truth") for row in rows))
    return replace(accuracy, evaluation=replace(accuracy.evaluation, cameras=both))


@pytest.mark.parametrize("truth", [False, True])
@pytest.mark.parametrize("factor", [1.0, 30.0])
def test_tables_of_all_models_fit_80_columns(paper: Findings, truth: bool, factor: float) -> None:
    accuracies = many_models(paper.accuracies)
    accuracies = [replace(a, evaluation=scale(a.evaluation, factor)) for a in accuracies if a.evaluation]
    text = printed([with_truth(a) for a in accuracies] if truth else accuracies)
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80, text
    # A name in two lines is complete; large errors leave less room.
    parts = {part for model in ALL_MODELS for part in re.split("[+-]", model)}
    assert factor > 1 or all(part in text for part in parts)
    assert "…" not in text


def test_long_names_of_cameras_fit_too(paper: Findings) -> None:
    accuracies = many_models(paper.accuracies)
    names = {"red": "north_east_corner", "white": "middle", "black": "south_west_corner"}
    text = printed([rename_cameras(accuracy, names) for accuracy in accuracies])
    assert max(len(line.rstrip()) for line in text.splitlines()) <= 80, text


def test_names_out_of_a_log_are_only_text(paper: Findings) -> None:
    (accuracy,) = only(paper, "poly").accuracies
    assert accuracy.evaluation is not None
    names = ("[bold]x[/nothing]", "a\x1b[31mb", "[link=http://x]y")
    suspects = tuple(Suspect(n, ("red",), np.full(3, 0.1), 9.0, "side", f"{n}: measured") for n in names)
    text = printed([replace(accuracy, evaluation=replace(accuracy.evaluation, suspects=suspects))], 120)
    assert names[0] in text
    assert names[2] in text
    assert "\x1b" not in text


def test_the_recommendation_is_printed(paper: Findings) -> None:
    text = printed(only(paper, "rigid", "poly").accuracies)
    assert "Model by the number of points per camera" in text
    assert "30 poly 1.69" in " ".join(text.split())
