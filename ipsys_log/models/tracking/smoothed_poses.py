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

from ipsys_log.messages import Array, Model, Position, Rig
from ipsys_log.models.tracking.filter import UNKNOWN_RAD2, Sightings, States, start
from ipsys_log.models.tracking.frame_reader import FrameReader
from ipsys_log.models.tracking.history import Sighted, combine_seen, gather_sightings
from ipsys_log.models.tracking.motion import FREE, LEVEL, Layout, MotionNoise, transition
from ipsys_log.models.tracking.tracks import (
    FREE_BODIES,
    Pose,
    Robot,
    RobotTracks,
    TrackSettings,
)
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotation, rotation_vector

_HEADING, _TURN = 3, slice(3, 6)
# The speed of a robot is that between two sightings this long before and after: cameras differ by some mm.
_SPEED_S = 0.1
# Sightings of a block: 40 MB with 21 amplitudes.
_BLOCK = 512


class _State(NamedTuple):
    """A mean (s,), its covariance (s, s), and the rotation (3, 3) of a free body.

    The turn of the mean of a free body is 0, as in :class:`~ipsys_log.models.tracking.filter.States`.
    """

    mean: Array
    covariance: Array
    turn: Array | None = None


class _Block(NamedTuple):
    """States (k, s), (k, s, s) of a block, and rotations (k, 3, 3) of a free body."""

    means: Array
    covariances: Array
    turns: Array | None

    def state(self, n: int) -> _State:
        """Return a copy of a state: a view would keep the memory of the block."""
        turn = None if self.turns is None else self.turns[n].copy()
        return _State(self.means[n].copy(), self.covariances[n].copy(), turn)

    def put(self, n: int, state: _State) -> None:
        """Replace a state; a turn of its mean becomes a part of its rotation."""
        self.means[n], self.covariances[n] = state.mean, state.covariance
        if self.turns is not None and state.turn is not None:
            self.turns[n] = rotation(state.mean[_TURN]) @ state.turn
            self.means[n, _TURN] = 0.0


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
    layout = LEVEL if sightings.turns is None else FREE
    count, motion = sightings.sensitivities.shape[2], layout.size
    speeds_m_s = _speeds(sightings.poses[:, : layout.accelerated], durations_s)

    def steps(first: int, last: int) -> tuple[Array, Array]:
        own = slice(first, last)
        return _transition(durations_s[own], speeds_m_s[own], noise, fade_m, count, layout)

    firsts = range(0, len(sightings.poses), block)
    begins = [_begin(sightings, noise, layout)]
    for first in firsts[:-1]:
        filtered = _filter_block(begins[-1], sightings, first, *steps(first, first + block))
        begins.append(filtered.state(-1))
        progress(block)
    progress(len(sightings.poses) - firsts[-1])
    later = begins[-1]  # not used: the last block has no step after it
    for first, begin in zip(reversed(firsts), reversed(begins), strict=True):
        forward, spread = steps(first, first + block)
        own = len(sightings.poses[first : first + block])
        states = _filter_block(begin, sightings, first, forward[: own - 1], spread[: own - 1])
        later = _smooth_block(states, forward, spread, later)
        both = (states.covariances + states.covariances.swapaxes(1, 2)) / 2
        # Copies: a view would keep the memory of all amplitudes.
        own_part, cross = both[:, :motion, :motion].copy(), -both[:, :motion, motion:]
        progress(own)
        yield States(states.means[:, :motion].copy(), own_part, cross, turns=states.turns)


def _smooth_block(states: _Block, forward: Array, spread: Array, later: _State) -> _State:
    """Replace the filtered states of a block by smoothed ones; return a copy of the first one.

    ``later`` is the smoothed state after the block, if there is a step from the last state to it.
    """
    gains, rest = _gains(states.covariances[: len(forward)], forward, spread)
    for n in range(len(forward) - 1, -1, -1):
        own = states.state(n)
        after = states.state(n + 1) if n + 1 < len(states.means) else later
        change = after.mean - forward[n] @ own.mean
        if own.turn is None or after.turn is None:
            change[_HEADING] = _wrap(change[_HEADING])
        else:
            # The mean of the later state has no turn, so the change is that of the prediction.
            predicted = rotation(-change[_TURN]) @ own.turn
            change[_TURN] = rotation_vector(after.turn @ predicted.T)
        covariance = rest[n] + gains[n] @ after.covariance @ gains[n].T
        states.put(n, _State(own.mean + gains[n] @ change, covariance, own.turn))
    return states.state(0)


