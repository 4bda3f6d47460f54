"""How accurate a session is: one summary, as JSON and as a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from ipsys_log.log.session import Session
from ipsys_log.messages import (
    TRUTH_TOPIC,
    ErrorStatistics,
    Evaluation,
    Tracks,
)
from ipsys_log.offline.evaluate import gather_tracks, track_errors
from ipsys_log.runs import Outcome
from ipsys_log.units import CM_PER_M

__all__ = ["Accuracy", "accuracy_json", "accuracy_table", "read_accuracy"]


@dataclass(frozen=True, slots=True)
class Accuracy:
    """One model's evaluation, and its tracks against the truth where there is one."""

    run: str
    evaluation: Evaluation | None
    tracks: tuple[ErrorStatistics, ErrorStatistics] | None


def read_accuracy(session: Session, outcomes: Sequence[Outcome]) -> list[Accuracy]:
    """What a replay has found, read from the log that holds it."""
    evaluated = [outcome.run for outcome in outcomes if outcome.stage == "evaluate"]
    fused = [outcome.run for outcome in outcomes if outcome.stage == "fuse"]
    found = []
    for run in dict.fromkeys([*evaluated, *fused]):
        evaluations = session.payloads(session.topics(Evaluation, run))
        tracks = None
        if run in fused and session.count(TRUTH_TOPIC):
            tracks = track_errors(
                gather_tracks(session.messages(session.topics(Tracks, run))),
                gather_tracks(session.messages([TRUTH_TOPIC])),
            )
        if evaluations or tracks is not None:
            found.append(Accuracy(run, evaluations[-1] if evaluations else None, tracks))
    return found


def accuracy_json(accuracies: Sequence[Accuracy]) -> dict[str, Any]:
    """The summary as plain data, in cm: ``models -> cameras -> 3d / 2d``; ``truth`` where known."""
    models: dict[str, Any] = {}
    for accuracy in accuracies:
        name = accuracy.evaluation.model if accuracy.evaluation else accuracy.run
        cameras: dict[str, Any] = {}
        for row in accuracy.evaluation.cameras if accuracy.evaluation else ():
            errors = {"3d": _statistics(row.error_3d), "2d": _statistics(row.error_2d)}
            if row.against == "tape":
                cameras.setdefault(row.camera, {}).update(errors)
            else:
                cameras.setdefault(row.camera, {})[row.against] = errors
        models[name] = {"run": accuracy.run, "cameras": cameras}
        if accuracy.tracks is not None:
            models[name]["tracks"] = {
                "truth": {"3d": _statistics(accuracy.tracks[0]), "2d": _statistics(accuracy.tracks[1])}
            }
    return {"models": models}


def _statistics(errors: ErrorStatistics) -> dict[str, float | int]:
    found: dict[str, float | int] = {
        "mean_cm": errors.mean_m * CM_PER_M,
        "min_cm": errors.min_m * CM_PER_M,
        "max_cm": errors.max_m * CM_PER_M,
        "n": errors.count,
    }
    if errors.std_m is not None:
        found["std_cm"] = errors.std_m * CM_PER_M
    return found


def accuracy_table(accuracies: Sequence[Accuracy]) -> Table:
    """The summary as a table of at most 80 columns: a row for each model and camera."""
    table = Table(title="Errors in cm, on places held out", title_justify="left", box=None, pad_edge=False)
    for column in ("model", "camera", "against"):
        table.add_column(column)
    for column in ("n", "3D mean", "min", "max", "std", "2D mean", "max"):
        table.add_column(column, justify="right")
    for accuracy in accuracies:
        rows = list(accuracy.evaluation.cameras) if accuracy.evaluation else []
        name = accuracy.evaluation.model if accuracy.evaluation else accuracy.run
        for row in rows:
            table.add_row(name, row.camera, row.against, *_cells(row.error_3d, row.error_2d))
        if accuracy.tracks is not None:
            table.add_row(name, "(tracks)", "truth", *_cells(*accuracy.tracks))
        table.add_section()
    return table


def _cells(error_3d: ErrorStatistics, error_2d: ErrorStatistics) -> list[str]:
    values = (
        error_3d.mean_m,
        error_3d.min_m,
        error_3d.max_m,
        error_3d.std_m,
        error_2d.mean_m,
        error_2d.max_m,
    )
    return [str(error_3d.count), *("-" if v is None else f"{v * CM_PER_M:.3f}" for v in values)]
