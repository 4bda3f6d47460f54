"""Rules that make tracks from the positions of several cameras, for the benchmark of tracks."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from track_drives import SeenDrive

from ipsys_log.messages import Message, Position, Track, Tracks
from ipsys_log.models.tracking.motion import MotionNoise
from ipsys_log.models.tracking.smoothed_poses import Frame, smooth_positions
from ipsys_log.models.tracking.track_messages import TrackRows, gather_rows, interpolate, make_track
from ipsys_log.stages.fuse import Fuse
from ipsys_log.units import NS_PER_S

__all__ = ["COASTING", "CONTENDERS", "RobotTrack"]

Array = NDArray[np.float64]
Times = NDArray[np.int64]

_RUN = "drive"
# Cameras are averaged within this time, as by the first version of the stage.
_WINDOW_NS = 5_000_000
# A camera sees a robot if it saw it in this time: a little more than a frame.
_SEEN_NS = 40_000_000
# Limits of the cameras in the world's y, from the program of the authors.
_MIDDLE_TO_M, _LEFT_TO_M = 3.00, 1.65
# White acceleration of the plain filter: 1 m/s^2 over a second, in both directions.
_ACCELERATION_M2_S3 = 1.0
_FIRST_SPEED_M_S = 1.0
_USUAL_M2 = 0.002**2 * np.eye(2)

# Points (k, 2) and covariances (k, 2, 2) at times (k,), from the rows at or before each time.
Predict = Callable[[Times], tuple[Array, Array]]


@dataclass(frozen=True, slots=True, eq=False)
class RobotTrack:
    """The track of a robot: n rows in order of time, NaN for missing values.

    Attributes
    ----------
    times_ns : (n,), points_m : (n, 3), headings_rad : (n,).
    covariances_m2 : (n, 2, 2).
    velocities_m_s : (n, 2).
    predict : returns the positions at any times.
    """

    times_ns: Times
    points_m: Array
    headings_rad: Array
    covariances_m2: Array
    velocities_m_s: Array
    predict: Predict


def _hold(times_ns: Times, points_m: Array, velocities_m_s: Array | None = None) -> Predict:
    """Return a prediction that keeps the last point, or its velocity; it has no covariance."""

    def predict(wanted_ns: Times) -> tuple[Array, Array]:
        last = np.maximum(np.searchsorted(times_ns, wanted_ns, side="right") - 1, 0)
        points = points_m[last, :2]
        if velocities_m_s is not None:
            points = points + velocities_m_s[last] * ((wanted_ns - times_ns[last]) / NS_PER_S)[:, None]
        return points, np.full((len(wanted_ns), 2, 2), np.nan)

    return predict


def _of_positions(rows: Iterable[tuple[int, Position]]) -> RobotTrack:
    """Return the track with the positions of a rule: it has no velocity."""
    chosen = sorted(rows, key=lambda row: row[0])
    times_ns = np.array([time_ns for time_ns, _ in chosen], dtype=np.int64)
    points_m = np.array([(p.x_m, p.y_m, p.z_m) for _, p in chosen])
    headings_rad = [np.nan if p.heading_rad is None else p.heading_rad for _, p in chosen]
    unknown = np.full((2, 2), np.nan)
    covariances = [unknown if p.covariance_m2 is None else p.covariance_m2[:2, :2] for _, p in chosen]
    return RobotTrack(
        times_ns,
        points_m,
        np.array(headings_rad),
        np.array(covariances),
        np.full((len(chosen), 2), np.nan),
        _hold(times_ns, points_m),
    )


_Recent = dict[str, tuple[int, Position]]


def _by_rule(
    rule: Callable[[SeenDrive, _Recent], str],
) -> Callable[[SeenDrive], dict[int, RobotTrack]]:
    """Return the contender that writes a row for the camera that a rule selects from those that see."""

    def track(drive: SeenDrive) -> dict[int, RobotTrack]:
        recent: dict[int, _Recent] = defaultdict(dict)
        rows: dict[int, list[tuple[int, Position]]] = defaultdict(list)
        for time_ns, camera, position in _positions(drive):
            seen = recent[position.id]
            seen[camera] = time_ns, position
            seeing = {name: row for name, row in seen.items() if time_ns - row[0] <= _SEEN_NS}
            if rule(drive, seeing) == camera:
                rows[position.id].append((time_ns, position))
        return {robot: _of_positions(chosen) for robot, chosen in rows.items()}

    return track


def _positions(drive: SeenDrive) -> Iterator[tuple[int, str, Position]]:
    for message in drive.positions:
        for position in message.payload.positions:
            yield message.publish_time_ns + (position.time_offset_ns or 0), str(message.camera), position


def _authors(drive: SeenDrive, seeing: _Recent) -> str:
    """Return the camera of the authors' program: the right one, unless those left of it see it nearer."""
    left, middle, right = sorted(
        drive.camera_places_m, key=lambda name: float(drive.camera_places_m[name][1])
    )
    chosen = right if right in seeing else ""
    if middle in seeing and (not chosen or seeing[middle][1].y_m <= _MIDDLE_TO_M):
        chosen = middle
    if left in seeing and (not chosen or seeing[left][1].y_m <= _LEFT_TO_M):
        chosen = left
    return chosen


