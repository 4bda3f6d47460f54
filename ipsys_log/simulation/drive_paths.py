"""Closed paths of robots over the floor of the simulated lab. They do not cross themselves."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ipsys_log.arrays import Array
from ipsys_log.simulation.settings import FLOOR_M, LabSettings

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


def choose_path(settings: LabSettings, mirrored: bool) -> DrivePath:
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
