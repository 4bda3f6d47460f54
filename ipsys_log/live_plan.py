"""What a live run is made of: the stages, and the runs that a replay would name."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import replace
from typing import Any

from ipsys_log.log.session import Session
from ipsys_log.lookup import fitted_in, wanted_models
from ipsys_log.messages import CameraCalibration, Message, Model
from ipsys_log.request import Request
from ipsys_log.stages import camera_frame, detect, fuse, locate
from ipsys_log.tasks import model_run

__all__ = ["copied_models", "live_stages", "with_corners"]

# The run a stage writes to, the payloads it reads, its step, and whether it takes each camera by itself.
Row = tuple[str, tuple[type, ...], Callable[[Message], Iterable[Any]], bool]


def with_corners(request: Request, cameras: Collection[str], settings: Sequence[Message]) -> Request:
    """A request that says how corners are found: as a replay would, by edges if all cameras have a lens."""
    lenses = {message.camera for message in settings if isinstance(message.payload, CameraCalibration)}
    usual = detect.EDGES if lenses >= set(cameras) else detect.STOCK
    return replace(request, corners=request.corners or usual)


def copied_models(request: Request, until: str) -> list[Model]:
    """The model of another log that is applied; none before locate.

    Raises
    ------
    IpsysError
        Where the other log has no such model.
    """
    if until != "fuse":
        return []
    assert request.model_from is not None
    with Session([request.model_from]) as other:
        return [fitted_in(other, name)[0] for name in wanted_models(request, "fuse")]


def live_stages(request: Request, models: Sequence[Model], until: str) -> tuple[dict[str, str], list[Row]]:
    """The run that each stage of a replay would write to, and the causal ones of these stages."""
    corners = str(request.corners)
    points = corners if request.method == camera_frame.PERIMETER else f"{corners}_{request.method}"
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
