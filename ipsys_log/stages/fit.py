"""The stage *fit*: a model for the calibration points of each camera."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ipsys_log.analysis.calibration_points import (
    JOINT_READS,
    find_pairs,
    has_measurements,
    measured,
    measured_part,
    split_ids,
    split_parameters,
)
from ipsys_log.analysis.camera_models import fit_camera_models
from ipsys_log.analysis.cross_validation import gather_points
from ipsys_log.analysis.pairs import level_cameras
from ipsys_log.arrays import Array
from ipsys_log.errors import FitError
from ipsys_log.messages import Model, Pair
from ipsys_log.messages.channels import CAMERA_POINTS, MEASUREMENTS, MODEL, RIG
from ipsys_log.messages.stage import Plan, Progress, Stage, StageView
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import MODEL_PARTS, min_pairs, reads_corners
from ipsys_log.units import CM_PER_M

# Two calibration points closer than this are the same point; points closer to a line (RMS) lie on it.
_SAME_PLACE_M = 0.01
BESIDE_LINE_M = 0.03


def fit_model(
    name: str,
    pairs: Mapping[str, Sequence[Pair]],
    time_ns: int,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Model:
    """Fit the model called ``name`` for each camera that has pairs.

    Parameters
    ----------
    name : in the table of models, such as ``poly``.
    pairs : calibration points by camera; a camera without points is left out.
    time_ns : of the last input.
    progress : called with the number of fits done, and the number of all fits.

    Returns
    -------
    Model : with each camera's parameters, pairs, the covariance of its left-out errors, and the terms of the
        covariance of a position; the last two only if there are more pairs than the model needs.

    Raises
    ------
    FitError
        A camera has fewer pairs than the model needs, or no camera has a pair.
    """
    cameras = check_pairs(name, pairs)
    return Model(time_ns, name, tuple(fit_camera_models(name, cameras, pairs, progress)))


def check_pairs(name: str, pairs: Mapping[str, Sequence[Pair]]) -> dict[str, CalibrationPoints]:
    """Return the calibration points by camera, if they are enough for a model.

    Raises
    ------
    FitError
        No camera has a pair, or a camera has too few, or its points are too near to one another or to a line.
    """
    cameras = gather_points(pairs)
    if not cameras:
        raise FitError(
            "no camera saw a calibration point for the fit; measure points in the view of the cameras"
        )
    for camera, places in cameras.items():
        _check_count(name, camera, places)
        _check_spread(name, camera, places.world_m)
    return cameras


def _check_count(name: str, camera: str, places: CalibrationPoints) -> None:
    needed = min_pairs(name)
    if len(places.names) < needed:
        other = "" if name == "rigid" else ", or use --model rigid, which needs 3"
        raise FitError(
            f"camera {camera}: {name} needs at least {needed} calibration points, found "
            f"{len(places.names)}; measure more{other}"
        )


def _check_spread(name: str, camera: str, targets: Array) -> None:
    """Check that the points differ by more than the tape's error; otherwise they add no information."""
    check_different(name, f"camera {camera}", targets)
    beside_m = np.linalg.svd(targets - targets.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(targets))
    if beside_m < BESIDE_LINE_M:
        raise FitError(
            f"camera {camera}: all {len(targets)} calibration points are on one line; measure some beside it"
        )


def check_different(name: str, where: str, targets: Array) -> None:
    """Check that enough calibration points, (n, 3) in m, are different ones.

    Raises
    ------
    FitError
        The model needs more of them. The text names ``where``.
    """
    different = len(np.unique(np.round(targets / _SAME_PLACE_M), axis=0))
    if different < min_pairs(name):
        raise FitError(
            f"{where}: {name} needs at least {min_pairs(name)} different points, found {different} "
            f"in {len(targets)} measurements; measure other points, too"
        )


def model_run(model: str) -> str:
    """Return the name of the run of a model, unless it is taken."""
    return model.replace("+", "_").replace("-", "_")


def _plan(view: StageView, options: Mapping[str, str]) -> Plan | str:
    name = options["model"]
    if "model_run" in options:
        return options["model_run"]
    if not has_measurements(view):
        copied = next((run for run, model in view.copied(MODEL) if model.name == name), None)
        if copied is not None:
            return copied
    notes: list[str] = []
    parameters = {"model": name, **split_parameters(view, options)}
    if reads_corners(name):
        return _plan_joint(view, options, parameters)

    def compute(progress: Progress) -> Model:
        points = measured(view)
        train, _ = split_ids([point.measurement for point in points], options)
        pairs = {
            camera: [pair for pair in seen if pair.measurement in train]
            for camera, seen in find_pairs(view, points).items()
        }
        fitted = fit_model(name, pairs, view.last_ns(RIG, CAMERA_POINTS, MEASUREMENTS), progress)
        notes.extend(_unused_points(pairs, train))
        notes.extend(
            f"camera {camera}: all calibration points have the height {height_m * CM_PER_M:.1f} cm: the "
            "model is valid for x and y, and returns only this height"
            for camera, height_m in level_cameras(fitted).items()
        )
        return fitted

    return Plan(
        run=model_run(name),
        parameters=parameters,
        reads=(RIG, CAMERA_POINTS, MEASUREMENTS),
        compute=compute,
        notes=notes,
    )


def _plan_joint(view: StageView, options: Mapping[str, str], parameters: Mapping[str, str]) -> Plan:
    notes: list[str] = []

    def compute(progress: Progress) -> Model:
        # Late: scipy takes 1 s, and most commands fit nothing.
        from ipsys_log.analysis.joint_calibration import fit_joint_model

        train, _ = split_ids([point.measurement for point in measured(view)], options)
        return fit_joint_model(view, train, view.last_ns(*JOINT_READS), notes, progress)

    return Plan(
        run=model_run(parameters["model"]),
        parameters=parameters,
        reads=JOINT_READS,
        compute=compute,
        notes=notes,
    )


def _unused_points(pairs: Mapping[str, list[Pair]], train: set[str]) -> list[str]:
    """Return remarks on points that no camera saw, and on cameras that saw no point."""
    seen = {pair.measurement for camera_pairs in pairs.values() for pair in camera_pairs}
    unseen = sorted(train - seen)
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


STAGE = Stage(
    name="fit",
    versions={"fit": 1} | {name: part.version for name, part in MODEL_PARTS.items()},
    reads=JOINT_READS,
    writes=(MODEL,),
    plan=_plan,
    rig_part=measured_part,
    method=lambda parameters, view: parameters.get("model", ""),
    causal=False,
    of_model=True,
)
