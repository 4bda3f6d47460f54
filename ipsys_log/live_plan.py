"""What a live run is made of: the stages, and the runs that a replay would name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.lookup import wanted_models
from ipsys_log.messages import CameraCalibration, Message, Model, Rig
from ipsys_log.models import reads_height
from ipsys_log.perform import signed_copy
from ipsys_log.request import Request
from ipsys_log.sources.attendant import CameraState
from ipsys_log.stages import camera_frame, detect, fuse, locate
from ipsys_log.tasks import Task, copy_model, model_run, points_run, usual_corners

__all__ = ["LivePlan", "check_pictures", "plan_live"]

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
    request = replace(request, corners=request.corners or usual_corners(cameras, lenses))
    names = wanted_models(request, "fuse") if until == "fuse" else ()
    copied = [copy_model(request, name) for name in names]
    models = [model for _, model in copied]
    _check(cameras, settings, models, until)
    return LivePlan(request, copied, *_stages(request, models, until))


def _check(
    cameras: Collection[str], settings: Sequence[Message], models: Sequence[Model], until: str
) -> None:
    """See that the stages will not have to stop later."""
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
