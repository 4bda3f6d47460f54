"""The evaluations of several models in worker processes; this process appends them in order.

The logs do not change while they are read: an append leaves the messages before it where they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

from ipsys_log.engine.execute import record_of
from ipsys_log.engine.graph import Task, plan_stage
from ipsys_log.engine.provenance import find_run
from ipsys_log.engine.request import Request
from ipsys_log.engine.workers import LocalWorkers
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.log.location import LogLocation
from ipsys_log.messages.channels import CHANNELS, EVALUATION, Channel
from ipsys_log.messages.stage import Stage
from ipsys_log.stages import load_stage


class ModelPiece(NamedTuple):
    """A model, and by the name of a derived channel the run that its stage reads."""

    stage: str
    model: str
    inputs: Mapping[str, str]

    def __str__(self) -> str:
        return f"{self.stage} {self.model}"


class ModelResult(NamedTuple):
    """The payload of a stage for a model with its remarks, or the error of the input."""

    model: str
    payload: Any
    notes: Sequence[str]
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
        assert isinstance(task, Task)
        assert task.compute is not None
        try:
            return ModelResult(piece.model, task.compute(lambda done, total: None), task.notes)
        except IpsysError as error:
            return ModelResult(piece.model, None, task.notes, error)


class ModelPlan(NamedTuple):
    """The division of a stage into models, see :meth:`ipsys_log.engine.workers.LocalWorkers.compute`."""

    run: ModelWork
    pieces: Sequence[ModelPiece]

    def ahead(self, _workers: int) -> int:
        """Return how many models may be finished before the models in front of them: all."""
        return len(self.pieces)


def _plan(
    session: Session, request: Request, stage: Stage, inputs: Mapping[Channel, str], model: str
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

    def task_of(self, model: str, task: Task) -> Task:
        """Return a task that takes its payload from a worker, if one computes it."""
        if EVALUATION not in task.stage.writes or model not in self._missing:
            return task
        return replace(task, compute=lambda progress: self._take(model, task.notes))

    def _take(self, model: str, notes: list[str]) -> Any:
        result: ModelResult = next(one for one in self._results if one.model == model)
        if result.error is not None:
            raise result.error
        notes[:] = result.notes
        return result.payload
