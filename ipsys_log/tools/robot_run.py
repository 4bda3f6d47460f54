"""A robot run in a log: its errors at the waypoints, the errors of its positions, and its stops."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, groupby

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    FINISHED,
    HOLDING,
    STOPPED,
    Array,
    ErrorStatistics,
    RobotPath,
    Tracks,
    Waypoint,
    WheelCommand,
)
from ipsys_log.messages.channels import COMMANDS, PATHS, TRACKS, TRUTH
from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.ground_truth import gather_tracks, last_poses
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.time_brackets import bracket_times

# A stopped robot stands after this time: its motors have a lag.
_STANDS_NS = NS_PER_S // 2


@dataclass(frozen=True, slots=True, eq=False)
class WaypointResult:
    """A robot at one of its waypoints, from its arrival to its departure.

    Attributes
    ----------
    number : number of the waypoint, from 1.
    start_ns, end_ns : the last interval in which the robot stood there.
    control_m : largest distance of a received position from the waypoint.
    true_m : distances of the true positions from the waypoint; None without a ground truth.
    positioning_m : by model, distances on the floor between true and estimated positions.
    """

    number: int
    place: Waypoint
    start_ns: int
    end_ns: int
    control_m: float
    true_m: ErrorStatistics | None
    positioning_m: dict[str, ErrorStatistics]


@dataclass(frozen=True, slots=True)
class Stop:
    """A robot without positions: the time of its stop, and the age of its last position then.

    ``braking_m`` is the true distance that it moved from its last position to half a second after the stop,
    and ``moved_m`` the distance after that; None without a ground truth.
    """

    start_ns: int
    end_ns: int
    age_s: float | None
    braking_m: float | None
    moved_m: float | None


@dataclass(frozen=True, slots=True, eq=False)
class RobotResult:
    """The results of one robot.

    Attributes
    ----------
    reached : the waypoints that it reached, in order; ``path`` has all waypoints.
    received : times (n,) and positions (n, 2) that the commands name.
    true : times and true positions; None without a ground truth.
    positioning_m : by model, errors on the floor over the whole drive.
    """

    name: str
    path: tuple[Waypoint, ...]
    reached: list[WaypointResult]
    stops: list[Stop]
    received: TimedPoints
    true: TimedPoints | None
    positioning_m: dict[str, ErrorStatistics]
    is_finished: bool


@dataclass(frozen=True, slots=True, eq=False)
class RobotRunResult:
    """The results of a robot run; ``nearest_m`` is the smallest distance of two robots, between centres."""

    start_ns: int
    end_ns: int
    robots: list[RobotResult]
    nearest_m: float | None


def has_robot_run(session: Session) -> bool:
    """Return whether a log has the paths of robots."""
    return bool(session.topics(PATHS))


def read_robot_run(session: Session) -> RobotRunResult:
    """Return the results of a robot run."""
    paths: list[RobotPath] = session.payloads(session.topics(PATHS))
    commands: list[WheelCommand] = session.payloads(session.topics(COMMANDS))
    if not paths or not commands:
        raise IpsysError(f"{session}: has no robot run; 'ipsys drive' makes one")
    ids = _ids(session)
    truth = gather_tracks(session.messages(session.topics(TRUTH)))
    models = {
        run: gather_tracks(session.messages(topics))
        for run in sorted(session.run_names())
        if (topics := session.topics(TRACKS, run))
    }
    robots = []
    for path in paths:
        mine = [command for command in commands if command.robot == path.robot]
        marker = ids.get(path.robot, -1)
        estimated = {run: tracks[marker] for run, tracks in models.items() if marker in tracks}
        robots.append(_robot(path, mine, truth.get(marker), estimated))
    nearest_m = _nearest_m([robot.true for robot in robots if robot.true is not None])
    return RobotRunResult(commands[0].timestamp, commands[-1].timestamp, robots, nearest_m)


def _ids(session: Session) -> dict[str, int]:
    """Return the id of the marker of each robot in the ground truth and the tracks."""
    topics = [*session.topics(TRUTH)]
    for run in session.run_names():
        topics += session.topics(TRACKS, run)
    return {
        track.robot: track.id
        for message in session.messages(topics)
        if isinstance(message.payload, Tracks)
        for track in message.payload.tracks
    }


def _robot(
    path: RobotPath,
    commands: Sequence[WheelCommand],
    true: TimedPoints | None,
    estimated: Mapping[str, TimedPoints],
) -> RobotResult:
    errors = {run: _errors_m(track, true) for run, track in estimated.items()} if true is not None else {}
    reached = [
        result
        for number, place in enumerate(path.waypoints, 1)
        if (result := _waypoint(number, place, commands, true, errors)) is not None
    ]
    whole = {
        run: error_statistics(rows[:, 1], independent=False) for run, rows in errors.items() if len(rows)
    }
    rows = [(c.position_time, c.x_m, c.y_m) for c in commands if c.position_time is not None]
    received = dict.fromkeys(rows)
    return RobotResult(
        path.robot,
        path.waypoints,
        reached,
        _stops(commands, true),
        TimedPoints(
            np.array([row[0] for row in received], dtype=np.int64),
            np.array([row[1:] for row in received], dtype=np.float64).reshape(-1, 2),
        ),
        true,
        whole,
        bool(commands) and commands[-1].state == FINISHED,
    )


def _errors_m(track: TimedPoints, true: TimedPoints) -> Array:
    """Return rows of time in ns and error on the floor in m, at the instants of the ground truth."""
    rows = last_poses(track)
    truth = bracket_times(true.times_ns, track.times_ns[rows], 0)
    errors_m = np.linalg.norm((track.points_m[rows] - truth.mix(true.points_m))[:, :2], axis=1)
    return np.column_stack([track.times_ns[rows], errors_m])[truth.is_known]


def _waypoint(
    number: int,
    place: Waypoint,
    commands: Sequence[WheelCommand],
    true: TimedPoints | None,
    errors: Mapping[str, Array],
) -> WaypointResult | None:
    """Return the last stay at a waypoint; None if the robot did not reach it."""
    stay = _last_stay(number, commands)
    target_m = np.array([place.x_m, place.y_m])
    points_m = [(c.x_m, c.y_m) for c in stay if c.x_m is not None and c.y_m is not None]
    if not points_m:
        return None
    start_ns, end_ns = stay[0].timestamp, stay[-1].timestamp
    true_m = None
    if true is not None and (within := _within(true.times_ns, start_ns, end_ns)).any():
        true_m = error_statistics(
            np.linalg.norm(true.points_m[within, :2] - target_m, axis=1), independent=False
        )
    return WaypointResult(
        number,
        place,
        start_ns,
        end_ns,
        float(np.linalg.norm(np.array(points_m) - target_m, axis=1).max()),
        true_m,
        {
            run: error_statistics(rows[within, 1], independent=False)
            for run, rows in errors.items()
            if (within := _within(rows[:, 0], start_ns, end_ns)).any()
        },
    )


def _last_stay(number: int, commands: Sequence[WheelCommand]) -> list[WheelCommand]:
    """Return the commands of a robot's last stay at a waypoint; empty if it did not reach it."""
    stay: list[WheelCommand] = []
    for stands, group in groupby(commands, lambda c: c.waypoint == number and c.state in (HOLDING, FINISHED)):
        if stands:
            stay = list(group)
    return stay


