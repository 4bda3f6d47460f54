"""Convoy of robots that drive along a smooth closed path over the whole floor.

The path does not cross itself, so the robots of a convoy never meet, for any duration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ipsys_log.arrays import Array
from ipsys_log.simulation.calibration_points import SimulatedPose, overlap
from ipsys_log.simulation.cameras import Camera
from ipsys_log.simulation.drive_paths import DrivePath, choose_path
from ipsys_log.simulation.pace import Pace
from ipsys_log.simulation.settings import LabSettings, Purpose, random_stream

# Time constant of the acceleration of a robot.
_START_S = 0.4
_TRIES = 200
# Largest rate of turn. A robot slows down in bends to keep below it.
_TURN_RAD_S = 2.5
_CHECKED_HZ = 10


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A path over the floor, and the start of each marker on it.

    ``ahead_s`` is the time from the start of the path to the start of each marker, in s. ``times_s`` (n,) are
    the times at which a robot passes the angles ``phases_rad`` (n,) of the path. A marker in ``paces`` does
    not drive at full speed all the time, and can meet others.
    """

    height_m: float
    path: DrivePath
    ahead_s: dict[int, float]
    times_s: Array
    phases_rad: Array
    paces: Mapping[int, Pace] = field(default_factory=dict)

    def mirror(self) -> Drive:
        """Return the drive along the mirrored path."""
        return replace(self, path=replace(self.path, mirrored=not self.path.mirrored))

    def poses_at(self, time_s: float) -> tuple[SimulatedPose, ...]:
        """Return the poses of all markers at a time after the start; before it, they are stationary."""
        return tuple(self.pose_at(marker_id, time_s) for marker_id in self.ahead_s)

    def pose_at(self, marker_id: int, time_s: float) -> SimulatedPose:
        """Return the pose of one marker at a time after the start."""
        (x_m, y_m), (dx, dy) = self._follow(marker_id, np.array([max(time_s, 0.0)]))
        heading_rad = float(np.arctan2(dy[0], dx[0]))
        return SimulatedPose(marker_id, float(x_m[0]), float(y_m[0]), self.height_m, heading_rad)

    def poses_over(self, marker_id: int, times_s: Array) -> Array:
        """Return x, y and heading of one marker at times (n,) after the start: (n, 3), in m and rad."""
        (x_m, y_m), (dx, dy) = self._follow(marker_id, np.maximum(times_s, 0.0))
        return np.stack([x_m, y_m, np.arctan2(dy, dx)], axis=1)

    def velocities_over(self, marker_id: int, times_s: Array) -> Array:
        """Return the exact velocities of one marker at times (n,) after the start: (n, 2), in m/s."""
        pace = self.paces.get(marker_id)
        way_s = self._way_s(self.ahead_s[marker_id], np.maximum(times_s, 0.0), pace)
        interval = np.clip(np.searchsorted(self.times_s, way_s, side="right"), 1, len(self.times_s) - 1) - 1
        by_way = (np.diff(self.phases_rad) / np.diff(self.times_s))[interval]
        # The robot accelerates: its way on the path grows by this share of the time.
        share = np.where(times_s > 0, 1 - np.exp(-np.maximum(times_s, 0.0) / _START_S), 0.0)
        if pace is not None:
            share = share * pace.share_at(_driven_s(times_s))
        _, (dx, dy) = self.path.at(self._phase(way_s))
        return np.stack([dx, dy], axis=1) * (by_way * share)[:, None]

    def track(self, ahead_s: float, times_s: Array) -> Array:
        """Return the centres of a marker at times (n,): (n, 3) in m."""
        (x_m, y_m), _ = self.path.at(self._phase(self._way_s(ahead_s, times_s)))
        return np.stack([x_m, y_m, np.full_like(x_m, self.height_m)], axis=1)

    def _follow(self, marker_id: int, times_s: Array) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        way_s = self._way_s(self.ahead_s[marker_id], times_s, self.paces.get(marker_id))
        return self.path.at(self._phase(way_s))

    def _way_s(self, ahead_s: float, times_s: Array, pace: Pace | None = None) -> Array:
        """Return the place on the path (n,), as the time from its start to there at full speed."""
        driven_s = _driven_s(times_s)
        if pace is not None:
            driven_s = pace.driven_s(driven_s)
        return np.asarray((ahead_s + driven_s) % self.times_s[-1])

    def _phase(self, way_s: Array) -> Array:
        return np.interp(way_s, self.times_s, self.phases_rad)


def _driven_s(times_s: Array) -> Array:
    """Return the ways (n,) of a robot that never stops, as the time for them at full speed."""
    driven_s: Array = times_s - _START_S * (1 - np.exp(-times_s / _START_S))
    return driven_s


def plan_drive(settings: LabSettings, cameras: Sequence[Camera]) -> Drive:
    """Put up to ``settings.markers`` markers, which never cover one another, on the path; return the drive.

    Marker 0 starts at a wall.
    """
    rng = random_stream(settings.seed, Purpose.DRIVE)
    mirrored = bool(rng.integers(2))
    timetable = _timetable(choose_path(settings, False), settings.drive_speed_m_s)
    empty = Drive(settings.drive_height_m, choose_path(settings, mirrored), {}, *timetable)
    times_s = np.arange(0, settings.drive_s + 1 / _CHECKED_HZ, 1 / _CHECKED_HZ)
    ahead_s, tracks_m = {0: 0.0}, [empty.track(0.0, times_s)]
    for marker_id in range(1, settings.markers):
        for start_s in rng.uniform(0, empty.times_s[-1], _TRIES).tolist():
            track_m = empty.track(start_s, times_s)
            if not any(overlap(track_m, other_m, cameras, settings).any() for other_m in tracks_m):
                ahead_s[marker_id] = start_s
                tracks_m.append(track_m)
                break
    return replace(empty, ahead_s=ahead_s)


def _timetable(path: DrivePath, speed_m_s: float) -> tuple[Array, Array]:
    """Return times in s, and the angles of the path at these times in rad.

    The path starts at the wall at the first camera.
    """
    phases_rad = -np.pi / 2 + np.linspace(0, 2 * np.pi, 20_001)
    (x_m, y_m), (dx, dy) = path.at(phases_rad)
    step_m = np.hypot(np.diff(x_m), np.diff(y_m))
    turn_rad = np.abs(np.diff(np.unwrap(np.arctan2(dy, dx))))
    step_s = np.hypot(step_m / speed_m_s, turn_rad / _TURN_RAD_S)
    return np.concatenate([[0.0], np.cumsum(step_s)]), phases_rad
