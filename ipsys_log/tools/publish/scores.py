"""Scores of models on logs: the errors of an evaluation in mm, and the file of the expected scores."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_type_hints

from ipsys_log.engine.graph import writer_of, writes
from ipsys_log.engine.provenance import fingerprint
from ipsys_log.engine.request import Progress, Request
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraEvaluation, ErrorStatistics
from ipsys_log.messages.channels import EVALUATION
from ipsys_log.models.table import MODEL_PARTS, is_known
from ipsys_log.plain_text import plain_text
from ipsys_log.statistics.accuracy import POOLED, count_repeats, root_mean_square_m
from ipsys_log.tools.publish.manifest import SCORES, parse_json

_MM_PER_M = 1000.0
# Six decimals of a mm are more than any two environments agree on.
_DECIMALS = 6
_SCORES_VERSION = 1
_MOST_SCORES = 1000
_LARGEST_MM = 1e6

# Two BLAS kernels differ by 1.3e-6 mm from camera points on; other versions of numerical libraries by more.
_TOLERANCE_MM = 0.01
# Corners of two versions of OpenCV differ by up to 0.15 px. In two labs, scores differ by up to 0.19 mm with
# images of 1920 px, and by up to 1.0 mm with 960 px.
_TOLERANCE_FROM_IMAGES_MM, _USUAL_WIDTH_PX = 1.0, 1920


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """The errors of a model over all cameras, in mm.

    Attributes
    ----------
    model : name in the table of models, or the name of a model of the user.
    scheme : ``held_out`` or ``cross_validation``.
    against : ``tape``, or ``truth`` for the ground truth of a simulated lab.
    dimensions : ``3d``, or ``2d`` for errors on the floor.
    points : number of errors; each pair of a camera and a calibration point counts as one.
    mean_mm, median_mm, p95_mm, rmse_mm : statistics of the distances.
    tolerance_mm : the largest difference of a repetition; None if the score is not stated by a pack.
    """

    model: str
    scheme: str
    against: str
    dimensions: str
    points: int
    mean_mm: float
    median_mm: float
    p95_mm: float
    rmse_mm: float
    tolerance_mm: float | None = None

    @property
    def figures(self) -> tuple[float, float, float, float]:
        """Return mean, median, 95th percentile and RMSE in mm."""
        return self.mean_mm, self.median_mm, self.p95_mm, self.rmse_mm

    @property
    def key(self) -> tuple[str, str, str, str]:
        """Return the identity of a score within a pack."""
        return self.model, self.scheme, self.against, self.dimensions


# The columns of the scores in the manifest.
SCORE_FIELDS = {
    name: "text" if kind is str else "integer" if kind is int else "number"
    for name, kind in get_type_hints(Score).items()
}


@dataclass(frozen=True, slots=True)
class StatedScores:
    """The expected scores of a pack, and the versions of the models that they belong to."""

    scores: tuple[Score, ...]
    versions: Mapping[str, int]

    @property
    def models(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(score.model for score in self.scores))


def compute_scores(
    logs: Sequence[Path],
    results: Path,
    models: Sequence[str] = (),
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Score]:
    """Run the pipeline on logs as ``ipsys evaluate`` does, and return the scores of models.

    Parameters
    ----------
    logs : read as one session; they stay unchanged.
    results : a new log for the results.
    models : names of models; none: all that the logs allow.
    """
    from ipsys_log.live_runs.pipeline import replay

    request = Request(models=tuple(models))
    outcomes = replay(logs, request, writer_of(EVALUATION).name, results, progress, say)
    runs = dict.fromkeys(outcome.run for outcome in outcomes if writes(outcome, EVALUATION))
    with Session([*logs, *([results] if results.exists() else [])]) as session:
        evaluations = [session.payloads(session.topics(EVALUATION, run)) for run in runs]
        rows = [(found[-1].model, found[-1].cameras) for found in evaluations if found]
    return [score for model, cameras in rows for score in score_rows(model, cameras)]


def score_rows(model: str, rows: Sequence[CameraEvaluation]) -> Iterator[Score]:
    """Yield the scores of the rows over all cameras; with one camera, those of its rows."""
    several = any(row.camera == POOLED for row in rows)
    for row in rows:
        repeats = count_repeats(row, rows)
        if (row.camera == POOLED) is not several or repeats is None:
            continue
        for dimensions, errors in (("3d", row.error_3d), ("2d", row.error_2d)):
            if errors is not None:
                yield _score(model, row, dimensions, errors, repeats)


def _score(
    model: str, row: CameraEvaluation, dimensions: str, errors: ErrorStatistics, repeats: int
) -> Score:
    assert errors.median_m is not None
    assert errors.p95_m is not None
    means_m = (errors.mean_m, errors.median_m, errors.p95_m, root_mean_square_m(errors, repeats))
    mean, median, p95, rmse = (round(value_m * _MM_PER_M, _DECIMALS) for value_m in means_m)
    return Score(
        model=model,
        scheme=row.scheme or "held_out",
        against=row.against,
        dimensions=dimensions,
        points=errors.count,
        mean_mm=mean,
        median_mm=median,
        p95_mm=p95,
        rmse_mm=rmse,
    )


def scores_json(scores: Iterable[Score], width_px: int | None) -> dict[str, Any]:
    """Return expected scores with their tolerances, and the environment in which they were computed.

    ``width_px`` is the width of the narrowest images; None if the pack has none.
    """
    tolerance_mm = _TOLERANCE_MM
    if width_px is not None:
        tolerance_mm = round(_TOLERANCE_FROM_IMAGES_MM * _USUAL_WIDTH_PX / width_px, 3)
    rows = [{**asdict(score), "tolerance_mm": tolerance_mm} for score in scores]
    parts = {part for row in rows for part in str(row["model"]).split("+")}
    return {
        "version": _SCORES_VERSION,
        "unit": "mm",
        "environment": fingerprint(),
        "models": {name: MODEL_PARTS[name].version for name in sorted(parts)},
        "scores": rows,
    }


def parse_scores(data: bytes, where: str) -> StatedScores:
    """Return the expected scores of a pack."""
    where = f"{where}: {SCORES}"
    table = parse_json(data, where)
    version, rows, versions = (table.get(key) for key in ("version", "scores", "models"))
    if type(version) is int and version > _SCORES_VERSION:
        raise IpsysError(
            f"{where}: has version {version}, and this ipsys reads {_SCORES_VERSION}; update ipsys"
        )
    if not isinstance(rows, list) or not 0 < len(rows) <= _MOST_SCORES or not isinstance(versions, dict):
        raise IpsysError(f"{where}: has no list of scores; pack the dataset again with ipsys pack")
    scores = tuple(_parse_score(row, f"{where}: score {number}") for number, row in enumerate(rows, 1))
    if len({score.key for score in scores}) < len(scores):
        raise IpsysError(f"{where}: states a score twice; pack the dataset again with ipsys pack")
    known = {name: number for name, number in versions.items() if type(number) is int}
    return StatedScores(scores, known)


def _parse_score(row: object, where: str) -> Score:
    if not isinstance(row, dict) or set(row) != set(SCORE_FIELDS):
        raise IpsysError(
            f"{where}: does not have the fields {', '.join(SCORE_FIELDS)}; pack the dataset again"
        )
    for name, kind in SCORE_FIELDS.items():
        value = row[name]
        is_number = type(value) in (int, float) and 0 <= value < _LARGEST_MM
        valid = {"text": isinstance(value, str), "integer": type(value) is int and is_number}
        if not valid.get(kind, is_number):
            raise IpsysError(
                f"{where}: {name} is {plain_text(str(value), longest=80)}; pack the dataset again"
            )
    if not is_known(row["model"]):
        raise IpsysError(
            f"{where}: model '{plain_text(row['model'], longest=80)}' is not known; update ipsys"
        )
    return Score(**row)
