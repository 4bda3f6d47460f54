"""Calibration of a carried body, or of the cameras that see it: a run of the log of carrying it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import median_low

import numpy as np

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import BoardSighting, find_board
from ipsys_log.calibration.images import read_frames
from ipsys_log.calibration.joint.body_calibration import BodyCalibration, calibrate_body
from ipsys_log.calibration.joint.carried_observations import BOARD, gather_board, gather_carried
from ipsys_log.calibration.joint.fit import JointFit
from ipsys_log.calibration.joint.hand_held import fit_hand_held, fit_motion
from ipsys_log.calibration.joint.held_out import corner_sigma, distance_errors, hold_out_halves, misfits
from ipsys_log.calibration.joint.lab_frame import (
    LabFrame,
    Target,
    apply_frame,
    find_frame,
    first_camera,
    relative_length,
)
from ipsys_log.calibration.joint.observations import Observations
from ipsys_log.calibration.joint.payload import JOINT, joint_payload, restore_joint
from ipsys_log.calibration.joint.settings import JointSettings
from ipsys_log.engine.mended_model import find_model
from ipsys_log.engine.provenance import new_run, newest_run, read_channels
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, Array, CameraCalibration, Interval, Markers, Message, Rig, Run
from ipsys_log.messages.channels import CALIBRATED_RIG, MARKERS, MEASUREMENTS, MODEL
from ipsys_log.models.table import reads_corners
from ipsys_log.sinks.selection import rig_in_force
from ipsys_log.statistics.calibration_points import active_measurements
from ipsys_log.statistics.joint_evaluation import is_nominal
from ipsys_log.tools.cut_selection import CutOptions, time_range
from ipsys_log.vision.bodies import body_shapes

# Between a body that lies on the floor and its marker: paper and plates bend by half a millimetre.
_LAID_TILT_RAD = 0.001
_CONTRADICTED = 4.0  # standard deviations
# A marker whose pose in the rig is wrong by 2 mm fits 2 to 4 times worse than the others.
_CONTRADICTED_MISFIT = 1.5
# Six points measured to 1 mm, some metres apart, show 0.05 %.
_ODD_LENGTH = 0.003
# A board needs no intrinsics from a chessboard: it determines them.
BOARD_SETTINGS = JointSettings(
    focal_sigma=0.02, centre_sigma=0.01, distortion_sigma=0.05, edge_sigma_px=0.0, corner_floor_px=0.0,
    clock_sigma_s=0.2,
)  # fmt: skip
_BOARD_SCALE_SIGMA = 0.001
_ROUNDS = 2
# Time between knots of the path: half the usual interval of the frames, within these limits.
_SHORTEST_STEP_S, _LONGEST_STEP_S = 0.05, 0.1


Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class CarriedLab:
    """Cameras that a carried body has calibrated.

    Attributes
    ----------
    robot : the body.
    fit : the cameras, in the coordinates of the lab.
    frame : these coordinates, in those of the first camera.
    rest : the time at which the body at rest defines the coordinates; None: measured points define them.
    held_out_px : reprojection errors of each camera, (n, p, 2), in frames that were not in the fit.
    distance_errors_m : (n,), of neighbouring points of a board that two cameras measure at held-out instants;
        none for a body of markers.
    remarks : what contradicts the rig or the tape.
    """

    robot: str
    fit: JointFit
    frame: LabFrame
    rest: Interval | None
    held_out_px: Mapping[str, Array]
    distance_errors_m: Array
    remarks: tuple[str, ...]


def calibrate_carried_lab(
    session: Session,
    robot: str,
    rig: Rig,
    lenses: Mapping[str, CameraCalibration],
    progress: Progress = lambda what, done, total: None,
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
    run = _markers_run(session)
    topics = session.topics(MARKERS, run)
    markers: dict[str, list[Markers]] = {}
    for message in session.messages(topics):
        markers.setdefault(str(message.camera), []).append(message.payload)
    markers = {camera: own for camera, own in markers.items() if any(one.markers for one in own)}
    measured = active_measurements(session.payloads(session.topics(MEASUREMENTS)))
    ids = [marker.id for marker in rig.markers if marker.robot == robot]
    left_out: dict[int, str] = {}
    while True:
        gathered = gather_carried(rig, lenses, _nominal(lenses), markers, robot, measured, left_out)
        fit = fit_motion(_fit(gathered[0], JointSettings(), progress))
        worst = _find_contradiction(misfits(fit))
        if worst is None:
            break
        left_out[int(worst[0])] = (
            f"marker {worst[0]} of {robot} contradicts the others, by {worst[1]:.1f} times its noise: it is "
            "left out. Correct its pose or its side in the rig: ipsys calibrate-body"
        )
    shape = next(shape for shape in body_shapes(rig) if shape.robot == robot)
    lab = _describe(robot, fit, *gathered[1:], shape.scale_sigma, progress)
    unknown = [
        f"marker {i} of {robot} has no pose in the rig: it is not used" for i in ids if i not in shape.markers
    ]
    lab = replace(lab, remarks=(*unknown, *left_out.values(), *lab.remarks))
    return lab, *_store(session, lab, (run,), [*topics, *session.topics(MEASUREMENTS)])


def calibrate_with_board(
    session: Session,
    board: Board,
    lenses: Mapping[str, CameraCalibration],
    progress: Progress = lambda what, done, total: None,
) -> tuple[CarriedLab, Run, Message]:
    """Estimate the same from a board in the frames of the log."""
    if not session.images:
        raise IpsysError(f"{session}: has no frames of a board; record them, or use a body with --body")
    sightings, done = dict[str, list[tuple[int, BoardSighting]]](), 0
    total = sum(session.count(topic) for topic in session.images.values())
    for camera, topic in sorted(session.images.items()):
        for time_ns, grey in read_frames(session, topic):
            seen = None if grey is None else find_board(camera, grey, board, thorough=False)
            if seen is not None:
                sightings.setdefault(camera, []).append((time_ns, seen))
            done += 1
            progress("find board", done, total)
    if not sightings:
        raise IpsysError(f"{session}: no frame shows {board}; check --board, --dictionary and --inverted")
    observations, targets, rest = gather_board(lenses, _nominal(lenses), sightings, board)
    fit = _fit(observations, BOARD_SETTINGS, progress)
    for _ in range(_ROUNDS):
        size = 2 * observations.bodies[0].points_m.shape[0]
        covariance = corner_sigma(fit) ** 2 * np.eye(size)
        tables = tuple(
            replace(own, covariances_px2=np.tile(covariance, (len(own), 1, 1)))
            for own in fit.observations.sightings
        )
        fit = fit_motion(_fit(replace(observations, sightings=tables), fit.settings, progress))
    lab = _describe(str(board), fit, targets, rest, _BOARD_SCALE_SIGMA, progress)
    return lab, *_store(session, lab, (), list(session.images.values()))


def _markers_run(session: Session) -> str:
    run = newest_run(session, MARKERS)
    if run is None:
        raise IpsysError(f"{session}: has no markers; run: ipsys replay LOG --until detect")
    return run


def _find_contradiction(errors: Mapping[str, float]) -> tuple[str, float] | None:
    """Return the marker that fits much worse than the others, and its error in units of its noise.

    Two markers that contradict each other do not tell which one is wrong.
    """
    if len(errors) < 3:
        return None
    worst = max(errors, key=errors.__getitem__)
    others = [error for name, error in errors.items() if name != worst]
    limit = _CONTRADICTED_MISFIT * max(median_low(others), 1.0)
    return (worst, errors[worst]) if errors[worst] > limit else None


def _nominal(lenses: Mapping[str, CameraCalibration]) -> set[str]:
    return {camera for camera, lens in lenses.items() if is_nominal(lens)}


def _fit(observations: Observations, settings: JointSettings, progress: Progress) -> JointFit:
    intervals_s = np.concatenate([np.diff(own.times_s[own.point < 0]) for own in observations.sightings])
    usual_s = float(np.median(intervals_s[intervals_s > 0])) if (intervals_s > 0).any() else _LONGEST_STEP_S
    step_s = float(np.clip(usual_s / 2, _SHORTEST_STEP_S, _LONGEST_STEP_S))
    return fit_hand_held(observations, settings, step_s, lambda step, cost: progress("fit", step, step + 1))


def _describe(
    body: str,
    fit: JointFit,
    targets: Sequence[Target],
    rest: Interval | None,
    scale_sigma: float,
    progress: Progress,
) -> CarriedLab:
    """Return the cameras in the coordinates of the lab, with their errors in held-out frames."""
    # Errors above the noise have causes that are not known: the covariance covers them.
    frame = find_frame(fit, targets) if targets else first_camera(fit)
    by_frame = (frame.chi2 / frame.freedom) ** 0.5 if frame.freedom > 0 and rest is not None else 1.0
    excess = max(1.0, by_frame, *misfits(fit).values())
    is_contradicted = excess > _CONTRADICTED_MISFIT
    fit = replace(fit, covariance=excess**2 * fit.covariance)
    frame = frame._replace(covariance=excess**2 * frame.covariance)
    errors_px = hold_out_halves(fit, lambda done, total: progress("hold out", done, total))
    # The size of the body scales all lengths about the places that are known.
    known_m = [np.zeros(3)] if rest is not None or not targets else [one.position_m for one in targets]
    tilt_rad = 0.0 if rest is None else _LAID_TILT_RAD
    excess_length = relative_length(fit, targets) if rest is None and len(targets) > 1 else 0.0
    scale_sigma = max(scale_sigma, abs(excess_length))
    in_lab = apply_frame(fit, frame, tilt_rad, scale_sigma, np.mean(known_m, axis=0))
    in_lab = replace(in_lab, is_certain=bool(targets) and not is_contradicted)
    names = [camera.name for camera in fit.observations.cameras]
    remarks = _remarks(frame, rest, names[0] if not targets else None)
    if is_contradicted:
        remarks += (
            f"the corners contradict the shape of {body}, by {excess:.1f} times their noise: poses may be "
            "wrong by centimetres, and the model is uncertain. Check poses and sides: ipsys calibrate-body",
        )
    if abs(excess_length) > _ODD_LENGTH:
        more = (
            f"{100 * abs(excess_length):.1f} % {'farther apart' if excess_length > 0 else 'nearer together'}"
        )
        remarks += (
            f"the measured points are {more} than by the prints of {body}; measure the sides of its markers, "
            "and check the tape",
        )
    origins_m = [
        in_lab.state.values[block.start + 3 : block.start + 6] for block in in_lab.problem.layout.cameras
    ]
    below = [name for name, origin_m in zip(names, origins_m, strict=True) if origin_m[2] < 0]
    if rest is not None and below:
        remarks += (
            f"camera {', '.join(below)} would be below the floor: {body} did not lie with its z axis up; lay "
            "it down again",
        )
    held_out = dict(zip(names, errors_px, strict=True))
    distances_m = distance_errors(fit) if fit.observations.bodies[0].name == BOARD else np.zeros(0)
    return CarriedLab(body, in_lab, frame, rest, held_out, distances_m, remarks)


def _remarks(frame: LabFrame, rest: Interval | None, camera: str | None) -> tuple[str, ...]:
    if camera is not None:
        return (
            f"the coordinates are those of camera {camera}: fewer than two measured points are seen, and the "
            "body is never at rest. Lay it onto the floor for 3 s, or measure two points some metres apart",
        )
    name, score = frame.worst
    if rest is not None or frame.freedom < 1 or score < _CONTRADICTED:
        return ()
    return (
        f"point {name} contradicts the other measured points and the size of the body by {score:.0f} "
        "standard deviations; measure it again",
    )


def _store(
    session: Session, lab: CarriedLab, runs: tuple[str, ...], topics: Sequence[str]
) -> tuple[Run, Message]:
    parameters = {"format": "carried body", "body": lab.robot, "model": JOINT}
    record = Run(0, "", IMPORTED, parameters, input_runs=runs, inputs=read_channels(session, topics))
    record, log_time_ns = new_run(session, record, JOINT, topics)
    model = joint_payload(lab.fit, {}, record.timestamp)
    return record, Message(MODEL.topic_of(record.run), log_time_ns, record.timestamp, model)


def calibrate_carried_body(
    session: Session, robot: str, rig: Rig | None = None, start: str = "", end: str = ""
) -> tuple[BodyCalibration, Run, Message]:
    """Estimate the poses of the markers of a body; return them, and the run that stores them.

    Parameters
    ----------
    session : the logs with the markers and the joint model.
    robot : the body.
    rig : names the markers of the body. None: the rig of the log.
    start, end : a part of the log, as in :class:`ipsys_log.tools.cut_selection.CutOptions`.

    Raises
    ------
    IpsysError
        The log has no joint model, no markers or no such body, or the frames do not determine its poses.
    """
    start_ns, end_ns = time_range(session, CutOptions(start=start, end=end))
    found = find_model(session, session.end_ns)
    if found is None or not reads_corners(found[0].name):
        raise IpsysError(
            f"{session}: has no model joint, which knows the poses of the cameras; run: ipsys calibrate-lab, "
            "and name its log before this one"
        )
    run = _markers_run(session)
    rig = rig or rig_in_force(session, [run])
    if rig is None:
        raise IpsysError(f"{session}: has no rig, which names the markers of {robot}; give --rig lab.toml")
    topics = session.topics(MARKERS, run)
    messages = session.messages(topics, start_ns, end_ns)
    body = calibrate_body(restore_joint(found[0]), rig, robot, messages)
    parameters = {"format": "body", "robot": robot, "start": start, "end": end}
    record = Run(
        0,
        "",
        IMPORTED,
        {key: text for key, text in parameters.items() if text},
        input_runs=tuple({run: "", str(run_of_topic(found[1])): ""}),
        inputs=read_channels(session, [*topics, found[1]]),
    )
    record, log_time_ns = new_run(session, record, f"{robot}_body", topics)
    message = Message(CALIBRATED_RIG.topic_of(record.run), log_time_ns, record.timestamp, body.apply(rig))
    return body, record, message
