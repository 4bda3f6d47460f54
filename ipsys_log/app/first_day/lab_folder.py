"""The folder of a lab: the names of its files, and the facts in its logs that tell the finished steps."""

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import chain, count
from pathlib import Path

import numpy as np

from ipsys_log.app.first_day.alignment import AlignmentResult, read_result
from ipsys_log.app.report.accuracy import Accuracy, gather_outliers
from ipsys_log.app.report.summary import answer_json, answer_text
from ipsys_log.engine.graph import writes
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.states import recorded_stages
from ipsys_log.engine.view import LogView
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.lab_files import tape_sheet_path
from ipsys_log.live_runs.survey.from_log import exclude
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import find_new_ids
from ipsys_log.messages import LATENCY_TOPIC, Measurement
from ipsys_log.messages.channels import CAMERA_POINTS, EVALUATION, MEASUREMENTS, MODEL, RIG, TRACKS
from ipsys_log.statistics.calibration_points import (
    active_measurements,
    find_pairs,
    locate_measurements,
    measured,
)
from ipsys_log.units import CM_PER_M, NS_PER_S

# The names of logs of an alignment, and of a drive, begin with these.
ALIGNMENT_LOG = "alignment"
DRIVE_LOG = "drive"
_SUFFIX = ".mcap"
_MOST_LOGS = 200
_Stamp = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, slots=True)
class LogFacts:
    """The facts of a log.

    Attributes
    ----------
    points : number of calibration points that are not withdrawn.
    places_m : (x, y) of these points.
    seen : the number of these points that each camera saw; empty before the detection.
    drive_s : duration of a drive; 0 for other logs.
    tracked : number of messages with tracks of a live recording.
    alignment : the result of an alignment; None for other logs.
    fault : the reason if the log cannot be read.
    """

    path: Path
    start_ns: int = 0
    points: int = 0
    places_m: tuple[tuple[float, float], ...] = ()
    seen: Mapping[str, int] = field(default_factory=dict)
    drive_s: float = 0.0
    tracked: int = 0
    alignment: AlignmentResult | None = None
    fault: str = ""


@dataclass(frozen=True, slots=True)
class FitFacts:
    """The newest fit to the calibration logs, of ``model``, in ``log``.

    ``answer`` are the sentences of ``ipsys replay``, ``mean_m`` the mean distance to the tape points.
    ``outliers`` are the points that contradict the fit. Without an evaluation, they are empty. ``stale`` is
    the reason if the fit or its evaluation is out of date; "" if it is current.
    """

    run: str
    model: str
    log: Path
    stale: str
    answer: tuple[str, ...]
    mean_m: float | None
    outliers: "tuple[OutlierPoint, ...]"


