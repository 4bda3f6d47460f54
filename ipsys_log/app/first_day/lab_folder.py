"""The folder of a lab: the names of its files, and the facts in its logs that tell the finished steps."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import numpy as np

from ipsys_log.app.first_day.alignment import AlignmentResult, read_result
from ipsys_log.app.report.accuracy import Accuracy, gather_outliers
from ipsys_log.app.report.summary import answer_json, answer_text
from ipsys_log.engine.graph import writes
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.states import recorded_stages
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.lab_files import tape_sheet_path
from ipsys_log.live_runs.survey.from_log import exclude
from ipsys_log.log.dataset import Session
from ipsys_log.log.merged_logs import find_new_ids
from ipsys_log.messages import LATENCY_TOPIC, Measurement
from ipsys_log.messages.channels import CAMERA_POINTS, EVALUATION, MEASUREMENTS, TRACKS
from ipsys_log.statistics.calibration_points import active_measurements
from ipsys_log.units import CM_PER_M

# The names of logs of an alignment begin with this.
ALIGNMENT_LOG = "alignment"
_SUFFIX = ".mcap"
_MOST_LOGS = 200
_Stamp = tuple[tuple[str, int, int], ...]


@dataclass(frozen=True, slots=True)
class LogFacts:
    """The facts of a log.

    Attributes
    ----------
    points : number of calibration points that are not withdrawn.
    tracked : number of messages with tracks of a live recording.
    alignment : the result of an alignment; None for other logs.
    fault : the reason if the log cannot be read.
    """

    path: Path
    start_ns: int = 0
    points: int = 0
    tracked: int = 0
    alignment: AlignmentResult | None = None
    fault: str = ""


@dataclass(frozen=True, slots=True)
class FitFacts:
    """The newest evaluation of the calibration logs.

    ``answer`` are the sentences of ``ipsys replay``, ``mean_m`` the mean distance to the tape points.
    ``outliers`` are the points that contradict the fit. ``stale`` is the reason if the evaluation is out of
    date; "" if it is current.
    """

    run: str
    stale: str
    answer: tuple[str, ...]
    mean_m: float | None
    outliers: tuple[OutlierPoint, ...]


class LabFolder:
    """A folder with ``lab.toml``, intrinsics and logs. Any thread may read it.

    Parameters
    ----------
    path : the folder; it exists.
    """

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
        """Return the logs with calibration points, in the order of their time."""
        return [log.path for log in self.logs() if log.points]

    def fit(self) -> FitFacts | None:
        """Return the newest evaluation of the calibration logs; None if there is none."""
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
            points = len(active_measurements(session.payloads(session.topics(MEASUREMENTS))))
            # Only a live recording has latencies; the run of a replay does not count.
            run = newest_run(session, TRACKS) if session.count(LATENCY_TOPIC) else None
            tracked = 0 if run is None else session.count(TRACKS.topic_of(run))
            alignment = None if points or tracked else _read_alignment(session, path)
            return LogFacts(path, session.start_ns, points, tracked, alignment)
    except (IpsysError, OSError) as error:
        return LogFacts(path, fault=str(error))


def _read_alignment(session: Session, path: Path) -> AlignmentResult | None:
    run = newest_run(session, CAMERA_POINTS) if path.stem.startswith(ALIGNMENT_LOG) else None
    return None if run is None else read_result(session, run)


def _read_fit(paths: Sequence[Path]) -> FitFacts | None:
    try:
        with Session(paths) as session:
            stages = [one for one in recorded_stages(session) if writes(one.run, EVALUATION)]
            if not stages:
                return None
            newest = stages[-1]
            run = newest.run.run
            evaluations = session.payloads(session.topics(EVALUATION, run))
        if not evaluations:
            return None
        accuracies = [Accuracy(run, evaluations[-1], None)]
        outliers = find_outlier_points(paths, accuracies)
    except IpsysError:
        return None
    stale = newest.state.partition(": ")[2] if newest.out_of_date else ""
    mean_m = answer_json(accuracies).get("answer", {}).get("mean_m")
    return FitFacts(run, stale, _sentences(accuracies), mean_m, outliers)


def _sentences(accuracies: Sequence[Accuracy]) -> tuple[str, ...]:
    """Return the lines of the answer, each sentence on one line."""
    answer = answer_text(accuracies)
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
    """Exclude a calibration point from all stages (``ipsys exclude LOG POINT``); nothing is erased.

    Raises
    ------
    IpsysError
        There is no such log or no such point.
    """
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
