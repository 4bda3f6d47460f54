"""The requests of the user, and the models, the rig and the settings of a log that they select."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ipsys_log.engine.provenance import complete_runs, newest_run
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import CameraCalibration, Model, Rig
from ipsys_log.messages.channels import MARKERS, MODEL, RIG
from ipsys_log.models.table import is_known
from ipsys_log.plain_text import shell_words
from ipsys_log.stages import CORNERS, METHOD
from ipsys_log.statistics.calibration_points import has_measurements

# Called with the stage, the number of messages done, and the number of all messages, if it is known.
Progress = Callable[[str, int, int | None], None]


@dataclass(frozen=True, slots=True)
class Request:
    """The requests of the user.

    Attributes
    ----------
    models : names in the table of models; empty: see :func:`ipsys_log.engine.model_choice.choose_models`.
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


# The median edge offset of a camera needs 10 markers; an offset below 0.05 px counts as zero.
MIN_OFFSETS, LEAST_OFFSET_PX = 10, 0.05


def has_corners(session: Session) -> bool:
    """Return whether a log has the corners of markers, or images to detect them in."""
    return bool(session.images) or newest_run(session, MARKERS) is not None


def fitted_in(other: Session, name: str | None) -> tuple[Model, str]:
    """Return the newest model in another log, and its topic; of the given name, or of a run of this name."""
    models: list[Model] = []
    for topic in reversed(topics := _model_topics(other)):
        models.append(other.payloads([topic])[-1])
        if name in (None, models[-1].name):
            return models[-1], topic
    for model, topic in zip(models, reversed(topics), strict=True):
        if name == run_of_topic(topic):
            return model, topic
    wanted, option = (f"model {name}", f" --model {name}") if name else ("model", "")
    known = f" (it has: {', '.join(dict.fromkeys(model.name for model in models))})" if models else ""
    fit = f"; to fit one: ipsys replay {shell_words(*other.paths)} --until fit{option}"
    is_fittable = name is None or is_known(name)
    raise IpsysError(f"{other}: has no fitted {wanted}{known}{fit if is_fittable else ''}")


def _model_topics(session: Session) -> list[str]:
    """Return the topics of the models of complete runs, oldest first."""
    runs = [(run.run, {output.topic for output in run.outputs}) for run in complete_runs(session)]
    return [topic for run, written in runs for topic in session.topics(MODEL, run) if topic in written]


def copied_models(session: Session) -> tuple[str, ...]:
    """Return the names of the models that were copied into a log without measurements, oldest first."""
    if has_measurements(LogView(session)):
        return ()
    return tuple(dict.fromkeys(session.payloads([topic])[-1].name for topic in _model_topics(session)))


def copied_run(session: Session, model: str) -> str | None:
    """Return the newest run with a model that was copied into a log without measurements."""
    if has_measurements(LogView(session)):
        return None
    for topic in reversed(_model_topics(session)):
        if session.payloads([topic])[-1].name == model:
            return run_of_topic(topic)
    return None


def rig_with_offsets(session: Session) -> Rig:
    """Return the newest rig of a log, with the edge offsets of its cameras.

    If the rig has no edge offset for a camera, the offset is the median over the newest detection.
    """
    rigs: list[Rig] = session.payloads(session.topics(RIG))
    if not rigs:
        raise IpsysError(f"{session}: has no rig; to write an example: ipsys init lab.toml")
    run = newest_run(session, MARKERS)
    offsets_by_camera: dict[str, list[float]] = {}
    for message in session.messages(session.topics(MARKERS, run) if run else []):
        offsets = offsets_by_camera.setdefault(str(message.camera), [])
        offsets += [m.edge_offset_px for m in message.payload.markers if m.edge_offset_px is not None]
    cameras = {
        name: rigs[-1].camera(name) for name in [c.name for c in rigs[-1].cameras] + sorted(offsets_by_camera)
    }
    for name, offsets in offsets_by_camera.items():
        offset_px = float(np.median(offsets)) if len(offsets) >= MIN_OFFSETS else 0.0
        if abs(offset_px) >= LEAST_OFFSET_PX and cameras[name].edge_offset_px is None:
            cameras[name] = replace(cameras[name], edge_offset_px=round(offset_px, 3))
    return replace(rigs[-1], cameras=tuple(cameras.values()))
