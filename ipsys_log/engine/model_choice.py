"""The models that a command fits or applies, and the reason for this choice."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ipsys_log.engine.graph import input_runs, is_of_model, stage_named, writer_of, writes
from ipsys_log.engine.provenance import complete_runs, replaced_lenses
from ipsys_log.engine.request import Request, copied_models, fitted_in, has_corners
from ipsys_log.engine.states import is_fitted_here
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import Rig, Run
from ipsys_log.messages.channels import EVALUATION, MODEL, RIG
from ipsys_log.messages.stage import Stage
from ipsys_log.models.table import CORNER_MODELS, MODELS, check_name

# The most accurate model, and the most accurate one without corners or heights, see docs/models.md.
PREFERRED, SECOND = "joint", "best"


class Choice(NamedTuple):
    """The models to fit or apply, and the request with the settings of the run that it continues.

    ``reason`` is a line for the user; "" if the user has named the models. ``second`` is the model to fit if
    the first one cannot be fitted.
    """

    request: Request
    models: tuple[str, ...]
    reason: str = ""
    second: str | None = None


def choose_models(request: Request, paths: Sequence[LogLocation], until: Stage) -> Choice:
    """Choose the models to fit or apply, up to a stage.

    The first of these cases applies:

    - the models of the request;
    - for an evaluation, all models that the logs of ``paths`` can have;
    - the newest model of ``model_from``, see :func:`newest_model`;
    - the model and the settings of the newest run, for a stage that applies a model;
    - the models that were copied into the logs, if these have no measurements to fit to;
    - ``joint`` if the logs have markers, or images, and their heights; ``best`` if not.
    """
    if request.models or request.model_from is not None:
        return Choice(request, *applied_models(request))
    if not is_of_model(until):
        return Choice(request, ())
    with Session(paths) as session:
        copied = copied_models(session)
        if EVALUATION in until.writes:
            return Choice(request, copied or (*MODELS, *(CORNER_MODELS if has_corners(session) else ())))
        if MODEL not in until.writes and (chain := _newest_chain(complete_runs(session))):
            request = _continued(request, chain)
            return Choice(request, request.models, _newest_reason(session, request.models[0]))
        if copied:
            return Choice(request, copied, f"model {copied[0]}: it was copied into the log")
        return Choice(request, *_best_possible(session, request.rig))


def applied_models(request: Request) -> tuple[tuple[str, ...], str]:
    """Return the models of a request, or the newest one of its other log, and the reason."""
    for name in request.models:
        check_name(name)
    if request.models:
        return request.models, ""
    assert request.model_from is not None
    with Session([request.model_from]) as other:
        name = newest_model(other)
        return (name,), _newest_reason(other, name)


def _newest_reason(session: Session, name: str) -> str:
    """Return the line that names the newest model of a log, and the others that it has."""
    names = {run.parameters.get("model", name) for run in complete_runs(session) if writes(run, MODEL)}
    others = ", ".join(one for one in (*CORNER_MODELS, *reversed(MODELS)) if one in names - {name})
    more = f"; it also has {others} (--model)" if others else ""
    return f"model {name}: that of the newest run of {session}{more}"


def newest_model(session: Session) -> str:
    """Return the name of the model of the newest run of the user.

    Several models that are only fitted and evaluated were not selected: ``evaluate`` fits all models. Then it
    is the most accurate one of them.
    """
    records = complete_runs(session)
    if chain := _newest_chain(records):
        return _fitted(chain).parameters["model"]
    names = [run.parameters.get("model") for run in records if writes(run, MODEL)]
    return next((name for name in (PREFERRED, SECOND) if name in names), fitted_in(session, None)[0].name)


def _best_possible(session: Session, given: Rig | None) -> tuple[tuple[str], str, str | None]:
    """Return the most accurate model that a log can have, the reason, and the second model."""
    missing = ""
    if not has_corners(session):
        missing = "images or markers, and the log has only camera points"
    for rig in [given] if given is not None else session.payloads(session.topics(RIG))[-1:]:
        unknown = rig.without_height()
        if not missing and (unknown or (not rig.markers and rig.marker_height_m is None)):
            missing = f"marker_height_m of {f'marker {unknown[0]}' if unknown else 'the markers'} in the rig"
    if missing:
        return (SECOND,), f"model {SECOND}: the more accurate {PREFERRED} needs {missing}", None
    return (PREFERRED,), f"model {PREFERRED}: the log has markers and their heights", SECOND


def _newest_chain(records: Sequence[Run]) -> list[Run]:
    """Return the newest run that the user has selected by its model, the runs it has read, its evaluation."""
    applied = {run.run for run in records if _applies_model(run)}
    only_evaluated = {run.run for run in records if writes(run, EVALUATION)} - applied
    of_evaluation = only_evaluated if len(only_evaluated) > 1 else set()
    for run in reversed(records):
        is_candidate = _applies_model(run) or (writes(run, MODEL) and run.run not in of_evaluation)
        chain = _chain(run, records) if is_candidate else []
        if any(writes(one, MODEL) and "model" in one.parameters for one in chain):
            return chain + [one for one in records if one.run == run.run and writes(one, EVALUATION)][-1:]
    return []


def _fitted(chain: Sequence[Run]) -> Run:
    return next(one for one in chain if writes(one, MODEL) and "model" in one.parameters)


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


def _continued(request: Request, chain: Sequence[Run]) -> Request:
    fitted, recorded = _fitted(chain), dict[str, str]()
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
