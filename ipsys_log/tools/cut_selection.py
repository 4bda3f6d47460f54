"""Selection of a part of a log: its time range, topics, cameras, runs, robots and frames."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from enum import Enum
from fnmatch import fnmatchcase

import numpy as np
from numpy.typing import NDArray

from ipsys_log.engine.provenance import newest_run, with_inputs
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic, run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedVideo, Times
from ipsys_log.messages.channels import CAMERA_POINTS, CHANNELS, CUTS, MARKERS, MERGES, POSITIONS, RECORD, RIG
from ipsys_log.plain_text import join_names
from ipsys_log.tools.differences import marker_ids
from ipsys_log.units import NS_PER_S, format_time
from ipsys_log.vision.video import is_keyframe

_MOST_NAMES = 12
# The channels that tell which robots a frame shows; the first one in the log counts.
_SIGHTINGS = (MARKERS, CAMERA_POINTS, POSITIONS)


@dataclass(frozen=True, slots=True, kw_only=True)
class CutOptions:
    """The options of a cut; an empty option excludes nothing.

    Attributes
    ----------
    start, end : UTC as text, or seconds from the first message of the log; the end is not included.
    topics, exclude_topics : patterns of topics, with ``*`` and ``?``.
    cameras, runs : names.
    exclude_runs : names; the records of these runs are left out, too.
    robots : names; only frames that show one of these robots are kept, with their results.
    every : only each n-th of these frames of each camera is kept, with its results.
    """

    start: str = ""
    end: str = ""
    topics: Sequence[str] = ()
    exclude_topics: Sequence[str] = ()
    cameras: Sequence[str] = ()
    runs: Sequence[str] = ()
    exclude_runs: Sequence[str] = ()
    robots: Sequence[str] = ()
    every: int = 1

    def as_text(self) -> dict[str, str]:
        """Return the options that are set, by name."""
        texts = {
            "start": self.start,
            "end": self.end,
            "topics": " ".join(self.topics),
            "exclude_topics": " ".join(self.exclude_topics),
            "cameras": " ".join(self.cameras),
            "runs": " ".join(self.runs),
            "exclude_runs": " ".join(self.exclude_runs),
            "robots": " ".join(self.robots),
            "every": "" if self.every == 1 else str(self.every),
        }
        return {name: text for name, text in texts.items() if text}


class _Keep(Enum):
    """The part of a channel that a cut keeps."""

    NOTHING = "nothing"
    RANGE = "the messages in the range"
    ALL = "all messages"


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The selected part of a log.

    Attributes
    ----------
    start_ns, end_ns : the range of log times; the end is not included.
    rules : the part of each channel, by topic.
    cameras : the camera by topic.
    frames : log times (n,) of the selected frames in ns, in order, by camera; None: all frames.
    """

    start_ns: int
    end_ns: int
    rules: Mapping[str, _Keep]
    cameras: Mapping[str, str]
    frames: Mapping[str, Times] | None = None

    def choose(self, topic: str, times_ns: Times) -> NDArray[np.bool_]:
        """Return which messages of a topic are selected, (n,), by their log times (n,) in ns."""
        if self.rules[topic] is not _Keep.RANGE:
            return np.full(len(times_ns), self.rules[topic] is _Keep.ALL)
        in_range: NDArray[np.bool_] = (times_ns >= self.start_ns) & (times_ns < self.end_ns)
        camera = self.cameras.get(topic)
        if self.frames is None or (camera is None and run_of_topic(topic) is None):
            return in_range
        frames = [self.frames[camera]] if camera is not None else [*self.frames.values()]
        # A result has the log time of its frame.
        of_frame = np.zeros(len(times_ns), np.bool_)
        for frame_times_ns in frames:
            of_frame |= _is_among(times_ns, frame_times_ns)
        return in_range & of_frame

    def is_left_out(self, topic: str) -> bool:
        """Return whether the options exclude a whole channel."""
        return self.rules[topic] is _Keep.NOTHING

    def is_ranged(self, topic: str) -> bool:
        """Return whether the time range applies to a channel."""
        return self.rules[topic] is _Keep.RANGE


def _is_among(times_ns: Times, frame_times_ns: Times) -> NDArray[np.bool_]:
    places = np.searchsorted(frame_times_ns, times_ns)
    padded = np.append(frame_times_ns, -1)
    among: NDArray[np.bool_] = padded[places] == times_ns
    return among


