"""Convoy of robots on a smooth closed path over the whole floor.

The path does not cross itself, so the robots of a convoy never meet, for any duration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ipsys_log.capture.simulation.calibration_points import SimulatedPose, overlap
from ipsys_log.capture.simulation.cameras import Camera
from ipsys_log.capture.simulation.settings import FLOOR_M, LabSettings, Purpose, random_stream
from ipsys_log.messages import Array

# Time constant of the acceleration of a robot.
START_S = 0.4
_TRIES = 200
# Largest rate of turn. A robot slows down in bends to keep below it.
_TURN_RAD_S = 2.5
_CHECKED_HZ = 10

# Points (x, y) in m at angles of a path, and their derivatives by the angle.
Points = tuple[tuple[Array, Array], tuple[Array, Array]]

# Distance of the path from the walls: the path reaches the edges of the images, and whole markers are visible
# everywhere.
_FROM_WALL_M = 0.55
_ARMS = 5
# Mean reach, and the share of a second harmonic that rounds the bends between the arms.
_MEAN, _ROUND = 0.7, 0.18
# Distance of the way back from the bends of the lanes.
_BESIDE_M = 0.6
_LANES_PER_CAMERA = 2


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A path over the floor, and the start of each marker on it.

    ``ahead_s`` is the time from the start of the path to the start of each marker, in s. ``times_s`` (n,) are
    the times at which a robot passes the angles ``phases_rad`` (n,) of the path.
    """

    height_m: float
    path: DrivePath
    ahead_s: dict[int, float]
    times_s: Array
    phases_rad: Array

    def poses_at(self, time_s: float) -> tuple[SimulatedPose, ...]:
        """Return the poses of all markers at a time after the start; before it, they are stationary."""
        return tuple(self.pose_at(marker_id, time_s) for marker_id in self.ahead_s)

    def pose_at(self, marker_id: int, time_s: float) -> SimulatedPose:
        """Return the pose of one marker at a time after the start."""
        (x_m, y_m), (dx, dy) = self.follow(marker_id, np.array([max(time_s, 0.0)]))
        heading_rad = float(np.arctan2(dy[0], dx[0]))
        return SimulatedPose(marker_id, float(x_m[0]), float(y_m[0]), self.height_m, heading_rad)

    def track(self, ahead_s: float, times_s: Array) -> Array:
        """Return the centres of a marker at times (n,): (n, 3) in m."""
        (x_m, y_m), _ = self._points(ahead_s + eased_s(times_s))
        return np.stack([x_m, y_m, np.full_like(x_m, self.height_m)], axis=1)

    def follow(self, marker_id: int, times_s: Array) -> Points:
        """Return the points of a marker at times (n,) after the start, and their derivatives by the angle."""
        return self._points(self.way_s(marker_id, times_s))

    def way_s(self, marker_id: int, times_s: Array) -> Array:
        """Return the way of one marker since the start of the path (n,), as the time for it at full speed."""
        return self.ahead_s[marker_id] + eased_s(times_s)

    def _points(self, way_s: Array) -> Points:
        return self.path.at(np.interp(way_s % self.times_s[-1], self.times_s, self.phases_rad))


def eased_s(times_s: Array) -> Array:
    """Return the ways (n,) of a robot that never stops, as the time for them at full speed."""
    driven_s: Array = times_s - START_S * (1 - np.exp(-times_s / START_S))
    return driven_s


def plan_drive(settings: LabSettings, cameras: Sequence[Camera]) -> Drive:
    """Put up to ``settings.markers`` markers, which never cover one another, on the path; return the drive.

    Marker 0 starts at a wall.
    """
    rng = random_stream(settings.seed, Purpose.DRIVE)
    mirrored = bool(rng.integers(2))
    timetable = _timetable(_choose_path(settings, False), settings.drive_speed_m_s)
    empty = Drive(settings.drive_height_m, _choose_path(settings, mirrored), {}, *timetable)
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


@dataclass(frozen=True, slots=True)
class StarPath:
    """A star with five rounded arms in a lab of 4.88 m."""

    mirrored: bool

    def at(self, phase: Array) -> Points:
        """Return points of the path at angles (n,), in m, and their derivatives by the angle.

        Between two arms, the path returns to near the middle. The arms end on a square with rounded corners,
        so they reach the edges of all images.
        """
        side = -1.0 if self.mirrored else 1.0
        cos, sin = np.cos(phase), np.sin(phase)
        corner = cos**4 + sin**4
        arm = _ARMS * (phase + np.pi / 2)
        swing = (1 - _MEAN) / (1 + (1 - _MEAN) * _ROUND)
        wave = 1 - swing * (1 - np.cos(arm) + _ROUND * (1 - np.cos(2 * arm)))
        wave_slope = -swing * _ARMS * (np.sin(arm) + 2 * _ROUND * np.sin(2 * arm))
        size_m = (FLOOR_M / 2 - _FROM_WALL_M) * corner**-0.25
        reach_m = size_m * wave
        slope_m = size_m * (wave * (cos**3 * sin - sin**3 * cos) / corner + wave_slope)
        point_m = (FLOOR_M / 2 + side * reach_m * cos, FLOOR_M / 2 + reach_m * sin)
        return point_m, (side * (slope_m * cos - reach_m * sin), slope_m * sin + reach_m * cos)


