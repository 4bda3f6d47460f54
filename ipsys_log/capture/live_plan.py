"""What a live run is made of: the stages, and the runs that a replay would name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from ipsys_log.capture.camera_thread import CameraState
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration, Message, Model, Rig
from ipsys_log.models.table import reads_height
from ipsys_log.runs.execute import signed_copy
from ipsys_log.runs.graph import Task, copy_model, model_run, points_run, usual_corners
from ipsys_log.runs.options import Request
from ipsys_log.runs.select import wanted_models
from ipsys_log.stages import camera_frame, detect, fuse, locate

__all__ = ["LivePlan", "check_model", "check_pictures", "check_start", "plan_live"]

# The run a stage writes to, the payloads it reads, its step, and whether it takes each camera by itself.
Row = tuple[str, tuple[type, ...], Callable[[Message], Iterable[Any]], bool]


class LivePlan(NamedTuple):
    """A live run: the request with all that it leaves open, the models of another log with the tasks that
    copy them in, by stage the run that a replay would write to, and the causal ones of these stages."""

    request: Request
    copied: list[tuple[Task, Model]]
    runs: dict[str, str]
    rows: list[Row]

    def copies(self, now_ns: Callable[[], int]) -> list[Message]:
        """The models, as their runs, with log times from ``now_ns``."""
        return [message for task, model in self.copied for message in signed_copy(task, model, now_ns)]


def plan_live(
    cameras: Collection[str], settings: Sequence[Message], request: Request, until: str
) -> LivePlan:
    """Plan a live run as a replay of its log would be.

    Raises
    ------
    IpsysError
        Where the other log has no such model; for a camera without a lens, a model that knows none of the
        cameras, or one that needs a height that the rig does not say.
    """
    lenses = {str(message.camera) for message in settings if isinstance(message.payload, CameraCalibration)}
    (rig,) = (message.payload for message in settings if isinstance(message.payload, Rig))
    request = replace(request, corners=request.corners or usual_corners(cameras, lenses))
    copied = _copied(request, until)
    models = [model for _, model in copied]
    _check(rig, cameras, lenses, models, until)
    return LivePlan(request, copied, *_stages(request, models, until))


def check_start(
    rig: Rig, cameras: Collection[str], lenses: Collection[str], request: Request, until: str
) -> list[str]:
    """See, before a camera is opened, that a live run can be planned.

    Parameters
    ----------
    cameras, lenses : the names of the cameras, and of those that have a lens.
    request, until : as of :func:`plan_live`.

    Returns
    -------
    A line for each thing to know.

    Raises
    ------
    IpsysError
        As :func:`plan_live`.
    """
    models = [model for _, model in _copied(request, until)]
    _check(rig, cameras, lenses, models, until)
    return [
        f"camera {name}: {request.model_from} has no model of it; it is recorded, and places no robots"
        for model in models
        for name in sorted(set(cameras) - {camera.camera for camera in model.cameras})
    ]


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


def _copied(request: Request, until: str) -> list[tuple[Task, Model]]:
    """The models of another log that are applied, with the tasks that copy them in; none before locate."""
    return [copy_model(request, name) for name in wanted_models(request, "fuse")] if until == "fuse" else []


def _check(
    rig: Rig, cameras: Collection[str], lenses: Collection[str], models: Sequence[Model], until: str
) -> None:
    """See that the stages will not have to stop later."""
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


def _stages(request: Request, models: Sequence[Model], until: str) -> tuple[dict[str, str], list[Row]]:
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