def _speeds(points_m: Array, durations_s: Array) -> Array:
    """Return the speed (n - 1,) over each step, from sightings before and after it."""
    times_s = np.concatenate([[0.0], np.cumsum(durations_s)])
    first = np.maximum(np.searchsorted(times_s, times_s[:-1] - _SPEED_S, side="right") - 1, 0)
    last = np.minimum(np.searchsorted(times_s, times_s[1:] + _SPEED_S), len(times_s) - 1)
    way_m = np.linalg.norm(points_m[last] - points_m[first], axis=1)
    speeds: Array = way_m / np.maximum(times_s[last] - times_s[first], _SPEED_S)
    return speeds


def _begin(sightings: Sightings, noise: MotionNoise, layout: Layout) -> _State:
    """Return the state after the first sighting."""
    first, motion = start(sightings.take(np.array([0])), noise), layout.size
    size = motion + sightings.sensitivities.shape[2]
    mean, covariance = np.zeros(size), np.eye(size)
    mean[:motion], covariance[:motion, :motion] = first.means[0], first.covariances[0]
    # The errors of the filter are estimates minus truths.
    covariance[:motion, motion:], covariance[motion:, :motion] = -first.cross[0], -first.cross[0].T
    return _State(mean, covariance, None if first.turns is None else first.turns[0])


def _filter_block(begin: _State, sightings: Sightings, first: int, forward: Array, spread: Array) -> _Block:
    """Return the states of a block: a state, and those after the next k sightings.

    ``begin`` is the state after the sighting ``first``.
    """
    count, size = len(forward) + 1, len(begin.mean)
    turns = None if begin.turn is None else np.empty((count, 3, 3))
    states = _Block(np.empty((count, size)), np.empty((count, size, size)), turns)
    states.put(0, begin)
    for n in range(1, count):
        before = states.state(n - 1)
        mean = forward[n - 1] @ before.mean
        covariance = forward[n - 1] @ before.covariance @ forward[n - 1].T + spread[n - 1]
        states.put(n, _update(_State(mean, covariance, before.turn), sightings, first + n))
    return states


def _update(before: _State, sightings: Sightings, n: int) -> _State:
    """Return the state after a sighting, in the form of Joseph."""
    mean, covariance, turn = before
    layout, noise, seen = LEVEL if turn is None else FREE, sightings.noise[n], sightings.take(np.array([n]))
    motion = layout.size
    if turn is not None:
        turn, mean = rotation(mean[_TURN]) @ turn, mean.copy()
        mean[_TURN] = 0.0
    # A camera whose clock is late by d shows the robot v d behind.
    modes = sightings.sensitivities[n] - mean[layout.rates, None] * sightings.clock_s[n]
    difference = sightings.poses[n] - seen.rows(mean[None, :, None], layout)[0, :, 0] - modes @ mean[motion:]
    if turn is not None and sightings.turns is not None:
        # The turn of the sighting is 0, so the difference is minus the expected turn.
        turned = rotation(-difference[_TURN]) @ turn
        difference[_TURN] = rotation_vector(sightings.turns[n] @ turned.T)
    else:
        known = noise[_HEADING, _HEADING] < UNKNOWN_RAD2
        difference[_HEADING] = _wrap(difference[_HEADING]) if known else 0.0
    across = seen.columns(covariance[None], layout)[0] + covariance[:, motion:] @ modes.T
    spread = seen.rows(across[None], layout)[0] + modes @ across[motion:] + noise
    gain = np.linalg.solve(spread, across.T).T
    left = covariance - gain @ across.T
    observed = seen.columns(left[None], layout)[0] + left[:, motion:] @ modes.T
    after = left + (gain @ noise - observed) @ gain.T
    return _State(mean + gain @ difference, (after + after.T) / 2, turn)


