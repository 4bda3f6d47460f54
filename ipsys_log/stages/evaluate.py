"""The stage *evaluate*: errors of a model, effect of the number of points, and suspect measurements."""

from collections.abc import Mapping

from ipsys_log.messages import Evaluation, Model
from ipsys_log.messages.channels import EVALUATION, MODEL, TRUTH
from ipsys_log.messages.stage import Plan, Progress, Stage, StageView, model_read
from ipsys_log.statistics.calibration_points import find_pairs, held_out_ids, measured, split_parameters
from ipsys_log.statistics.cross_validation import FOLDS, Study, labelled_subsets
from ipsys_log.statistics.ground_truth import gather_tracks, true_points
from ipsys_log.statistics.model_kinds import JOINT_READS, can_evaluate, can_refit, model_kind


def _plan(view: StageView, options: Mapping[str, str]) -> Plan | str:
    model: Model = view.payloads(MODEL)[-1]
    if not can_evaluate(view, options, model.name):
        return ""
    again = can_refit(view, options, model.name)
    seed = options.get("seed", "0")
    kind = model_kind(model.name)
    reads = (*kind.fit_reads, MODEL, TRUTH)
    notes: list[str] = []

    def compute(progress: Progress) -> Evaluation:
        points = measured(view)
        measurements = [point.measurement for point in points]
        study = Study(
            points,
            find_pairs(view, points),
            held_out_ids(measurements, options),
            labelled_subsets(measurements),
            true_points(points, gather_tracks(view.messages(TRUTH))),
            int(seed) if again else None,
        )
        return kind.evaluate(model, view, study, view.last_ns(*reads), notes, progress)

    folds = {"folds": str(FOLDS), "repeats": str(kind.repeats), "seed": seed}
    return Plan(
        run=view.run(MODEL),
        parameters={**split_parameters(view, options), **folds} if again else {},
        reads=reads,
        compute=compute,
        notes=notes,
    )


STAGE = Stage(
    name="evaluate",
    versions={"evaluate": 5},
    reads=(*JOINT_READS, MODEL, TRUTH),
    writes=(EVALUATION,),
    plan=_plan,
    rig_part=lambda rig, model: model_kind(model).fit_part(rig),
    method=model_read,
    causal=False,
)
