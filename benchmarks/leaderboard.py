"""Errors of all models, or of estimates of robots, on published datasets, in one table.

    python benchmarks/leaderboard.py paper.zip lab/
    python benchmarks/leaderboard.py monday.zip lab/ --estimates wheels/ orb_slam/
    python benchmarks/leaderboard.py paper.zip lab/ --own mine.py:Estimator --markdown

Each dataset of ``ipsys pack`` is scored again, as ``ipsys score`` does. A cell is the mean error in mm, and
≠ marks scores that do not come out as stated. The first row has the lowest mean rank over the datasets.
The errors of a dataset are cross-validated and in 3D, if all of its models have such errors.

The folder of an odometry or SLAM has a file for each drive, with the name of its dataset: ``monday.tum``.
Estimates that a dataset has are rows, too. A cell is the ATE (RMSE) in mm, after yaw and translation,
against the tracks of the model with the smallest stated error.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import ipsys_log as ipsys
from ipsys_log.app.report.advice import HEIGHT_NOTE, label
from ipsys_log.app.report.pack_scores import ranked_scores
from ipsys_log.tools.publish.opened_pack import copy_pack, fetch_pack

__all__ = ["leaderboard", "table_lines"]

_DIFFERS = "≠"


def dataset_scores(path: str, own: Sequence[str]) -> dict[str, tuple[float, bool]]:
    """Return by model the mean error in mm on a dataset, and whether it is as stated."""
    stated = ipsys.score(path)
    # A second call: with models of the user only, the models of the dataset are not repeated.
    of_user = ipsys.score(path, models=own).own if own else ()
    wrong = {one.stated.model for one in stated.comparisons if not one.as_stated}
    computed = [one.computed for one in stated.comparisons if one.computed is not None]
    ranked = ranked_scores((*computed, *of_user))
    return {score.model: (score.mean_mm, score.model not in wrong) for score in ranked}


def estimate_scores(path: str, name: str, folders: Sequence[Path]) -> dict[str, tuple[float, bool]]:
    """Return by folder, or by stored run, the ATE in mm of the estimates of a drive."""
    scores: dict[str, list[float]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder, results = Path(temporary, "pack"), Path(temporary, "results.mcap")
        folder.mkdir()
        opened = copy_pack(fetch_pack(path, Path(temporary)), folder)
        ipsys.replay(*opened.logs, model=ranked_scores(opened.stated.scores)[0].model, output=results)
        with ipsys.open(*opened.logs, results) as log:
            for row in log.compare().estimates.to_dict("records"):
                scores.setdefault(row["run"], []).append(row["ate_m"])
            for folder in folders:
                if files := sorted(folder.glob(f"{name}.*")):
                    scores[folder.name] = log.compare(*files).estimates["ate_m"].tolist()
    return {method: (1000 * sum(ates_m) / len(ates_m), True) for method, ates_m in scores.items()}


def leaderboard(datasets: Mapping[str, Mapping[str, tuple[float, bool]]]) -> list[tuple[str, ...]]:
    """Return the rows of the table: the model, its mean rank, and its error on each dataset.

    Parameters
    ----------
    datasets : by name of a dataset, the mean error in mm of each model, and whether it is as stated.
    """
    ranks: dict[str, list[int]] = {}
    for scores in datasets.values():
        ordered = sorted(scores, key=lambda model: scores[model][0])
        for rank, model in enumerate(ordered, 1):
            ranks.setdefault(model, []).append(rank)
    mean_ranks = {model: sum(own) / len(own) for model, own in ranks.items()}
    # A model that is missing in a dataset comes after all that have scores in more of them.
    best_first = sorted(mean_ranks, key=lambda model: (-len(ranks[model]), mean_ranks[model], model))
    return [
        (
            label(model),
            f"{mean_ranks[model]:.1f}",
            *(_cell(scores.get(model)) for scores in datasets.values()),
        )
        for model in best_first
    ]


def _cell(score: tuple[float, bool] | None) -> str:
    if score is None:
        return "-"
    mean_mm, as_stated = score
    return f"{'' if as_stated else _DIFFERS}{mean_mm:.2f}"


def table_lines(head: Sequence[str], rows: Sequence[Sequence[str]], markdown: bool) -> list[str]:
    """Return the lines of a table; the first column is a name, the others are numbers."""
    if markdown:
        rules = ["---", *["---:"] * (len(head) - 1)]
        return [f"| {' | '.join(cells)} |" for cells in (head, rules, *rows)]
    widths = [max(len(row[column]) for row in (head, *rows)) for column in range(len(head))]
    return [
        "  ".join(
            cell.rjust(width) if column else cell.ljust(width)
            for column, (cell, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (head, *rows)
    ]


def _name(path: str, taken: Mapping[str, object]) -> str:
    """Return a short name for a dataset, different from the others."""
    stem = "".join(sign if sign.isalnum() or sign in "._-" else "_" for sign in Path(path).stem) or "dataset"
    name, number = stem, 2
    while name in taken:
        name, number = f"{stem}_{number}", number + 1
    return name


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("datasets", nargs="+", metavar="DATASET", help="folder or .zip of ipsys pack")
    parser.add_argument(
        "--own", action="append", default=[], metavar="FILE.py:CLASS", help="a model of yours"
    )
    parser.add_argument(
        "--estimates",
        nargs="*",
        type=Path,
        metavar="FOLDER",
        help="score estimates, those of the datasets and these",
    )
    parser.add_argument("--markdown", action="store_true", help="print a table in Markdown")
    options = parser.parse_args()
    scores: dict[str, dict[str, tuple[float, bool]]] = {}
    try:
        for path in options.datasets:
            name = _name(path, scores)
            is_estimate = options.estimates is not None
            scores[name] = (
                estimate_scores(path, name, options.estimates)
                if is_estimate
                else dataset_scores(path, options.own)
            )
    except ipsys.IpsysError as error:
        sys.exit(str(error))
    rows = leaderboard(scores)
    print(
        *table_lines(
            ("model" if options.estimates is None else "estimate", "mean rank", *scores),
            rows,
            options.markdown,
        ),
        sep="\n",
    )
    notes = {
        HEIGHT_NOTE: any(row[0].endswith("*") for row in rows),
        f"{_DIFFERS} does not come out as stated": any(_DIFFERS in cell for row in rows for cell in row[2:]),
    }
    print("", *(note for note, needed in notes.items() if needed), sep="\n")


if __name__ == "__main__":
    main()
