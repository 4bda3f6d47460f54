"""Robots that drive one behind the other along a smooth closed path over the whole floor.

The path does not cross itself, so that a convoy never meets itself however long it drives.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.sources.simulator.cameras import FLOOR_M, Camera
from ipsys_log.sources.simulator.places import Place, overlap
from ipsys_log.sources.simulator.seeds import Purpose, stream
from ipsys_log.sources.simulator.settings import LabSettings

__all__ = ["Drive", "plan_drive"]

Array = NDArray[np.float64]

# Of the path from the walls: near enough for the edge of the images, and seen whole everywhere.
_FROM_WALL_M = 0.55
# A robot gathers speed within about this time.
_START_S = 0.4
_TRIES = 200
_ARMS = 5
_MEAN = 0.64
_CHECKED_HZ = 10


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A star with five rounded arms, and how far along it each marker starts, in m.

    ``lengths_m`` (n,) are the ways along the path up to the angles ``phases`` (n,), in rad.
    """

    settings: LabSettings
    mirrored: bool
    starts_m: dict[int, float]
    lengths_m: Array
    phases: Array

    def places_at(self, time_s: float) -> tuple[Place, ...]:
        """Where the markers are, a time after the start."""
        places = []
        for marker_id, start_m in self.starts_m.items():
            x_m, y_m, heading_rad = (float(v[0]) for v in self._follow(start_m, np.array([time_s])))
            places.append(Place(marker_id, x_m, y_m, self.settings.drive_height_m, heading_rad))
        return tuple(places)

    def track(self, start_m: float, times_s: Array) -> Array:
        """Centres of a marker at times (n,): (n, 3) in m."""
        x_m, y_m, _ = self._follow(start_m, times_s)
        return np.stack([x_m, y_m, np.full_like(x_m, self.settings.drive_height_m)], axis=1)

    def _follow(self, start_m: float, times_s: Array) -> tuple[Array, Array, Array]:
        driven_m = times_s - _START_S * (1 - np.exp(-times_s / _START_S))
        along_m = (start_m + self.settings.drive_speed_m_s * driven_m) % self.lengths_m[-1]
        phase = np.interp(along_m, self.lengths_m, self.phases)
        (x_m, y_m), (dx, dy) = _figure(phase, self.mirrored)
        return x_m, y_m, np.arctan2(dy, dx)


def plan_drive(settings: LabSettings, cameras: Sequence[Camera]) -> Drive:
    """Markers on the path, as many of them as never cover one another; marker 0 starts at a wall."""
    rng = stream(settings.seed, Purpose.DRIVE)
    mirrored = bool(rng.integers(2))
    # It begins at the outermost camera and leads through the views of all of them within 14 s.
    phases = -np.pi / 2 + np.linspace(0, 2 * np.pi, 20_001)
    (x_m, y_m), _ = _figure(phases, mirrored)
    lengths_m = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
    empty = Drive(settings, mirrored, {}, lengths_m, phases)
    times_s = np.arange(0, settings.drive_s + 1 / _CHECKED_HZ, 1 / _CHECKED_HZ)
    starts_m, tracks_m = {0: 0.0}, [empty.track(0.0, times_s)]
    for marker_id in range(1, settings.markers):
        for start_m in rng.uniform(0, lengths_m[-1], _TRIES).tolist():
            track_m = empty.track(start_m, times_s)
            if not any(overlap(track_m, other_m, cameras, settings).any() for other_m in tracks_m):
                starts_m[marker_id] = start_m
                tracks_m.append(track_m)
                break
    return Drive(settings, mirrored, starts_m, lengths_m, phases)


def _figure(phase: Array, mirrored: bool) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    """Points of the path at angles (n,), in m, and their derivatives by the angle.

    Between the arms the path comes back to near the middle; the arms end on a square with rounded
    corners, so that they reach the edges of all images.
    """
    side = -1.0 if mirrored else 1.0
    cos, sin = np.cos(phase), np.sin(phase)
    corner = cos**4 + sin**4
    wave = _MEAN + (1 - _MEAN) * np.cos(_ARMS * (phase + np.pi / 2))
    size_m = (FLOOR_M / 2 - _FROM_WALL_M) * corner**-0.25
    reach_m = size_m * wave
    slope_m = size_m * (
        wave * (cos**3 * sin - sin**3 * cos) / corner
        - (1 - _MEAN) * _ARMS * np.sin(_ARMS * (phase + np.pi / 2))
    )
    point_m = (FLOOR_M / 2 + side * reach_m * cos, FLOOR_M / 2 + reach_m * sin)
    return point_m, (side * (slope_m * cos - reach_m * sin), slope_m * sin + reach_m * cos)
