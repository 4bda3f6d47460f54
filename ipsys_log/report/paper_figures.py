"""The tables and figures of the paper, and some more, as files of a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from ipsys_log.errors import IpsysError
from ipsys_log.report.csv_tables import cross_validation_csv, paper_csv
from ipsys_log.report.figures import png
from ipsys_log.report.files import write_files
from ipsys_log.report.findings import Findings
from ipsys_log.report.learning import has_published
from ipsys_log.report.learning_figure import learning_figure, mean_curves, published_figure
from ipsys_log.report.models_figure import models_figure
from ipsys_log.report.points_figure import places_figure
from ipsys_log.report.residuals_figure import residuals_figure, shown_models

__all__ = ["write_plots"]


def _always(findings: Findings) -> bool:
    return bool(findings.accuracies)


def _crossed(findings: Findings) -> bool:
    return any(accuracy.rows(True) for accuracy in findings.accuracies)


def _published(findings: Findings) -> bool:
    return has_published(findings.evaluations)


# Each file: when there is something for it, and its bytes.
_FILES: dict[str, tuple[Callable[[Findings], bool], Callable[[Findings], bytes]]] = {
    "table_1.csv": (_always, lambda f: paper_csv(f, in_space=True)),
    "table_2.csv": (_always, lambda f: paper_csv(f, in_space=False)),
    "cross_validation.csv": (_crossed, cross_validation_csv),
    "figure_9.png": (lambda f: bool(f.training_m() or f.test_m()), lambda f: png(places_figure(f))),
    "figure_10.png": (
        lambda f: _published(f) and f.in_space,
        lambda f: png(published_figure(f, in_space=True)),
    ),
    "figure_11.png": (_published, lambda f: png(published_figure(f, in_space=False))),
    "learning_curve.png": (lambda f: bool(mean_curves(f, False)), lambda f: png(learning_figure(f))),
    "errors_floor.png": (lambda f: bool(shown_models(f)), lambda f: png(residuals_figure(f))),
    "models.png": (_always, lambda f: png(models_figure(f))),
}


def write_plots(findings: Findings, folder: Path) -> list[str]:
    """Write what there is to be shown into a folder, all of it or nothing.

    Returns
    -------
    The names of the files.

    Raises
    ------
    IpsysError
        Where no model was evaluated.
    """
    files = {name: draw(findings) for name, (wanted, draw) in _FILES.items() if wanted(findings)}
    if not files:
        raise IpsysError(
            f"{folder}: nothing to draw: no model was evaluated, for no place is held out; measure some"
        )
    write_files(folder, files)
    return list(files)