class LabFolder:
    """A folder with ``lab.toml``, intrinsics and logs. Any thread may read it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.rig_file = path / "lab.toml"
        self._facts: dict[_Stamp, LogFacts] = {}
        self._fits: dict[_Stamp, FitFacts | None] = {}
        self._lock = threading.Lock()
        self._writing: Path | None = None

    @property
    def sheet(self) -> Path | None:
        """The sheet of tape measurements of the simulated lab; None if there is none."""
        sheet = tape_sheet_path(self.rig_file)
        return sheet if sheet.exists() else None

    def new_log(self, name: str) -> Path:
        """Return the path of a new log, such as ``live.mcap``, ``live_2.mcap`` and so on.

        Until :meth:`finish_log`, the log does not count: it is being written.
        """
        self._writing = _unused(self.path / f"{name}{_SUFFIX}")
        return self._writing

    def new_board_folder(self, camera: str) -> Path:
        """Make and return a folder for pictures of a board: ``boards/red``, ``boards/red_2`` and so on."""
        path = _unused(self.path / "boards" / camera)
        path.mkdir(parents=True)
        return path

    def finish_log(self) -> None:
        """Note that no log is being written."""
        self._writing = None

    def logs(self) -> list[LogFacts]:
        """Return the facts of all finished logs, in the order of their time."""
        paths = sorted(self.path.glob(f"*{_SUFFIX}"))[:_MOST_LOGS]
        with self._lock:
            facts = [self._read(path) for path in paths if path != self._writing]
        return sorted((one for one in facts if one is not None), key=lambda one: (one.start_ns, one.path))

    def calibration_logs(self) -> list[Path]:
        """Return the logs with calibration points or drives, in the order of their time."""
        return [log.path for log in self.logs() if log.points or log.drive_s]

    def has_drive(self) -> bool:
        """Return whether a log has a drive."""
        return any(log.drive_s for log in self.logs())

    def fit(self) -> FitFacts | None:
        """Return the newest fit to the calibration logs; None if there is none."""
        paths = self.calibration_logs()
        stamp = _stamp(paths)
        if not paths or stamp is None:
            return None
        with self._lock:
            if stamp not in self._fits:
                self._fits = {stamp: _read_fit(paths)}
            return self._fits[stamp]

    def _read(self, path: Path) -> LogFacts | None:
        """Return the facts of a log, read again only if the file has changed."""
        stamp = _stamp([path])
        if stamp is None:
            return None
        if stamp not in self._facts:
            self._facts = {key: facts for key, facts in self._facts.items() if facts.path != path}
            self._facts[stamp] = _read_facts(path)
        return self._facts[stamp]


def _unused(path: Path) -> Path:
    """Return the path; if it exists, with ``_2``, ``_3`` and so on in its name."""
    others = (path.with_stem(f"{path.stem}_{number}") for number in count(2))
    return next(one for one in chain([path], others) if not one.exists())


def _stamp(paths: Sequence[Path]) -> _Stamp | None:
    """Return names, sizes and times of files; None if one of them has vanished."""
    with suppress(FileNotFoundError):
        stats = [(path.name, path.stat()) for path in paths]
        return tuple((name, stat.st_size, stat.st_mtime_ns) for name, stat in stats)
    return None


def _read_facts(path: Path) -> LogFacts:
    try:
        with Session([path]) as session:
            active = active_measurements(session.payloads(session.topics(MEASUREMENTS)))
            places = locate_measurements(active, next(iter(session.payloads(session.topics(RIG))), None))[0]
            # Only a live recording has latencies; the run of a replay does not count.
            run = newest_run(session, TRACKS) if session.count(LATENCY_TOPIC) else None
            tracked = 0 if run is None else session.count(TRACKS.topic_of(run))
            is_drive = path.stem.startswith(DRIVE_LOG) and bool(session.images)
            return LogFacts(
                path,
                session.start_ns,
                len(active),
                tuple((float(place.point_m[0]), float(place.point_m[1])) for place in places),
                _count_seen(session) if active else {},
                (session.end_ns - session.start_ns) / NS_PER_S if is_drive and not tracked else 0.0,
                tracked,
                None if active or tracked else _read_alignment(session, path),
            )
    except (IpsysError, OSError) as error:
        return LogFacts(path, fault=str(error))


def _count_seen(session: Session) -> dict[str, int]:
    """Return the number of calibration points that each camera saw; empty before the detection."""
    run = newest_run(session, CAMERA_POINTS)
    if run is None:
        return {}
    view = LogView(session, {CAMERA_POINTS: run})
    try:
        return {camera: len(pairs) for camera, pairs in find_pairs(view, measured(view)).items()}
    except IpsysError:  # the fit names the fault
        return {}


def _read_alignment(session: Session, path: Path) -> AlignmentResult | None:
    run = newest_run(session, CAMERA_POINTS) if path.stem.startswith(ALIGNMENT_LOG) else None
    return None if run is None else read_result(session, run)


def _read_fit(paths: Sequence[Path]) -> FitFacts | None:
    try:
        with Session(paths) as session:
            stages = recorded_stages(session)
            fits = [one for one in stages if writes(one.run, MODEL)]
            if not fits:
                return None
            newest = fits[-1]
            run, topics = newest.run.run, session.topics(MODEL, newest.run.run)
            evaluations = session.payloads(session.topics(EVALUATION, run))
        accuracies = [Accuracy(run, evaluations[-1], None)] if evaluations else []
        outliers = find_outlier_points(paths, accuracies)
        log = next(path for path in reversed(paths) if _has_topics(path, topics))
    except IpsysError:
        return None
    own = (
        one
        for one in stages
        if one.run.run == run and (writes(one.run, MODEL) or writes(one.run, EVALUATION))
    )
    stale = next((one.state.partition(": ")[2] for one in own if one.out_of_date), "")
    mean_m = answer_json(accuracies).get("answer", {}).get("mean_m") if accuracies else None
    return FitFacts(run, newest.method, log, stale, _sentences(accuracies), mean_m, outliers)


def _has_topics(path: Path, topics: Sequence[str]) -> bool:
    with Session([path]) as session:
        return any(session.count(topic) for topic in topics)


def _sentences(accuracies: Sequence[Accuracy]) -> tuple[str, ...]:
    """Return the lines of the answer, each sentence on one line."""
    answer = answer_text(accuracies) if accuracies else None
    if answer is None:
        return ()
    return tuple(" ".join(str(line).split()) for line in answer.renderables)


_REASON = "it contradicts the fit (setup page)"


@dataclass(frozen=True, slots=True)
class OutlierPoint:
    """A calibration point that contradicts the fit.

    Attributes
    ----------
    log, point : name of its log, and its id in this log.
    error_cm : distance between the measured position and that of the fit without the point.
    text : a possible explanation; "" if no simple mistake explains it.
    """

    log: str
    point: str
    error_cm: float
    text: str


def find_outlier_points(paths: Sequence[Path], accuracies: Sequence[Accuracy]) -> tuple[OutlierPoint, ...]:
    """Return the calibration points that contradict the fit and are not excluded, the worst first."""
    suspects = [suspect for suspect, _ in gather_outliers(accuracies)]
    origins = _origins(paths) if suspects else {}
    return tuple(
        OutlierPoint(
            origins[suspect.measurement][0].name,
            origins[suspect.measurement][1],
            float(np.linalg.norm(suspect.residual_m)) * CM_PER_M,
            suspect.text or "",
        )
        for suspect in suspects
        if suspect.measurement in origins
    )


def exclude_outlier(paths: Sequence[Path], log: str, point: str) -> None:
    """Exclude a calibration point from all stages (``ipsys exclude LOG POINT``); nothing is erased."""
    found = next((path for path in paths if path.name == log), None)
    if found is None:
        raise IpsysError(f"the folder has no log {log!r} with calibration points; reload this page")
    exclude(found, [point], _REASON)


def _origins(paths: Sequence[Path]) -> dict[str, tuple[Path, str]]:
    """Return the log of each valid point and its id in it, by the id in the session of all logs."""
    measured = sorted((found for path in paths if (found := _measured(path))), key=lambda one: one[0])
    new_ids = find_new_ids([list(payloads) for _, _, payloads in measured])
    return {
        ids.get(payload.id, payload.id): (path, payload.id)
        for (_, path, payloads), ids in zip(measured, new_ids, strict=True)
        for payload in active_measurements(payloads)
    }


def _measured(path: Path) -> tuple[int, Path, tuple[Measurement, ...]] | None:
    """Return the time of the first measurement, and all measurements; None without any."""
    with Session([path]) as session:
        messages = list(session.messages(session.topics(MEASUREMENTS)))
    if not messages:
        return None
    return messages[0].log_time_ns, path, tuple(message.payload for message in messages)
