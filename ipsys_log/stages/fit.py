"""The stage *fit*: a model for the calibration points of each camera."""

from collections.abc import Mapping

from ipsys_log.messages import Model
from ipsys_log.messages.channels import MODEL
from ipsys_log.messages.stage import Plan, Progress, Stage, StageView
from ipsys_log.models.table import MODEL_PARTS, model_run
from ipsys_log.statistics.calibration_points import has_measurements, measured, split_ids, split_parameters
from ipsys_log.statistics.model_kinds import JOINT_READS, model_kind


def _plan(view: StageView, options: Mapping[str, str]) -> Plan | str:
    name = options["model"]
    if "model_run" in options:
        return options["model_run"]
    if not has_measurements(view):
        copied = next((run for run, model in view.copied(MODEL) if model.name == name), None)
        if copied is not None:
            return copied
    notes: list[str] = []
    kind = model_kind(name)

    def compute(progress: Progress) -> Model:
        train, _ = split_ids([point.measurement for point in measured(view)], options)
        return kind.fit(name, view, train, notes, progress)

    return Plan(
        run=model_run(name),
        parameters={"model": name, **split_parameters(view, options)},
        reads=kind.fit_reads,
        compute=compute,
        notes=notes,
    )


STAGE = Stage(
    name="fit",
    versions={"fit": 1} | {name: part.version for name, part in MODEL_PARTS.items()},
    reads=JOINT_READS,
    writes=(MODEL,),
    plan=_plan,
    rig_part=lambda rig, model: model_kind(model).fit_part(rig),
    method=lambda parameters, view: parameters.get("model", ""),
    causal=False,
    of_model=True,
)
