"""Choice of the topics that a playback sends: the tracks of a run, or topics that the user names."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, Message, Model, Rig
from ipsys_log.messages.channels import (
    CALIBRATIONS,
    LATENCY,
    MEASUREMENTS,
    POSES,
    POSITIONS,
    RIG_TOPIC,
    TRACKS,
    TRUTH,
)
from ipsys_log.plain_text import shell_words
from ipsys_log.runs.provenance import newest_run
from ipsys_log.sinks.selection import choose_runs, model_in_force


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

    Raises
    ------
    IpsysError
        The log has no tracks, no such run or no such topic, or two of the topics have tracks.
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