def _nearest(drive: SeenDrive, seeing: _Recent) -> str:
    def apart_m(camera: str) -> float:
        position = seeing[camera][1]
        return float(np.hypot(*(drive.camera_places_m[camera] - [position.x_m, position.y_m])))

    return min(seeing, key=apart_m)


def _average(drive: SeenDrive) -> dict[int, RobotTrack]:
    """Average positions of one instant, weighted by their inverse covariances: the first version of fuse."""
    recent: dict[int, _Recent] = defaultdict(dict)
    rows: dict[int, list[tuple[int, Position]]] = defaultdict(list)
    for time_ns, camera, position in _positions(drive):
        seen = recent[position.id]
        seen[camera] = time_ns, position
        together = [other for other_ns, other in seen.values() if abs(time_ns - other_ns) <= _WINDOW_NS]
        rows[position.id].append((time_ns, _mean(together)))
    return {robot: _of_positions(averaged) for robot, averaged in rows.items()}


def _mean(positions: list[Position]) -> Position:
    if len(positions) == 1:
        return positions[0]
    covariances = [p.covariance_m2 for p in positions if p.covariance_m2 is not None]
    points = np.array([(p.x_m, p.y_m, p.z_m) for p in positions])
    weights = (
        np.linalg.inv(covariances)
        if len(covariances) == len(positions)
        else np.array([np.eye(3)] * len(points))
    )
    spread = np.linalg.inv(weights.sum(axis=0))
    x_m, y_m, z_m = (spread @ np.einsum("nij,nj->i", weights, points)).tolist()
    along = sum(np.exp(1j * p.heading_rad) for p in positions if p.heading_rad is not None)
    covariance = spread if len(covariances) == len(positions) else None
    return Position(positions[0].id, x_m, y_m, z_m, float(np.angle(along)), covariance)


def _velocity_filter(drive: SeenDrive) -> dict[int, RobotTrack]:
    """Filter positions with constant velocity and white acceleration; all errors count as white noise."""
    sightings: dict[int, list[tuple[int, Position]]] = defaultdict(list)
    for time_ns, _, position in sorted(_positions(drive), key=lambda row: row[:2]):
        sightings[position.id].append((time_ns, position))
    return {robot: _filter(seen) for robot, seen in sightings.items()}


def _filter(seen: list[tuple[int, Position]]) -> RobotTrack:
    times_ns = np.array([time_ns for time_ns, _ in seen], dtype=np.int64)
    states, spreads = np.zeros((len(seen), 4)), np.zeros((len(seen), 4, 4))
    state, spread = np.zeros(4), np.diag([1e4, 1e4, _FIRST_SPEED_M_S**2, _FIRST_SPEED_M_S**2])
    for n, (time_ns, position) in enumerate(seen):
        state, spread = _ahead(state, spread, (time_ns - times_ns[max(n - 1, 0)]) / NS_PER_S)
        noise = _USUAL_M2 if position.covariance_m2 is None else position.covariance_m2[:2, :2]
        gain = np.linalg.solve(spread[:2, :2] + noise, spread[:2]).T
        state = state + gain @ ([position.x_m, position.y_m] - state[:2])
        spread = spread - gain @ spread[:2]
        states[n], spreads[n] = state, (spread + spread.T) / 2

    def predict(wanted_ns: Times) -> tuple[Array, Array]:
        last = np.maximum(np.searchsorted(times_ns, wanted_ns, side="right") - 1, 0)
        ahead_s = ((wanted_ns - times_ns[last]) / NS_PER_S)[:, None]
        along = states[last, :2] + states[last, 2:] * ahead_s
        cross, own = spreads[last, :2, 2:], ahead_s[:, :, None]
        grown = spreads[last, :2, :2] + own * (cross + cross.swapaxes(1, 2)) + own**2 * spreads[last, 2:, 2:]
        return along, grown + own**3 / 3 * _ACCELERATION_M2_S3 * np.eye(2)

    measured = _of_positions(seen)
    points_m = np.column_stack([states[:, :2], measured.points_m[:, 2]])
    return RobotTrack(times_ns, points_m, measured.headings_rad, spreads[:, :2, :2], states[:, 2:], predict)


