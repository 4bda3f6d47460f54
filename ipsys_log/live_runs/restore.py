"""Repair of logs whose recorder was killed: the recorder's runs are completed."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from ipsys_log.engine.graph import is_of_model, stages_until, writer_of
from ipsys_log.engine.provenance import Outcome, newest_run
from ipsys_log.engine.request import Progress, Request
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CAMERA_POINTS, EVENTS, MARKERS, MODEL
from ipsys_log.messages.events import skipped_frames
from ipsys_log.messages.stage import Stage
from ipsys_log.stages.camera_frame import METHODS, PERIMETER, points_run
from ipsys_log.stages.detect import CORNERS

# The names of the runs of camera points, each with its corner method and its camera-point method.
_POINTS = [(points_run(corners, method), corners, method) for corners in CORNERS for method in METHODS]


def unfinished_runs(session: Session) -> dict[Stage, str]:
    """Return by stage the unsigned runs that ``ipsys live`` and ``record --detect`` wrote."""
    signed = {(run.run, run.stage) for run in session.runs()}
    live_runs = _live_runs(session) if session.images else ()
    return {stage: run for stage, run in live_runs if (run, stage.name) not in signed}


def _live_runs(session: Session) -> Iterator[tuple[Stage, str]]:
    """Yield stages and their runs with the names of live processing, if the log has them."""
    of_points = {name for name, _, _ in _POINTS}
    of_model = {run for run in session.run_names() if session.topics(MODEL, run)}
    for stage in stages_until(None):
        for run in sorted(of_model if is_of_model(stage) else of_points) if stage.causal else ():
            if session.topics(stage.writes[0], run):
                yield stage, run


def finish_runs(path: Path, progress: Progress) -> list[Outcome]:
    """Complete the runs that a killed recorder left; the stages also process its last frames.

    A run is signed only if all its messages equal the messages that its stages make from the log now, byte
    for byte. Frames that live processing skipped because it was too slow are skipped again.

    Returns
    -------
    One outcome for each stage; none if all runs are finished.

    Raises
    ------
    IpsysError
        The log lacks an input of the stages; in this case nothing was changed.
    """
    with Session([path]) as session:
        left = unfinished_runs(session)
        if not left:
            return []
        request = _request(session, left)
    return replay([path], request, list(left)[-1].name, progress=progress)


def _request(session: Session, left: Mapping[Stage, str]) -> Request:
    """Return the request of the live run, derived from the names of the runs."""
    points = left.get(writer_of(CAMERA_POINTS)) or newest_run(session, CAMERA_POINTS)
    live = (left.get(writer_of(MARKERS)), PERIMETER)
    corners, method = next(((corners, method) for run, corners, method in _POINTS if run == points), live)
    run = next((run for stage, run in left.items() if is_of_model(stage)), None)
    models = session.payloads(session.topics(MODEL, run)) if run else []
    return Request(
        models=tuple(model.name for model in models[-1:]),
        corners=corners,
        method=method,
        as_live=bool(skipped_frames(session.payloads(session.topics(EVENTS)))),
        skip_ambiguous=True,
    )
