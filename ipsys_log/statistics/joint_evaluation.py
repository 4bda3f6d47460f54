"""The joint calibration of a log: its fit, and its errors on points that are not in the fit."""

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from ipsys_log.calibration.joint.diagnosis import find_faults, point_covariances
from ipsys_log.calibration.joint.fit import JointFit, refit_without
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.hypotheses import fit_hypotheses
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel, build_models
from ipsys_log.calibration.joint.observations import Observations, seeing_cameras, without_points
from ipsys_log.calibration.joint.payload import joint_payload, restore_joint
from ipsys_log.errors import FitError
from ipsys_log.messages import (
    Array,
    CameraCalibration,
    CameraEvaluation,
    Evaluation,
    LearningPoint,
    Markers,
    Model,
    Pair,
    Suspect,
)
from ipsys_log.messages.channels import MARKERS, MEASUREMENTS, RIG
from ipsys_log.messages.stage import Progress, StageView
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, HELD_OUT, error_rows
from ipsys_log.statistics.calibration_points import active_baselines, find_pairs, measured
from ipsys_log.statistics.cross_validation import (
    FOLDS,
    Study,
    gather_points,
    learning_curve,
    learning_sizes,
    make_folds,
    published_curve,
)
from ipsys_log.statistics.outliers import describe_outlier
from ipsys_log.statistics.tape import RiggedMeasurement


def observe(view: StageView) -> Observations:
    """Return the observations of a log: all its calibration points, and the drives of its robots.

    Raises
    ------
    FitError
        The log has no rig, or no markers.
    """
    points = measured(view)
    rig = view.rig or next(iter(view.payloads(RIG)[-1:]), None)
    markers: dict[str, list[Markers]] = {}
    for message in view.messages(MARKERS):
        markers.setdefault(str(message.camera), []).append(message.payload)
    if rig is None or not markers:
        raise FitError("joint is fitted to the corners of markers, but the log has none; use best")
    lenses = view.calibrations()
    nominal = {camera for camera, lens in lenses.items() if is_nominal(lens)}
    baselines = active_baselines(view.payloads(MEASUREMENTS))
    measurements = [point.measurement for point in points]
    return gather_observations(rig, lenses, markers, measurements, nominal, baselines=baselines)


def is_nominal(lens: CameraCalibration) -> bool:
    """Return whether intrinsics come from a data sheet: a calibration by images gives a distortion."""
    return not lens.D.any()


def fit_without(
    observations: Observations, left_out: Collection[str], progress: Progress = lambda done, total: None
) -> JointFit:
    """Fit the cameras that saw something, without some calibration points.

    The fit is a pure function, and a command needs the same fit for the model and for its description. So the
    last fit is kept.
    """
    wanted = seeing_cameras(without_points(observations, left_out))
    for known, fit in tuple(_LAST_FIT):
        if _same(known, wanted):
            return fit
    # The number of steps is not known before; each brings the fit nearer to its end.
    fit = fit_hypotheses(wanted, progress=lambda step, cost: progress(step, step + 1))
    _LAST_FIT[:] = [(wanted, fit)]
    return fit


# The observations and the result of the last fit; empty before the first.
_LAST_FIT: list[tuple[Observations, JointFit]] = []


