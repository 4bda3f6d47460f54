"""The two kinds of models, with one interface, and the evaluation of models of camera points.

A model of camera points maps those of one camera. A model of corners is a joint calibration of all cameras.
The rest of the program asks :func:`model_kind` what a model reads, and lets it fit, evaluate and apply it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ipsys_log.errors import FitError
from ipsys_log.messages import Array, CameraEvaluation, Evaluation, LearningPoint, Model, Pair, Rig, Suspect
from ipsys_log.messages.channels import (
    CALIBRATIONS,
    CAMERA_POINTS,
    MARKERS,
    MEASUREMENTS,
    MODEL,
    RIG,
    Channel,
)
from ipsys_log.messages.stage import Progress, StageView, Step
from ipsys_log.models.locate_points import LocatePoints
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import AppliedModel, min_pairs, reads_corners, reads_height
from ipsys_log.statistics import camera_models
from ipsys_log.statistics.accuracy import evaluate_cross_validated, evaluate_held_out
from ipsys_log.statistics.calibration_points import (
    has_measurements,
    held_out_ids,
    level_cameras,
    measured,
    training_pairs,
)
from ipsys_log.statistics.cross_validation import (
    FOLDS,
    REPEATS,
    Study,
    gather_points,
    learning_curve,
    learning_sizes,
    leave_one_out,
    published_curve,
)
from ipsys_log.statistics.outliers import find_outliers, is_gross
from ipsys_log.statistics.tape import RiggedMeasurement
from ipsys_log.units import CM_PER_M

if TYPE_CHECKING:
    from ipsys_log.calibration.joint.model import JointModel


# Models that check the measurements. They fit in milliseconds, and they follow the calibration points
# closely enough to show an error of some centimetres.
SCREENING = ("poly", "rayplane", "best", "joint")
# The same model selects the gross outliers for all evaluations, so that all models have the same points. The
# polynomial is a hundred times as fast as the second model;
_GROSS_MODEL = "poly"
_GROSS_MODEL_FEW = "best"
# with fewer points of a camera, it is too uncertain.
_FEW = 20


def evaluate_model(
    model: Model, study: Study, time_ns: int, notes: list[str], progress: Callable[[int, int], None]
) -> Evaluation:
    """Compute errors on held-out points and by cross-validation, learning curve and suspect measurements.

    Gross outliers come first. The errors and the learning curve are without them, in the fit and in the test;
    the errors with them are in ``with_excluded``.

    Parameters
    ----------
    model : fitted model.
    time_ns : of the last input.
    notes : list of remarks; each impossible step adds a remark.
    progress : called with the number of steps done, and the number of all steps.
    """
    if study.seed is None:
        return Evaluation(time_ns, model.name, tuple(_held_out_rows(model, study)))
    cameras = gather_points(fitted_pairs(model, study))
    excluded = gross_outliers(cameras, study.places)
    reduced, clean = _without(model, study, {suspect.measurement for suspect in excluded}, notes)
    if reduced is model:
        excluded = ()
    remaining = gather_points(fitted_pairs(reduced, clean))
    total = 2 + len(learning_sizes(model.name, remaining))
    progress(0, total)
    rows = _rows(reduced, clean, notes)
    progress(1, total)
    learning: list[LearningPoint] = published_curve(model.name, remaining, study.subsets, clean.held_out)
    for done, points in enumerate(learning_curve(model.name, remaining, study.seed), 2):
        learning += points
        progress(done, total)
    suspects = _suspects(model.name, cameras, study.places) if model.name in SCREENING else ()
    with_excluded = _rows(model, study, []) if excluded else ()
    progress(total, total)
    return Evaluation(time_ns, model.name, rows, tuple(learning), suspects, excluded, with_excluded)


def fitted_pairs(model: Model, study: Study) -> dict[str, Sequence[Pair]]:
    fitted = {camera.camera for camera in model.cameras}
    return {camera: camera_pairs for camera, camera_pairs in study.pairs.items() if camera in fitted}


def _held_out_rows(model: Model, study: Study) -> list[CameraEvaluation]:
    held_out = {
        camera: [pair for pair in camera_pairs if pair.measurement in study.held_out]
        for camera, camera_pairs in study.pairs.items()
    }
    return evaluate_held_out(model, held_out, study.truth)


def _rows(model: Model, study: Study, notes: list[str]) -> tuple[CameraEvaluation, ...]:
    """Return the errors on held-out points and by cross-validation."""
    assert study.seed is not None
    rows, pairs = _held_out_rows(model, study), fitted_pairs(model, study)
    if _enough(model.name, pairs, notes):
        try:
            rows += evaluate_cross_validated(model, pairs, study.truth, study.seed)
        except FitError as error:
            notes.append(f"no cross-validation: {error}")
    return tuple(rows)


def gross_outliers(
    cameras: Mapping[str, CalibrationPoints], places: Sequence[RiggedMeasurement]
) -> tuple[Suspect, ...]:
    fewest = min((len(points.names) for points in cameras.values()), default=0)
    name = _GROSS_MODEL if fewest >= _FEW else _GROSS_MODEL_FEW
    return tuple(suspect for suspect in _suspects(name, cameras, places) if is_gross(suspect))


def _without(model: Model, study: Study, names: set[str], notes: list[str]) -> tuple[Model, Study]:
    """Return the model and the data without some measurements; both unchanged if this is impossible."""
    if not names:
        return model, study
    pairs = {camera: _remaining(camera_pairs, names) for camera, camera_pairs in study.pairs.items()}
    fitted = {camera.camera: _remaining(camera.pairs, names) for camera in model.cameras}
    if any(len(camera_pairs) < min_pairs(model.name) for camera_pairs in fitted.values()):
        notes.append("gross outliers are not excluded: too few calibration points remain")
        return model, study
    try:
        cameras = tuple(camera_models.fit_camera_models(model.name, gather_points(fitted), fitted))
    except FitError as error:
        notes.append(f"gross outliers are not excluded: {error}")
        return model, study
    clean = replace(study, pairs=pairs, held_out=study.held_out - names)
    return replace(model, cameras=cameras), clean


def _remaining(pairs: Sequence[Pair], names: set[str]) -> list[Pair]:
    return [pair for pair in pairs if pair.measurement not in names]


def _enough(name: str, pairs: Mapping[str, Sequence[Pair]], notes: list[str]) -> bool:
    """Return whether each fold leaves enough calibration points for a fit."""
    for camera, camera_pairs in pairs.items():
        if len(camera_pairs) - -(-len(camera_pairs) // FOLDS) < min_pairs(name):
            notes.append(
                f"no cross-validation of {name}: camera {camera} has only {len(camera_pairs)} "
                "calibration points"
            )
            return False
    return True


def _suspects(
    name: str, cameras: Mapping[str, CalibrationPoints], places: Sequence[RiggedMeasurement]
) -> tuple[Suspect, ...]:
    if any(len(points.names) <= min_pairs(name) + 1 for points in cameras.values()):
        return ()
    seen = {place for camera_places in cameras.values() for place in camera_places.names}
    try:
        return find_outliers(leave_one_out(name, cameras), [p for p in places if p.measurement.id in seen])
    except FitError:
        return ()


def can_evaluate(view: StageView, options: Mapping[str, str], model: str) -> bool:
    """Return whether a model has held-out points, or enough points for cross-validation."""
    measurements = [point.measurement for point in measured(view)]
    enough = len(measurements) - -(-len(measurements) // FOLDS) >= min_pairs(model)
    held_out = held_out_ids(measurements, options)
    return bool(held_out) or (can_refit(view, options, model) and enough)


def can_refit(view: StageView, options: Mapping[str, str], model: str) -> bool:
    """Return whether a model is fitted to points of this log: then it can be fitted to fewer points too."""
    if "model_from" in options:
        return False
    return has_measurements(view) or all(copy.name != model for _, copy in view.copied(MODEL))


# The channels that a joint calibration reads.
JOINT_READS = (RIG, CALIBRATIONS, MARKERS, CAMERA_POINTS, MEASUREMENTS)


class PointModels:
    """The models of camera points.

    Attributes
    ----------
    fit_reads : the channels that a fit reads.
    repeats : number of repeats of a cross-validation.
    is_checked : the checks before a fit find all its faults.
    """

    fit_reads: tuple[Channel, ...] = (RIG, CAMERA_POINTS, MEASUREMENTS)
    repeats = REPEATS
    is_checked = True

    def reads(self, name: str) -> tuple[Channel, ...]:
        """Return the channels that positions follow from."""
        return (RIG, CAMERA_POINTS) if reads_height(name) else (CAMERA_POINTS,)

    def fit_part(self, rig: Rig) -> object:
        """Return the part of the rig on which a fit and its evaluation depend."""
        return rig.reference_points, {m.id for m in rig.markers}

    def place_part(self, rig: Rig) -> object:
        """Return the part of the rig on which positions depend."""
        heights = {(m.id, m.height_m, m.height_sigma_m) for m in rig.markers}
        poses = [(m.id, m.robot, m.xyz_m, m.rpy_rad) for m in rig.markers]
        bodies = (rig.bodies, poses) if rig.bodies else ()
        return rig.marker_height_m, rig.marker_height_sigma_m, heights, *bodies

    def check_points(self, name: str, where: str, train_m: Array, has_corners: bool) -> None:
        """Check that a log has what a fit to points (n, 3) needs; ``where`` is the start of an error text."""
        if len(train_m) < min_pairs(name):
            raise FitError(
                f"{where}: {name} needs at least {min_pairs(name)} calibration points for each camera, "
                f"but the log has {len(train_m)} in all; measure more"
                + ("" if name == "rigid" else ", or use --model rigid")
            )
        camera_models.check_different(name, where, train_m)
        camera_models.check_line(where, train_m)

    def check_pairs(self, name: str, pairs: Mapping[str, Sequence[Pair]]) -> None:
        """Check that the observations of each camera are enough for a fit, if that is known before."""
        camera_models.check_pairs(name, pairs)

    def fit(
        self, name: str, view: StageView, train: Collection[str], notes: list[str], progress: Progress
    ) -> Model:
        """Fit a model of a log to the calibration points ``train``; add remarks to ``notes``."""
        pairs = training_pairs(view, train)
        fitted = camera_models.fit_model(name, pairs, view.last_ns(*self.fit_reads), progress)
        notes.extend(_unused_points(pairs, train))
        notes.extend(
            f"camera {camera}: all calibration points have the height {height_m * CM_PER_M:.1f} cm: the "
            "model is valid for x and y, and returns only this height"
            for camera, height_m in level_cameras(fitted).items()
        )
        return fitted

    def evaluate(
        self, model: Model, view: StageView, study: Study, time_ns: int, notes: list[str], progress: Progress
    ) -> Evaluation:
        """Compute the errors of a model; add remarks to ``notes``."""
        return evaluate_model(model, study, time_ns, notes, progress)

    def step(self, model: Model) -> Step:
        """Return the step from messages to positions."""
        return LocatePoints(model)

    def restore(self, model: Model) -> Mapping[str, AppliedModel]:
        """Return the fitted model of each camera."""
        return {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}


def _unused_points(pairs: Mapping[str, list[Pair]], train: Collection[str]) -> list[str]:
    """Return remarks on points that no camera saw, and on cameras that saw no point."""
    seen = {pair.measurement for camera_pairs in pairs.values() for pair in camera_pairs}
    unseen = sorted(set(train) - seen)
    lines = [
        f"camera {name} saw no calibration point: it has no model"
        for name, camera_pairs in pairs.items()
        if not camera_pairs
    ]
    if unseen:
        names = ", ".join(unseen[:5]) + (" ..." if len(unseen) > 5 else "")
        lines.append(
            f"{len(unseen)} of {len(train)} calibration points have no stationary interval in any "
            f"camera: {names}"
        )
    return lines


class CornerModels:
    """The models of corners, with the interface of :class:`PointModels`.

    One fit has all cameras, drives and calibration points. Its modules are imported late: scipy takes 1 s,
    and most commands need no such model.
    """

    fit_reads: tuple[Channel, ...] = JOINT_READS
    repeats = 1  # a fit takes seconds
    is_checked = False  # only a fit shows if the corners determine all cameras

    def reads(self, name: str) -> tuple[Channel, ...]:
        return RIG, MARKERS

    def fit_part(self, rig: Rig) -> object:
        markers = {
            (m.id, rig.length_of(m.id), rig.height_of(m.id), rig.height_sigma_of(m.id)) for m in rig.markers
        }
        cameras = {(camera.name, camera.row_time_ns) for camera in rig.cameras}
        tape = rig.tape_sigma_m, rig.tape_scale_sigma, rig.ab_sigma_m
        return _POINT_KIND.fit_part(rig), markers, cameras, tape

    def place_part(self, rig: Rig) -> object:
        references = {m.id for m in rig.reference_markers}
        lengths = {(m.id, m.length_m) for m in rig.markers}
        return _POINT_KIND.place_part(rig), rig.marker_length_m, lengths, references

    def check_points(self, name: str, where: str, train_m: Array, has_corners: bool) -> None:
        if not has_corners:
            raise FitError(
                f"{where}: {name} is fitted to the corners of markers, but the log has only camera points; "
                "use --model best"
            )

    def check_pairs(self, name: str, pairs: Mapping[str, Sequence[Pair]]) -> None:
        """Check nothing: a drive is enough."""

    def fit(
        self, name: str, view: StageView, train: Collection[str], notes: list[str], progress: Progress
    ) -> Model:
        from ipsys_log.statistics.joint_evaluation import fit_joint_model

        return fit_joint_model(view, train, view.last_ns(*self.fit_reads), notes, progress)

    def evaluate(
        self, model: Model, view: StageView, study: Study, time_ns: int, notes: list[str], progress: Progress
    ) -> Evaluation:
        """Compute the errors without the gross outliers that all models leave out."""
        from ipsys_log.statistics.joint_evaluation import evaluate_joint, observe

        cameras = gather_points(fitted_pairs(model, study))
        excluded = () if study.seed is None else gross_outliers(cameras, study.places)
        return evaluate_joint(model, observe(view), study, excluded, time_ns, notes, progress)

    def step(self, model: Model) -> Step:
        from ipsys_log.models.locate_corners import LocateCorners

        return LocateCorners(model)

    def restore(self, model: Model) -> Mapping[str, JointModel]:
        from ipsys_log.calibration.joint.payload import restore_joint

        return restore_joint(model)


ModelKind = PointModels | CornerModels
_POINT_KIND, _CORNER_KIND = PointModels(), CornerModels()


def model_kind(name: str) -> ModelKind:
    """Return the kind of a model by its name."""
    return _CORNER_KIND if reads_corners(name) else _POINT_KIND


def joint_models(model: Model) -> Mapping[str, JointModel]:
    """Return the joint model of each camera; none for a model of camera points."""
    return _CORNER_KIND.restore(model) if reads_corners(model.name) else {}
