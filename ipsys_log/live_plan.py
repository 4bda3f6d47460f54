"""What a live run is made of: the stages, and the runs that a replay would name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.lookup import wanted_models
from ipsys_log.messages import CameraCalibration, Message, Model, Rig
from ipsys_log.models import reads_height
from ipsys_log.request import Request
from ipsys_log.stages import camera_frame, detect, fuse, locate
from ipsys_log.tasks import Task, copy_model, model_run, points_run, usual_corners

__all__ = [
    "cameras_with_lens",
    "check_live",
    "check_model",
    "check_start",
    "copied_models",
    "live_stages",
    "with_corners",
]

# The run a stage writes to, the payloads it reads, its step, and whether it takes each camera by itself.
Row = tuple[str, tuple[type, ...], Callable[[Message], Iterable[Any]], bool]


def with_corners(request: Request, cameras: Collection[str], settings: Sequence[Message]) -> Request:
    """A request that says how corners are found: as a replay would, by edges if all cameras have a lens."""
    corners = request.corners or usual_corners(cameras, cameras_with_lens(settings))
    return replace(request, corners=corners)


def cameras_with_lens(settings: Sequence[Message]) -> set[str]:
    """The cameras whose lens is among the first messages of a log."""
    return {str(message.camera) for message in settings if isinstance(message.payload, CameraCalibration)}


def copied_models(request: Request, until: str) -> list[tuple[Task, Model]]:
    """The models of another log that are applied, each with the task that copies it in; none before locate.

    Raises
    ------
    IpsysError
        Where the other log has no such model.
    """
    return [copy_model(request, name) for name in wanted_models(request, "fuse")] if until == "fuse" else []


def check_start(
    rig: Rig, cameras: Collection[str], lenses: Collection[str], request: Request, until: str
) -> list[str]:
    """What can be said to be wrong before a camera is opened.

    Parameters
    ----------
    cameras, lenses : the names of the cameras, and of those that have a lens.
    request, until : as of :func:`ipsys_log.pipeline.live`.

    Returns
    -------
    A line for each thing to know.

    Raises
    ------
    IpsysError
        Where the other log has no such model, and as :func:`check_live`.
    """
    models = [model for _, model in copied_models(request, until)]
    check_live(rig, cameras, lenses, models, until)
    return [
        f"camera {name}: {request.model_from} has no model of it; it is recorded, and places no robots"
        for model in models
        for name in sorted(set(cameras) - {camera.camera for camera in model.cameras})
    ]


def check_live(
    rig: Rig, cameras: Collection[str], lenses: Collection[str], models: Sequence[Model], until: str
) -> None:
    """See that the stages will not have to stop later.

    Raises
    ------
    IpsysError
        For a camera without a lens, a model that knows none of the cameras, or one that needs a height that
        the rig does not say.
    """
    missing = sorted(set(cameras) - set(lenses))
    if missing and until != "detect":
        name = missing[0]
        raise IpsysError(
            f'camera {name} has no lens: write calibration = "{name}.yaml" into lab.toml, or give '
            f"--calibration {name}=file.yaml"
        )
    for model in models:
        check_model(model, cameras)
        heights = [rig.height_of(marker.id) for marker in rig.markers] or [rig.marker_height_m]
        if reads_height(model.name) and None in heights:
            raise IpsysError(
                f"{model.name} needs the height at which markers are carried: write marker_height_m into "
                "lab.toml"
            )


def check_model(model: Model, cameras: Collection[str]) -> None:
    """See that a model is of some of the cameras.

    Raises
    ------
    IpsysError
        Otherwise.
    """
    known = sorted(camera.camera for camera in model.cameras)
    if not set(known) & set(cameras):
        raise IpsysError(
            f"the model {model.name} is of the cameras {', '.join(known)}, and none of them is here, but "
            f"{', '.join(cameras)}; give a model of these, or name the cameras in lab.toml as they were then"
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
