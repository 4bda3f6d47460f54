"""What a live run is made of: the stages, and the runs that a replay would name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.lookup import wanted_models
from ipsys_log.messages import CameraCalibration, Message, Model, Rig
from ipsys_log.models import reads_height
from ipsys_log.request import Request
from ipsys_log.sources.attached import CameraState
from ipsys_log.stages import camera_frame, detect, fuse, locate
from ipsys_log.tasks import Task, copy_model, model_run, points_run, usual_corners

__all__ = ["check_live", "check_pictures", "copied_models", "live_stages", "with_corners"]

# The run a stage writes to, the payloads it reads, its step, and whether it takes each camera by itself.
Row = tuple[str, tuple[type, ...], Callable[[Message], Iterable[Any]], bool]


def with_corners(request: Request, cameras: Collection[str], settings: Sequence[Message]) -> Request:
    """A request that says how corners are found: as a replay would, by edges if all cameras have a lens."""
    lenses = {str(message.camera) for message in settings if isinstance(message.payload, CameraCalibration)}
    return replace(request, corners=request.corners or usual_corners(cameras, lenses))


def copied_models(request: Request, until: str) -> list[tuple[Task, Model]]:
    """The models of another log that are applied, each with the task that copies it in; none before locate.

    Raises
    ------
    IpsysError
        Where the other log has no such model.
    """
    return [copy_model(request, name) for name in wanted_models(request, "fuse")] if until == "fuse" else []


def check_live(
    cameras: Collection[str], settings: Sequence[Message], models: Sequence[Model], until: str
) -> None:
    """See that the stages will not have to stop later.

    Raises
    ------
    IpsysError
        For a camera without a lens, a model that knows none of the cameras, or one that needs a height that
        the rig does not say.
    """
    lenses = {message.camera for message in settings if isinstance(message.payload, CameraCalibration)}
    missing = sorted(set(cameras) - lenses)
    if missing and until != "detect":
        name = missing[0]
        raise IpsysError(
            f'camera {name} has no lens: write calibration = "{name}.yaml" into lab.toml, or give '
            f"--calibration {name}=file.yaml"
        )
    (rig,) = (message.payload for message in settings if isinstance(message.payload, Rig))
    for model in models:
        known = {camera.camera for camera in model.cameras}
        if not known & set(cameras):
            names = ", ".join(sorted(known))
            raise IpsysError(f"the model {model.name} is of the cameras {names}, and none of them is here")
        heights = [rig.height_of(marker.id) for marker in rig.markers] or [rig.marker_height_m]
        if reads_height(model.name) and None in heights:
            raise IpsysError(
                f"{model.name} needs the height at which markers are carried: write marker_height_m into "
                "lab.toml"
            )


def check_pictures(cameras: Mapping[str, CameraState]) -> None:
    """See that any frame can be taken out of what cameras send.

    Raises
    ------
    IpsysError
        For a camera that sends video: a frame of it is nothing without those before it.
    """
    for name, state in cameras.items():
        if state.format in ("h264", "h265"):
            raise IpsysError(
                f"camera {name} sends {state.format}, of which no single seconds can be kept: set it to "
                "MJPEG, or record all of it, with 'ipsys record --measure'"
            )


def live_stages(request: Request, models: Sequence[Model], until: str) -> tuple[dict[str, str], list[Row]]:
    """The run that each stage of a replay would write to, and the causal ones of these stages."""
    corners = str(request.corners)
    points = points_run(corners, request.method)
    runs = {"detect": corners}
    rows: list[Row] = [(corners, detect.READS, detect.Detect(corners), True)]
    if until != "detect":
        runs["camera-frame"] = points
        rows.append((points, camera_frame.READS, camera_frame.CameraFrame(request.method), True))
    for model in models:
        name = model_run(model.name)
        runs |= {"fit": name, "locate": name, "fuse": name}
        rows.append((name, locate.READS, locate.Locate(model), True))
        rows.append((name, fuse.READS, fuse.Fuse(name), False))
    return runs, rows
