"""Measuring in a finished log: stationary intervals, measurements at their time, excluded measurements."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ipsys_log.engine.output import write_messages
from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress, Request
from ipsys_log.engine.states import out_of_date_lines
from ipsys_log.errors import FrameError, IpsysError, LogError
from ipsys_log.live_runs.survey.checks import free_id, withdrawal_of
from ipsys_log.live_runs.survey.entry import check_references
from ipsys_log.live_runs.survey.scene import CameraView, StationaryInterval
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import (
    MEASUREMENTS_TOPIC,
    CompressedImage,
    CompressedVideo,
    Measurement,
    Message,
    Model,
    Rig,
)
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, MEASUREMENTS, MODEL, RIG, Channel
from ipsys_log.plain_text import join_names
from ipsys_log.statistics.calibration_points import TimedPoints, gather_sightings, withdrawals
from ipsys_log.statistics.stationary import stationary_intervals
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.decode import decode_grey
from ipsys_log.vision.video import decode_last

# Largest difference between the log time of a frame and the time of its results; longest time from the time
# of a frame to the exposure of a marker in it.
_LATE_NS = 2 * NS_PER_S
_ROLLING_NS = NS_PER_S // 10
# Number of stationary intervals whose images are kept. The page requests an image after every typed key.
_KEPT = 4


@contextmanager
def open_finished_log(
    path: Path,
    request: Request,
    progress: Progress = lambda stage, done, total: None,
    say: Callable[[str], None] = lambda text: None,
) -> "Iterator[FinishedLog]":
    """Open a log for measuring; missing markers and camera points are computed and appended first.

    Parameters
    ----------
    path : a finished log.
    request : its rig and camera intrinsics are used instead of those of the log.
    progress : called with the progress of the computation.
    say : called with the runs that are out of date.

    Raises
    ------
    IpsysError
        The log cannot be written to, the rig lacks two reference points, or no marker of the rig is
        stationary in the log.
    """
    with LogWriter.append(path) as writer:
        writer.abandon()
    with Session([path]) as session:
        rigs = rigs_of(session, request)
        if rigs:
            check_references(rigs[-1])
        if len({rig.reference_points for rig in rigs}) > 1:
            raise IpsysError(
                f"{path}: its reference points change during the log; give the valid ones with --rig"
            )
    from ipsys_log.live_runs.pipeline import replay  # most users of a finished log compute nothing

    replay([path], request, "camera-frame", progress=progress, say=say)
    with Session([path]) as session:
        for line in out_of_date_lines(session, [newest_run(session, MODEL)]):
            say(line)
        yield FinishedLog(path, session, rigs[-1])


class FinishedLog:
    """A finished log as a :class:`~ipsys_log.live_runs.survey.scene.MeasuringScene`."""

    def __init__(self, path: Path, session: Session, rig: Rig) -> None:
        self.path, self.rig = path, rig
        self._session = session
        self.start_ns = session.start_ns
        self._topics: dict[Channel, list[str]] = {
            channel: _newest(session, channel) for channel in (CAMERA_POINTS, MARKERS)
        }
        cameras = {str(camera_of_topic(topic)) for topic in self._topics[CAMERA_POINTS]}
        self._cameras = sorted({*session.images, *cameras})
        self._seen: dict[int, list[CameraView]] = {}
        models = session.payloads(_newest(session, MODEL))
        self.model: Model | None = models[-1] if models else None
        self._history = list(session.messages(session.topics(MEASUREMENTS)))
        self.intervals = _find_intervals(gather_sightings(session.messages(self._topics[CAMERA_POINTS])), rig)
        if not self.intervals:
            raise IpsysError(
                f"{path}: no marker of the rig is stationary for two frames or longer: there is nothing "
                "to measure; lay markers down while recording"
            )

    def views(self, interval: int | None) -> list[CameraView]:
        """Return the view of each camera in a stationary interval, with the image at its middle."""
        number = interval or 0
        if number not in self._seen:
            while len(self._seen) >= _KEPT:
                del self._seen[next(iter(self._seen))]
            self._seen[number] = [self._view(camera, self.intervals[number]) for camera in self._cameras]
        return self._seen[number]

    def history(self) -> list[Measurement]:
        return [message.payload for message in self._history]

    def add(self, measurements: Sequence[Measurement]) -> None:
        """Append measurements at the end of their stationary intervals.

        A withdrawal comes after its measurement.

        Raises
        ------
        LogError
            The log is locked or cannot be written to, or another process has added measurements to it. These
            are then in the history, and the caller can repeat this call.
        """
        with LogWriter.append(self.path) as writer:
            others = self._of_others()
            if others:
                self._history += others
                names = ", ".join(message.payload.id for message in others)
                raise LogError(
                    f"another program wrote measurements into this log ({names}); check them, and save again"
                )
            added: list[Message] = []
            for measurement in measurements:
                added.append(place_in_log(measurement, [*self._history, *added]))
            write_messages(writer, added)
        self._history += added

    def _of_others(self) -> list[Message]:
        """Return the measurements that other processes have added since the last read of the log."""
        known_ids = {(message.payload.id, message.payload.refers_to) for message in self._history}
        with Session([self.path]) as session:
            messages = session.messages(session.topics(MEASUREMENTS))
            return [
                message
                for message in messages
                if (message.payload.id, message.payload.refers_to) not in known_ids
            ]

    def _view(self, camera: str, interval: StationaryInterval) -> CameraView:
        middle_ns = interval.start_ns + (interval.end_ns - interval.start_ns) // 2
        seen = [m for m in self._within(CAMERA_POINTS, camera, interval) if _sees(m, interval)]
        marker_messages = self._within(MARKERS, camera, interval)
        nearest = min(marker_messages, key=lambda m: abs(m.publish_time_ns - middle_ns), default=None)
        jpeg = self._picture(camera, nearest.log_time_ns if nearest else middle_ns)
        return CameraView(
            camera,
            nearest.publish_time_ns if nearest else middle_ns,
            jpeg,
            nearest.payload if nearest else None,
            tuple(message.payload for message in seen),
        )

    def _within(self, channel: Channel, camera: str, interval: StationaryInterval) -> list[Message]:
        """Return the messages of a camera whose frames lie in a stationary interval."""
        topics = [topic for topic in self._topics[channel] if camera_of_topic(topic) == camera]
        messages = self._session.messages(topics, interval.start_ns - _LATE_NS, interval.end_ns + _LATE_NS)
        return [
            m for m in messages if interval.start_ns - _ROLLING_NS <= m.publish_time_ns <= interval.end_ns
        ]

    def _picture(self, camera: str, log_time_ns: int) -> bytes | None:
        """Return the frame nearest to a log time, as a JPEG."""
        topic = self._session.images.get(camera)
        if topic is None:
            return None
        times_ns = np.concatenate([r.times(topic) for r in self._session.readers if topic in r.channels])
        nearest_ns = int(times_ns[np.abs(times_ns - log_time_ns).argmin()])
        frame = self._frame(topic, nearest_ns)
        if isinstance(frame, CompressedImage) and frame.data[:2] == b"\xff\xd8":
            return frame.data
        try:
            if isinstance(frame, CompressedVideo):
                before = times_ns[times_ns <= nearest_ns][::-1].tolist()
                frame = decode_last(self._frame(topic, time_ns) for time_ns in before)
            return None if frame is None else cv2.imencode(".jpg", decode_grey(frame))[1].tobytes()
        except FrameError:
            return None

    def _frame(self, topic: str, log_time_ns: int) -> Any:
        return next(self._session.messages([topic], log_time_ns, log_time_ns + 1)).payload


def rigs_of(session: Session, request: Request) -> list[Rig]:
    """Return the rigs of a log, or the rig of the request instead; measurements use the last rig."""
    return [request.rig] if request.rig is not None else session.payloads(session.topics(RIG))


def _newest(session: Session, channel: Channel) -> list[str]:
    run = newest_run(session, channel)
    return session.topics(channel, run) if run else []


def _find_intervals(sightings: Mapping[tuple[str, int], TimedPoints], rig: Rig) -> list[StationaryInterval]:
    """Return the stationary intervals of the rig's markers, in order of time."""
    intervals = []
    for marker_id in sorted({marker_id for _, marker_id in sightings}):
        if rig.knows(marker_id):
            seen = {
                camera: observations
                for (camera, seen_id), observations in sightings.items()
                if seen_id == marker_id
            }
            intervals += [StationaryInterval(marker_id, *interval) for interval in stationary_intervals(seen)]
    return sorted(intervals, key=lambda stop: (stop.start_ns, stop.marker_id))


