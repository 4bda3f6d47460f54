"""How accurate a session is: one summary, as JSON and as tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table

from ipsys_log.log.session import Session
from ipsys_log.messages import (
    TRUTH_TOPIC,
    CameraEvaluation,
    ErrorStatistics,
    Evaluation,
    LearningPoint,
    Suspect,
    Tracks,
)
from ipsys_log.offline.errors import CROSS_VALIDATION, POOLED
from ipsys_log.offline.truth import gather_tracks, track_errors
from ipsys_log.runs import Outcome
from ipsys_log.units import CM_PER_M

__all__ = ["Accuracy", "accuracy_json", "accuracy_tables", "read_accuracy"]


@dataclass(frozen=True, slots=True)
class Accuracy:
    """One model's evaluation, and its tracks against the truth where there is one."""

    run: str
    evaluation: Evaluation | None
    tracks: tuple[ErrorStatistics, ErrorStatistics] | None

    @property
    def model(self) -> str:
        return self.evaluation.model if self.evaluation else self.run

    def rows(self, cross_validated: bool) -> list[CameraEvaluation]:
        """The rows by cross-validation, or those of the places held out."""
        rows = self.evaluation.cameras if self.evaluation else ()
        return [row for row in rows if (row.scheme == CROSS_VALIDATION) == cross_validated]


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
    """The summary as plain data, in cm.

    ``models -> cameras -> 3d / 2d`` on places held out, in each of these ``cross_validation`` and
    ``truth`` where there are such; ``pooled`` has the same over all cameras.
    """
    models: dict[str, Any] = {}
    for accuracy in accuracies:
        cameras: dict[str, Any] = {}
        for row in (*accuracy.rows(False), *accuracy.rows(True)):
            place = cameras.setdefault(row.camera, {})
            if row.scheme == CROSS_VALIDATION:
                place = place.setdefault("cross_validation", {})
            if row.against != "tape":
                place = place.setdefault(row.against, {})
            place.update(_row_json(row))
        found: dict[str, Any] = {"run": accuracy.run}
        if POOLED in cameras:
            found["pooled"] = cameras.pop(POOLED)
        found["cameras"] = cameras
        if accuracy.evaluation is not None:
            found["learning_curve"] = [_learning_json(point) for point in accuracy.evaluation.learning]
            found["suspects"] = [suspect_json(suspect) for suspect in accuracy.evaluation.suspects]
        if accuracy.tracks is not None:
            found["tracks"] = {
                "truth": {"3d": _statistics(accuracy.tracks[0]), "2d": _statistics(accuracy.tracks[1])}
            }
        models[accuracy.model] = found
    return {"models": models}


def _row_json(row: CameraEvaluation) -> dict[str, Any]:
    found: dict[str, Any] = {}
    if row.error_3d is not None:
        found["3d"] = _statistics(row.error_3d)
    found["2d"] = _statistics(row.error_2d)
    if row.bias_m is not None:
        found["bias_cm"] = (row.bias_m * CM_PER_M).tolist()
    if row.within_68 is not None and row.within_95 is not None:
        found["within"] = {"68": row.within_68, "95": row.within_95}
    return found


def _statistics(errors: ErrorStatistics) -> dict[str, float | int]:
    values = {
        "mean_cm": errors.mean_m,
        "min_cm": errors.min_m,
        "max_cm": errors.max_m,
        "std_cm": errors.std_m,
        "median_cm": errors.median_m,
        "p95_cm": errors.p95_m,
        "mean_low_cm": errors.mean_low_m,
        "mean_high_cm": errors.mean_high_m,
    }
    found: dict[str, float | int] = {k: v * CM_PER_M for k, v in values.items() if v is not None}
    return {**found, "n": errors.count}


def _learning_json(point: LearningPoint) -> dict[str, Any]:
    found: dict[str, Any] = {"camera": point.camera, "pairs": point.pairs, "subsets": point.subsets}
    if point.label is not None:
        found["label"] = point.label
    for kind, mean_m, std_m in (
        ("3d", point.mean_3d_m, point.std_3d_m),
        ("2d", point.mean_2d_m, point.std_2d_m),
    ):
        found[kind] = {"mean_cm": mean_m * CM_PER_M}
        if std_m is not None:
            found[kind]["std_cm"] = std_m * CM_PER_M
    return found


def suspect_json(suspect: Suspect) -> dict[str, Any]:
    found: dict[str, Any] = {
        "measurement": suspect.measurement,
        "cameras": list(suspect.cameras),
        "residual_cm": (suspect.residual_m * CM_PER_M).tolist(),
        "score": suspect.score,
    }
    if suspect.kind is not None:
        found["kind"] = suspect.kind
    if suspect.text is not None:
        found["text"] = suspect.text
    if suspect.corrected_m is not None:
        found["corrected_m"] = suspect.corrected_m.tolist()
    return found


