"""A mended model as a new run of a log: the model before the motion, and the markers that show the motion."""

from collections.abc import Mapping
from pathlib import Path

from ipsys_log.calibration.joint.payload import PoseChange, mend_poses
from ipsys_log.engine.graph import version_parameters, writer_of
from ipsys_log.engine.output import append_run
from ipsys_log.engine.provenance import complete_runs, new_run, newest_run, read_channels
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Message, Model, Run
from ipsys_log.messages.channels import MARKERS, MODEL
from ipsys_log.models.table import reads_corners

# Parameters of the record of a mended model: its cameras, the log of the baseline, and its first valid time.
_MOST_DIGITS = 19
_MENDED, _BASELINE, _VALID_FROM = "mended", "baseline", "valid_from_ns"


def find_model(session: Session, until_ns: int) -> tuple[Model, str] | None:
    """Return the newest model of a log that was valid at a time, joint models first, and its topic.

    A mended model is valid from the motion of its cameras on.
    """
    models: list[tuple[bool, Model, str]] = []
    for run in complete_runs(session):
        if _valid_from_ns(run) > until_ns:
            continue
        for topic in session.topics(MODEL, run.run):
            if topic in {output.topic for output in run.outputs}:
                model = session.payloads([topic])[-1]
                models.append((reads_corners(model.name), model, topic))
    newest = max(enumerate(models), key=lambda item: (item[1][0], item[0]), default=None)
    return None if newest is None else (newest[1][1], newest[1][2])


def _valid_from_ns(run: Run) -> int:
    text = run.parameters.get(_VALID_FROM, "0")
    return int(text) if text.isascii() and text.isdigit() and len(text) <= _MOST_DIGITS else 0


def append_mended_model(
    target: Path,
    source: tuple[LogLocation, str],
    baseline: LogLocation,
    changes: Mapping[str, PoseChange],
    valid_from_ns: int,
) -> str:
    """Append the model with the new poses of moved cameras to a log, as a new run; return its name.

    Parameters
    ----------
    target : the log that gets the run; its reference markers show the motion.
    source : the log and the topic of the model before the motion.
    baseline : the log with the reference markers before the motion.
    changes : motions by camera.
    valid_from_ns : time of the last motion.

    Raises
    ------
    IpsysError
        The model is no joint model, or the log cannot be extended.
    """
    log, topic = source
    with Session([log]) as before:
        model: Model = before.payloads([topic])[-1]
        foreign = read_channels(before, [topic])
    if not reads_corners(model.name):
        raise IpsysError(
            f"{log}: its model {model.name} has no camera poses to correct; measure some points again and "
            "fit it, or use the model joint (ipsys calibrate-lab)"
        )
    with Session([baseline]) as first:
        reference = read_channels(first, first.topics(MARKERS, newest_run(first, MARKERS)))
    parameters = {
        "model": model.name,
        _MENDED: ", ".join(sorted(changes)),
        _BASELINE: baseline.name,
        _VALID_FROM: str(valid_from_ns),
    }
    stage = writer_of(MODEL)
    with Session([target]) as session:
        run = str(newest_run(session, MARKERS))
        topics = session.topics(MARKERS, run)
        parameters |= version_parameters(stage.name, model.name)
        sources = (f"{log.name}:{run_of_topic(topic)}", run)
        inputs = (*foreign, *reference, *read_channels(session, topics))
        record = Run(0, "", stage.name, parameters, input_runs=sources, inputs=inputs)
        record, log_time_ns = new_run(session, record, f"{model.name}_mended", topics, stage.writes)
    mended = mend_poses(model, changes, record.timestamp)
    message = Message(MODEL.topic_of(record.run), log_time_ns, record.timestamp, mended)
    append_run(target, record, log_time_ns, lambda: [message], {})
    return record.run