def _same(one: Any, other: Any) -> bool:
    """Return whether two values of observations are equal, with all arrays in them."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return (one.shape, one.dtype) == (other.shape, other.dtype) and one.tobytes() == other.tobytes()
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(_same, one, other))
    if is_dataclass(one):
        return all(_same(getattr(one, field.name), getattr(other, field.name)) for field in fields(one))
    return bool(one == other)


# More remarks on probable faults hide the first ones, which often cause the others.
_MOST_FAULTS = 10


def fit_joint_model(
    view: StageView, train: Collection[str], time_ns: int, notes: list[str], progress: Progress
) -> Model:
    """Fit the joint model of a log to the calibration points ``train`` and to all drives.

    Probable faults of the observations, and cameras without a model, go to ``notes``.
    """
    points = measured(view)
    left_out = {point.measurement.id for point in points} - set(train)
    observations = observe(view)
    fit = fit_without(observations, left_out, progress)
    seeing = {camera.name for camera in seeing_cameras(observations).cameras}
    notes.extend(
        f"camera {camera.name} saw no calibration point and no robot: it has no model"
        for camera in observations.cameras
        if camera.name not in seeing
    )
    faults = [fault.text for fault in find_faults(fit)]
    notes.extend(faults[:_MOST_FAULTS])
    if len(faults) > _MOST_FAULTS:
        notes.append(f"{len(faults) - _MOST_FAULTS} more probable faults; correct the first ones")
    pairs = {
        camera: [pair for pair in seen if pair.measurement in train]
        for camera, seen in find_pairs(view, points).items()
    }
    return joint_payload(fit, pairs, time_ns)


Models = Mapping[str, JointModel]

# Random subsets of each size. A fit takes seconds with a drive, so these are fewer than for other models.
JOINT_SUBSETS = 3
# Kinds of faults that concern the measurement of a point.
_OF_A_POINT = ("distance", "height", "place", "swapped", "side")
# Error of the place of a point that is not in the fit, by the shape of all points.
_SHAPE_SIGMA_M = 0.01


def evaluate_joint(
    model: Model,
    observations: Observations,
    study: Study,
    excluded: tuple[Suspect, ...],
    time_ns: int,
    notes: list[str],
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Evaluation:
    """Compute errors on held-out points and by cross-validation, the learning curve, and outliers.

    All fits use all drives. The cross-validation has one repeat, because a fit takes seconds.

    Parameters
    ----------
    model : the fitted joint model.
    observations : all observations of the log.
    study : the calibration points; ``seed`` is None for a model of another log, which is not fitted again.
    excluded : the gross outliers. The errors and the learning curve are without them.
    time_ns : of the last input.
    notes : list of remarks; each impossible step adds a remark.
    progress : called with the number of steps done, and the number of all steps.
    """
    study = replace(study, pairs=_located(observations, study.pairs))
    cameras: Mapping[str, JointModel] = restore_joint(model)
    used = {pair.measurement for camera in model.cameras for pair in camera.pairs}
    if study.seed is None:
        rows = _held_out_rows(model, cameras, observations, study, used)
        return Evaluation(time_ns, model.name, tuple(rows))
    gross = {suspect.measurement for suspect in excluded}
    try:
        fits = whole = _Fits(observations, frozenset())
    except FitError as error:
        notes.append(f"no cross-validation, and no search for outliers: {error}")
        rows = _held_out_rows(model, cameras, observations, study, used)
        return Evaluation(time_ns, model.name, tuple(rows))
    clean, reduced = study, cameras
    if gross:
        try:
            fits = _Fits(observations, frozenset(gross))
            reduced = build_models(fits.without({point.name for point in observations.points} - used))
            clean = _without(study, gross)
        except FitError as error:
            notes.append(f"gross outliers are not excluded: {error}")
            fits, excluded, gross = whole, (), set()
    points = gather_points(clean.pairs)
    sizes = learning_sizes(model.name, points) if points else []
    steps = _Steps(FOLDS * (1 + bool(gross)) + len(sizes) + 1, progress)
    rows = _held_out_rows(model, reduced, observations, clean, used)
    rows += _cross_validated_rows(model, fits, clean, notes, steps)
    learning = _learning(model.name, fits, clean, steps)
    with_excluded: list[CameraEvaluation] = []
    if gross:
        with_excluded = _held_out_rows(model, cameras, observations, study, used)
        with_excluded += _cross_validated_rows(model, whole, study, [], steps)
    suspects = _find_joint_outliers(whole.fit, study.places)
    steps.done()
    return Evaluation(
        time_ns, model.name, tuple(rows), tuple(learning), suspects, excluded, tuple(with_excluded)
    )


class _Fits:
    """A fit, and the fits without further calibration points, which start at it.

    Raises
    ------
    FitError
        The observations do not determine the cameras.
    """

    def __init__(self, observations: Observations, left_out: frozenset[str]) -> None:
        self.observations, self._left_out = observations, left_out
        self.fit = fit_without(observations, left_out)

    def without(self, names: Collection[str]) -> JointFit:
        """Return the fit without further points.

        A correction of the readings of a point is only right for the fit that found it.
        """
        if not self.fit.known and self.fit.is_certain:
            with suppress(FitError):  # of a camera that sees no other point
                return refit_without(self.fit, names)
        return fit_without(self.observations, self._left_out.union(names))


class _Steps:
    """The steps of an evaluation, and how many of them are done."""

    def __init__(self, total: int, progress: Callable[[int, int], None]) -> None:
        self._count, self._total, self._progress = 0, total, progress
        progress(0, total)

    def done(self) -> None:
        self._count += 1
        self._progress(min(self._count, self._total), self._total)


def _located(observations: Observations, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, list[Pair]]:
    """Return the pairs whose corners a camera saw in the stationary interval."""
    located = {}
    for camera, sightings in zip(observations.cameras, observations.sightings, strict=True):
        seen = {observations.points[point].name for point in sightings.point.tolist() if point >= 0}
        located[camera.name] = [pair for pair in pairs.get(camera.name, ()) if pair.measurement in seen]
    return located


def _without(study: Study, names: Collection[str]) -> Study:
    pairs = {
        camera: [pair for pair in own if pair.measurement not in names] for camera, own in study.pairs.items()
    }
    return replace(study, pairs=pairs, held_out=study.held_out - set(names))


def _held_out_rows(
    model: Model, cameras: Models, observations: Observations, study: Study, used: Collection[str]
) -> list[CameraEvaluation]:
    predicted = _predict(cameras, observations, study, study.held_out - set(used))
    return _error_rows(model, [predicted], study, HELD_OUT)


def _cross_validated_rows(
    model: Model, fits: _Fits, study: Study, notes: list[str], steps: _Steps
) -> list[CameraEvaluation]:
    assert study.seed is not None
    parts = []
    try:
        for fold in make_folds(gather_points(study.pairs), FOLDS, np.random.default_rng(study.seed)):
            fitted = build_models(fits.without(fold))
            parts.append(_predict(fitted, fits.observations, study, fold))
            steps.done()
    except FitError as error:
        notes.append(f"no cross-validation: {error}")
        return []
    return _error_rows(model, parts, study, CROSS_VALIDATION)


def _learning(name: str, fits: _Fits, study: Study, steps: _Steps) -> list[LearningPoint]:
    """Return the errors by the number of calibration points, each with all drives."""
    assert study.seed is not None
    cameras = gather_points(study.pairs)
    if not cameras:
        return []

    def predict(left_out: Collection[str]) -> dict[str, Array]:
        models = build_models(fits.without(left_out))
        # A camera without a sighting has no model: then this subset counts for no camera.
        if missing := cameras.keys() - models.keys():
            raise FitError(f"camera {min(missing)}: it saw no point of the subset")
        everything = {name for places in cameras.values() for name in places.names}
        predicted = _predict(models, fits.observations, study, everything)
        return {camera: points_m for camera, (_, points_m, _) in predicted.items()}

    points = published_curve(name, cameras, study.subsets, study.held_out, predict)
    for more in learning_curve(name, cameras, study.seed, predict, JOINT_SUBSETS):
        points += more
        steps.done()
    return points


# Pairs of a camera, with their predictions (n, 3) and covariances (n, 3, 3).
_Predicted = dict[str, tuple[list[Pair], Array, Array]]


def _predict(cameras: Models, observations: Observations, study: Study, names: Collection[str]) -> _Predicted:
    """Locate the markers at some calibration points by their mean corners and measured heights."""
    predicted: _Predicted = {}
    for camera, sightings in zip(observations.cameras, observations.sightings, strict=True):
        row_of = {
            observations.points[point].name: row
            for row, point in enumerate(sightings.point.tolist())
            if point >= 0
        }
        own = [pair for pair in study.pairs.get(camera.name, ()) if pair.measurement in names]
        model = cameras.get(camera.name)
        if model is None or not own:
            continue
        rows = [row_of[pair.measurement] for pair in own]
        points = [observations.points[int(sightings.point[row])] for row in rows]
        located = locate_markers(
            model,
            sightings.pixels[rows],
            sightings.covariances_px2[rows],
            np.array([pair.world_m[2] for pair in own]),
            np.array([observations.bodies[point.body].length_m for point in points]),
            np.array([point.height_sigma_m for point in points]),
        )
        predicted[camera.name] = (own, located.points_m, located.covariances_m2)
    return predicted


def _error_rows(
    model: Model, parts: Sequence[_Predicted], study: Study, scheme: str
) -> list[CameraEvaluation]:
    found: dict[str, tuple[list[Pair], Array]] = {}
    covariances: dict[str, Array | None] = {}
    for camera in sorted({camera for part in parts for camera in part}):
        own = [part[camera] for part in parts if camera in part]
        predicted_m = np.concatenate([points_m for _, points_m, _ in own])[None]
        found[camera] = ([pair for kept, _, _ in own for pair in kept], predicted_m)
        covariances[camera] = np.concatenate([c for _, _, c in own])
    return error_rows(model, found, covariances, study.truth, scheme)


def _find_joint_outliers(fit: JointFit, places: Sequence[RiggedMeasurement]) -> tuple[Suspect, ...]:
    """Return the measurements that contradict a joint fit, the one with the largest error first.

    The loss of the fit is robust: a wrong reading has nearly no weight in the estimated point. So this point
    is the prediction from all other observations, and no further fit is necessary.

    Parameters
    ----------
    fit : the fit to all measurements.
    places : the measurements, each with the rig in force.

    Raises
    ------
    IpsysError
        A measurement forms no world point.
    """
    by_id = {place.measurement.id: place for place in places}
    numbers = {point.name: number for number, point in enumerate(fit.observations.points)}
    floor_m = fit.problem.layout.floor.heights(
        fit.state.positions_m[:, :2], fit.state.values[fit.problem.layout.modes]
    )[0]
    usual_m2 = point_covariances(fit)
    outliers = []
    for fault in find_faults(fit):
        if fault.kind not in _OF_A_POINT or fault.subject not in by_id:
            continue
        number = numbers.get(fault.subject, -1)
        if fault.place_m is not None:
            predicted_m = np.array([*fault.place_m, by_id[fault.subject].measurement.height_m or 0.0])
            covariance_m2 = _SHAPE_SIGMA_M**2 * np.eye(3)
        else:
            predicted_m, covariance_m2 = fit.state.positions_m[number].copy(), usual_m2[number]
            # A measured height is that above the floor, and not that above the plane z = 0.
            predicted_m[2] -= floor_m[number]
        cameras = tuple(
            camera.name
            for camera, sightings in zip(fit.observations.cameras, fit.observations.sightings, strict=True)
            if number >= 0 and (sightings.point == number).any()
        )
        place = by_id[fault.subject]
        outliers.append(describe_outlier(place, cameras, predicted_m, covariance_m2, fault.score))
    return tuple(sorted(outliers, key=lambda suspect: -float((suspect.residual_m**2).sum())))