def select(session: Session, options: CutOptions) -> Selection:
    """Return the part of a log that options select.

    Lasting channels, such as the rig, the models and the measurements, are selected whatever the time range
    and ``topics`` are, and so are the records of the selected runs and of the runs that these have read.

    Raises
    ------
    IpsysError
        A camera, run, robot or topic is not in the log, the range is outside of it, or the selected frames of
        a video need other frames.
    """
    cameras = _cameras(session)
    _check_names(session, options, cameras)
    start_ns, end_ns = time_range(session, options)
    topics = sorted({topic for reader in session.readers for topic in reader.channels})
    rule = _TopicRule(options, cameras, _lasting_topics(session), _with_inputs(session, options.runs))
    selection = Selection(start_ns, end_ns, {topic: rule(topic) for topic in topics}, cameras)
    if options.every == 1 and not options.robots:
        return selection
    selection = replace(selection, frames=_select_frames(session, options, selection))
    _check_videos(session, selection)
    return selection


@dataclass(frozen=True, slots=True)
class _TopicRule:
    """The rule of a topic; ``read_too`` are the wanted runs with all runs that they have read."""

    options: CutOptions
    cameras: Mapping[str, str]
    lasting: Collection[str]
    read_too: Collection[str]

    def __call__(self, topic: str) -> _Keep:
        if self._is_excluded(topic):
            return _Keep.NOTHING
        if topic in self.lasting:
            return _Keep.ALL
        wanted = not self.options.topics or _matches(topic, self.options.topics)
        return _Keep.RANGE if wanted else _Keep.NOTHING

    def _is_excluded(self, topic: str) -> bool:
        options, run, camera = self.options, run_of_topic(topic), self.cameras.get(topic)
        if run in options.exclude_runs:
            return True
        if run is not None and options.runs and run not in options.runs:
            is_read = run in self.read_too and topic in self.lasting
            if not is_read:
                return True
        if topic in (RECORD.topic_of(run), CUTS.topic, MERGES.topic):
            return False
        if camera is not None and options.cameras and camera not in options.cameras:
            return True
        return _matches(topic, options.exclude_topics)


def _select_frames(session: Session, options: CutOptions, selection: Selection) -> dict[str, Times]:
    """Return the log times of the selected frames by camera."""
    seen = _frames_with(session, options.robots) if options.robots else None
    frames = {}
    for camera in sorted(set(selection.cameras.values())):
        times_ns = _frame_times(session, camera, selection)
        if seen is not None:
            times_ns = times_ns[_is_among(times_ns, seen.get(camera, np.empty(0, np.int64)))]
        frames[camera] = times_ns[:: options.every]
    return frames


def _frame_times(session: Session, camera: str, selection: Selection) -> Times:
    """Return the log times of the frames of a camera in the range; without images, those of its results."""
    image = session.images.get(camera)
    derived = (t for t, name in selection.cameras.items() if name == camera and run_of_topic(t))
    topics = [image] if image is not None else [*derived]
    times = [r.times(topic) for r in session.readers for topic in topics if topic in r.channels]
    times_ns = np.unique(np.concatenate([np.empty(0, np.int64), *times]))
    return times_ns[(times_ns >= selection.start_ns) & (times_ns < selection.end_ns)]


def _frames_with(session: Session, robots: Collection[str]) -> dict[str, Times]:
    """Return by camera the log times of the frames that show a marker of one of the robots."""
    rigs = session.payloads(session.topics(RIG))
    ids = {marker.id for rig in rigs for marker in rig.markers if marker.robot in robots}
    times: dict[str, list[int]] = {}
    for channel in _SIGHTINGS:
        run = newest_run(session, channel)
        if run is not None:
            for message in session.messages(session.topics(channel, run)):
                if not ids.isdisjoint(marker_ids(message.payload)):
                    times.setdefault(str(message.camera), []).append(message.log_time_ns)
            return {camera: np.array(of_one, np.int64) for camera, of_one in times.items()}
    raise IpsysError(
        f"{session}: has no markers, so the robots in its frames are not known; run: "
        "ipsys replay --until detect"
    )


