"""Re-scoring of a pack in a temporary copy, and of a model of the user, from a file that the user names."""

import importlib.util
import os
import tempfile
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress, Request
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Array, CameraEvaluation, Evaluation, Model, Pair
from ipsys_log.messages.channels import CAMERA_POINTS, EVALUATION, MODEL, RECORD, TRUTH
from ipsys_log.models.rays import CalibrationPoints
from ipsys_log.models.table import MODEL_PARTS, check_name, reads_corners
from ipsys_log.statistics.accuracy import CROSS_VALIDATION, HELD_OUT, error_rows
from ipsys_log.statistics.calibration_points import find_pairs, held_out_ids, measured
from ipsys_log.statistics.cross_validation import cross_validate, gather_points, leave_out
from ipsys_log.statistics.ground_truth import gather_tracks, true_points
from ipsys_log.tools.publish.kept_contents import kept_channels
from ipsys_log.tools.publish.opened_pack import OpenedPack, copy_pack, fetch_pack
from ipsys_log.tools.publish.scores import Score, StatedScores, compute_scores, score_rows


@dataclass(frozen=True, slots=True)
class OwnModel:
    """A model of the user.

    Attributes
    ----------
    name : its name in the scores.
    create : returns an unfitted estimator with ``fit(points_m, world_m)`` and ``predict(points_m)``: camera
        points (n, 3) to world points (n, 3), in m. An estimator with a true attribute ``reads_height`` gets
        the height of each marker as the fourth column of ``points_m``.
    """

    name: str
    create: Callable[[], Any]


def load_own_model(text: str) -> OwnModel:
    """Load a class or a function from ``FILE.py:NAME``. The file is executed."""
    file, _, name = text.rpartition(":")
    path = Path(file)
    if not file or not name.isidentifier():
        raise IpsysError(
            f"--model {text}: write the file and the class of a model, such as mine.py:Estimator"
        )
    if not path.exists():
        raise IpsysError(f"--model {text}: {path} does not exist; give the file of your model")
    if path.suffix != ".py" or not path.is_file():
        raise IpsysError(f"--model {text}: {path} is not a Python file; give the file of your model")
    spec = importlib.util.spec_from_file_location(f"ipsys_own_model_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    create = getattr(module, name, None)
    if not callable(create):
        raise IpsysError(f"--model {text}: {path} has no class {name}; give the name of the estimator")
    return OwnModel(f"{path.name}:{name}", create)


def score_own_model(
    model: OwnModel, session: Session, camera_points: str, fitted: Model, evaluation: Evaluation
) -> list[Score]:
    """Return the scores of a model of the user, at the same points and in the same folds as another model.

    Parameters
    ----------
    session : the logs.
    camera_points : the run with the camera points that the other model has read.
    fitted, evaluation : the other model, which names the cameras, and its gross outliers.

    Raises
    ------
    IpsysError
        The model returns other shapes, or numbers that are not finite.
    """
    request, view = Request(), LogView(session, {CAMERA_POINTS: camera_points})
    points = measured(view)
    excluded = {suspect.measurement for suspect in evaluation.excluded}
    held_out = held_out_ids([point.measurement for point in points], request.options()) - excluded
    cameras = {camera.camera for camera in fitted.cameras}
    pairs = {
        camera: [pair for pair in seen if pair.measurement not in excluded]
        for camera, seen in find_pairs(view, points).items()
        if camera in cameras
    }
    truth = true_points(points, gather_tracks(view.messages(TRUTH)))
    rows = _error_rows(model, fitted, pairs, held_out, truth, request.seed)
    stated = {(row.scheme, row.against) for row in evaluation.cameras}
    return [*score_rows(model.name, [row for row in rows if (row.scheme, row.against) in stated])]


def _error_rows(
    model: OwnModel,
    fitted: Model,
    pairs: Mapping[str, Sequence[Pair]],
    held_out: Collection[str],
    truth: Mapping[str, Array],
    seed: int,
) -> list[CameraEvaluation]:
    """Return the rows on held-out points and by cross-validation."""
    cameras = gather_points(pairs)
    unknown = dict.fromkeys(cameras)

    def predict(left_out: Collection[str]) -> dict[str, Array]:
        return {
            camera: _predict(model, leave_out(places, left_out), places) for camera, places in cameras.items()
        }

    tested = {}
    held_out_predictions = predict(held_out) if held_out else {}
    for camera, predicted_m in held_out_predictions.items():
        rows = [row for row, pair in enumerate(pairs[camera]) if pair.measurement in held_out]
        if rows:
            tested[camera] = ([pairs[camera][row] for row in rows], predicted_m[None, rows])
    rows_held_out = error_rows(fitted, tested, unknown, truth, HELD_OUT)
    predictions = cross_validate(model.name, cameras, seed, predict)
    crossed = {camera: (list(pairs[camera]), predictions[camera]) for camera in cameras}
    return [*rows_held_out, *error_rows(fitted, crossed, unknown, truth, CROSS_VALIDATION)]


def _predict(model: OwnModel, training: CalibrationPoints, places: CalibrationPoints) -> Array:
    """Fit a new estimator; return its predictions (n, 3) in m for all calibration points of a camera."""
    estimator = model.create()
    if not callable(getattr(estimator, "fit", None)) or not callable(getattr(estimator, "predict", None)):
        raise IpsysError(f"--model {model.name}: needs the methods fit and predict; add them")
    estimator.fit(_inputs(estimator, training), training.world_m.copy())
    predicted_m = np.asarray(estimator.predict(_inputs(estimator, places)), dtype=np.float64)
    if predicted_m.shape != places.world_m.shape:
        raise IpsysError(
            f"--model {model.name}: predict returns the shape {predicted_m.shape} for {len(places.names)} "
            f"points; return world points {places.world_m.shape} in m"
        )
    if not np.isfinite(predicted_m).all():
        raise IpsysError(f"--model {model.name}: predict returns numbers that are not finite; check the fit")
    return predicted_m


def _inputs(estimator: Any, places: CalibrationPoints) -> Array:
    """Return a copy of the inputs: a model may change its arrays."""
    if getattr(estimator, "reads_height", False):
        return np.column_stack([places.points_m, places.world_m[:, 2]])
    return places.points_m.copy()


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

    def __repr__(self) -> str:
        return (
            f"<ScoreResult of {self.title}: {len(self.comparisons)} of {len(self.stated)} scores computed, "
            f"as_stated={self.as_stated}; {len(self.own)} scores of your models>"
        )

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
