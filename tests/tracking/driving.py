"""Sightings of robots with a known motion, for tests of tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.models.tracking.filter import Sightings
from ipsys_log.models.tracking.tracks import Pose, RobotTracks, TrackSettings
from ipsys_log.units import NS_PER_S

Array = NDArray[np.float64]

MS = NS_PER_S // 1000
NOISE_M, NOISE_RAD = 1e-4, 1e-3
CAMERAS = ("red", "white", "black")
START_NS = 10 * NS_PER_S


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """The sighting of one robot by one camera."""

    time_ns: int
    camera: str
    pose: Array
    robot: str = "ada"


def circle(time_ns: int, speed_m_s: float = 0.26, radius_m: float = 0.5) -> Array:
    """Return x, y, z and heading of a robot on a circle around (2, 2), (4,)."""
    angle = speed_m_s / radius_m * (time_ns - START_NS) / NS_PER_S
    place_m = 2 + radius_m * np.array([np.cos(angle), np.sin(angle)])
    return np.array([*place_m, 0.1, (angle + np.pi / 2 + np.pi) % (2 * np.pi) - np.pi])


def sight(
    drive: Callable[[int], Array],
    seconds: float,
    cameras: Sequence[str] = CAMERAS,
    robot: str = "ada",
    seed: int = 0,
) -> list[Sighting]:
    """Return sightings by cameras of 30 Hz that are out of step by 11 ms, in order of time."""
    rng, sightings = np.random.default_rng(seed), []
    for number, camera in enumerate(cameras):
        for frame in range(round(30 * seconds)):
            time_ns = START_NS + frame * NS_PER_S // 30 + 11 * number * MS
            noise = rng.normal(0.0, [NOISE_M, NOISE_M, NOISE_M, NOISE_RAD])
            sightings.append(Sighting(time_ns, camera, drive(time_ns) + noise, robot))
    return sorted(sightings, key=lambda one: one.time_ns)


def arrays(poses: Sequence[Array]) -> Sightings:
    """Return sightings without errors of the calibration."""
    count = len(poses)
    noise = np.broadcast_to(np.diag([NOISE_M**2] * 3 + [NOISE_RAD**2]), (count, 4, 4))
    return Sightings(np.array(poses), noise, np.zeros((count, 4, 0)), np.zeros((count, 0)))


def follow(
    sightings: Sequence[Sighting], settings: TrackSettings | None = None, tracks: RobotTracks | None = None
) -> list[Pose]:
    """Return the poses of tracks, one sighting after the other in the order of the list."""
    tracks = tracks or RobotTracks(settings)
    return [pose for one in sightings for pose in observe(tracks, one)]


def observe(tracks: RobotTracks, one: Sighting) -> Iterator[Pose]:
    """Yield the poses that one sighting gives: those of robots that were not seen before, and its own."""
    yield from tracks.coast_before(one.time_ns)
    yield from tracks.observe(one.camera, [(one.robot, 0)], [one.time_ns], arrays([one.pose]), [True], [True])


def place_of(pose: Pose) -> Array:
    """Return the position (3,) of a pose."""
    place: Array = pose.states.means[pose.state, :3]
    return place


def errors_m(poses: Sequence[Pose], drive: Callable[[int], Array]) -> Array:
    """Return the distances of poses from a known motion, (n,)."""
    return np.array([np.linalg.norm(place_of(pose) - drive(pose.time_ns)[:3]) for pose in poses])
