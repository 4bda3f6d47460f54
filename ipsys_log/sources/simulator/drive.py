"""Robots that drive one behind the other along a smooth closed path over the whole floor."""

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
_CHECKED_HZ = 10


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A Lissajous figure (2 : 3) and how far along it each marker starts, in m."""

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
    """Markers on the path, as many of them as never cover one another; marker 0 starts in a corner."""
    rng = stream(settings.seed, Purpose.DRIVE)
    mirrored = bool(rng.integers(2))
    # It begins where y is least, so that the first 10 s lead through the views of all cameras.
    phases = -np.pi / 6 + np.linspace(0, 2 * np.pi, 20_001)
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
    """Points of the path and their derivatives by the phase."""
    size_m = FLOOR_M / 2 - _FROM_WALL_M
    side = -1.0 if mirrored else 1.0
    x_m = FLOOR_M / 2 + side * size_m * np.sin(2 * phase + 0.4)
    y_m = FLOOR_M / 2 + size_m * np.sin(3 * phase)
    return (x_m, y_m), (side * 2 * size_m * np.cos(2 * phase + 0.4), 3 * size_m * np.cos(3 * phase))
