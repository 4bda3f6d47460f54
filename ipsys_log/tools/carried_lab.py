"""Calibration of the cameras of a lab from a log of carrying a body, as a model of this log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.carried_observations import gather_carried
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held, fit_motion, hold_out_halves
from ipsys_log.calibration.joint.lab_frame import LabFrame, apply_frame, find_frame
from ipsys_log.calibration.joint.payload import joint_payload
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.engine.provenance import fingerprint, free_name, newest_run, read_channels
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, CameraCalibration, Interval, Markers, Message, Rig, Run
from ipsys_log.messages.channels import MARKERS, MEASUREMENTS, MODEL
from ipsys_log.statistics.calibration_points import active_measurements
from ipsys_log.statistics.joint_evaluation import is_nominal
from ipsys_log.vision.bodies import body_shapes

# Between a body that lies on the floor and its marker: paper and plates bend by half a millimetre.
_LAID_TILT_RAD = 0.001
_CONTRADICTED = 4.0  # standard deviations


@dataclass(frozen=True, slots=True, eq=False)
class CarriedLab:
    """Cameras that a carried body has calibrated.

    Attributes
    ----------
    robot : the body.
    fit : the cameras, in the coordinates of the lab.
    frame : these coordinates, in those of the first camera.
    rest : the time at which the body at rest defines the coordinates; None: measured points define them.
    held_out_px : reprojection errors of each camera, (n, 4, 2), in frames that were not in the fit.
    remarks : what contradicts the rig or the tape.
    """

    robot: str
    fit: JointFit
    frame: LabFrame
    rest: Interval | None
    held_out_px: Mapping[str, np.ndarray]
    remarks: tuple[str, ...]


def calibrate_carried_lab(
    session: Session,
    robot: str,
    rig: Rig,
    lenses: Mapping[str, CameraCalibration],
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> tuple[CarriedLab, Run, Message]:
    """Estimate poses, clocks and intrinsics of all cameras; return them, and the run that stores the model.

    Parameters
    ----------
    session : the logs with the markers.
    robot : the body, with known poses of its markers.
    rig : the rig.
    lenses : intrinsics by camera; those without distortion are nominal.
    progress : called with a name of the step, and done and total numbers of fits.

    Raises
    ------
    IpsysError
        The log has no markers of the body, or the frames do not determine the cameras.
    """
    run = newest_run(session, MARKERS)
    if run is None:
        raise IpsysError(f"{session}: has no markers; run: ipsys replay LOG --until detect")
    topics = session.topics(MARKERS, run)
    markers: dict[str, list[Markers]] = {}
    for message in session.messages(topics):
        markers.setdefault(str(message.camera), []).append(message.payload)
    markers = {camera: own for camera, own in markers.items() if any(one.markers for one in own)}
    nominal = {camera for camera in markers if camera in lenses and is_nominal(lenses[camera])}
    measured = active_measurements(session.payloads(session.topics(MEASUREMENTS)))
    observations, targets, rest = gather_carried(rig, lenses, nominal, markers, robot, measured)
    progress("fit", 0, 0)
    fit = fit_motion(
        fit_hand_held(observations, JointSettings(), progress=lambda n, cost: progress("fit", n, 0))
    )
    frame = find_frame(fit, targets)
    held_out = hold_out_halves(fit, lambda done, total: progress("hold out", done, total))
    scale_sigma = next(shape.scale_sigma for shape in body_shapes(rig) if shape.robot == robot)
    middle_m = np.mean([target.position_m for target in targets], axis=0)
    in_lab = apply_frame(fit, frame, _LAID_TILT_RAD if rest is not None else 0.0, scale_sigma, middle_m)
    names = [camera.name for camera in observations.cameras]
    remarks = _remarks(frame, rest)
    lab = CarriedLab(robot, in_lab, frame, rest, dict(zip(names, held_out, strict=True)), remarks)
    return lab, *_record(session, lab, run, topics)


def _remarks(frame: LabFrame, rest: Interval | None) -> tuple[str, ...]:
    name, score = frame.worst
    if rest is not None or frame.freedom < 1 or score < _CONTRADICTED:
        return ()
    return (
        f"point {name} contradicts the other measured points and the size of the body by {score:.0f} "
        "standard deviations; measure it again",
    )


def _record(session: Session, lab: CarriedLab, run: str, topics: Sequence[str]) -> tuple[Run, Message]:
    topics = [*topics, *session.topics(MEASUREMENTS)]
    log_time_ns, time_ns = session.last(topics)
    record = Run(
        time_ns,
        "",
        IMPORTED,
        {"format": "carried body", "robot": lab.robot, "model": "joint"},
        fingerprint(),
        input_runs=(run,),
        inputs=read_channels(session, topics),
        number=max((own.number for own in session.runs()), default=0) + 1,
    )
    record = replace(record, run=free_name(session, record, "joint", ()))
    return record, Message(
        MODEL.topic_of(record.run), log_time_ns, time_ns, joint_payload(lab.fit, {}, time_ns)
    )