def _ahead(state: Array, spread: Array, step_s: float) -> tuple[Array, Array]:
    motion = np.eye(4)
    motion[0, 2] = motion[1, 3] = step_s
    noise = _ACCELERATION_M2_S3 * np.array([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]])
    return motion @ state, motion @ spread @ motion.T + np.kron(noise, np.eye(2))


def _stage(drive: SeenDrive) -> dict[int, RobotTrack]:
    """Track with the stage of the program, as while recording."""
    step = Fuse(_RUN, drive.model)
    rows: dict[int, list[tuple[int, Track]]] = defaultdict(list)
    for message in drive.messages():
        for payload in step(message):
            if isinstance(payload, Tracks):
                for track in payload.tracks:
                    rows[track.id].append((payload.timestamp, track))
    return {robot: _of_tracks(tracks, _extrapolate) for robot, tracks in rows.items()}


def _smoothed(drive: SeenDrive) -> dict[int, RobotTrack]:
    """Smooth the sightings of the whole drive, as the stage of the program."""
    frames = [
        Frame(one.publish_time_ns, str(one.camera), one.log_time_ns, one.payload.positions)
        for one in drive.positions
    ]
    rows: dict[int, list[tuple[int, Track]]] = defaultdict(list)
    for _, pose in smooth_positions(frames, drive.rig, drive.model):
        track = make_track(pose)
        rows[track.id].append((pose.time_ns, track))
    return {robot: _of_tracks(tracks, _interpolate) for robot, tracks in rows.items()}


def _of_tracks(rows: list[tuple[int, Track]], make_predict: Callable[[TrackRows], Predict]) -> RobotTrack:
    messages = [Message("", time_ns, time_ns, Tracks(time_ns, (track,))) for time_ns, track in rows]
    gathered, _ = gather_rows(messages, rows[0][1].robot)
    return RobotTrack(
        gathered.times_ns,
        gathered.points_m,
        gathered.headings_rad,
        gathered.covariances_m2[:, :2, :2],
        gathered.velocities_m_s[:, :2],
        make_predict(gathered),
    )


def _interpolate(rows: TrackRows) -> Predict:
    def predict(wanted_ns: Times) -> tuple[Array, Array]:
        samples = interpolate(rows, wanted_ns)
        return samples.points_m[:, :2], samples.covariances_m2[:, :2, :2]

    return predict


def _extrapolate(rows: TrackRows) -> Predict:
    """Return the prediction of a reader of live rows: constant speed and turn rate from the last row."""
    usual = MotionNoise()

    def predict(wanted_ns: Times) -> tuple[Array, Array]:
        last = np.maximum(np.searchsorted(rows.times_ns, wanted_ns, side="right") - 1, 0)
        ahead_s = (wanted_ns - rows.times_ns[last]) / NS_PER_S
        velocities = rows.velocities_m_s[last, :2]
        turned = np.exp(0.5j * np.nan_to_num(rows.turn_rates_rad_s[last]) * ahead_s)
        along = (velocities @ np.array([1, 1j])) * turned * ahead_s
        points_m = rows.points_m[last, :2] + np.stack([along.real, along.imag], axis=1)
        by_velocity = ahead_s[:, None, None] ** 2 * rows.velocity_covariances_m2_s2[last][:, :2, :2]
        usual_m_s2 = np.hypot(usual.acceleration_m_s2, usual.bend_rad_s * np.linalg.norm(velocities, axis=1))
        unknown_m2 = (usual_m_s2 * ahead_s**2 / 2) ** 2
        own = rows.covariances_m2[last][:, :2, :2]
        return points_m, own + by_velocity + unknown_m2[:, None, None] * np.eye(2)

    return predict


# By name, from a drive to the tracks of its robots.
CONTENDERS: dict[str, Callable[[SeenDrive], dict[int, RobotTrack]]] = {
    "fuse": _stage,
    "smooth": _smoothed,
    "average in 5 ms": _average,
    "authors' rule": _by_rule(_authors),
    "nearest camera": _by_rule(_nearest),
    "velocity filter": _velocity_filter,
}
# These have covariances while no camera sees a robot.
COASTING = frozenset({"fuse", "smooth", "velocity filter"})
