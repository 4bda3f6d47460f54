"""Calibration of a body from a log of carrying it, as a run of this log."""

from dataclasses import replace

from ipsys_log.calibration.joint.body_calibration import BodyCalibration, calibrate_body
from ipsys_log.calibration.joint.payload import restore_joint
from ipsys_log.engine.mended_model import find_model
from ipsys_log.engine.provenance import fingerprint, free_name, newest_run, read_channels
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import IMPORTED, Message, Rig, Run
from ipsys_log.messages.channels import CALIBRATED_RIG, MARKERS
from ipsys_log.models.table import reads_corners
from ipsys_log.sinks.selection import rig_in_force
from ipsys_log.tools.cut_selection import CutOptions, time_range


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
    run = newest_run(session, MARKERS)
    if run is None:
        raise IpsysError(f"{session}: has no markers; run: ipsys replay LOG --until detect")
    rig = rig or rig_in_force(session, [run])
    if rig is None:
        raise IpsysError(f"{session}: has no rig, which names the markers of {robot}; give --rig lab.toml")
    topics = session.topics(MARKERS, run)
    messages = session.messages(topics, start_ns, end_ns)
    body = calibrate_body(restore_joint(found[0]), rig, robot, messages)
    log_time_ns, time_ns = session.last(topics)
    parameters = {"format": "body", "robot": robot, "start": start, "end": end}
    record = Run(
        time_ns,
        "",
        IMPORTED,
        {key: text for key, text in parameters.items() if text},
        fingerprint(),
        input_runs=tuple({run: "", str(run_of_topic(found[1])): ""}),
        inputs=read_channels(session, [*topics, found[1]]),
        number=max((run.number for run in session.runs()), default=0) + 1,
    )
    record = replace(record, run=free_name(session, record, f"{robot}_body", ()))
    message = Message(CALIBRATED_RIG.topic_of(record.run), log_time_ns, time_ns, body.apply(rig))
    return body, record, message
