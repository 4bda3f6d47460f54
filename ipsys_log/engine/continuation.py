"""The newest run of a log, which a stage without ``--model`` continues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ipsys_log.engine.graph import input_runs, is_of_model, stage_named, writer_of, writes
from ipsys_log.engine.options import Request
from ipsys_log.engine.provenance import complete_runs, replaced_lenses
from ipsys_log.engine.states import is_fitted_here
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Run
from ipsys_log.messages.channels import EVALUATION, MODEL
from ipsys_log.messages.stage import Stage


def continue_newest(request: Request, paths: Sequence[LogLocation], until: Stage) -> Request:
    """Return the request with the model and the settings of the newest run, if the user selects no model.

    The stages that make or evaluate models have their own default. Settings of the user take precedence.
    Several models that are only fitted and evaluated were not selected: ``evaluate`` fits all models.
    """
    has_default = MODEL in until.writes or EVALUATION in until.writes or not is_of_model(until)
    if request.models or request.model_from is not None or has_default:
        return request
    with Session(paths) as session:
        records = complete_runs(session)
        applied = {run.run for run in records if _applies_model(run)}
        only_evaluated = {run.run for run in records if writes(run, EVALUATION)} - applied
        of_evaluation = only_evaluated if len(only_evaluated) > 1 else set()
        for run in reversed(records):
            is_candidate = _applies_model(run) or (writes(run, MODEL) and run.run not in of_evaluation)
            chain = _chain(run, records) if is_candidate else []
            fitted = next((one for one in chain if writes(one, MODEL)), None)
            if fitted is not None and "model" in fitted.parameters:
                return _continued(request, chain, fitted)
    return request


def _applies_model(run: Run) -> bool:
    stage = stage_named(run.stage)
    return stage is not None and is_of_model(stage) and not (writes(run, EVALUATION) or writes(run, MODEL))


def _chain(run: Run, records: Sequence[Run]) -> list[Run]:
    """Return the record of a stage and those of the stages whose results it has read, the newest first."""
    chain, waiting = [], [run]
    while waiting:
        one = waiting.pop(0)
        chain.append(one)
        for channel, name in input_runs(one).items():
            stage = writer_of(channel).name
            made = [record for record in records if (record.run, record.stage) == (name, stage)]
            waiting += [record for record in made[-1:] if record not in [*chain, *waiting]]
    return chain


def _continued(request: Request, chain: Sequence[Run], fitted: Run) -> Request:
    recorded: dict[str, str] = {}
    for run in chain:
        recorded = {**run.parameters, **recorded}
    usual = Request()
    lenses = {name: lens for run in reversed(chain) for name, lens in replaced_lenses(run).items()}
    return replace(
        request,
        models=(fitted.parameters["model"],),
        corners=request.corners or recorded.get("corners"),
        method=recorded.get("method", usual.method) if request.method == usual.method else request.method,
        train=recorded.get("train", usual.train) if request.train == usual.train else request.train,
        seed=int(recorded.get("seed", usual.seed)) if request.seed == usual.seed else request.seed,
        as_live=request.as_live or "as_live" in recorded,
        rig=request.rig or next((run.rig for run in chain if run.rig is not None), None),
        lenses={**lenses, **request.lenses},
        model_run=None if is_fitted_here(fitted) else fitted.run,
    )
