"""What the user asks for, beyond what the log itself says."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from ipsys_log.messages import CameraCalibration, Rig
from ipsys_log.stages.camera_frame import PERIMETER, check_method
from ipsys_log.stages.detect import check_corners

__all__ = ["Progress", "Request"]

# Called with the stage, the messages done, and all there are, where that is known.
Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True, slots=True)
class Request:
    """What the user asks for.

    Attributes
    ----------
    models : names in the table of models; empty: ``poly``, or what ``model_from`` holds; to evaluate,
        all of them.
    rig, lenses : used instead of the log's own, as a new run. Lenses by camera.
    model_from : another log, whose newest fitted model is applied and copied in.
    train, seed : the subset to fit on, or the seed of the random split where nothing is labelled.
    run : name for the new run of the last stages, instead of one made from the model.
    corners : how corners are found: ``edges`` or ``stock``; None: edges, if all cameras have a calibration.
    method : how camera points are made of markers: ``perimeter`` or ``pose``.
    as_live : pass over the frames that were skipped when the log was recorded live.
    skip_ambiguous : go on where a marker id is seen twice in a frame, without that marker.
    parameters : further options of stages, by name.

    Raises
    ------
    IpsysError
        Where there is no such method.
    """

    models: tuple[str, ...] = ()
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    model_from: Path | None = None
    train: str = "train"
    seed: int = 0
    run: str | None = None
    corners: str | None = None
    method: str = PERIMETER
    as_live: bool = False
    skip_ambiguous: bool = False
    parameters: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.corners is not None:
            check_corners(self.corners)
        check_method(self.method)

    def options(self, model: str | None = None) -> dict[str, str]:
        """Return the options of stages by name, for one model."""
        options = {
            "corners": self.corners or "",
            "method": self.method,
            "model": model or "",
            "train": self.train,
            "seed": str(self.seed),
            "as_live": "yes" if self.as_live else "",
            "model_from": "yes" if self.model_from is not None else "",
            **self.parameters,
        }
        return {name: value for name, value in options.items() if value}
