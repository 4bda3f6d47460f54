"""The graph of stages: one table of their rows, and the plan of each on a log.

A new stage needs a file with its row and an entry in the table of :mod:`ipsys_log.stages`. A new channel
needs a line in the table of :mod:`ipsys_log.messages.channels`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from ipsys_log.engine.provenance import Outcome, read_channels
from ipsys_log.engine.request import Request, fitted_in
from ipsys_log.engine.view import LogView
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, ChannelRead, Model, Rig, Run
from ipsys_log.messages.channels import CALIBRATIONS, MODEL, RIG, RUN_EVENTS, Channel
from ipsys_log.messages.stage import Plan, Progress, Stage, Step
from ipsys_log.models.table import model_run
from ipsys_log.stages import ENTRIES, load_stage
from ipsys_log.vision.lenses import same_intrinsics

STAGES: tuple[Stage, ...] = tuple(load_stage(entry.name) for entry in ENTRIES)
VERSIONS: dict[str, int] = {name: number for stage in STAGES for name, number in stage.versions.items()}


def stage_named(name: str) -> Stage | None:
    """Return the row of a stage by its name; None for a stage that is not known here."""
    return next((stage for stage in STAGES if stage.name == name), None)


def stages_until(name: str | None) -> list[Stage]:
    """Return a stage and all those that it needs, in order; for None, all stages but those on demand.

    If no stage reads the result of this stage, the earlier stages of the table without readers are included:
    fuse also evaluates.
    """
    if name is None:
        return [stage for stage in STAGES if not stage.on_demand]
    last = stage_named(name)
    if last is None:
        raise ValueError(f"no stage is named {name}")
    wanted = _with_needed(last)
    if not _readers(last):
        for stage in STAGES[: STAGES.index(last)]:
            if not _readers(stage):
                wanted |= _with_needed(stage)
    return [stage for stage in STAGES if stage in wanted]


def _with_needed(stage: Stage) -> set[Stage]:
    needed = {stage}
    for writer in (candidate for candidate in STAGES if _own(candidate) & set(stage.reads)):
        if writer is not stage:
            needed |= _with_needed(writer)
    return needed


def _readers(stage: Stage) -> list[Stage]:
    return [candidate for candidate in STAGES if _own(stage) & set(candidate.reads)]


def _own(stage: Stage) -> set[Channel]:
    """Return the channels that only this stage writes."""
    return set(stage.writes) - {RUN_EVENTS}


def is_of_model(stage: Stage) -> bool:
    """Return whether each model has its own run of a stage."""
    return any(needed.of_model for needed in _with_needed(stage))


def versioned_names(stage: str, method: str = "") -> list[str]:
    """Return the parts of a stage that have versions, the stage first: a hybrid has those of its parts."""
    return [stage, *(part for part in method.split("+") if part)]


def version_parameters(stage: str, method: str = "") -> dict[str, str]:
    """Return the parameters of a run that name the versions of a stage and its method, except version 1."""
    versions = [(name, VERSIONS.get(name, 1)) for name in versioned_names(stage, method)]
    return {name: str(version) for name, version in versions if version != 1}


@dataclass(frozen=True, slots=True, kw_only=True)
class Task:
    """A run of a stage on a log: its plan, with the topics that it reads.

    Attributes
    ----------
    run : its name, if this name is free.
    topics : the topics that it reads from the log; ``foreign`` are the topics from another log.
    inputs : by derived channel, the run that it reads.
    parameters : all other settings on which its result depends; ``input_runs`` are the runs of ``foreign``.
    rig, lenses : set if they replace those of the log.
    """

    stage: Stage
    run: str
    topics: tuple[str, ...] = ()
    inputs: Mapping[Channel, str] = field(default_factory=dict)
    parameters: Mapping[str, str] = field(default_factory=dict)
    step: Callable[[str], Step] | None = None
    compute: Callable[[Progress], Any] | None = None
    rig: Rig | None = None
    lenses: Mapping[str, CameraCalibration] = field(default_factory=dict)
    foreign: tuple[ChannelRead, ...] = ()
    input_runs: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)


def plan_stage(
    stage: Stage,
    session: Session,
    options: Mapping[str, str],
    inputs: Mapping[Channel, str],
    rig: Rig | None = None,
    lenses: Mapping[str, CameraCalibration] | None = None,
) -> Task | str:
    """Plan a stage on a log.

    Parameters
    ----------
    options : of the user, by name, see :meth:`ipsys_log.engine.request.Request.options`.
    inputs : by derived channel, the run to read.
    rig, lenses : given by the user. They replace those of the log if they change the input of the stage.

    Returns
    -------
    The task; or the name of an existing run to use instead, "" if there is none.
    """
    other_lenses = _other_lenses(session, lenses or {}) if CALIBRATIONS in stage.reads else {}
    method = stage.method(options, LogView(session, inputs)) if rig is not None else ""
    view = LogView(session, inputs, _other_rig(session, stage, method, rig), other_lenses)
    plan = stage.plan(view, options)
    if not isinstance(plan, Plan):
        return plan
    topics = [topic for channel in plan.reads for topic in view.topics(channel)]
    method = stage.method(plan.parameters, view)
    return Task(
        stage=stage,
        run=plan.run,
        topics=tuple(topics),
        inputs={channel: run for channel, run in inputs.items() if channel in plan.reads},
        parameters={**plan.parameters, **version_parameters(stage.name, method)},
        step=plan.step,
        compute=plan.compute,
        rig=view.rig if RIG in plan.reads else None,
        lenses=other_lenses if CALIBRATIONS in plan.reads else {},
        notes=plan.notes,
    )


def _other_rig(session: Session, stage: Stage, method: str, rig: Rig | None) -> Rig | None:
    """Return a rig that the user gives if it differs, for a stage, from those of the log."""
    rigs = session.payloads(session.topics(RIG)) if rig is not None else []
    if rig is None or (
        rigs and all(stage.rig_part(recorded, method) == stage.rig_part(rig, method) for recorded in rigs)
    ):
        return None
    return rig


def _other_lenses(session: Session, given: Mapping[str, CameraCalibration]) -> dict[str, CameraCalibration]:
    """Return the given intrinsics that differ from those of the log."""
    lenses = dict(given)
    for camera, topic in session.calibrations.items():
        if camera in lenses and all(
            same_intrinsics(recorded, lenses[camera]) for recorded in session.payloads([topic])
        ):
            del lenses[camera]
    return lenses


def copy_model(request: Request, name: str) -> tuple[Task, Model]:
    """Return the task that copies a model from another log, and the model.

    Raises
    ------
    IpsysError
        The other log has no such model.
    """
    assert request.model_from is not None
    with Session([request.model_from]) as other:
        model, topic = fitted_in(other, name)
        foreign = read_channels(other, [topic])
    task = Task(
        stage=writer_of(MODEL),
        run=model_run(name),
        compute=lambda progress: model,
        parameters={"model": name},
        foreign=foreign,
        input_runs=(f"{request.model_from.name}:{run_of_topic(topic)}",),
    )
    return task, model


def input_runs(run: Run) -> dict[Channel, str]:
    """Return the runs that a recorded stage has read, by derived channel."""
    stage = stage_named(run.stage)
    runs: dict[Channel, str] = {}
    for topic in (read.topic for read in run.inputs if stage):
        name, camera = run_of_topic(topic), camera_of_topic(topic)
        for channel in stage.reads if stage and name else ():
            if channel.topic_of(name, camera) == topic:
                runs[channel] = str(name)
    return runs


def method_of(session: Session, run: Run) -> str:
    """Return the corner method, camera-point method or model of a recorded stage; "" if it has none."""
    stage = stage_named(run.stage)
    return stage.method(run.parameters, LogView(session, input_runs(run))) if stage else ""


def writes(run: Run | Outcome, channel: Channel) -> bool:
    """Return whether the stage of a record, or of an outcome, writes a channel."""
    stage = stage_named(run.stage)
    return stage is not None and channel in stage.writes


def writer_of(channel: Channel) -> Stage:
    """Return the stage that writes a derived channel."""
    return next(stage for stage in STAGES if channel in _own(stage))
