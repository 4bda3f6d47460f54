"""Parts of the observations: without some calibration points, or without cameras that saw nothing."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from ipsys_log.joint.observations import Observations


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


def without_cameras(observations: Observations, cameras: Collection[int]) -> Observations:
    """Return the observations without some cameras, by their numbers."""
    kept = [number for number in range(len(observations.cameras)) if number not in cameras]
    return replace(
        observations,
        cameras=tuple(observations.cameras[number] for number in kept),
        sightings=tuple(observations.sightings[number] for number in kept),
    )


def seeing_cameras(observations: Observations) -> Observations:
    """Return the observations of the cameras that have sightings."""
    blind = [number for number, sightings in enumerate(observations.sightings) if not len(sightings)]
    return without_cameras(observations, blind)


def divide_camera(observations: Observations, camera: int, time_s: float) -> Observations:
    """Return observations in which a camera until a time is another one, after all others."""
    prior, sightings = observations.cameras[camera], observations.sightings[camera]
    before = sightings.times_s <= time_s
    later = [*observations.sightings]
    later[camera] = sightings.select(~before)
    return replace(
        observations,
        cameras=(*observations.cameras, replace(prior, is_former=True)),
        sightings=(*later, sightings.select(before)),
    )
