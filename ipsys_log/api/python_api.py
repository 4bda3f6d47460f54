"""The Python API of ``import ipsys_log as ipsys``. All other modules are private until 1.0.

Names that are imported as themselves are public, too.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from ipsys_log.api.log_export import Export as Export
from ipsys_log.api.opened_log import Listing as Listing
from ipsys_log.api.opened_log import Log, StrPath
from ipsys_log.api.sampled_track import SampledTrack as SampledTrack
from ipsys_log.calibration.calibrate import CalibrationResult, Failure
from ipsys_log.engine.output import choose_target
from ipsys_log.engine.provenance import Outcome
from ipsys_log.engine.request import Progress, Request
from ipsys_log.errors import IpsysError
from ipsys_log.live_runs.player import LiveTracks as LiveTracks
from ipsys_log.live_runs.player import Player, Tracker
from ipsys_log.log.dataset import Session
from ipsys_log.log.known_contents import one_reading
from ipsys_log.log.location import LogUrl, parse_location
from ipsys_log.log.log_files import find_logs
from ipsys_log.messages import Array, CameraCalibration, ErrorStatistics, Evaluation, Model, Rig
from ipsys_log.messages.channels import EVALUATION
from ipsys_log.models.table import AppliedModel, model_run, reads_corners
from ipsys_log.plain_text import join_names
from ipsys_log.statistics.accuracy import POOLED
from ipsys_log.tools.differences import Comparison
from ipsys_log.tools.publish.scores import Score as Score
from ipsys_log.tools.publish.scoring import ScoreComparison as ScoreComparison
from ipsys_log.tools.publish.scoring import ScoreResult
from ipsys_log.tools.soundness.check import check_logs
from ipsys_log.tools.soundness.finding import LogCheck
from ipsys_log.tools.soundness.finding import LogFinding as LogFinding
from ipsys_log.units import CM_PER_M

if TYPE_CHECKING:
    import pandas as pd

    from ipsys_log.capture.frames import Clock
    from ipsys_log.engine.pieces import PieceWorkers
    from ipsys_log.models.locate_corners import FittedCornerModel
    from ipsys_log.sinks.sink import Sink


def open(*paths: StrPath | LogUrl) -> Log:
    """Open logs, read as one in log order: files, or URLs such as ``s3://bucket/2026-05-*/lab.mcap``.

    Raises
    ------
    IpsysError
        A file is missing, damaged, or no MCAP log.

    Examples
    --------
    >>> with open("sample_logs/small_lab.mcap") as log:  # doctest: +SKIP
    ...     log.cameras
    """
    return Log(*paths)


@dataclass(frozen=True, slots=True)
class ModelEvaluation:
    """The evaluation of a model: its errors on held-out and cross-validated calibration points."""

    model: str
    run: str
    evaluation: Evaluation

    def __repr__(self) -> str:
        means = [
            f"{row['scheme']} {row['dimensions']} against {row['against']}: {row['mean_m'] * CM_PER_M:.2f} cm"
            for row in self.rows()
            if row["camera"] == POOLED
        ]
        return "\n  ".join([f"<ModelEvaluation of {self.model}, run {self.run}; mean errors:", *means]) + ">"

    def to_frame(self) -> pd.DataFrame:
        """Return the errors as a table: a row for each camera ("" for all), scheme and dimension."""
        from ipsys_log.exchange.data_frames import import_pandas

        table: pd.DataFrame = import_pandas().DataFrame(self.rows())
        return table

    def rows(self) -> list[dict[str, Any]]:
        """Return the rows of :meth:`to_frame` as plain data."""
        return [
            {
                "camera": errors_of_camera.camera,
                "scheme": errors_of_camera.scheme or "held_out",
                "against": errors_of_camera.against,
                "dimensions": name,
            }
            | {key: getattr(errors, key) for key in ErrorStatistics.__slots__}
            for errors_of_camera in self.evaluation.cameras
            for name, errors in (("3d", errors_of_camera.error_3d), ("2d", errors_of_camera.error_2d))
            if errors is not None
        ]


@dataclass(frozen=True, slots=True)
class ReplayResult:
    """The result of a replay: an outcome for each stage, and by model its evaluation."""

    outcomes: tuple[Outcome, ...]
    evaluations: Mapping[str, ModelEvaluation]

    def __repr__(self) -> str:
        new = sum(outcome.fresh for outcome in self.outcomes)
        runs = join_names(list(dict.fromkeys(outcome.run for outcome in self.outcomes)))
        evaluated = join_names(list(self.evaluations)) or "none"
        return (
            f"<ReplayResult: {len(self.outcomes)} stages, {new} new; runs {runs}; evaluations: {evaluated}>"
        )


@one_reading()
def replay(
    *paths: StrPath | LogUrl,
    model: str | Iterable[str] = (),
    models: str | Iterable[str] = (),
    until: str | None = None,
    rig: Rig | StrPath | None = None,
    calibrations: Mapping[str, CameraCalibration] | None = None,
    model_from: StrPath | LogUrl | None = None,
    output: StrPath | None = None,
    run: str | None = None,
    corners: str | None = None,
    method: str = "perimeter",
    train: str = "train",
    seed: int = 0,
    as_live: bool = False,
    skip_ambiguous: bool = False,
    parameters: Mapping[str, str] | None = None,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
    jobs: int | None = None,
    workers: PieceWorkers | None = None,
) -> ReplayResult:
    """Compute the results that logs lack, and append them to the last log or write them to ``output``.

    Nothing can be appended to a log at a URL: its results come into ``<name>.derived.mcap`` in the current
    folder, which a later call extends.

    Parameters
    ----------
    model : a name of a model, such as ``best``, or several; none: as ``ipsys replay`` chooses.
    models : the old name of ``model``.
    until : the last stage, such as ``detect`` or ``evaluate``; None: all stages.
    rig, calibrations : they replace those of the log, as a new run; calibrations by camera.
    model_from : another log; its fitted model is applied and copied into the log.
    run : name of the new run.
    corners, method, train, seed, as_live, skip_ambiguous : as the options of ``ipsys replay``.
    parameters : options of further stages, by name.
    progress : called with the stage, the number of messages done, and the total number of messages.
    say : called with the runs that are out of date and computed again.
    jobs : number of processes that detect markers in a long log; None: one for each core.
    workers : they compute the pieces of a long log, instead of ``jobs`` processes of this machine.

    Raises
    ------
    IpsysError
        The input has a fault that the user must correct.
    """
    from ipsys_log.engine.workers import available_cores
    from ipsys_log.live_runs import pipeline
    from ipsys_log.messages.rig_file import load_rig

    request = Request(
        models=_names(model, models),
        rig=rig if rig is None or isinstance(rig, Rig) else load_rig(Path(rig)),
        lenses=dict(calibrations or {}),
        model_from=None if model_from is None else parse_location(model_from),
        train=train,
        seed=seed,
        run=run,
        corners=corners,
        method=method,
        as_live=as_live,
        skip_ambiguous=skip_ambiguous,
        parameters=dict(parameters or {}),
    )
    count = available_cores() if jobs is None else jobs
    logs, target = choose_target(find_logs(paths), None if output is None else Path(output))
    outcomes = pipeline.replay(logs, request, until, target, progress, say, count, workers)
    written = [target] if target is not None and target.exists() else []
    with Session([*logs, *written]) as session:
        return ReplayResult(tuple(outcomes), _evaluations(session, outcomes))


def _names(*given: str | Iterable[str]) -> tuple[str, ...]:
    """Return the names of models, each once; a text is one name."""
    names = [[one] if isinstance(one, str) else one for one in given]
    return tuple(dict.fromkeys(chain.from_iterable(names)))


def _evaluations(session: Session, outcomes: Sequence[Outcome]) -> dict[str, ModelEvaluation]:
    runs = dict.fromkeys(outcome.run for outcome in outcomes)
    evaluations: dict[str, ModelEvaluation] = {}
    for run in runs:
        for evaluation in session.payloads(session.topics(EVALUATION, run)):
            evaluations[evaluation.model] = ModelEvaluation(evaluation.model, run, evaluation)
    return evaluations


def check(
    *paths: StrPath | LogUrl, progress: Progress = lambda stage, done, total: None
) -> tuple[LogCheck, ...]:
    """Read logs completely and check them; no file is changed.

    The check covers the file, schemas, times, rates, references and runs. A run may have its inputs in
    another of the logs.

    Returns
    -------
    A result for each log: its ``state`` is ``sound``, ``readable`` (with remarks), ``unread`` or ``broken``.

    Examples
    --------
    >>> for result in check("monday.mcap"):  # doctest: +SKIP
    ...     print(result.state, *(finding.text for finding in result.remarks), sep="\\n")
    """
    return check_logs(find_logs(paths), progress)


def verify(
    *paths: StrPath | LogUrl,
    run: str | None = None,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> list[Comparison]:
    """Repeat the runs of logs from their recorded input, and compare each channel byte for byte.

    Returns
    -------
    One comparison for each derived channel; its ``equal`` is the result.

    Raises
    ------
    IpsysError
        There is no such run, or nothing of it can be verified.
    """
    from ipsys_log.tools.verify import verify as verify_runs

    return verify_runs(find_logs(paths), run, progress, say)


def score(
    dataset: StrPath,
    *,
    model: str | Iterable[str] = (),
    models: str | Iterable[str] = (),
    own: Mapping[str, Callable[[], object]] | None = None,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> ScoreResult:
    """Check a dataset of ``ipsys pack``, compute its scores again, and compare them with the stated ones.

    The pipeline runs in a temporary copy; the dataset is not changed.

    Parameters
    ----------
    dataset : a folder, a zip archive, or the address of a zip archive.
    model : a name of a model to repeat, or several; ``FILE.py:CLASS`` is a model of your own. None: all.
    models : the old name of ``model``.
    own : classes of your own models by name. Each has ``fit(points_m, world_m)`` and ``predict(points_m)``:
        camera points (n, 3) to world points (n, 3), in m. They are scored in the same folds.

    Returns
    -------
    ScoreResult : its ``as_stated`` is the answer; ``own`` has the scores of your models.

    Raises
    ------
    IpsysError
        The dataset is damaged or refused, or a model has a fault.

    Examples
    --------
    >>> score("dataset").as_stated  # doctest: +SKIP
    True
    """
    from ipsys_log.tools.publish.scoring import OwnModel
    from ipsys_log.tools.publish.scoring import score as score_pack

    of_user = [OwnModel(name, create) for name, create in (own or {}).items()]
    return score_pack(os.fspath(dataset), [*_names(model, models), *of_user], progress, say)


class FittedModel:
    """A fitted model of a log, ready to be applied.

    Attributes
    ----------
    name : the name in the table of models.
    cameras : names of the cameras of the model.
    """

    def __init__(self, model: Model) -> None:
        self.name = model.name
        self.cameras = tuple(camera.camera for camera in model.cameras)
        self._applied = {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}

    def __repr__(self) -> str:
        return f"<FittedModel {self.name} of {', '.join(self.cameras)}>"

    def predict(self, camera: str, points_m: ArrayLike, heights_m: ArrayLike = 0.0) -> Array:
        """Return world points (n, 3) in m.

        Parameters
        ----------
        camera : the camera that saw the markers.
        points_m : camera points (n, 3) in m.
        heights_m : heights of the markers above the floor (n,) in m; only some models read them.

        Raises
        ------
        IpsysError
            The model does not know the camera, or the points have another shape.
        """
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3:
            raise IpsysError(f"points_m has the shape {points.shape}; give camera points (n, 3) in m")
        if camera not in self._applied:
            raise IpsysError(
                f"the model {self.name} has no camera {camera!r} (it has {', '.join(self.cameras)})"
            )
        heights = np.broadcast_to(np.asarray(heights_m, dtype=np.float64), (len(points),))
        return self._applied[camera].predict(points, heights)


def load_model(path: StrPath | LogUrl, name: str | None = None) -> FittedModel | FittedCornerModel:
    """Load the newest fitted model of a log.

    Parameters
    ----------
    name : a model, such as ``best``, or a run with a model, such as ``best_2``; None: the newest of all.

    Returns
    -------
    A model that reads camera points; or, for ``joint``, one that reads the corners of markers.

    Raises
    ------
    IpsysError
        The log has no such model.
    """
    from ipsys_log.engine.request import fitted_in

    with Session([parse_location(path)]) as session:
        model = fitted_in(session, name)[0]
    if not reads_corners(model.name):
        return FittedModel(model)
    from ipsys_log.models.locate_corners import FittedCornerModel  # late: scipy takes 1 s

    return FittedCornerModel(model)


def calibrate(
    *sources: StrPath,
    board: str,
    square_m: float = 0.03,
    lens: str = "fisheye",
    marker_scale: float = 0.75,
    dictionary: str = "DICT_4X4_50",
    inverted: bool = False,
    cameras: Sequence[str] = (),
    force: bool = False,
    progress: Progress = lambda stage, done, total: None,
) -> Iterator[CalibrationResult | Failure]:
    """Calibrate camera intrinsics from images of a chessboard or a ChArUco board.

    Parameters
    ----------
    sources : logs, folders, image files or videos.
    board : inner corners of a chessboard as ``6x4``, or squares of a ChArUco board as ``charuco:4x5``.
    square_m : side of a square in m.
    lens : ``fisheye`` or another lens model of ``ipsys calibrate``.
    cameras : the cameras of a log to use; for other sources, the name of the one camera.
    force : accept the stated board size, and poor results.

    Yields
    ------
    A result for each camera as soon as it is ready; a failure gives the reason if a camera has no result.

    Raises
    ------
    IpsysError
        A source cannot be read, or an option is not valid.
    """
    from ipsys_log.calibration.board import parse_board
    from ipsys_log.calibration.calibrate import calibrate_cameras
    from ipsys_log.calibration.images import find_sources
    from ipsys_log.calibration.lens_models import find_lens_model

    model = find_lens_model(lens)
    wanted = parse_board(board, square_m, marker_scale, dictionary, inverted)
    images = find_sources([Path(source) for source in sources], list(cameras))
    return calibrate_cameras(images, wanted, model, progress, force=force)


def live(
    rig: StrPath,
    *,
    record: StrPath | None = None,
    model_from: StrPath | LogUrl | None = None,
    model: str | Iterable[str] = (),
    models: str | Iterable[str] = (),
    cameras: Sequence[str] = (),
    calibrations: Mapping[str, CameraCalibration] | None = None,
    corners: str | None = None,
    method: str = "perimeter",
    self_calibrate: bool = False,
    force: bool = False,
    say: Callable[[str], None] = lambda text: None,
) -> Tracker:
    """Track robots with the cameras of a rig file; with ``record``, write everything into a log.

    Parameters
    ----------
    rig : the rig file, ``lab.toml``; the streams of its ``[stream]`` are opened.
    record : the new log; None: nothing is recorded.
    model_from : the log with the fitted models, a file or a URL.
    model : a name of a model, or several; none: that of the newest run of the log.
    models : the old name of ``model``.
    cameras : only these cameras of the rig.
    calibrations : they replace the intrinsics that the rig names, by camera.
    corners, method, self_calibrate : as the options of ``ipsys live``.
    force : replace an existing log.
    say : called with remarks.

    Returns
    -------
    Tracker : enter it to open the cameras.

    Raises
    ------
    IpsysError
        On entering: the rig, a camera, an intrinsic calibration or a model has a fault.

    Examples
    --------
    >>> with live("lab.toml", model_from="cal.mcap") as tracker:  # doctest: +SKIP
    ...     for tracks in tracker:
    ...         print(tracks.time_ns, tracks.tracks)
    """
    request = Request(
        models=_names(model, models),
        model_from=None if model_from is None else parse_location(model_from),
        corners=corners,
        method=method,
        parameters={"self_calibrate": "yes"} if self_calibrate else {},
    )

    target = None if record is None else Path(record)

    def track(tracker: Tracker) -> list[Outcome]:
        from ipsys_log.capture.lab import open_lab
        from ipsys_log.capture.live_plan import check_start, shown_run
        from ipsys_log.exchange.lab_files import read_lab
        from ipsys_log.live_runs import pipeline
        from ipsys_log.sinks.streams.opening import check_streams, open_live_streams, settings_of_rig

        lab = read_lab(Path(rig), cameras, calibrations or {})
        for camera, text in lab.assumed.items():
            say(f"camera {camera}: {text}")
        for line in check_start(lab.rig, lab.names, lab.lenses, request, None):
            say(line)
        if target is not None and target.exists() and not force:
            raise IpsysError(f"{record}: exists already; give another name, or force=True to overwrite it")
        streamed = settings_of_rig(lab.rig.stream, lab.folder)
        for line in check_streams(streamed):
            say(line)
        with open_lab(lab, say) as opened, open_live_streams(streamed, opened, shown_run(request)) as streams:
            tracker.begin(opened.cameras.stop, opened.cameras.positions)
            sinks: list[Sink] = [tracker, *streams]
            return pipeline.live(
                opened.cameras, opened.settings, target, request, sinks=sinks, overwrite=force
            )

    return Tracker(track)


def play(
    *paths: StrPath | LogUrl,
    rate: float = 1.0,
    loop: bool = False,
    start_paused: bool = False,
    start_offset_s: float = 0.0,
    run: str | None = None,
    topics: Sequence[str] = (),
    restamp: bool = False,
    udp: Sequence[str] = (),
    key: StrPath | None = None,
    vrpn: int | None = None,
    mavlink: Sequence[str] = (),
    ros2: int | None = None,
    ros2_domain: int = 0,
    foxglove: int | None = None,
    images: bool = False,
    host: str | None = None,
    robots: Sequence[str] = (),
    clock: Clock | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> Player:
    """Play logs as if they were live, to a loop and to streams. The logs are not changed.

    Parameters
    ----------
    rate : seconds of the log in a second.
    loop : begin again at the end.
    start_paused : wait for ``resume()`` or ``step()``.
    start_offset_s : begin so long after the first message, in s.
    run : the run of the tracks; None: the newest.
    topics : topics of the logs instead, one of them with tracks.
    restamp : replace the capture times with the present.
    udp : destinations of datagrams, such as ``192.168.1.20:9870``.
    key : the file with the key that signs the datagrams.
    vrpn : the port of a VRPN server, usually 3883; None: no server.
    mavlink : autopilots, such as ``ada=192.168.1.30:14550``.
    ros2 : the port of the Zenoh router of ROS 2, usually 7447; None: no messages to ROS 2.
    ros2_domain : the domain ID of ROS 2.
    foxglove : the port of a server for Foxglove, usually 8765; None: no server.
    images : Foxglove gets images, too.
    host : the address of this machine that other computers can reach; None: only this machine.
    robots : only these robots.
    clock : the clock of the playback; None: the system's.
    say : called with the messages that a stream dropped.

    Returns
    -------
    Player : enter it to start.

    Raises
    ------
    IpsysError
        A log has no tracks, or a stream cannot be opened.

    Examples
    --------
    >>> with play("monday.mcap", rate=2) as player:  # doctest: +SKIP
    ...     for tracks in player:
    ...         print(tracks.time_ns, tracks.tracks)
    """
    from ipsys_log.sinks.playback import PlaybackOptions
    from ipsys_log.sinks.streams import StreamSettings

    options = PlaybackOptions(rate, loop, start_paused, start_offset_s, restamp)
    path = None if key is None else Path(key)
    settings = StreamSettings(
        host=host,
        udp=tuple(udp),
        key=path,
        vrpn=vrpn,
        mavlink=tuple(mavlink),
        robots=tuple(robots),
        ros2=ros2,
        ros2_domain=ros2_domain,
        foxglove=foxglove,
        images=images,
    )
    return Player(find_logs(paths), run and model_run(run), topics, options, settings, clock, say)