def _within(times_ns: NDArray[np.int64] | Array, start_ns: int, end_ns: int) -> NDArray[np.bool_]:
    within: NDArray[np.bool_] = (times_ns >= start_ns) & (times_ns <= end_ns)
    return within


def _stops(commands: Sequence[WheelCommand], true: TimedPoints | None) -> list[Stop]:
    """Return the stops after the first movement: before it, the robot waits for its first position."""
    begun = next((n for n, command in enumerate(commands) if command.state != STOPPED), len(commands))
    stops = []
    for is_stopped, group in groupby(commands[begun:], lambda command: command.state == STOPPED):
        if is_stopped:
            rows = list(group)
            first, last = rows[0], rows[-1]
            seen_ns = first.timestamp if first.position_time is None else first.position_time
            stands_ns = first.timestamp + _STANDS_NS
            stops.append(
                Stop(
                    first.timestamp,
                    last.timestamp,
                    None if first.position_time is None else (first.timestamp - seen_ns) / NS_PER_S,
                    None if true is None else _length_m(true, seen_ns, stands_ns),
                    None if true is None else _length_m(true, stands_ns, last.timestamp),
                )
            )
    return stops


def _length_m(true: TimedPoints, start_ns: int, end_ns: int) -> float:
    """Return the length of a true path between two times."""
    points_m = true.points_m[_within(true.times_ns, start_ns, end_ns), :2]
    return float(np.linalg.norm(np.diff(points_m, axis=0), axis=1).sum())


def _nearest_m(paths: Sequence[TimedPoints]) -> float | None:
    distances_m = []
    for one, other in combinations(paths, 2):
        _, first, second = np.intersect1d(one.times_ns, other.times_ns, return_indices=True)
        apart_m = np.linalg.norm(one.points_m[first, :2] - other.points_m[second, :2], axis=1)
        distances_m += [float(apart_m.min())] if len(apart_m) else []
    return min(distances_m, default=None)
