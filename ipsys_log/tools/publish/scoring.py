"""Re-scoring of a pack: the pipeline runs again in a temporary copy, and the scores are compared."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages.channels import CAMERA_POINTS, EVALUATION, MODEL, RECORD
from ipsys_log.models.table import MODEL_PARTS, check_name, reads_corners
from ipsys_log.tools.publish.kept_channels import kept_channels
from ipsys_log.tools.publish.opened_pack import OpenedPack, copy_pack
from ipsys_log.tools.publish.own_model import OwnModel, load_own_model, score_own_model
from ipsys_log.tools.publish.remote_pack import fetch_pack
from ipsys_log.tools.publish.scores import Score, StatedScores, compute_scores


@dataclass(frozen=True, slots=True)
class ScoreComparison:
    """A stated score and its repetition, which is None if the model could not be evaluated."""

    stated: Score
    computed: Score | None

    @property
    def difference_mm(self) -> float | None:
        """Return the largest difference of mean, median, 95th percentile and RMSE, in mm."""
        if self.computed is None:
            return None
        return max(abs(a - b) for a, b in zip(self.stated.figures, self.computed.figures, strict=True))

    @property
    def as_stated(self) -> bool:
        """Return whether the repetition has the same points, and its errors are within the tolerance."""
        difference_mm, computed = self.difference_mm, self.computed
        if difference_mm is None or computed is None or self.stated.tolerance_mm is None:
            return False
        return computed.points == self.stated.points and difference_mm <= self.stated.tolerance_mm


@dataclass(frozen=True, slots=True)
class ScoreResult:
    """The result of a re-scoring.

    Attributes
    ----------
    title : of the dataset.
    stated : the expected scores of the pack.
    comparisons : each expected score of the repeated models, with its repetition.
    own : the scores of models of the user.
    other_versions : names of models that have another version here than in the pack.
    """

    title: str
    stated: tuple[Score, ...]
    comparisons: tuple[ScoreComparison, ...]
    own: tuple[Score, ...]
    other_versions: tuple[str, ...] = ()

    @property
    def as_stated(self) -> bool | None:
        """Return whether all repeated scores come out as stated; None if none was repeated."""
        return all(comparison.as_stated for comparison in self.comparisons) if self.comparisons else None


def score(
    source: str | Path,
    models: Sequence[str | OwnModel] = (),
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> ScoreResult:
    """Check a pack, run the pipeline again in a temporary copy, and compare the scores.

    Parameters
    ----------
    source : the folder or the zip archive of a pack, or the address of such an archive; it stays unchanged.
    models : names of models to repeat, and models of the user, also as ``FILE.py:NAME``; none: all models of
        the pack. With models of the user only, no model of the pack is compared.

    Raises
    ------
    IpsysError
        The pack is damaged or refused, does not state a score of a model, or a model has a fault.
    """
    names, own = _names_and_own(models)
    with tempfile.TemporaryDirectory(prefix="ipsys_score_") as temporary:
        folder, results = Path(temporary) / "pack", Path(temporary) / "results.mcap"
        folder.mkdir()
        opened = copy_pack(fetch_pack(str(source), Path(temporary)), folder)
        with _named_as(folder, source):
            _check_recorded(opened)
            repeated = _repeated_models(opened.stated, names, own, source)
            computed = compute_scores(opened.logs, results, repeated, progress, say)
            own_scores = [found for model in own for found in _score_own(model, opened.logs, results)]
    if own and not names:
        repeated = ()
    by_key = {found.key: found for found in computed}
    stated = opened.stated.scores
    return ScoreResult(
        opened.manifest.title,
        stated,
        tuple(ScoreComparison(one, by_key.get(one.key)) for one in stated if one.model in repeated),
        tuple(own_scores),
        tuple(_other_versions(opened.stated, repeated)),
    )


def _names_and_own(models: Sequence[str | OwnModel]) -> tuple[list[str], list[OwnModel]]:
    """Return the names of models of the table, and the models of the user, which are loaded."""
    names: list[str] = []
    own: list[OwnModel] = []
    for model in models:
        if isinstance(model, OwnModel):
            own.append(model)
        elif ":" in model:
            own.append(load_own_model(model))
        else:
            check_name(model)
            names.append(model)
    return names, own


@contextmanager
def _named_as(folder: Path, source: object) -> Iterator[None]:
    """Name the pack in errors of its logs: the temporary copy does not exist any more."""
    try:
        yield
    except IpsysError as error:
        raise IpsysError(str(error).replace(f"{folder}{os.sep}", f"{source}: ")) from error


def _check_recorded(opened: OpenedPack) -> None:
    """Check that the logs have no results that the pipeline would take over instead of computing them."""
    with Session(opened.logs) as session:
        kept = kept_channels(session, without_images=False)
        for topic in sorted({topic for reader in session.readers for topic in reader.channels} - kept):
            run = run_of_topic(topic)
            if run is not None and topic != RECORD.topic_of(run) and session.count(topic):
                raise IpsysError(
                    f"{session}: has the result {topic}, which would not be computed again; pack the logs "
                    "again with ipsys pack"
                )


def _repeated_models(
    stated: StatedScores, names: Sequence[str], own: Sequence[OwnModel], source: object
) -> tuple[str, ...]:
    for name in names:
        if name not in stated.models:
            raise IpsysError(f"{source}: states no score of {name}; it has {', '.join(stated.models)}")
    if names or not own:
        return tuple(dict.fromkeys(names)) or stated.models
    # Each model names the same gross outliers and the same points; the first is fast.
    known = [name for name in stated.models if not reads_corners(name)]
    if not known:
        raise IpsysError(f"{source}: states no score of a model of camera points; --model FILE needs one")
    return (known[0],)


def _score_own(model: OwnModel, logs: Sequence[Path], results: Path) -> list[Score]:
    with Session([*logs, *([results] if results.exists() else [])]) as session:
        for run in sorted(session.run_names()):
            evaluations = session.payloads(session.topics(EVALUATION, run))
            models = session.payloads(session.topics(MODEL, run))
            if evaluations and models and not reads_corners(models[-1].name):
                camera_points = newest_run(session, CAMERA_POINTS) or ""
                return score_own_model(model, session, camera_points, models[-1], evaluations[-1])
    raise IpsysError(f"--model {model.name}: no model of camera points was evaluated; add --model poly")


def _other_versions(stated: StatedScores, models: Iterable[str]) -> list[str]:
    parts = dict.fromkeys(part for model in models for part in model.split("+"))
    return [part for part in parts if stated.versions.get(part) not in (None, MODEL_PARTS[part].version)]