def accuracy_tables(accuracies: Sequence[Accuracy]) -> list[Table]:
    """The summary as tables of at most 80 columns; of many models only all cameras together."""
    tables = []
    if any(accuracy.rows(False) or accuracy.tracks for accuracy in accuracies):
        tables.append(_held_out_table(accuracies))
    if any(accuracy.rows(True) for accuracy in accuracies):
        tables.append(_cross_validation_table(accuracies))
    if any(accuracy.evaluation and accuracy.evaluation.suspects for accuracy in accuracies):
        tables.append(_suspects_table(accuracies))
    return tables


def _table(title: str, names: Iterable[str], figures: Iterable[str]) -> Table:
    table = Table(title=title, title_justify="left", box=None, pad_edge=False, padding=(0, 1, 0, 0))
    for column in names:
        # The longest name of a model goes on in a second line.
        table.add_column(column, overflow="fold", max_width=16)
    for column in figures:
        table.add_column(column, justify="right")
    return table


def _held_out_table(accuracies: Sequence[Accuracy]) -> Table:
    figures = ("n", "3D mean", "min", "max", "std", "2D mean", "max")
    table = _table("Errors in cm, on places held out", ("model", "camera", "against"), figures)
    for accuracy in accuracies:
        lines = [
            (row.camera, row.against, *_cells(row.error_3d, row.error_2d))
            for row in accuracy.rows(False)
            if row.camera != POOLED
        ]
        if accuracy.tracks is not None:
            lines.append(("(tracks)", "truth", *_cells(*accuracy.tracks)))
        for number, line in enumerate(lines):
            table.add_row("" if number else accuracy.model, *line)
    return table


def _cells(error_3d: ErrorStatistics | None, error_2d: ErrorStatistics) -> list[str]:
    in_space = (error_3d.mean_m, error_3d.min_m, error_3d.max_m, error_3d.std_m) if error_3d else (None,) * 4
    return [str(error_2d.count), *map(_cm, (*in_space, error_2d.mean_m, error_2d.max_m))]


def _cm(value_m: float | None) -> str:
    return "-" if value_m is None else f"{value_m * CM_PER_M:.3f}"


def _cross_validation_table(accuracies: Sequence[Accuracy]) -> Table:
    figures = ("n", "3D mean", "95 % CI", "p50", "p95", "max", "2D mean")
    title = "By cross-validation, in cm: each place predicted by models that were not fitted on it"
    table = _table(title, ("model", "camera", "against"), figures)
    for accuracy in accuracies:
        rows = accuracy.rows(True)
        if len(accuracies) > 1 and any(row.camera == POOLED for row in rows):
            rows = [row for row in rows if row.camera == POOLED]
        for row in rows:
            errors = row.error_3d or row.error_2d
            space = row.error_3d is not None
            table.add_row(
                accuracy.model,
                row.camera or "(all)",
                row.against,
                str(errors.count),
                _cm(errors.mean_m if space else None),
                _interval(errors) if space else "-",
                *(_cm(v if space else None) for v in (errors.median_m, errors.p95_m, errors.max_m)),
                _cm(row.error_2d.mean_m),
            )
        if len(accuracies) == 1:
            table.add_section()
    return table


def _interval(errors: ErrorStatistics) -> str:
    if errors.mean_low_m is None or errors.mean_high_m is None:
        return "-"
    return f"{errors.mean_low_m * CM_PER_M:.2f}-{errors.mean_high_m * CM_PER_M:.2f}"


def _suspects_table(accuracies: Sequence[Accuracy]) -> Table:
    """Each suspect once, with the models that say so."""
    table = _table("Suspect measurements, the worst first: measure these again", ("place",), ())
    table.add_column("off by cm", justify="right")
    table.add_column("found by")
    table.add_column("what would explain it", overflow="fold")
    for suspect, models in gather_suspects(accuracies):
        length_cm = float((suspect.residual_m**2).sum() ** 0.5) * CM_PER_M
        table.add_row(
            suspect.measurement, f"{length_cm:.1f}", ", ".join(models), suspect.text or "nothing simple"
        )
    return table


def gather_suspects(accuracies: Sequence[Accuracy]) -> list[tuple[Suspect, list[str]]]:
    """Each suspect as the last model has it that names it, and all that do; the worst first."""
    found: dict[str, tuple[Suspect, list[str]]] = {}
    for accuracy in accuracies:
        for suspect in accuracy.evaluation.suspects if accuracy.evaluation else ():
            models = found.get(suspect.measurement, (suspect, []))[1]
            found[suspect.measurement] = (suspect, [*models, accuracy.model])
    return sorted(found.values(), key=lambda pair: -pair[0].score)
