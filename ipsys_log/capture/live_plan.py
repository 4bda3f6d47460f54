"""The plan of a live run: its stages, and its runs with the names of a replay."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from ipsys_log.capture.camera_thread import imported_run
from ipsys_log.capture.frames import CameraState
from ipsys_log.capture.nodes.wire import MARKERS_FORMAT
from ipsys_log.engine.execute import LiveRun, copy_messages
from ipsys_log.engine.graph import Task, copy_model, is_of_model, stages_until
from ipsys_log.engine.model_checks import compare_labs
from ipsys_log.engine.model_choice import applied_models
from ipsys_log.engine.request import Request
from ipsys_log.engine.stream import WiredStage, wire
from ipsys_log.errors import IpsysError
from ipsys_log.messages import CameraCalibration, Message, Model, Rig
from ipsys_log.messages.channels import (
    CALIBRATIONS,
    CAMERA_POINTS,
    MARKERS,
    MODEL,
    RUN_EVENTS,
    Channel,
    channel_of,
)
from ipsys_log.messages.stage import Plan, Stage
from ipsys_log.models.table import model_run, needs_height
from ipsys_log.stages.detect import usual_corners
from ipsys_log.statistics.model_kinds import model_kind


class LivePlan(NamedTuple):
    """The plan of a live run.

    It has the rig, the completed request, the reason for its models, and the models of another log with the
    tasks that copy them. It also has the runs in the order of their records, and the causal stages.
    """

    rig: Rig
    request: Request
    reason: str
    copied: list[tuple[Task, Model]]
    runs: list[LiveRun]
    stages: list[WiredStage]

    def copies(self, now_ns: Callable[[], int]) -> list[Message]:
        """Return the models, as their runs, with log times from ``now_ns``."""
        return [
            message
            for number, (task, model) in enumerate(self.copied, 1)
            for message in copy_messages(task, model, number, now_ns)
        ]


@dataclass(frozen=True, slots=True, eq=False)
class _LiveView:
    """The view of a stage on live cameras: only the rig and the intrinsics are recorded so far.

    ``model`` is the model that the stage applies. ``imported`` are the runs that arrive instead of images.
    """

    cameras: Collection[str]
    lenses: Collection[str]
    settings: Sequence[Message]
    inputs: Mapping[Channel, str]
    model: Model | None
    rig: Rig | None = None
    imported: Mapping[Channel, str] = field(default_factory=dict)

    def calibrations(self) -> dict[str, CameraCalibration]:
        return {str(message.camera): message.payload for message in self.messages(CALIBRATIONS)}

    def run(self, channel: Channel) -> str:
        return self.inputs.get(channel, "")

    def messages(self, *channels: Channel) -> Iterator[Message]:
        return (
            message
            for message in self.settings
            if channel_of(message.topic, type(message.payload)) in channels
        )

    def payloads(self, channel: Channel) -> list[Any]:
        if channel is MODEL:
            return [] if self.model is None else [self.model]
        return [message.payload for message in self.messages(channel)]

    def count(self, *channels: Channel) -> int:
        return sum(1 for _ in self.messages(*channels))

    def last_ns(self, *channels: Channel) -> int:
        return max((message.publish_time_ns for message in self.messages(*channels)), default=0)

    def newest(self, channel: Channel, /) -> str:
        return self.imported.get(channel, "")

    def copied(self, _channel: Channel, /) -> Iterator[tuple[str, Any]]:
        return iter(())


def plan_live(
    cameras: Mapping[str, CameraState], settings: Sequence[Message], request: Request, until: str | None
) -> LivePlan:
    """Plan a live run like a replay of its log; ``cameras`` are the states of the cameras.

    Raises
    ------
    IpsysError
        The other log has no such model; a camera has no intrinsics; the model has none of the cameras, or it
        needs a height that the rig does not give.
    """
    lenses = {str(message.camera) for message in settings if isinstance(message.payload, CameraCalibration)}
    (rig,) = (message.payload for message in settings if isinstance(message.payload, Rig))
    # Nodes can send markers instead of frames.
    pictured = [name for name, state in cameras.items() if state.format != MARKERS_FORMAT]
    request = replace(request, corners=request.corners or usual_corners(pictured, lenses))
    copied = _copied(request, until)
    models = [model for _, model in copied]
    _check(rig, cameras, lenses, models, until)
    wired = _wire(pictured, settings, lenses, request, copied, until, imported_run(cameras))
    reason = applied_models(request)[1] if copied else ""
    return LivePlan(rig, request, reason, copied, *wired)


def check_start(
    rig: Rig,
    cameras: Collection[str],
    lenses: Mapping[str, CameraCalibration],
    request: Request,
    until: str | None,
) -> list[str]:
    """Check, before a camera is opened, that a live run can be planned.

    Parameters
    ----------
    cameras, lenses : the names of the cameras, and the intrinsics by camera.
    request, until : as for :func:`plan_live`.

    Returns
    -------
    One line for each remark.

    Raises
    ------
    IpsysError
        As for :func:`plan_live`; or the model is for other cameras.
    """
    models = [model for _, model in _copied(request, until)]
    _check(rig, cameras, lenses, models, until)
    if not models:
        return []
    for model in models:
        model_kind(model.name).step(model)  # loads its libraries: no frame must wait for them
    assert request.model_from is not None
    return compare_labs(request.model_from, models, rig, lenses) + [
        f"camera {name}: {request.model_from} has no model of this camera; it is recorded, but not used "
        "for tracking"
        for model in models
        for name in sorted(set(cameras) - {camera.camera for camera in model.cameras})
    ]


def shown_run(request: Request) -> str:
    """Return the run of the first model: streams, viewers and the dashboard show one run."""
    return model_run(applied_models(request)[0][0])


def check_model(model: Model, cameras: Collection[str]) -> None:
    """Check that a model has some of the cameras."""
    known = sorted(camera.camera for camera in model.cameras)
    if not set(known) & set(cameras):
        raise IpsysError(
            f"the model {model.name} is for the cameras {', '.join(known)}, but the rig has only "
            f"{', '.join(cameras)}; give a model of these, or use the names of the model in lab.toml"
        )


def _copied(request: Request, until: str | None) -> list[tuple[Task, Model]]:
    """Return the models of another log to apply, with the tasks that copy them in; none before locate."""
    reads_model = any(MODEL in stage.reads for stage in _causal(until))
    if reads_model and request.model_from is None:
        raise IpsysError(
            "no fitted model is given; give the log of a calibration: --model-from LOG (in Python: "
            "model_from). To fit one: ipsys calibrate-lab LOG"
        )
    return [copy_model(request, name) for name in applied_models(request)[0]] if reads_model else []


def _causal(until: str | None) -> list[Stage]:
    return [stage for stage in stages_until(until) if stage.causal]


def _check(
    rig: Rig, cameras: Collection[str], lenses: Collection[str], models: Sequence[Model], until: str | None
) -> None:
    """Check that the stages will not have to stop later."""
    missing = sorted(set(cameras) - set(lenses))
    if missing and any(CAMERA_POINTS in stage.writes for stage in _causal(until)):
        name = missing[0]
        raise IpsysError(
            f'camera {name} has no calibration: write calibration = "{name}.yaml" into lab.toml, or give '
            f"--calibration {name}=file.yaml"
        )
    for model in models:
        check_model(model, cameras)
        unknown = rig.without_height() if rig.markers else rig.marker_height_m is None
        if needs_height(model.name) and unknown:
            raise IpsysError(
                f"{model.name} needs the height of the markers above the floor: write marker_height_m into "
                "lab.toml"
            )


def check_independent_frames(cameras: Mapping[str, CameraState]) -> None:
    """Check that each frame of the cameras can be decoded by itself."""
    for name, state in cameras.items():
        if state.format == MARKERS_FORMAT:
            raise IpsysError(
                f"camera {name} sends only markers, but --points-only keeps frames: start its node without "
                "--detect"
            )
        if state.format in ("h264", "h265"):
            raise IpsysError(
                f"camera {name} sends {state.format}, but --points-only can keep short parts only of MJPEG: "
                "set the camera to MJPEG, or record everything with 'ipsys record --measure'"
            )


def _wire(
    cameras: Collection[str],
    settings: Sequence[Message],
    lenses: Collection[str],
    request: Request,
    copied: Sequence[tuple[Task, Model]],
    until: str | None,
    arriving: str | None,
) -> tuple[list[LiveRun], list[WiredStage]]:
    """Return the runs of a live recording, and its stages, each wired to the runs that it reads.

    ``cameras`` send frames. ``arriving`` is the run of markers that other cameras send instead.
    """
    runs: list[LiveRun] = []
    stages: list[WiredStage] = []

    imported = {} if arriving is None else {MARKERS: arriving}

    def add(stage: Stage, inputs: dict[Channel, str], model: Model | None) -> None:
        options = request.options(model.name if model else None)
        view = _LiveView(cameras, lenses, settings, inputs, model, imported=imported)
        plan = stage.plan(view, options)
        if isinstance(plan, str) and (arriving is not None or not plan):
            inputs.update({channel: plan for channel in stage.writes if channel is not RUN_EVENTS})
            return
        assert isinstance(plan, Plan), f"{stage.name} cannot run live"
        assert plan.step is not None
        stages.append(wire(stage, plan.run, inputs, plan.step(plan.run)))
        runs.append(LiveRun(stage, plan.run, dict(inputs)))
        inputs.update({channel: plan.run for channel in stage.writes if channel is not RUN_EVENTS})

    # Without frames, the next stages read the arriving run itself.
    shared: dict[Channel, str] = dict(imported) if cameras else {}
    for stage in _causal(until):
        if not is_of_model(stage):
            add(stage, shared, None)
    for task, model in copied:
        inputs = {**shared, MODEL: task.run}
        runs.append(LiveRun(task.stage, task.run, {}, copied=True))
        for stage in _causal(until):
            if is_of_model(stage):
                add(stage, inputs, model)
    return runs, stages
