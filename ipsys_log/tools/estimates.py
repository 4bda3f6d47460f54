"""Estimates of robots: their files, their robots, and their alignment with the tracks of a log."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ipsys_log.engine.provenance import newest_run
from ipsys_log.engine.request import Progress
from ipsys_log.errors import IpsysError
from ipsys_log.exchange.trajectory_columns import GivenUnits
from ipsys_log.exchange.trajectory_files import TrajectoryFile, Wanted, read_trajectories, selected_bodies
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message
from ipsys_log.messages.channels import SMOOTHED_TRACKS, TRACKS
from ipsys_log.models.tracking.track_messages import TrackRows, gather_rows
from ipsys_log.plain_text import join_names, shell_words
from ipsys_log.statistics.ground_truth import TrackedPath, gather_paths
from ipsys_log.statistics.path_alignment import PathAlignment, align_trajectories
from ipsys_log.statistics.path_problem import Problem
from ipsys_log.statistics.trajectories import KnownParts, Trajectory, TrajectoryPair

# A robot is guessed if its residuals are smaller than this part of those of any other robot.
_MOST_RATIO = 0.5
# A correlation of 0.7, as Fisher's z. Paths of other drives reach half of it at some time offset.
_SURE_AGREEMENT = float(np.arctanh(0.7))


@dataclass(frozen=True, slots=True)
class CompareOptions:
    """The options of a comparison.

    Attributes
    ----------
    robots : ``NAME=BODY`` for a body or a topic of a file; ``NAME`` for the next one without a known robot.
    run : the run with the tracks; None: the newest complete one.
    topic : of the estimates in bags.
    units : of columns whose header has none.
    """

    robots: tuple[str, ...] = ()
    run: str | None = None
    known: KnownParts = field(default_factory=KnownParts)
    topic: str | None = None
    units: GivenUnits | None = None


class Body(NamedTuple):
    """A body of a file with the name of its robot, if it is known."""

    file: Path
    trajectory: Trajectory
    robot: str | None

    @property
    def where(self) -> str:
        name = self.trajectory.name
        return f"{self.file}: {name}" if name not in ("", self.robot) else str(self.file)


class TrackedRobots:
    """The tracks of a run by robot: smoothed tracks if there are any; predicted poses are left out."""

    def __init__(self, session: Session, run: str | None) -> None:
        name = run or newest_run(session, TRACKS)
        found = [session.topics(channel, name) for channel in (SMOOTHED_TRACKS, TRACKS)] if name else []
        self.topics = next((topics for topics in found if topics), [])
        if name is None or not self.topics:
            known = sorted(one for one in session.run_names() if session.topics(TRACKS, one))
            lacks = f"run {run} has no tracks (they are in: {', '.join(known) or 'none'})"
            raise IpsysError(
                f"{session}: {lacks if run else 'has no tracks'}; compute them: "
                f"ipsys replay {shell_words(session.paths[-1])}"
            )
        self.run = name
        self._messages = [_seen(message) for message in session.messages(self.topics)]
        self.paths: dict[str, TrackedPath] = {}
        self.markers: dict[str, int] = {}
        paths = gather_paths(self._messages)
        # A robot with several markers has the track with the most poses.
        for marker_id, path in sorted(paths.items(), key=lambda item: len(item[1].positions.times_ns)):
            self.paths[path.robot], self.markers[path.robot] = path, marker_id

    def rows(self, robot: str) -> TrackRows:
        """Return the rows of a robot, with velocities and covariances."""
        if robot not in self.paths:
            raise IpsysError(
                f"run {self.run} has no track of {robot}; it has {join_names(sorted(self.paths))}"
            )
        return gather_rows(self._messages, robot)[0]


def _seen(message: Message) -> Message:
    tracks = tuple(track for track in message.payload.tracks if track.coasting_ns is None)
    return replace(message, payload=replace(message.payload, tracks=tracks))


def read_estimates(
    files: Sequence[Path],
    tracked: TrackedRobots,
    options: CompareOptions,
    say: Callable[[str], None],
    progress: Progress,
) -> list[Body]:
    """Return the bodies to compare: the selected ones of a file, else those named as robots, else all."""
    selected = (options.topic,) if options.topic else selected_bodies(options.robots)
    wanted = Wanted(selected, options.units)
    for file in files:
        if not file.exists():
            raise IpsysError(f"{file}: does not exist; name a file with the estimate of a robot")
    read = [read_trajectories(file, wanted, progress) for file in files]
    for line in (line for file in read for line in (*file.understood, *file.remarks) if line):
        say(line)
    return _bodies(read, tracked, options)


def _bodies(read: Sequence[TrajectoryFile], tracked: TrackedRobots, options: CompareOptions) -> list[Body]:
    """Return the bodies to compare: the selected ones of a file, else those named as robots, else all."""
    bodies = {body.name for file in read for body in file.trajectories}
    chosen = {text.partition("=")[2]: text.partition("=")[0] for text in options.robots if "=" in text}
    chosen |= {name: name for name in options.robots if name in bodies}
    names = [name for name in options.robots if "=" not in name and name not in bodies]
    for robot in (*chosen.values(), *names):
        if robot not in tracked.paths:
            known = join_names(sorted(tracked.paths))
            raise IpsysError(f"--robot {robot}: has no track in run {tracked.run}; it has {known}")
    if unknown := [body for body in chosen if body not in bodies]:
        raise IpsysError(
            f"--robot {chosen[unknown[0]]}={unknown[0]}: no file has this body; they have "
            f"{join_names(sorted(filter(None, bodies))) or 'none with a name'}"
        )
    found = []
    for file in read:
        own = [body for body in file.trajectories if body.name in chosen]
        own = own or [body for body in file.trajectories if body.name in tracked.paths]
        for body in own or file.trajectories:
            of_body = chosen.get(body.name)
            if of_body is None and body.name in tracked.paths:
                of_body = body.name
            elif of_body is None and names:
                of_body = names.pop(0)
            found.append(Body(file.path, body, of_body))
    if names:
        raise IpsysError(f"--robot {names[0]}: no estimate is left for it; give one name for each estimate")
    return found


def align_body(body: Body, tracked: TrackedRobots, known: KnownParts) -> tuple[str, PathAlignment]:
    """Return the robot of a body and its alignment; the robot is guessed if only one fits well."""

    def align(name: str) -> PathAlignment:
        return align_trajectories([pairs[name]], known, body.where)

    pairs = {name: TrajectoryPair(body.trajectory, path) for name, path in sorted(tracked.paths.items())}
    names = [body.robot] if body.robot else _likely_robots(pairs, known)
    if len(names) == 1:
        return names[0], align(names[0])
    fitting, reason = dict[str, PathAlignment](), ""
    for name in names:
        try:
            fitting[name] = align(name)
        except IpsysError as error:
            reason = str(error).removeprefix(f"{body.where}: ")
    ranked = sorted(fitting, key=lambda name: fitting[name].residuals.rmse_2d_m)
    errors_m = [fitting[name].residuals.rmse_2d_m for name in ranked[:2]]
    if not ranked:
        raise IpsysError(f"{body.where}: fits the track of no robot in run {tracked.run}: {reason}")
    if len(ranked) > 1 and errors_m[0] > _MOST_RATIO * errors_m[1]:
        raise IpsysError(
            f"{body.where}: fits the tracks of {join_names(ranked[:2])} in run {tracked.run}; name its robot "
            "with --robot NAME"
        )
    return ranked[0], fitting[ranked[0]]


def _likely_robots(pairs: dict[str, TrajectoryPair], known: KnownParts) -> list[str]:
    """Return the robots whose motion agrees with that of a body: a fit of each robot takes seconds."""
    if len(pairs) == 1 or known.offset_ns is not None:
        return [*pairs]
    scores = dict.fromkeys(pairs, 0.0)
    for name, pair in pairs.items():
        with suppress(IpsysError):  # such as too few poses: its fit says so
            scores[name] = float(np.arctanh(Problem([pair], known, "").agreement()))
    best = max(scores.values())
    return [name for name, score in scores.items() if best < _SURE_AGREEMENT or score >= best / 2]
