"""The requests of the user, beyond the content of the log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from ipsys_log.log.location import LogLocation
from ipsys_log.messages import CameraCalibration, Rig
from ipsys_log.stages import CORNERS, METHOD

# Called with the stage, the number of messages done, and the number of all messages, if it is known.
Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True, slots=True)
class Request:
    """The requests of the user.

    Attributes
    ----------
    models : names in the table of models; empty: ``poly``, or the model of ``model_from``; for an evaluation,
        all models.
    rig, lenses : used instead of those of the log, as a new run. Camera intrinsics by camera.
    model_from : another log; its newest fitted model is applied and copied into the log.
    model_run : a run of the log whose model was copied from another log; it is applied again.
    train, seed : the subset to fit on, or the seed of the random split if no measurement has a label.
    run : name for the new run of the last stages; without it, the name comes from the model.
    corners : method of corner detection: ``edges`` or ``stock``; None: edges, if all cameras have intrinsics.
    method : method that computes camera points from markers: ``perimeter`` or ``pose``.
    as_live : skip the frames that were skipped when the log was recorded live.
    skip_ambiguous : if a frame shows a marker id twice, continue without that marker.
    parameters : further options of stages, by name.

    Raises
    ------
    IpsysError
        There is no such method.
    """

    models: tuple[str, ...] = ()
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    model_from: LogLocation | None = None
    model_run: str | None = None
    train: str = "train"
    seed: int = 0
    run: str | None = None
    corners: str | None = None
    method: str = METHOD.default
    as_live: bool = False
    skip_ambiguous: bool = False
    parameters: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.corners is not None:
            CORNERS.check(self.corners)
        METHOD.check(self.method)

    def options(self, model: str | None = None) -> dict[str, str]:
        """Return the options of stages by name, for one model."""
        options = {
            "corners": self.corners or "",
            "method": self.method,
            "model": model or "",
            "train": self.train,
            "seed": str(self.seed),
            "as_live": "yes" if self.as_live else "",
            "model_from": "yes" if self.model_from is not None or self.model_run is not None else "",
            "model_run": self.model_run or "",
            **self.parameters,
        }
        return {name: value for name, value in options.items() if value}