def _sees(message: Message, interval: StationaryInterval) -> bool:
    """Return whether camera points hold the marker of a stationary interval at a time within it."""
    return any(
        point.id == interval.marker_id
        and interval.start_ns <= message.publish_time_ns + (point.time_offset_ns or 0) <= interval.end_ns
        for point in message.payload.points
    )


_MOST_NAMES = 40


@dataclass(frozen=True, slots=True)
class ExclusionResult:
    """The result of an exclusion or a re-admission.

    Attributes
    ----------
    changed : ids of the measurements that the log now excludes, or re-admits.
    unchanged : ids of the measurements that were excluded, or valid, before; by id, the reason of their
        present exclusion, or "".
    active : number of the valid measurements of the log now.
    """

    changed: tuple[str, ...]
    unchanged: Mapping[str, str]
    active: int


def exclude(path: Path, names: Sequence[str], reason: str) -> ExclusionResult:
    """Withdraw measurements of a finished log: no stage uses them any more, and the log keeps them.

    Parameters
    ----------
    names : ids of measurements, or names of calibration points. The latter name all their measurements.
    reason : is written into the log.

    Raises
    ------
    IpsysError
        A name is not in the log, or there is no reason. The log is unchanged.
    LogError
        The log is locked or cannot be written to.
    """
    return _append(path, names, reason, readmits=False)


