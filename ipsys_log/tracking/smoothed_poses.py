"""Smoothed poses of all robots of a log, from the positions of all cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Model, Position, Rig
from ipsys_log.tracking.frame_reader import FrameReader
from ipsys_log.tracking.history import History
from ipsys_log.tracking.smoother import smooth_track
from ipsys_log.tracking.tracks import Pose, Robot, RobotTracks, TrackSettings, gather_sightings
from ipsys_log.units import NS_PER_S

__all__ = ["Frame", "SmoothedPose", "smooth_positions"]


class Frame(NamedTuple):
    """The positions of one frame of a camera."""

    time_ns: int
    camera: str
    log_time_ns: int
    positions: Sequence[Position]


class SmoothedPose(NamedTuple):
    """A pose, and the log time of the frame of its sighting."""

    log_time_ns: int
    pose: Pose


# By the identity of the sightings of a frame: its log time, and flags of known covariances.
_Sources = dict[int, tuple[int, Sequence[bool]]]


def smooth_positions(
    frames: Sequence[Frame], rig: Rig, model: Model | None, settings: TrackSettings | None = None
) -> list[SmoothedPose]:
    """Return the smoothed poses of all robots, one for each instant of a sighting, in order of time.

    The filter runs over the frames in order of their capture times, and selects the sightings of each track.
    The order of the frames in the log has no effect.

    Parameters
    ----------
    frames : of all cameras, in any order.
    rig : the markers of the robots.
    model : the model of the positions; None for positions of another program.
    settings : the limits of tracks.
    """
    limits, reader = settings or TrackSettings(), FrameReader(model)
    reader.use_rig(rig)
    tracks, sources = RobotTracks(limits, reader.modes.fade_m, complete=True), _Sources()
    for frame in sorted(frames, key=lambda one: (one.time_ns, one.camera, one.log_time_ns)):
        seen = reader.read(frame.camera, frame.time_ns, frame.positions)
        if seen is not None:
            sources[id(seen.sightings)] = frame.log_time_ns, seen.has_covariance
            tracks.observe(
                seen.camera, seen.robots, seen.times_ns, seen.sightings, seen.inside, seen.has_covariance
            )
    poses = [
        pose
        for robot, history in tracks.histories()
        for pose in _smooth_track(robot, history, sources, limits, reader.modes.fade_m)
    ]
    return sorted(poses, key=lambda one: (one.pose.time_ns, str(one.pose.robot)))


def _smooth_track(
    robot: Robot,
    history: History,
    sources: _Sources,
    settings: TrackSettings,
    fade_m: NDArray[np.float64],
) -> Iterator[SmoothedPose]:
    records = history.records
    times_ns = [record.time_ns for record in records]
    durations_s = np.diff(times_ns) / NS_PER_S
    states = smooth_track(gather_sightings(records), durations_s, settings.motion, fade_m)
    for row, record in enumerate(records):
        # Sightings of one instant have equal states: the last one has the pose.
        if row + 1 == len(records) or times_ns[row + 1] > times_ns[row]:
            recent = history.recent(record.time_ns, settings.window_ns)
            flags = [one.inside for one in recent if one.inside is not None]
            log_time_ns, known = sources[id(record.sightings)]
            pose = Pose(
                robot,
                record.time_ns,
                states,
                row,
                tuple(sorted({one.camera for one in recent})),
                any(flags) if flags else None,
                known[record.sighting],
                age_ns=record.time_ns - times_ns[0],
            )
            yield SmoothedPose(log_time_ns, pose)