def _check_videos(session: Session, selection: Selection) -> None:
    """Refuse to select frames of a video that cannot be decoded alone."""
    for camera, topic in session.images.items():
        if not selection.is_ranged(topic):
            continue
        for message in session.messages([topic], selection.start_ns, selection.end_ns):
            if not isinstance(message.payload, CompressedVideo):
                break
            kept = selection.choose(topic, np.array([message.log_time_ns]))[0]
            if kept and not is_keyframe(message.payload):
                raise IpsysError(
                    f"{session}: camera {camera} has video, whose frames need the frames since the last "
                    f"keyframe; cut it without --every and --robots, or add --exclude-topics '{topic}'"
                )


def _lasting_topics(session: Session) -> set[str]:
    runs = [None, *session.run_names()]
    channels = [channel for channel in CHANNELS if channel.lasting]
    return {topic for channel in channels for run in runs for topic in session.topics(channel, run)}


def _cameras(session: Session) -> dict[str, str]:
    """Return the camera by topic; the names of cameras in logs of other programs come from the session."""
    named = {topic: camera_of_topic(topic) for reader in session.readers for topic in reader.channels}
    own = {topic: camera for topic, camera in named.items() if camera is not None}
    by_topic = {
        topic: camera for topics in (session.calibrations, session.images) for camera, topic in topics.items()
    }
    return own | by_topic


def _with_inputs(session: Session, runs: Iterable[str]) -> set[str]:
    """Return runs and all runs that they have read, directly or through others."""
    inputs: dict[str, set[str]] = {}
    for record in session.runs():
        inputs.setdefault(record.run, set()).update(record.input_runs)
    return with_inputs(runs, inputs)


def _matches(topic: str, patterns: Iterable[str]) -> bool:
    return any(fnmatchcase(topic, pattern) for pattern in patterns)


def _check_names(session: Session, options: CutOptions, cameras: Mapping[str, str]) -> None:
    topics = sorted({topic for reader in session.readers for topic in reader.channels})
    _check_known(session, "camera", options.cameras, set(cameras.values()))
    _check_known(session, "run", (*options.runs, *options.exclude_runs), session.run_names())
    if options.robots:
        rigs = session.payloads(session.topics(RIG))
        robots = {marker.robot for rig in rigs for marker in rig.markers if marker.robot is not None}
        _check_known(session, "robot", options.robots, robots)
    for pattern in (*options.topics, *options.exclude_topics):
        if not any(fnmatchcase(topic, pattern) for topic in topics):
            raise IpsysError(f"{session}: no topic fits {pattern!r}; the log has {_listed(topics)}")


def _check_known(session: Session, kind: str, names: Iterable[str], known: Collection[str]) -> None:
    for name in names:
        if name not in known:
            raise IpsysError(f"{session}: has no {kind} {name!r}; it has {_listed(sorted(known))}")


def _listed(names: Sequence[str]) -> str:
    return join_names(names, _MOST_NAMES) or "none"


def time_range(session: Session, options: CutOptions) -> tuple[int, int]:
    """Return the range of log times of a part; the end is not included."""
    first_ns, last_ns = session.start_ns, session.end_ns
    start_ns = _parse_time(options.start, "--start", first_ns) if options.start else first_ns
    end_ns = _parse_time(options.end, "--end", first_ns) if options.end else last_ns + 1
    extent = f"the log is from {format_time(first_ns)} to {format_time(last_ns)} UTC"
    if start_ns >= end_ns and options.start and options.end:
        raise IpsysError(
            f"--end {options.end}: is not after --start {options.start}; give a later end; {extent}"
        )
    if start_ns > last_ns or end_ns <= first_ns:
        raise IpsysError(
            f"{session}: has no message in the range; {extent} ({(last_ns - first_ns) / NS_PER_S:.1f} s)"
        )
    return start_ns, end_ns


def _parse_time(text: str, option: str, first_ns: int) -> int:
    """Return a time in ns: seconds from the first message, or UTC in ISO 8601."""
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        seconds = None
    if seconds is not None and seconds.is_finite() and abs(seconds) < NS_PER_S:
        return first_ns + int(seconds * NS_PER_S)
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        raise IpsysError(
            f"{option} {text}: is no time; give seconds from the start of the log, such as 12.5, or UTC, "
            f"such as '{format_time(first_ns)}'"
        ) from None
    since = (moment if moment.tzinfo else moment.replace(tzinfo=UTC)) - datetime.fromtimestamp(0, UTC)
    return ((since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds) * 1_000
