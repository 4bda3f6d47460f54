"""The stages of a replay in order: those that all models share, and then those of each model.

The evaluations of several models come from worker processes; this process appends them in order. Each worker
reads the logs as they were when it opened them. If another program has changed the input of an evaluation
since then, this process computes it again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from ipsys_log.engine.checks import check_earlier_runs, describe_changed_images
from ipsys_log.engine.execute import compute_messages, one_blas_thread, record_of, run_stage
from ipsys_log.engine.graph import Task, copy_model, is_of_model, plan_stage
from ipsys_log.engine.model_checks import check_fits
from ipsys_log.engine.model_choice import Choice
from ipsys_log.engine.pieces import DividedRun, PieceWorkers, divide_run
from ipsys_log.engine.provenance import Outcome, find_run, imported_inputs
from ipsys_log.engine.request import Progress, Request
from ipsys_log.engine.workers import LocalWorkers
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages import ChannelRead, Message
from ipsys_log.messages.channels import CHANNELS, EVALUATION, IMAGES, MODEL, RUN_EVENTS, Channel
from ipsys_log.messages.stage import Progress as StageProgress
from ipsys_log.messages.stage import Stage
from ipsys_log.stages import load_stage
from ipsys_log.statistics.model_kinds import model_kind


@dataclass(slots=True, eq=False)
class Replay:
    """The work of one replay.

    Attributes
    ----------
    choice : the models, and the options of the stages.
    stages : those to compute, in order.
    logs, target : the logs to read as one, and the log that gets the results.
    workers, local : they compute the pieces of a long log, and the evaluations of several models.
    progress, say : called with the state of the work, and with remarks.
    unchecked : several models of which it is not known yet if all can be fitted.
    outcomes : one for each stage so far.
    divided : the run in work, if the workers compute it.
    """

    choice: Choice
    stages: Sequence[Stage]
    logs: Sequence[LogLocation]
    target: Path
    workers: PieceWorkers
    local: LocalWorkers
    progress: Progress
    say: Callable[[str], None]
    unchecked: list[str] = field(init=False)
    outcomes: list[Outcome] = field(default_factory=list, init=False)
    divided: DividedRun | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        self.unchecked = [*self.models] if len(self.models) > 1 else []

    @property
    def request(self) -> Request:
        """The options of the stages."""
        return self.choice.request

    @property
    def models(self) -> tuple[str, ...]:
        """The models to fit or apply, in order."""
        return self.choice.models

    def compute(self) -> None:
        """Run the stages that all models share, and then those of each model."""
        with Session(self.logs) as session:
            shared = imported_inputs(session)
        of_model = [stage for stage in self.stages if is_of_model(stage)]
        self._run_stages([stage for stage in self.stages if stage not in of_model], shared)
        inputs = {model: dict(shared) for model in self.models}
        if of_model and self.choice.reason:
            self.say(self.choice.reason)
        # All fits come first: the evaluations then need nothing from one another.
        fits = [stage for stage in of_model if stage.of_model]
        self._run_models(fits, inputs)
        if not inputs and self.choice.second is not None:
            inputs[self.choice.second] = dict(shared)
            self._run_models(fits, inputs)
        self._run_models([stage for stage in of_model if stage not in fits], inputs)

    def _run_models(self, stages: Sequence[Stage], inputs: dict[str, dict[Channel, str]]) -> None:
        """Run some stages for each model in order; a model that cannot be fitted leaves ``inputs``."""
        if not stages:
            return
        names, several = [*inputs], len(self.models) > 1
        runs = ModelRuns(self.logs, self.request, stages, inputs, self.local)
        step = "fits" if stages[0].of_model else "models"
        for place, model in enumerate(names):
            if several:
                self.progress(step, place, len(names))
            try:
                self._run_stages(stages, inputs[model], model, runs)
            except FitError as error:
                if model in self.request.models or model_kind(model).is_checked:
                    raise
                self.say(f"{model} is left out: {error}")
                del inputs[model]
        if several:
            self.progress(step, len(names), len(names))

    def _run_stages(
        self,
        stages: Sequence[Stage],
        inputs: dict[Channel, str],
        model: str | None = None,
        runs: ModelRuns | None = None,
    ) -> None:
        """Run some stages in order, and note the runs of their channels."""
        for stage in stages:
            run = self._run_stage(stage, inputs, model, runs)
            inputs.update({channel: run for channel in stage.writes if channel is not RUN_EVENTS})

    def _run_stage(
        self, stage: Stage, inputs: Mapping[Channel, str], model: str | None, runs: ModelRuns | None
    ) -> str:
        """Run a stage, or find its result; return its run."""
        request = self.request
        with Session(self.logs) as session:
            check_earlier_runs(session, self.outcomes)
            if MODEL in stage.writes and request.model_from is not None:
                task: Task | str = copy_model(request, str(model))[0]
            else:
                task = _plan(session, request, stage, inputs, model)
            if isinstance(task, str):
                return task
            if runs is not None:
                task = runs.task_of(session, str(model), task)
            until, target = self.stages[-1], self.target
            outcome = run_stage(
                session, target, task, request, until, self._messages, self.say, self._prepare
            )
        self.outcomes.append(outcome)
        return outcome.run

    def _prepare(self, task: Task, session: Session) -> None:
        """Divide a long run, and check its images while the workers load libraries and open the log."""
        self.divided = divide_run(task, session, self.workers)
        if self.divided is not None:
            self.divided.workers.prepare(self.divided.plan)
        if IMAGES in task.stage.reads:
            for remark in describe_changed_images(session):
                self.say(remark)

    def _messages(self, task: Task, session: Session, name: str) -> Iterator[Message]:
        """Compute a run. Before the first fit, check that all models can be fitted."""
        progress = self.progress
        if len(self.models) > 1 and is_of_model(task.stage):
            progress = name_run(progress, name)
        with one_blas_thread():
            if MODEL in task.stage.writes and task.foreign == () and self.unchecked:
                check_fits(session, self.request, task.inputs, self.unchecked)
                self.unchecked.clear()
            yield from compute_messages(task, session, name, progress, self.divided)


def name_run(progress: Progress, run: str) -> Progress:
    """Return a progress function whose steps name their run: with several runs, a stage has several."""
    return lambda stage, done, total: progress(f"{stage} {run}", done, total)


class ModelPiece(NamedTuple):
    """A model, and by the name of a derived channel the run that its stage reads."""

    stage: str
    model: str
    inputs: Mapping[str, str]

    def __str__(self) -> str:
        return f"{self.stage} {self.model}"


class ModelResult(NamedTuple):
    """The payload of a stage for a model with its remarks, or the error of the input.

    ``reads`` has the content that the stage has read; it is empty if the logs no longer have the input.
    """

    model: str
    reads: tuple[ChannelRead, ...] = ()
    payload: Any = None
    notes: Sequence[str] = ()
    error: IpsysError | None = None


@dataclass(frozen=True, slots=True)
class ModelWork:
    """The part of the work that all models have in common. It can be pickled."""

    paths: Sequence[LogLocation]
    request: Request

    @contextmanager
    def open(self) -> Iterator[Callable[[ModelPiece], ModelResult]]:
        """Open the logs; yield the function that computes the payload of a model."""
        with Session(self.paths) as session:
            yield partial(self._compute, session)

    def _compute(self, session: Session, piece: ModelPiece) -> ModelResult:
        inputs = {channel: piece.inputs[channel.name] for channel in CHANNELS if channel.name in piece.inputs}
        task = _plan(session, self.request, load_stage(piece.stage), inputs, piece.model)
        if not isinstance(task, Task):
            return ModelResult(piece.model)
        assert task.compute is not None
        reads = record_of(session, task).inputs
        try:
            return ModelResult(piece.model, reads, task.compute(lambda done, total: None), task.notes)
        except IpsysError as error:
            return ModelResult(piece.model, reads, error=error)


class ModelPlan(NamedTuple):
    """The division of a stage into models, see :meth:`ipsys_log.engine.workers.LocalWorkers.compute`."""

    run: ModelWork
    pieces: Sequence[ModelPiece]

    def ahead(self, _workers: int) -> int:
        """Return how many models may be finished before the models in front of them: all."""
        return len(self.pieces)


def _plan(
    session: Session, request: Request, stage: Stage, inputs: Mapping[Channel, str], model: str | None
) -> Task | str:
    return plan_stage(stage, session, request.options(model), inputs, request.rig, request.lenses)


class ModelRuns:
    """The evaluations of models that the logs lack, from worker processes that have begun with all of them.

    Parameters
    ----------
    stages : of each model; one of them may evaluate it.
    inputs : by model, the runs that its stages read.
    workers : with one process, or one missing evaluation, they are not used.
    """

    def __init__(
        self,
        logs: Sequence[LogLocation],
        request: Request,
        stages: Sequence[Stage],
        inputs: Mapping[str, Mapping[Channel, str]],
        workers: LocalWorkers,
    ) -> None:
        pieces = []
        evaluations = [stage for stage in stages if EVALUATION in stage.writes]
        if evaluations and workers.divides and len(inputs) > 1:
            with Session(logs) as session:
                for model, runs in inputs.items():
                    task = _plan(session, request, evaluations[0], runs, model)
                    if isinstance(task, Task) and not find_run(session, record_of(session, task), EVALUATION):
                        read = {channel.name: run for channel, run in runs.items()}
                        pieces.append(ModelPiece(evaluations[0].name, model, read))
        plan = ModelPlan(ModelWork(tuple(logs), request), pieces if len(pieces) > 1 else ())
        self._missing = {piece.model for piece in plan.pieces}
        self._results = workers.compute(plan)

    def task_of(self, session: Session, model: str, task: Task) -> Task:
        """Return a task that takes its payload from a worker, if one computes it from the same content."""
        if EVALUATION not in task.stage.writes or model not in self._missing:
            return task
        return replace(task, compute=partial(self._take, model, task, record_of(session, task).inputs))

    def _take(self, model: str, task: Task, reads: tuple[ChannelRead, ...], progress: StageProgress) -> Any:
        result: ModelResult = next(one for one in self._results if one.model == model)
        if result.reads != reads:
            assert task.compute is not None
            return task.compute(progress)
        if result.error is not None:
            raise result.error
        task.notes[:] = result.notes
        return result.payload
