"""The runs and topics of a log that a display, a playback or an export shows."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.engine.provenance import newest_run
from ipsys_log.errors import IpsysError
from ipsys_log.log.contents import camera_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    EVENTS_TOPIC,
    RIG_TOPIC,
    TRUTH_TOPIC,
    CameraCalibration,
    Message,
    Model,
    Rig,
    Run,
)
from ipsys_log.messages.channels import (
    CALIBRATIONS,
    EVENTS,
    LATENCY,
    MARKERS,
    MEASUREMENTS,
    MODEL,
    POSES,
    POSITIONS,
    RUN_EVENTS,
    TRACKS,
    TRUTH,
)
from ipsys_log.plain_text import shell_words
from ipsys_log.units import NS_PER_S

_FADE_STEPS = 3


@dataclass(frozen=True, slots=True)
class Shown:
    """The content to show: the run of the markers, the runs of positions and tracks, and the topics by kind.

    ``cameras`` are the cameras with frames or markers, ``others`` the cameras with positions only.
    """

    markers: str | None
    runs: tuple[str, ...]
    frames: tuple[str, ...]
    moving: tuple[str, ...]
    events: tuple[str, ...]
    cameras: tuple[str, ...]
    others: tuple[str, ...]


def choose_runs(session: Session, names: Sequence[str] = ()) -> Shown:
    """Choose the runs to show: the named runs with the markers that they use, or the newest runs."""
    records = session.runs()
    known = list(dict.fromkeys(record.run for record in records))
    for name in names:
        if name not in known:
            raise IpsysError(f"{session}: has no run {name!r}; it has {', '.join(known) or 'none'}")
    located = [run for run in known if session.topics(TRACKS, run) or session.topics(POSITIONS, run)]
    marked = [run for run in known if session.topics(MARKERS, run)]
    if names:
        sources = _sources(records, names)
        markers = _newest(records, [run for run in marked if run in sources])
        runs = [name for name in dict.fromkeys(names) if name in located]
    else:
        markers, newest = _newest(records, marked), _newest(records, located)
        runs = [newest] if newest else []
    return _topics(session, markers, runs)


def _newest(records: Sequence[Run], among: Sequence[str]) -> str | None:
    return next((record.run for record in reversed(records) if record.run in among), None)


def _sources(records: Sequence[Run], names: Sequence[str]) -> set[str]:
    """Return some runs, and all runs from which they were made."""
    sources: set[str] = set()
    waiting = list(names)
    while waiting:
        name = waiting.pop()
        if name not in sources:
            sources.add(name)
            waiting += [source for record in records if record.run == name for source in record.input_runs]
    return sources


def _topics(session: Session, markers: str | None, runs: Sequence[str]) -> Shown:
    marked = session.topics(MARKERS, markers) if markers else []
    located = [topic for run in runs for topic in session.topics(POSITIONS, run)]
    tracked = [topic for run in runs for topic in session.topics(TRACKS, run)]
    truth = [TRUTH_TOPIC] if TRUTH_TOPIC in session.topics(TRUTH) else []
    events = [
        topic for run in dict.fromkeys([markers, *runs]) if run for topic in session.topics(RUN_EVENTS, run)
    ]
    recorded = [topic for topic in session.topics(EVENTS) if topic == EVENTS_TOPIC]
    cameras = {*session.images, *(str(camera_of_topic(topic)) for topic in marked)}
    others = {str(camera_of_topic(topic)) for topic in located} - cameras
    return Shown(
        markers,
        tuple(runs),
        (*sorted(session.images.values()), *marked),
        (*located, *tracked, *truth),
        (*recorded, *events),
        tuple(sorted(cameras)),
        tuple(sorted(others)),
    )


def fade_ns(session: Session, topics: Sequence[str], factor: int = 1) -> dict[str, int]:
    """Return by topic the silence in ns after which its last message is obsolete, from its usual period."""
    fades_ns = {}
    for topic in topics:
        times = [reader.times(topic) for reader in session.readers if topic in reader.channels]
        steps_ns = np.diff(np.unique(np.concatenate(times)).astype(np.int64))
        usual_ns = int(np.median(steps_ns)) if len(steps_ns) else 0
        fades_ns[topic] = factor * max(NS_PER_S, _FADE_STEPS * usual_ns)
    return fades_ns


def rig_in_force(session: Session, runs: Sequence[str]) -> Rig | None:
    """Return the rig that replaced the log's rig in the shown runs; else the last rig of the log."""
    for record in reversed(session.runs()):
        if record.run in runs and record.rig is not None:
            return record.rig
    rigs = session.payloads([RIG_TOPIC]) if session.count(RIG_TOPIC) else []
    return next((rig for rig in reversed(rigs) if isinstance(rig, Rig)), None)


