"""Parts of the observations: without some calibration points, or without cameras that saw nothing."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ipsys_log.joint.observations import Observations

__all__ = ["seeing_cameras", "without_points"]


def without_points(observations: Observations, names: Collection[str]) -> Observations:
    """Return the observations without some calibration points, and without their sightings."""
    kept = [number for number, point in enumerate(observations.points) if point.name not in names]
    # The last entry is that of moving bodies, -1.
    numbers = np.full(len(observations.points) + 1, -1, dtype=np.intp)
    numbers[kept] = np.arange(len(kept))
    dropped = np.array([point.name in names for point in observations.points] + [False], dtype=np.bool_)
    selected = []
    for sightings in observations.sightings:
        rest = sightings.select(~dropped[sightings.point])
        selected.append(replace(rest, point=numbers[rest.point]))
    points = tuple(observations.points[number] for number in kept)
    return replace(observations, points=points, sightings=tuple(selected))


def seeing_cameras(observations: Observations) -> Observations:
    """Return the observations of the cameras that have sightings."""
    seeing = [number for number, sightings in enumerate(observations.sightings) if len(sightings)]
    return replace(
        observations,
        cameras=tuple(observations.cameras[number] for number in seeing),
        sightings=tuple(observations.sightings[number] for number in seeing),
    )
