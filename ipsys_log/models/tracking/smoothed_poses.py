"""Smoothing of whole tracks: the poses of all robots of a log, by the sightings before and after each.

The state is the motion (``filter.py``) and the m amplitudes of the calibration
(``bias_modes.py``), which are constant or fade with the way. The sightings determine their
differences between cameras and places, and leave the error that all sightings share. A filter that only
considers the amplitudes has no optimal smoother, so this one estimates them.
"""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Model, Position, Rig
from ipsys_log.models.tracking.filter import (
    MOTION,
    POSE,
    RATES,
    UNKNOWN_RAD2,
    MotionNoise,
    Sightings,
    States,
    start,
    transition,
)
from ipsys_log.models.tracking.frame_reader import FrameReader
from ipsys_log.models.tracking.history import Sighted, combine_seen
from ipsys_log.models.tracking.tracks import Pose, Robot, RobotTracks, TrackSettings, gather_sightings
from ipsys_log.units import NS_PER_S

_HEADING = 3
# The speed of a robot is that between two sightings this long before and after: cameras differ by some mm.
_SPEED_S = 0.1
# Sightings of a block: 40 MB with 21 amplitudes.
_BLOCK = 512
# A mean (s,) and its covariance (s, s).
_State = tuple[Array, Array]


def smooth_track(
    sightings: Sightings,
    durations_s: Array,
    noise: MotionNoise,
    fade_m: Array | None = None,
    block: int = _BLOCK,
    progress: Callable[[int], None] = lambda sightings: None,
) -> Iterator[States]:
    """Yield the motion of one robot by all sightings of its track: block by block, the last one first.

    The memory for the covariances of all amplitudes is that of one block. The first pass of the filter keeps
    only its state at the beginning of each block; the second pass filters one block again, and smooths it.
    The size of a block has no effect on the result.

    Parameters
    ----------
    sightings : n of one robot, in order of time.
    durations_s : (n - 1,), times between the sightings, at least 0.
    noise : the usual motion.
    fade_m : (m,), of the amplitudes, see :class:`~ipsys_log.models.tracking.filter.States`.
    block : sightings of a block.
    progress : called with the number of sightings of each block that is filtered, and of each one that is
        smoothed: the sum is 2 n.

    Yields
    ------
    States : of the sightings of a block in order of time. Those of the same instant are equal.

    References
    ----------
    Rauch, Tung and Striebel, AIAA Journal 1965. Covariances are sums of squares, as in the form of Joseph.
    """
    speeds_m_s, count = _speeds(sightings.poses[:, :2], durations_s), sightings.sensitivities.shape[2]

    def steps(first: int, last: int) -> tuple[Array, Array]:
        return _transition(durations_s[first:last], speeds_m_s[first:last], noise, fade_m, count)

    firsts = range(0, len(sightings.poses), block)
    begins = [_begin(sightings, noise)]
    for first in firsts[:-1]:
        means, covariances = _filter_block(begins[-1], sightings, first, *steps(first, first + block))
        begins.append((means[-1].copy(), covariances[-1].copy()))
        progress(block)
    progress(len(sightings.poses) - firsts[-1])
    later = begins[-1]  # not used: the last block has no step after it
    for first, begin in zip(reversed(firsts), reversed(begins), strict=True):
        forward, spread = steps(first, first + block)
        own = len(sightings.poses[first : first + block])
        means, covariances = _filter_block(begin, sightings, first, forward[: own - 1], spread[: own - 1])
        later = _smooth_block(means, covariances, forward, spread, later)
        both = (covariances + covariances.swapaxes(1, 2)) / 2
        # Copies: a view would keep the memory of all amplitudes.
        own_part, cross = both[:, :MOTION, :MOTION].copy(), -both[:, :MOTION, MOTION:]
        progress(own)
        yield States(means[:, :MOTION].copy(), own_part, cross)


def _smooth_block(means: Array, covariances: Array, forward: Array, spread: Array, later: _State) -> _State:
    """Replace the filtered states (b,) of a block by smoothed ones; return a copy of the first one.

    ``later`` is the smoothed state after the block, if there is a step from the last state to it.
    """
    gains, rest = _gains(covariances[: len(forward)], forward, spread)
    for n in range(len(forward) - 1, -1, -1):
        mean, covariance = (means[n + 1], covariances[n + 1]) if n + 1 < len(means) else later
        change = mean - forward[n] @ means[n]
        change[_HEADING] = _wrap(change[_HEADING])
        means[n] += gains[n] @ change
        covariances[n] = rest[n] + gains[n] @ covariance @ gains[n].T
    return means[0].copy(), covariances[0].copy()