def model_in_force(session: Session, run: str) -> Model | None:
    """Return the fitted model of a run, or of a run from which it was made; None if the log has none."""
    records = session.runs()
    fitted = [name for name in _sources(records, [run]) if session.topics(MODEL, name)]
    newest = run if run in fitted else _newest(records, fitted)
    models = [] if newest is None else session.payloads(session.topics(MODEL, newest))
    return models[-1] if models else None


class PlayedTopics(NamedTuple):
    """The topics of a playback, the topic of the tracks among them, and their run (None: ground truth)."""

    topics: tuple[str, ...]
    tracks: str
    run: str | None


@dataclass(frozen=True, slots=True)
class PlayedScene:
    """The constant parts of a played log, for a display.

    Attributes
    ----------
    name : the name of the file.
    rig, model : None if the log has none.
    lenses : intrinsics by camera.
    run : the run of the tracks; None: ground truth.
    cameras : the cameras with images.
    """

    name: str
    rig: Rig | None
    lenses: Mapping[str, CameraCalibration]
    model: Model | None
    run: str | None
    cameras: tuple[str, ...]


def choose_topics(session: Session, run: str | None = None, names: Sequence[str] = ()) -> PlayedTopics:
    """Choose the topics of a playback.

    Parameters
    ----------
    run : the run of the tracks; None: the newest complete one.
    names : topics of the log instead, one of them with tracks.
    """
    runs = {topic: name for name in sorted(session.run_names()) for topic in session.topics(TRACKS, name)}
    tracks: dict[str, str | None] = {**runs, **dict.fromkeys(session.topics(TRUTH))}
    if not runs and not (names and tracks):
        raise IpsysError(f"{session}: has no tracks to play; {_command(session)}")
    if not names:
        chosen = run or newest_run(session, TRACKS) or runs[max(runs)]
        if chosen not in runs.values():
            raise IpsysError(f"{session}: run {chosen!r} has no tracks; {', '.join(runs.values())} has")
        topic = TRACKS.topic_of(chosen)
        return PlayedTopics((topic,), topic, chosen)
    known = {topic for reader in session.readers for topic in reader.channels}
    for name in names:
        if name not in known:
            raise IpsysError(
                f"--topics {name}: the log has no such topic; to list them: "
                f"ipsys info {shell_words(*session.paths)}"
            )
    of_tracks = [name for name in dict.fromkeys(names) if name in tracks]
    if len(of_tracks) != 1:
        raise IpsysError(f"--topics: name one topic with tracks: {', '.join(sorted(tracks))}")
    return PlayedTopics(tuple(dict.fromkeys(names)), of_tracks[0], tracks[of_tracks[0]])


def viewed_topics(session: Session, chosen: PlayedTopics, with_images: bool) -> PlayedTopics:
    """Add the topics that only a viewer shows: the poses of the run, and images."""
    poses = [] if chosen.run is None else session.topics(POSES, chosen.run)
    images = session.images.values() if with_images else ()
    return chosen._replace(topics=tuple(dict.fromkeys([*chosen.topics, *poses, *images])))


def read_first(session: Session, rig: Rig | None) -> Iterator[Message]:
    """Yield the rig in force and the camera intrinsics: a viewer needs them at any start of a playback."""
    yield from session.messages(session.topics(CALIBRATIONS))
    if rig is not None:
        yield Message(RIG_TOPIC, session.start_ns, session.start_ns, rig)


def dashboard_topics(session: Session, chosen: PlayedTopics) -> PlayedTopics:
    """Add the topics of the dashboard: images, markers, positions of the run, events, and latencies."""
    complete = {record.run for record in session.runs()}
    shown = choose_runs(session, [chosen.run] if chosen.run in complete else [])
    positions = session.topics(POSITIONS, chosen.run) if chosen.run is not None else []
    added = (*shown.frames, *positions, *shown.events, *session.topics(LATENCY))
    return chosen._replace(topics=tuple(dict.fromkeys([*chosen.topics, *added])))


def read_scene(session: Session, chosen: PlayedTopics, rig: Rig | None) -> PlayedScene:
    """Return the constant parts of a log."""
    lenses = {name: session.payloads([topic])[-1] for name, topic in session.calibrations.items()}
    model = None if chosen.run is None else model_in_force(session, chosen.run)
    return PlayedScene(session.paths[0].name, rig, lenses, model, chosen.run, tuple(sorted(session.images)))


def _command(session: Session) -> str:
    """Return the command that makes the tracks."""
    logs = shell_words(*session.paths)
    model = "" if session.topics(MEASUREMENTS) else " --model-from calibration.mcap"
    return f"to make them: ipsys replay {logs}{model}"