@dataclass(frozen=True)
class LanePath:
    """Lanes up and down a hall, and a way back along a wall.

    ``floor_m`` is the size of the floor, ``lanes`` an even number. Lanes are parallel to y. The angle of a
    point is proportional to its distance along the path, from -pi/2 on.
    """

    floor_m: tuple[float, float]
    lanes: int
    mirrored: bool

    def at(self, phase: Array) -> Points:
        """Return points of the path at angles (n,), in m, and their derivatives by the angle."""
        starts_m, headings_rad, firsts_m, curvatures = self._parts
        length_m = float(firsts_m[-1])
        way_m = ((phase + np.pi / 2) / (2 * np.pi) % 1.0) * length_m
        part = np.clip(np.searchsorted(firsts_m, way_m, side="right") - 1, 0, len(curvatures) - 1)
        along_m, start_m = way_m - firsts_m[part], starts_m[part]
        x_m, y_m, heading = _advance(start_m, headings_rad[part], along_m, curvatures[part])
        side, first_m = (-1.0, self.floor_m[0]) if self.mirrored else (1.0, 0.0)
        scale = length_m / (2 * np.pi)
        return (first_m + side * x_m, y_m), (side * scale * np.cos(heading), scale * np.sin(heading))

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array, Array]:
        """The straight and round parts.

        These are their starts (p, 2), first headings (p,), curvatures (p,), and distances (p + 1,) from the
        start of the path.
        """
        moves = np.array(self._moves())
        starts_m, headings_rad = [(_FROM_WALL_M, _FROM_WALL_M + self._radius_m)], [np.pi / 2]
        for length_m, curvature in moves[:-1]:
            one = np.array([length_m]), np.array([curvature])
            x_m, y_m, heading = _advance(np.array(starts_m[-1:]), np.array(headings_rad[-1:]), *one)
            starts_m.append((float(x_m[0]), float(y_m[0])))
            headings_rad.append(float(heading[0]))
        firsts_m = np.concatenate([[0.0], np.cumsum(moves[:, 0])])
        return np.array(starts_m), np.array(headings_rad), firsts_m, moves[:, 1]

    @property
    def _radius_m(self) -> float:
        """Half the distance of two lanes."""
        return (self.floor_m[0] - 2 * _FROM_WALL_M) / (self.lanes - 1) / 2

    def _moves(self) -> list[tuple[float, float]]:
        """Return the lengths of the parts in m, and their curvatures in 1/m."""
        radius_m = self._radius_m
        bend, corner = np.pi * radius_m, np.pi / 2 * radius_m
        outer_m = self.floor_m[1] - 2 * (_FROM_WALL_M + radius_m)
        inner_m = outer_m - _BESIDE_M
        moves: list[tuple[float, float]] = []
        for lane in range(self.lanes):
            moves.append((outer_m if lane in (0, self.lanes - 1) else inner_m, 0.0))
            moves.append((bend, -1 / radius_m if lane % 2 == 0 else 1 / radius_m))
        back_m = self.floor_m[0] - 2 * (_FROM_WALL_M + radius_m)
        return [*moves[:-1], (corner, -1 / radius_m), (back_m, 0.0), (corner, -1 / radius_m)]


DrivePath = StarPath | LanePath


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


def _choose_path(settings: LabSettings, mirrored: bool) -> DrivePath:
    """Return the path of the robots of a lab, or of a hall."""
    if settings.grid is None:
        return StarPath(mirrored)
    return LanePath(settings.floor_m, _LANES_PER_CAMERA * settings.grid[0], mirrored)


def _advance(start_m: Array, heading: Array, along_m: Array, curvature: Array) -> tuple[Array, Array, Array]:
    """Return x, y and heading, (n,), after distances (n,) along lines and arcs from starts (n, 2)."""
    turn = curvature * along_m
    # The chord of an arc has the direction in the middle between both headings.
    chord_m = along_m * np.sinc(turn / 2 / np.pi)
    middle = heading + turn / 2
    return (
        start_m[:, 0] + chord_m * np.cos(middle),
        start_m[:, 1] + chord_m * np.sin(middle),
        heading + turn,
    )
