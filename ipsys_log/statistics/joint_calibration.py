"""The joint calibration of a log: its observations, and the fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from ipsys_log.calibration.joint.diagnosis import find_faults
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.from_messages import gather_observations
from ipsys_log.calibration.joint.hypotheses import fit_hypotheses
from ipsys_log.calibration.joint.observations import Observations, seeing_cameras, without_points
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.errors import FitError
from ipsys_log.messages import CameraCalibration, Markers, Model
from ipsys_log.messages.channels import MARKERS, MEASUREMENTS, RIG
from ipsys_log.messages.stage import Progress, StageView
from ipsys_log.statistics.calibration_points import find_pairs, measured
from ipsys_log.statistics.pairs import active_baselines


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
