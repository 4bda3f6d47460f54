"""The data of tables, figures and the report: evaluations, and the lab of these evaluations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ipsys_log.app.report.accuracy import Accuracy
from ipsys_log.app.report.advice import Advice, advise, uses_height
from ipsys_log.engine.graph import input_runs, writes
from ipsys_log.engine.provenance import complete_runs, newest_run, replaced_lenses
from ipsys_log.engine.view import LogView
from ipsys_log.errors import FitError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CameraEvaluation, ErrorStatistics, Evaluation, Model, Rig
from ipsys_log.messages.channels import EVALUATION, MEASUREMENTS, MODEL
from ipsys_log.models.table import is_known, reads_corners
from ipsys_log.sinks.selection import rig_in_force
from ipsys_log.statistics.accuracy import POOLED
from ipsys_log.statistics.calibration_points import measured, split_ids
from ipsys_log.tools.soundness.references import check_clocks

if TYPE_CHECKING:
    from ipsys_log.statistics.calibrated_cameras import CalibratedCamera


@dataclass(frozen=True, slots=True, eq=False)
class PointErrors:
    """The position errors of one camera at n calibration points, in m, as means over repeats.

    Attributes
    ----------
    camera : name of the camera.
    world_m, offsets_m : (n, 3), the points, and predicted minus measured positions.
    lengths_m : (n, 2), lengths of the errors in space and on the floor.
    """

    camera: str
    world_m: Array
    offsets_m: Array
    lengths_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """The evaluated models of a session, and their lab.

    Attributes
    ----------
    rig : rig in force.
    accuracies : accuracies of the evaluated models.
    fitted : fitted models by name; a model of a log by other software may be missing.
    cameras : cameras in the order of the rig, which is the order of the paper's tables.
    advice : advice from learning curves; None without learning curves.
    calibrated : cameras of the joint model; empty without such a model.
    clock_contradictions : a sentence for each camera of a node whose clock contradicts the joint model.
    """

    rig: Rig | None
    accuracies: tuple[Accuracy, ...]
    fitted: Mapping[str, Model]
    cameras: tuple[str, ...]
    advice: Advice | None
    calibrated: tuple[CalibratedCamera, ...] = ()
    clock_contradictions: tuple[str, ...] = ()

    @property
    def models(self) -> list[str]:
        return [accuracy.model for accuracy in self.accuracies]

    @property
    def evaluations(self) -> list[Evaluation]:
        return [accuracy.evaluation for accuracy in self.accuracies if accuracy.evaluation]

    @property
    def in_space(self) -> bool:
        """The kind of the errors: True in space, False on the floor (if heights cannot be learned)."""
        return in_space(self.accuracies)

    def errors(self, row: CameraEvaluation) -> ErrorStatistics:
        """Return the errors of a row by which models are compared."""
        return ranking_errors(row, self.in_space)

    def ranked(self) -> list[Accuracy]:
        """Return the models, the lowest mean error first; models with heights as input come last."""
        return rank(self.accuracies)

    def training_m(self) -> dict[str, Array]:
        """Return the points that models were fitted on, (n, 3) in m by camera."""
        points_m: dict[str, Array] = {}
        for model in self.fitted.values():
            for camera in model.cameras:
                if camera.pairs and camera.camera not in points_m:
                    points_m[camera.camera] = np.array([pair.world_m for pair in camera.pairs])
        return points_m

    def test_m(self) -> dict[str, Array]:
        """Return the held-out points, (n, 3) in m by camera."""
        rows = [row for accuracy in self.accuracies for row in accuracy.rows(False)]
        return {
            row.camera: np.array([residual.world_m for residual in row.residuals])
            for row in rows
            if row.against == "tape" and row.residuals
        }

    def point_errors(self, accuracy: Accuracy) -> list[PointErrors]:
        """Return the errors at each point against the tape: cross-validated, or else on held-out points."""
        rows = accuracy.rows(True) or accuracy.rows(False)
        return [_point_errors(row) for row in rows if row.against == "tape" and row.residuals]


def _point_errors(row: CameraEvaluation) -> PointErrors:
    places: dict[str, list[Array]] = {}
    offsets: dict[str, list[Array]] = {}
    for residual in row.residuals:
        places.setdefault(residual.measurement, []).append(residual.world_m)
        offsets.setdefault(residual.measurement, []).append(residual.predicted_m - residual.world_m)
    lengths = [
        [np.linalg.norm(vectors_m, axis=1).mean(), np.linalg.norm(np.array(vectors_m)[:, :2], axis=1).mean()]
        for vectors_m in offsets.values()
    ]
    return PointErrors(
        row.camera,
        np.array([vectors_m[0] for vectors_m in places.values()]),
        np.array([np.mean(vectors_m, axis=0) for vectors_m in offsets.values()]),
        np.array(lengths),
    )


def in_space(accuracies: Sequence[Accuracy]) -> bool:
    """Return True for errors in space, or False for errors on the floor (if heights cannot be learned)."""
    rows = [row for accuracy in accuracies if accuracy.evaluation for row in accuracy.evaluation.cameras]
    return all(row.error_3d is not None for row in rows)


def ranking_errors(row: CameraEvaluation, space: bool) -> ErrorStatistics:
    """Return the errors of a row by which models are compared, in space or on the floor."""
    return row.error_3d if space and row.error_3d is not None else row.error_2d


def errors_in(row: CameraEvaluation | None, space: bool) -> ErrorStatistics | None:
    """Return the errors of a row in space or on the floor; None without them."""
    return None if row is None else row.error_3d if space else row.error_2d


def rank(accuracies: Sequence[Accuracy]) -> list[Accuracy]:
    """Sort models: the lowest mean error first; models with heights as input come last."""
    space = in_space(accuracies)

    def place(accuracy: Accuracy) -> tuple[bool, bool, float]:
        row = overall_row(accuracy, True) or overall_row(accuracy, False)
        return row is None, uses_height(accuracy.model), ranking_errors(row, space).mean_m if row else np.inf

    return sorted(accuracies, key=place)


def overall_row(accuracy: Accuracy, cross_validated: bool, against: str = "tape") -> CameraEvaluation | None:
    """Return the row over all cameras; with a single camera, return the row of this camera."""
    return _overall(accuracy.rows(cross_validated), against)


def _overall(rows: Sequence[CameraEvaluation], against: str) -> CameraEvaluation | None:
    rows = [row for row in rows if row.against == against]
    return next((row for row in rows if row.camera == POOLED), next(iter(rows), None))


def overall_row_with_excluded(accuracy: Accuracy, cross_validated: bool) -> CameraEvaluation | None:
    """Return the row over all cameras with the gross outliers; None if no measurement is excluded."""
    if not (accuracy.evaluation and accuracy.evaluation.with_excluded):
        return None
    return _overall(accuracy.rows_with_excluded(cross_validated), "tape")


def gather_findings(session: Session, accuracies: Sequence[Accuracy]) -> Findings:
    """Gather the evaluations of a session, with the models and the lab."""
    evaluated = tuple(accuracy for accuracy in accuracies if accuracy.evaluation is not None)
    rig = rig_in_force(session, [accuracy.run for accuracy in evaluated])
    evaluations = [accuracy.evaluation for accuracy in evaluated if accuracy.evaluation]
    cameras = {row.camera for evaluation in evaluations for row in evaluation.cameras} - {POOLED}
    rig_cameras = [camera.name for camera in rig.cameras] if rig else []
    ordered = [name for name in rig_cameras if name in cameras]
    models = {accuracy.model: _model(session, accuracy.run) for accuracy in evaluated}
    if (
        not models and (run := newest_run(session, MODEL)) is not None
    ):  # a live session with the model of a log
        models[run] = _model(session, run)
    return Findings(
        rig,
        evaluated,
        {name: model for name, model in models.items() if model is not None},
        (*ordered, *sorted(cameras - {*ordered})),
        advise(evaluations),
        _calibrated(session, evaluated, models),
        tuple(finding.text for finding in check_clocks(session)),
    )


def _calibrated(
    session: Session, accuracies: Sequence[Accuracy], models: Mapping[str, Model | None]
) -> tuple[CalibratedCamera, ...]:
    """Return the cameras of the joint model among the evaluated models."""
    joint = [one for one in accuracies if is_known(one.model) and reads_corners(one.model)]
    model = models[joint[0].model] if joint else None
    if model is None:
        return ()
    run = joint[0].run
    # Late: scipy takes 1 s, and most reports have no joint model.
    from ipsys_log.statistics.calibrated_cameras import describe_cameras
    from ipsys_log.statistics.joint_evaluation import fit_without, observe

    names = _model_runs(session, run)
    record = next((r for r in complete_runs(session)[::-1] if r.run in names and writes(r, MODEL)), None)
    view, fit = LogView(session), None
    if record is not None and {read.topic for read in record.inputs} & {*session.topics(MEASUREMENTS)}:
        view = LogView(session, input_runs(record), record.rig, replaced_lenses(record))
        measurements = [point.measurement for point in measured(view)]
        used, _ = split_ids(measurements, record.parameters)
        with suppress(FitError):
            fit = fit_without(observe(view), {one.id for one in measurements} - used)
    sizes_px = {camera: (lens.width, lens.height) for camera, lens in view.calibrations().items()}
    return describe_cameras(model, sizes_px, fit)


def _model(session: Session, run: str) -> Model | None:
    """Return the model that a run evaluated."""
    for name in _model_runs(session, run):
        if topics := session.topics(MODEL, name):
            model: Model = session.payloads(topics)[-1]
            return model
    return None


def _model_runs(session: Session, run: str) -> list[str]:
    """Return the runs that may have the model of an evaluation: its own run, and its input runs."""
    records = [record for record in session.runs() if record.run == run and writes(record, EVALUATION)]
    return [run, *(source for record in records for source in record.input_runs)]
