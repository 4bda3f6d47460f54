"""Smoothed poses of all robots of a log, from the positions of all cameras."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Position
from ipsys_log.tracking.bias_modes import BiasModes
from ipsys_log.tracking.history import History
from ipsys_log.tracking.position_sightings import read_sightings
from ipsys_log.tracking.smoother import smooth
from ipsys_log.tracking.tracks import Pose, RobotTracks, TrackSettings, gather_sightings
from ipsys_log.units import NS_PER_S

__all__ = ["Frame", "SmoothedPose", "smooth_positions"]


class Frame(NamedTuple):
    """The positions of one frame, with the robot of each position."""

    time_ns: int
    camera: str
    log_time_ns: int
    positions: Sequence[Position]
    robots: Sequence[Hashable]


class SmoothedPose(NamedTuple):
    """A pose, and the log time of the frame of its sighting."""

    log_time_ns: int
    pose: Pose


def smooth_positions(
    frames: Sequence[Frame], modes: BiasModes, settings: TrackSettings | None = None
) -> list[SmoothedPose]:
    """Return the smoothed poses of all robots, one for each instant of a sighting, in order of time.

    The filter runs over the frames in order of their capture times, and selects the sightings of each track.
    The order of the frames in the log has no effect.

    Parameters
    ----------
    frames : of all cameras, in any order.
    modes : the errors of the calibration.
    settings : limits of the tracks.
    """
    limits = settings or TrackSettings()
    tracks = RobotTracks(limits, complete=True)
    # The sightings of a frame are one object: by its identity, the records find their frames again.
    sources: dict[int, _Source] = {}
    for frame in sorted((one for one in frames if one.positions), key=lambda one: (one.time_ns, one.camera)):
        sightings, rest_m2 = read_sightings(frame.camera, frame.positions, modes)
        known = [position.covariance_m2 is not None for position in frame.positions]
        sources[id(sightings)] = _Source(frame.log_time_ns, rest_m2, known)
        times_ns = [frame.time_ns + (position.time_offset_ns or 0) for position in frame.positions]
        inside = [position.inside for position in frame.positions]
        tracks.observe(frame.camera, frame.robots, times_ns, sightings, rest_m2, inside, known)
    poses = [
        pose
        for robot, history in tracks.histories()
        for pose in _smooth_track(robot, history, sources, limits)
    ]
    return sorted(poses, key=lambda one: (one.pose.time_ns, str(one.pose.robot)))


class _Source(NamedTuple):
    """What a track needs of a frame beside its sightings."""

    log_time_ns: int
    rest_m2: NDArray[np.float64]
    has_covariance: Sequence[bool]


def _smooth_track(
    robot: Hashable, history: History, sources: dict[int, _Source], settings: TrackSettings
) -> Iterator[SmoothedPose]:
    records = history.records
    times_ns = [record.time_ns for record in records]
    states = smooth(gather_sightings(records), np.diff(times_ns) / NS_PER_S, settings.motion)
    for row, record in enumerate(records):
        # Sightings of one instant have equal states: the last one has the pose.
        if row + 1 == len(records) or times_ns[row + 1] > times_ns[row]:
            recent = history.recent(record.time_ns, settings.window_ns)
            flags = [one.inside for one in recent if one.inside is not None]
            # The pose has the errors of all recent sightings, and none of them has all of its weight.
            rests_m2 = [sources[id(one.sightings)].rest_m2[one.sighting] for one in recent]
            source = sources[id(record.sightings)]
            pose = Pose(
                robot,
                record.time_ns,
                states,
                row,
                tuple(sorted({one.camera for one in recent})),
                any(flags) if flags else None,
                np.mean(rests_m2, axis=0),
                source.has_covariance[record.sighting],
                age_ns=record.time_ns - times_ns[0],
            )
            yield SmoothedPose(source.log_time_ns, pose)
