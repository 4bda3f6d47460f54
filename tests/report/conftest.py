"""Evaluated logs, for tables, figures and pages."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.app.report.accuracy import Accuracy, read_accuracy
from ipsys_log.app.report.advice import advise
from ipsys_log.app.report.findings import Findings, gather_findings
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.exchange.imsel import read_imsel
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Evaluation, Message, Rig, RigCamera
from ipsys_log.statistics.accuracy import POOLED
from tests import labs

ALL_MODELS = (
    "rigid", "poly", "rigid+poly", "ann", "rigid+ann", "kriging", "rigid+kriging", "kriging-regression",
    "rigid+kriging-regression", "rayplane", "best",
)  # fmt: skip


@pytest.fixture(scope="session")
def paper(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Findings:
    """Return the paper's data, evaluated with its two simplest methods."""
    path = tmp_path_factory.mktemp("paper") / "imsel.mcap"
    write_log(path, read_imsel(data / "imsel"))
    return find(path, ("rigid", "poly"))


def only(findings: Findings, *models: str) -> Findings:
    """Return the findings for some of the models."""
    return with_accuracies(findings, [a for a in findings.accuracies if a.model in models])


def with_accuracies(findings: Findings, accuracies: Sequence[Accuracy]) -> Findings:
    advice = advise([accuracy.evaluation for accuracy in accuracies if accuracy.evaluation])
    return replace(findings, accuracies=tuple(accuracies), advice=advice)


def lab_messages(
    rig: Rig = labs.RIG, heights: Sequence[float] = labs.HEIGHTS, count: int = 30, cameras: int = 2
) -> list[Message]:
    """Return a session of one or two cameras over the paper's floor, with calibration points."""
    rng = np.random.default_rng(3)
    world_m = labs.places(rng, count, heights=tuple(heights))
    hung = [labs.camera(rng, y_m) for y_m in (0.9, 1.2)[:cameras]]
    points_m = {name: one.see(world_m, rng) for name, one in zip(("red", "white"), hung, strict=False)}
    rig = replace(rig, cameras=tuple(RigCamera(name) for name in points_m))
    return list(labs.session(points_m, world_m, rig, distances=True))


def find(path: Path, models: Sequence[str]) -> Findings:
    """Evaluate models on a log; return the findings."""
    outcomes = replay([path], Request(models=tuple(models)), "evaluate")
    with Session([path]) as session:
        return gather_findings(session, read_accuracy(session, outcomes))


def many_models(accuracies: Sequence[Accuracy]) -> list[Accuracy]:
    """Return as many evaluations as possible, derived from a few: new names, scaled errors."""
    known = {accuracy.model: accuracy for accuracy in accuracies}
    found = []
    for number, model in enumerate(ALL_MODELS):
        accuracy = known.get(model, accuracies[0])
        assert accuracy.evaluation is not None
        run = model.replace("+", "_").replace("-", "_")
        scaled = scale(accuracy.evaluation, 1.0 if model in known else 1.0 + 0.13 * number)
        found.append(Accuracy(run, replace(scaled, model=model), None))
    return found


def scale(evaluation: Evaluation, factor: float) -> Evaluation:
    """Return the findings with all errors scaled, except the single ones."""
    rows = tuple(
        replace(
            row,
            error_3d=None if row.error_3d is None else _scaled(row.error_3d, factor),
            error_2d=_scaled(row.error_2d, factor),
        )
        for row in evaluation.cameras
    )
    learning = tuple(_scaled(point, factor) for point in evaluation.learning)
    return replace(evaluation, cameras=rows, learning=learning)


def _scaled(payload: Any, factor: float) -> Any:
    lengths = {name: getattr(payload, name) for name in payload.__slots__ if name.endswith("_m")}
    return replace(payload, **{n: None if v is None else v * factor for n, v in lengths.items()})


def rename_cameras(accuracy: Accuracy, names: dict[str, str]) -> Accuracy:
    """Return the findings with other camera names."""
    assert accuracy.evaluation is not None
    found = accuracy.evaluation
    rows = tuple(replace(row, camera=names.get(row.camera, POOLED)) for row in found.cameras)
    learning = tuple(replace(point, camera=names[point.camera]) for point in found.learning)
    return replace(accuracy, evaluation=replace(found, cameras=rows, learning=learning))