def _transition(
    durations_s: Array,
    speeds_m_s: Array,
    noise: MotionNoise,
    fade_m: Array | None,
    count: int,
    layout: Layout,
) -> tuple[Array, Array]:
    """Return the transitions (k, s, s) of motion and amplitudes, and the covariances of their noise."""
    size = layout.size + count
    forward = np.broadcast_to(np.eye(size), (len(durations_s), size, size)).copy()
    spread = np.zeros_like(forward)
    own = slice(0, layout.size)
    forward[:, own, own], spread[:, own, own] = transition(durations_s, speeds_m_s, noise, layout=layout)
    if fade_m is not None:
        kept = np.exp(-(speeds_m_s * durations_s)[:, None] / fade_m)
        amplitudes = np.arange(layout.size, size)
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
    reader, sources = FrameReader(model), _Sources()
    reader.use_rig(rig)
    both = _filter(frames, reader, sources, lambda share: progress(share / 2))
    histories = [[(robot, one.everything()) for robot, one in tracks.histories()] for tracks in both]
    count = sum(len(records) for own in histories for _, records in own)
    smoother = _Smoother(sources, count, lambda share: progress((1 + share) / 2))
    poses = [
        pose
        for own, settings, fade_m in zip(
            histories, (TrackSettings(), FREE_BODIES), (reader.modes.fade_m, None), strict=True
        )
        for robot, records in own
        for pose in smoother.smooth(robot, records, settings, fade_m)
    ]
    return sorted(poses, key=lambda one: (one.pose.time_ns, str(one.pose.robot)))


def _filter(
    frames: Iterable[Frame], reader: FrameReader, sources: _Sources, progress: Callable[[float], None]
) -> tuple[RobotTracks, RobotTracks]:
    """Return the tracks of level robots and of free bodies in all frames, with their complete histories.

    The frames are added to ``sources``.
    """
    level = RobotTracks(fade_m=reader.modes.fade_m, complete=True)
    free = RobotTracks(FREE_BODIES, complete=True)
    waiting = sorted(frames, key=lambda one: (one.time_ns, one.camera, one.log_time_ns))
    waiting.reverse()  # each frame is forgotten when it is read
    count = len(waiting)
    while waiting:
        frame = waiting.pop()
        for seen in reader.read(frame.camera, frame.time_ns, frame.positions):
            sources[id(seen.sightings)] = frame.log_time_ns, seen.has_covariance
            tracks = level if seen.sightings.turns is None else free
            tracks.observe(
                seen.camera, seen.robots, seen.times_ns, seen.sightings, seen.inside, seen.has_covariance
            )
        progress(1 - len(waiting) / count)
    return level, free


@dataclass(slots=True, eq=False)
class _Smoother:
    """The smoother of tracks with ``count`` sightings; ``progress`` gets the share of its work."""

    sources: _Sources
    count: int
    progress: Callable[[float], None]
    done: int = 0

    def smooth(
        self, robot: Robot, records: Sequence[Sighted], settings: TrackSettings, fade_m: Array | None
    ) -> Iterator[SmoothedPose]:
        """Yield the smoothed poses of one track, the last one first."""
        times_ns = [record.time_ns for record in records]
        durations_s = np.diff(times_ns) / NS_PER_S
        end = len(records)
        for smoothed in smooth_track(
            gather_sightings(records), durations_s, settings.motion, fade_m, progress=self._advance
        ):
            first = end - len(smoothed.means)
            # A pose does not need the amplitudes.
            none = np.empty((end - first, smoothed.layout.size, 0))
            states = States(smoothed.means, smoothed.covariances, none, turns=smoothed.turns)
            for place in range(end - 1, first - 1, -1):
                # Sightings of one instant have equal states: the last one has the pose.
                if place + 1 == len(records) or times_ns[place + 1] > times_ns[place]:
                    window = slice(bisect_left(times_ns, times_ns[place] - settings.window_ns), place + 1)
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
