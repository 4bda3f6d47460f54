"""What can be said to be wrong before anything is computed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ipsys_log.derive import Request
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.session import Session, camera_of_topic
from ipsys_log.messages import MEASUREMENTS_TOPIC, RIG_TOPIC, CameraPoints, Markers, Rig
from ipsys_log.models import min_pairs
from ipsys_log.offline.pairs import active_measurements, split, world_point
from ipsys_log.runs import newest_run
from ipsys_log.tasks import STAGES, held_out_ids

__all__ = ["check_inputs"]


def check_inputs(paths: Sequence[Path], request: Request, models: Sequence[str], until: str) -> None:
    """Look at what the stages up to ``until`` need.

    Raises
    ------
    IpsysError
        For the first thing that is missing or cannot be right, and what to do about it.
    """
    wanted = STAGES[: STAGES.index(until) + 1]
    with Session(paths) as session:
        if request.rig is None and not session.topics(Rig):
            raise IpsysError(
                f"{session}: has no rig (markers, reference points); write one with 'ipsys init lab.toml' "
                "and give it with --rig lab.toml"
            )
        cameras = _check_frames(session, wanted)
        _check_lenses(session, request, cameras, wanted)
        if "fit" in wanted and request.model_from is None:
            _check_measurements(session, request, models)
        if until == "evaluate":
            _check_held_out(session, request)


def _check_frames(session: Session, wanted: Sequence[str]) -> set[str]:
    """The cameras whose markers are to be seen through a lens."""
    if session.images:
        return set(session.images)
    markers = newest_run(session, Markers)
    if markers is not None:
        return {str(camera_of_topic(topic)) for topic in session.topics(Markers, markers)}
    if wanted == ("detect",) or newest_run(session, CameraPoints) is None:
        raise IpsysError(f"{session}: has no images to detect markers in; record some, or name another log")
    return set()


def _check_lenses(session: Session, request: Request, cameras: set[str], wanted: Sequence[str]) -> None:
    if "camera-frame" not in wanted or not cameras:
        return
    strange = sorted(set(request.lenses) - cameras)
    if strange:
        raise IpsysError(
            f"--calibration {strange[0]}: the log has no such camera (it has {', '.join(sorted(cameras))})"
        )
    missing = sorted(cameras - set(request.lenses) - set(session.calibrations))
    if missing:
        raise IpsysError(
            f"{session}: camera {missing[0]} has no calibration; give one with "
            f"--calibration {missing[0]}=calibration.yaml"
        )


def _check_measurements(session: Session, request: Request, models: Sequence[str]) -> None:
    if not session.count(MEASUREMENTS_TOPIC):
        raise FitError(
            f"{session}: has no measurements to fit a model to; apply a model of another log with "
            "--model-from calibration.mcap"
        )
    rig = request.rig or session.payloads([RIG_TOPIC])[-1]
    measurements = active_measurements(session.payloads([MEASUREMENTS_TOPIC]))
    train, _ = split(measurements, request.train, request.seed)
    for measurement in measurements:
        world_point(measurement, rig)
        if measurement.marker_id is not None and not rig.knows(measurement.marker_id):
            known = ", ".join(str(marker.id) for marker in rig.markers)
            raise IpsysError(
                f"measurement {measurement.id} names marker {measurement.marker_id}, which is not in the rig "
                f"(it has {known}); correct lab.toml and give it with --rig"
            )
    for model in models:
        if len(train) < min_pairs(model):
            raise FitError(
                f"{session}: {model} needs at least {min_pairs(model)} measured places for each camera, "
                f"found {len(train)} in all; measure more"
                + ("" if model == "rigid" else ", or use --model rigid")
            )


def _check_held_out(session: Session, request: Request) -> None:
    measurements = active_measurements(session.payloads([MEASUREMENTS_TOPIC]))
    if not held_out_ids(measurements, request):
        raise IpsysError(
            f"{session}: no measured place is held out to evaluate on (of {len(measurements)}); label some "
            "'test', or measure at least five without labels, of which a fifth is then held out"
        )