def _speeds(points_m: Array, durations_s: Array) -> Array:
    """Return the speed (n - 1,) over each step, from sightings before and after it."""
    times_s = np.concatenate([[0.0], np.cumsum(durations_s)])
    first = np.maximum(np.searchsorted(times_s, times_s[:-1] - _SPEED_S, side="right") - 1, 0)
    last = np.minimum(np.searchsorted(times_s, times_s[1:] + _SPEED_S), len(times_s) - 1)
    way_m = np.linalg.norm(points_m[last] - points_m[first], axis=1)
    speeds: Array = way_m / np.maximum(times_s[last] - times_s[first], _SPEED_S)
    return speeds


def _begin(sightings: Sightings, noise: MotionNoise) -> _State:
    """Return the state after the first sighting."""
    first = start(sightings.take(np.array([0])), noise)
    size = MOTION + sightings.sensitivities.shape[2]
    mean, covariance = np.zeros(size), np.eye(size)
    mean[:MOTION], covariance[:MOTION, :MOTION] = first.means[0], first.covariances[0]
    # The errors of the filter are estimates minus truths.
    covariance[:MOTION, MOTION:], covariance[MOTION:, :MOTION] = -first.cross[0], -first.cross[0].T
    return mean, covariance


def _filter_block(
    begin: _State, sightings: Sightings, first: int, forward: Array, spread: Array
) -> tuple[Array, Array]:
    """Return the means (k + 1, s) and covariances (k + 1, s, s) of a state and after the next k sightings.

    ``begin`` is the state after the sighting ``first``.
    """
    count, size = len(forward) + 1, len(begin[0])
    means, covariances = np.empty((count, size)), np.empty((count, size, size))
    means[0], covariances[0] = begin
    for n in range(1, count):
        mean = forward[n - 1] @ means[n - 1]
        covariance = forward[n - 1] @ covariances[n - 1] @ forward[n - 1].T + spread[n - 1]
        means[n], covariances[n] = _update(mean, covariance, sightings, first + n)
    return means, covariances


def _update(mean: Array, covariance: Array, sightings: Sightings, n: int) -> tuple[Array, Array]:
    """Return the mean (s,) and the covariance (s, s) after a sighting, in the form of Joseph."""
    noise = sightings.noise[n]
    # A camera whose clock is late by d shows the robot v d behind.
    modes = sightings.sensitivities[n] - mean[RATES, None] * sightings.clock_s[n]
    difference = sightings.poses[n] - mean[POSE] - modes @ mean[MOTION:]
    difference[_HEADING] = _wrap(difference[_HEADING]) if noise[_HEADING, _HEADING] < UNKNOWN_RAD2 else 0.0
    across = covariance[:, POSE] + covariance[:, MOTION:] @ modes.T
    gain = np.linalg.solve(across[POSE] + modes @ across[MOTION:] + noise, across.T).T
    left = covariance - gain @ across.T
    observed = left[:, POSE] + left[:, MOTION:] @ modes.T
    after = left + (gain @ noise - observed) @ gain.T
    return mean + gain @ difference, (after + after.T) / 2


def _transition(
    durations_s: Array, speeds_m_s: Array, noise: MotionNoise, fade_m: Array | None, count: int
) -> tuple[Array, Array]:
    """Return the transitions (k, s, s) of motion and amplitudes, and the covariances of their noise."""
    forward = np.broadcast_to(
        np.eye(MOTION + count), (len(durations_s), MOTION + count, MOTION + count)
    ).copy()
    spread = np.zeros_like(forward)
    own = slice(0, MOTION)
    forward[:, own, own], spread[:, own, own] = transition(durations_s, speeds_m_s, noise)
    if fade_m is not None:
        kept = np.exp(-(speeds_m_s * durations_s)[:, None] / fade_m)
        amplitudes = np.arange(MOTION, MOTION + count)
        forward[:, amplitudes, amplitudes], spread[:, amplitudes, amplitudes] = kept, 1 - kept**2
    return forward, spread


def _gains(covariances: Array, forward: Array, spread: Array) -> tuple[Array, Array]:
    """Return the gains (k, s, s) of states by the next ones, and their covariances if the next are known."""
    cross = covariances @ forward.swapaxes(1, 2)
    ahead = forward @ cross + spread
    # Units differ by many orders of magnitude: with a diagonal of 1, the inverse loses no digits.
    units = np.sqrt(np.diagonal(ahead, axis1=1, axis2=2))
    scaled = ahead / units[:, :, None] / units[:, None]
    gains = np.linalg.solve(scaled, (cross / units[:, None]).swapaxes(1, 2)).swapaxes(1, 2) / units[:, None]
    kept = np.eye(gains.shape[1]) - gains @ forward
    rest = kept @ covariances @ kept.swapaxes(1, 2) + gains @ spread @ gains.swapaxes(1, 2)
    return gains, rest


def _wrap(angle_rad: float) -> float:
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


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
    progress : called with the share of the work after the reading of the frames: half of it is the filter of
        all frames, half the smoothing of the tracks.
    """
    limits, reader, sources = TrackSettings(), FrameReader(model), _Sources()
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
