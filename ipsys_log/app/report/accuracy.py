"""The accuracy of a session: the evaluations in a log, and their summary as JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ipsys_log.app.report.advice import Advice, Choice, advise
from ipsys_log.app.report.json_format import plain
from ipsys_log.app.report.rows import cm
from ipsys_log.engine.graph import writes
from ipsys_log.engine.provenance import Outcome
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    TRUTH_TOPIC,
    CameraEvaluation,
    ErrorStatistics,
    Evaluation,
    LearningPoint,
    Run,
    Suspect,
)
from ipsys_log.messages.channels import EVALUATION, MODEL, TRACKS
from ipsys_log.models.table import is_known, reads_height
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, POOLED, count_repeats, root_mean_square_m
from ipsys_log.statistics.ground_truth import (
    TrackErrors,
    TrajectoryErrors,
    gather_paths,
    pool_trajectories,
    track_errors,
    trajectory_errors,
)


class ErrorRow(NamedTuple):
    """The errors of a model in a camera as the row of a table, in space and on the floor.

    ``repeats`` is the number of errors of each point; without it, the RMSE is not known.
    """

    camera: str
    against: str
    space: ErrorStatistics | None
    floor: ErrorStatistics
    repeats: int | None = 1

    def rmse_m(self, errors: ErrorStatistics | None) -> float | None:
        """Return the RMSE of the errors in space or on the floor."""
        if errors is None or self.repeats is None:
            return None
        return root_mean_square_m(errors, self.repeats)

    def text(self, column: str, digits: int = 2) -> str:
        """Return the cell of a column in cm, such as ``n``, ``3D mean``, ``2D RMSE`` or ``3D 95 % CI``."""
        if column == "n":
            return str(self.floor.count)
        kind, _, name = column.partition(" ")
        errors = self.space if kind == "3D" else self.floor
        if errors is None:
            return cm(None)
        if name == "95 % CI":
            return interval_cm(errors)
        if name == "mean (95 % CI)":
            low_high = interval_cm(errors, " to ")
            return f"{cm(errors.mean_m)} ({low_high})" if errors.mean_low_m is not None else cm(errors.mean_m)
        return cm(self.rmse_m(errors) if name == "RMSE" else getattr(errors, f"{name}_m"), digits)


def interval_cm(errors: ErrorStatistics, between: str = "-") -> str:
    """Format the 95 % confidence interval of a mean in cm, or return a dash."""
    if errors.mean_low_m is None or errors.mean_high_m is None:
        return cm(None)
    return f"{cm(errors.mean_low_m)}{between}{cm(errors.mean_high_m)}"


@dataclass(frozen=True, slots=True, eq=False)
class Accuracy:
    """The evaluation of one model, and the errors of its tracks if the log has ground truth.

    ``trajectories`` are the errors of the tracks by robot.
    """

    run: str
    evaluation: Evaluation | None
    tracks: TrackErrors | None
    trajectories: tuple[TrajectoryErrors, ...] = ()

    @property
    def model(self) -> str:
        return self.evaluation.model if self.evaluation else self.run

    def rows(self, cross_validated: bool) -> list[CameraEvaluation]:
        """Return the cross-validated rows, or the rows on held-out points."""
        rows = self.evaluation.cameras if self.evaluation else ()
        return [row for row in rows if (row.scheme == CROSS_VALIDATION) == cross_validated]

    def rows_with_excluded(self, cross_validated: bool) -> list[CameraEvaluation]:
        """Return the rows with the gross outliers; the rows of :meth:`rows` if there are none."""
        rows = self.evaluation.with_excluded if self.evaluation else ()
        if not rows:
            return self.rows(cross_validated)
        return [row for row in rows if (row.scheme == CROSS_VALIDATION) == cross_validated]

    def errors_of(self, row: CameraEvaluation) -> ErrorRow:
        """Return the errors of a row for tables and JSON, with their RMSE."""
        rows = self.evaluation.cameras if self.evaluation else ()
        if self.evaluation and any(other is row for other in self.evaluation.with_excluded):
            rows = self.evaluation.with_excluded
        return ErrorRow(row.camera, row.against, row.error_3d, row.error_2d, count_repeats(row, rows))


def read_accuracy(session: Session, outcomes: Sequence[Outcome | Run]) -> list[Accuracy]:
    """Read the accuracy of each model from its log, by the outcomes of a replay or the records of runs."""
    accuracies = []
    for evaluated, fused in _run_pairs(outcomes):
        run = evaluated or fused
        evaluations = session.payloads(session.topics(EVALUATION, run))
        tracks, trajectories = _track_errors(session, fused)
        if evaluations or tracks is not None:
            evaluation = evaluations[-1] if evaluations else None
            accuracies.append(Accuracy(run, evaluation, tracks, tuple(trajectories)))
    return accuracies


def read_trajectories(session: Session, run: str) -> list[TrajectoryErrors]:
    """Return the errors of the tracks of a run by robot; none without tracks or without ground truth."""
    return _track_errors(session, run)[1]


def _track_errors(session: Session, run: str) -> tuple[TrackErrors | None, list[TrajectoryErrors]]:
    """Return the errors of the tracks of a run, at all robots and by robot, if there is ground truth."""
    if not run or not session.count(TRUTH_TOPIC):
        return None, []
    paths = gather_paths(session.messages(session.topics(TRACKS, run)))
    true = gather_paths(session.messages([TRUTH_TOPIC]))
    errors = track_errors(
        {marker_id: path.positions for marker_id, path in paths.items()},
        {marker_id: path.positions for marker_id, path in true.items()},
        at_track_height=_uses_heights(session, run),
    )
    return errors, trajectory_errors(paths, true)


def _run_pairs(outcomes: Sequence[Outcome | Run]) -> list[tuple[str, str]]:
    """Return for each model the run of its evaluation and the run of its tracks; "" if there is none.

    The two names differ if a model was evaluated again, for example with other folds.
    """
    pairs: list[tuple[str, str]] = []
    for outcome in outcomes:
        if writes(outcome, EVALUATION):
            pairs.append((outcome.run, ""))
        elif writes(outcome, TRACKS) and pairs and not pairs[-1][1]:
            pairs[-1] = (pairs[-1][0], outcome.run)
        elif writes(outcome, TRACKS):
            pairs.append(("", outcome.run))
    return pairs


def _uses_heights(session: Session, run: str) -> bool:
    models = session.payloads(session.topics(MODEL, run))
    return bool(models) and is_known(models[-1].name) and reads_height(models[-1].name)


def accuracy_json(accuracies: Sequence[Accuracy]) -> dict[str, Any]:
    """Return the summary as plain data, in m.

    ``models -> cameras -> 3d / 2d`` are the errors on held-out points. Each camera may also have
    ``cross_validation`` and ``truth``. ``pooled`` has the same over all cameras. ``recommendation`` exists
    only with learning curves. If measurements are ``excluded`` as gross outliers, ``with_excluded`` has the
    errors with them.
    """
    models = {accuracy.model: _model_json(accuracy) for accuracy in accuracies}
    advice = advise([accuracy.evaluation for accuracy in accuracies if accuracy.evaluation])
    return {"models": models} | ({"recommendation": _advice_json(advice)} if advice else {})


def _model_json(accuracy: Accuracy) -> dict[str, Any]:
    rows = (*accuracy.rows(False), *accuracy.rows(True))
    summary: dict[str, Any] = {"run": accuracy.run, **_rows_json(accuracy, rows)}
    if accuracy.evaluation is not None:
        summary["learning_curve"] = [_learning_json(point) for point in accuracy.evaluation.learning]
        summary["suspects"] = plain(accuracy.evaluation.suspects)
        if accuracy.evaluation.excluded:
            rows = (*accuracy.rows_with_excluded(False), *accuracy.rows_with_excluded(True))
            summary["excluded"] = plain(accuracy.evaluation.excluded)
            summary["with_excluded"] = _rows_json(accuracy, rows)
    if accuracy.tracks is not None:
        summary["tracks"] = _tracks_json(accuracy.tracks) | _trajectories_json(accuracy.trajectories)
    return summary


def _rows_json(accuracy: Accuracy, rows: Sequence[CameraEvaluation]) -> dict[str, Any]:
    cameras: dict[str, Any] = {}
    for row in rows:
        target = cameras.setdefault(row.camera, {})
        if row.scheme == CROSS_VALIDATION:
            target = target.setdefault("cross_validation", {})
        if row.against != "tape":
            target = target.setdefault(row.against, {})
        target.update(_row_json(accuracy, row))
    pooled = {"pooled": cameras.pop(POOLED)} if POOLED in cameras else {}
    return {**pooled, "cameras": cameras}


def _tracks_json(tracks: TrackErrors) -> dict[str, Any]:
    """Return the errors at the instants that count, at the others, and at all; one of them may be missing."""
    instants = {"counted": tracks.counted, "all": tracks.instants}
    pairs = {"truth": (tracks.space, tracks.floor)}
    if tracks.others is not None:
        pairs |= {"other_heights": tracks.others, "all_heights": tracks.whole}
    rows = {name: ErrorRow(POOLED, "truth", *pair) for name, pair in pairs.items()}
    return {"instants": instants, **{name: _errors_json(row) for name, row in rows.items()}}


def _trajectories_json(trajectories: Sequence[TrajectoryErrors]) -> dict[str, Any]:
    """Return the absolute trajectory error and the relative pose error, over all robots and by robot."""
    if not trajectories:
        return {}
    robots = {one.robot: _trajectory_json(one) for one in trajectories}
    return {**_trajectory_json(pool_trajectories(trajectories)), "robots": robots}


def _trajectory_json(trajectory: TrajectoryErrors) -> dict[str, Any]:
    return {
        "ate": _errors_json(ErrorRow(POOLED, "truth", trajectory.absolute_3d, trajectory.absolute_2d)),
        "rpe": [
            {"delta": one.delta, "unit": one.unit, "relation": one.relation, **_statistics(one.summary, 1)}
            for one in trajectory.relative
        ],
    }


def _row_json(accuracy: Accuracy, row: CameraEvaluation) -> dict[str, Any]:
    within = None if row.within_68 is None else {"68": row.within_68, "95": row.within_95}
    return _errors_json(accuracy.errors_of(row)) | dict(plain({"bias_m": row.bias_m, "within": within}))


def _errors_json(row: ErrorRow) -> dict[str, Any]:
    """Return the statistics and the RMSE of errors in space, if they are known, and on the floor."""
    kinds = {name: errors for name, errors in (("3d", row.space), ("2d", row.floor)) if errors is not None}
    return {name: _statistics(errors, row.repeats) for name, errors in kinds.items()}


def _statistics(errors: ErrorStatistics, repeats: int | None) -> dict[str, Any]:
    rmse = {} if repeats is None else {"rmse_m": root_mean_square_m(errors, repeats)}
    return {**plain(errors), **rmse}


def _learning_json(point: LearningPoint) -> Any:
    return plain(
        {
            "camera": point.camera,
            "pairs": point.pairs,
            "subsets": point.subsets,
            "label": point.label,
            "3d": {"mean_m": point.mean_3d_m, "std_m": point.std_3d_m},
            "2d": {"mean_m": point.mean_2d_m, "std_m": point.std_2d_m},
        }
    )


def _advice_json(advice: Advice) -> dict[str, Any]:
    """Return the model to use and the lowest error, by number of points and model group (:mod:`.advice`)."""
    return {
        "subsets": "labelled" if advice.published else "random",
        "errors": "3d" if advice.in_space else "2d",
        "by_places": [
            {"places": places} | {group: _choice_json(choice) for group, choice in choices.items()}
            for places, choices in advice.choices.items()
        ],
        "sentences": list(advice.sentences),
    }


def _choice_json(choice: Choice) -> dict[str, Any]:
    return {
        "use": choice.model,
        "mean_m": choice.mean_m,
        "lowest": choice.lowest,
        "lowest_mean_m": choice.lowest_mean_m,
    }


def gather_outliers(accuracies: Sequence[Accuracy]) -> list[tuple[Suspect, list[str]]]:
    """Return each outlier, from the last model that names it, with the names of all models that do.

    A gross outlier, which is excluded from the evaluation of every model, may have no such model. The outlier
    with the largest residual is first.
    """
    by_measurement: dict[str, tuple[Suspect, list[str]]] = {}
    for accuracy in accuracies:
        for suspect in accuracy.evaluation.excluded if accuracy.evaluation else ():
            by_measurement.setdefault(suspect.measurement, (suspect, []))
        for suspect in accuracy.evaluation.suspects if accuracy.evaluation else ():
            models = by_measurement.get(suspect.measurement, (suspect, []))[1]
            by_measurement[suspect.measurement] = (suspect, [*models, accuracy.model])
    return sorted(by_measurement.values(), key=lambda pair: -float((pair[0].residual_m ** 2).sum()))
