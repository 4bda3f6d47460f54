"""Smoothed poses of all robots of a log, from the positions of all cameras."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Model, Position, Rig
from ipsys_log.models.tracking.filter import States
from ipsys_log.models.tracking.frame_reader import FrameReader
from ipsys_log.models.tracking.history import Sighted, combine_seen
from ipsys_log.models.tracking.motion import MOTION
from ipsys_log.models.tracking.smoother import smooth_track
from ipsys_log.models.tracking.tracks import Pose, Robot, RobotTracks, TrackSettings, gather_sightings
from ipsys_log.units import NS_PER_S


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
    frames: Iterable[Frame],
    rig: Rig,
    model: Model | None,
    settings: TrackSettings | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> list[SmoothedPose]:
    """Return the smoothed poses of all robots, one for each instant of a sighting, in order of time.

    The filter runs over the frames in order of their capture times, and selects the sightings of each track.
    The order of the frames in the log has no effect. Only the sightings stay in memory until they are
    smoothed: neither the frames, nor the states of the filter.

    Parameters
    ----------
    frames : of all cameras, in any order.
    rig : the markers of the robots.
    model : the model of the positions; None for positions of another program.
    settings : the limits of tracks.
    progress : called with the share of the work after the reading of the frames: half of it is the filter of
        all frames, half the smoothing of the tracks.
    """
    limits, reader, sources = settings or TrackSettings(), FrameReader(model), _Sources()
    reader.use_rig(rig)
    tracks = _filter(frames, reader, sources, limits, lambda share: progress(share / 2))
    histories = [(robot, history.everything()) for robot, history in tracks.histories()]
    count = sum(len(records) for _, records in histories)
    smoother = _Smoother(sources, limits, reader.modes.fade_m, count, lambda share: progress((1 + share) / 2))
    poses = [pose for robot, records in histories for pose in smoother.smooth(robot, records)]
    return sorted(poses, key=lambda one: (one.pose.time_ns, str(one.pose.robot)))


def _filter(
    frames: Iterable[Frame],
    reader: FrameReader,
    sources: _Sources,
    settings: TrackSettings,
    progress: Callable[[float], None],
) -> RobotTracks:
    """Return the tracks of all frames with their complete histories; add the frames to ``sources``."""
    tracks = RobotTracks(settings, reader.modes.fade_m, complete=True)
    waiting = sorted(frames, key=lambda one: (one.time_ns, one.camera, one.log_time_ns))
    waiting.reverse()  # each frame is forgotten when it is read
    count = len(waiting)
    while waiting:
        frame = waiting.pop()
        seen = reader.read(frame.camera, frame.time_ns, frame.positions)
        if seen is not None:
            sources[id(seen.sightings)] = frame.log_time_ns, seen.has_covariance
            tracks.observe(
                seen.camera, seen.robots, seen.times_ns, seen.sightings, seen.inside, seen.has_covariance
            )
        progress(1 - len(waiting) / count)
    return tracks


@dataclass(slots=True, eq=False)
class _Smoother:
    """The smoother of tracks with ``count`` sightings; ``progress`` gets the share of its work."""

    sources: _Sources
    settings: TrackSettings
    fade_m: NDArray[np.float64]
    count: int
    progress: Callable[[float], None]
    done: int = 0

    def smooth(self, robot: Robot, records: Sequence[Sighted]) -> Iterator[SmoothedPose]:
        """Yield the smoothed poses of one track, the last one first."""
        times_ns = [record.time_ns for record in records]
        durations_s = np.diff(times_ns) / NS_PER_S
        end = len(records)
        for smoothed in smooth_track(
            gather_sightings(records), durations_s, self.settings.motion, self.fade_m, progress=self._advance
        ):
            first = end - len(smoothed.means)
            # A pose does not need the amplitudes.
            states = States(smoothed.means, smoothed.covariances, np.empty((end - first, MOTION, 0)))
            for place in range(end - 1, first - 1, -1):
                # Sightings of one instant have equal states: the last one has the pose.
                if place + 1 == len(records) or times_ns[place + 1] > times_ns[place]:
                    window = slice(
                        bisect_left(times_ns, times_ns[place] - self.settings.window_ns), place + 1
                    )
                    log_time_ns, known = self.sources[id(records[place].sightings)]
                    pose = Pose(
                        robot,
                        times_ns[place],
                        states,
                        place - first,
                        *combine_seen(tuple((one.camera, one.inside) for one in records[window])),
                        known[records[place].sighting],
                        age_ns=times_ns[place] - times_ns[0],
                    )
                    yield SmoothedPose(log_time_ns, pose)
            end = first

    def _advance(self, sightings: int) -> None:
        self.done += sightings
        # Each sighting is filtered, and then smoothed.
        self.progress(self.done / self.count / 2)