def readmit(path: Path, names: Sequence[str], reason: str) -> ExclusionResult:
    """Re-admit withdrawn measurements of a finished log; parameters and errors are those of `exclude`."""
    return _append(path, names, reason, readmits=True)


def place_in_log(measurement: Measurement, earlier: Sequence[Message]) -> Message:
    """Return the message of a measurement, at the end of its stationary interval.

    A message follows all earlier messages about the same measurement.
    """
    end_ns = measurement.timestamp if measurement.still is None else measurement.still.end
    names = {measurement.id, measurement.refers_to} - {None}
    same = [m.log_time_ns + 1 for m in earlier if {m.payload.id, m.payload.refers_to} & names]
    return Message(MEASUREMENTS_TOPIC, max([end_ns, *same]), measurement.timestamp, measurement)


def _append(path: Path, names: Sequence[str], reason: str, readmits: bool) -> ExclusionResult:
    with LogWriter.append(path) as writer:  # no other process adds measurements from here on
        with Session([path]) as session:
            messages = list(session.messages(session.topics(MEASUREMENTS)))
        history: list[Measurement] = [message.payload for message in messages]
        points = {measurement.id: measurement for measurement in history if measurement.is_point}
        excluded = withdrawals(history)
        chosen = _chosen_ids(path, points, names)
        if not reason.strip():
            raise IpsysError('--reason: is missing; say why, such as --reason "the tape sagged"')
        changed = [name for name in chosen if (name in excluded) == readmits]
        for name in changed:
            payload = (
                _readmission_of(history, points[name], reason.strip())
                if readmits
                else withdrawal_of(history, name, reason.strip())
            )
            messages.append(place_in_log(payload, messages))
            history.append(payload)
        write_messages(writer, messages[len(messages) - len(changed) :])
    unchanged = {
        name: (excluded[name].reason or "") if name in excluded else ""
        for name in chosen
        if name not in changed
    }
    return ExclusionResult(tuple(changed), unchanged, len(points.keys() - withdrawals(history).keys()))


def _readmission_of(history: Sequence[Measurement], point: Measurement, reason: str) -> Measurement:
    message_id = free_id(history, f"{point.id}_readmitted")
    return Measurement(point.timestamp, message_id, readmits=point.id, reason=reason)


def _chosen_ids(path: Path, points: dict[str, Measurement], names: Sequence[str]) -> list[str]:
    """Return the ids of the named measurements, each once, in the order of the names."""
    chosen: dict[str, None] = {}
    for name in names:
        ids = [key for key, point in points.items() if name in (key, point.calibration_point)]
        if not ids:
            raise IpsysError(f"{path}: has no calibration point {name!r}; it has {_listed(points)}")
        chosen |= dict.fromkeys(ids)
    return list(chosen)


def _listed(points: dict[str, Measurement]) -> str:
    names = list(dict.fromkeys(point.calibration_point or key for key, point in points.items()))
    return join_names(names, _MOST_NAMES) or "none"
