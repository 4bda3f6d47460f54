"""Rows of a trajectory that are no poses: repeated ones of a lost body, jumps, and poses after a reset."""

from dataclasses import replace

import numpy as np

from ipsys_log.messages import Array, Indices, Mask
from ipsys_log.statistics.path_pairs import gap_limit_s, jumps
from ipsys_log.statistics.trajectories import Trajectory
from ipsys_log.units import NS_PER_S

# A pose that stays the same to the last digit for this long is repeated: noise changes the digits of a
# measured one. A computed one repeats while its robot stands, which costs the alignment nothing.
_LEAST_REPEATS, _LEAST_REPEATED_S = 3, 0.1
# A step is a reset if it is longer and faster than that of any robot on a floor.
_RESET_M, _RESET_M_S = 0.3, 10.0
# After this time, a path has no longer come back from an excursion.
_COMES_BACK_S = 1.0
# Stamps come in bursts if this share of the intervals is shorter than this share of the usual one.
_BURST_SHARE, _SHORT_SHARE = 0.02, 0.03
# The delay of a stamp is measured against the earliest one within this time.
_BURST_WINDOW_S = 0.5


REPEATED = "repeated poses"


def clean_trajectory(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory without rows that are no poses; ``left_out`` counts them."""
    for reason, find in ((REPEATED, repeated), ("jumps", _jumping), ("poses after a reset", _after_reset)):
        is_bad = find(trajectory)
        if is_bad.any():
            left_out = (*trajectory.left_out, (reason, int(is_bad.sum())))
            trajectory = replace(select_rows(trajectory, ~is_bad), left_out=left_out)
    return trajectory


def select_rows(trajectory: Trajectory, kept: Mask) -> Trajectory:
    """Return a trajectory with some of its rows."""
    return replace(
        trajectory,
        times_ns=trajectory.times_ns[kept],
        points_m=trajectory.points_m[kept],
        quaternions=trajectory.quaternions[kept],
        covariances=None if trajectory.covariances is None else trajectory.covariances[kept],
    )


def repeated(trajectory: Trajectory) -> Mask:
    """Return which rows (n,) repeat the one before for a time; the first of them is a pose."""
    times_s, points_m = trajectory.times_ns / NS_PER_S, trajectory.points_m
    is_same = np.append(False, (points_m[1:] == points_m[:-1]).all(axis=1))
    starts = np.flatnonzero(~is_same)
    ends = np.append(starts[1:], len(is_same))
    lasts = (ends - starts >= _LEAST_REPEATS) & (times_s[ends - 1] - times_s[starts] >= _LEAST_REPEATED_S)
    return np.asarray(is_same & np.repeat(lasts, ends - starts))


def _jumping(trajectory: Trajectory) -> Mask:
    return jumps(trajectory.times_ns / NS_PER_S - trajectory.times_ns[0] / NS_PER_S, trajectory.points_m)


def _after_reset(trajectory: Trajectory) -> Mask:
    """Return the rows (n,) outside of the longest path without a reset; it may come back after some."""
    times_s, points_m = trajectory.times_ns / NS_PER_S, trajectory.points_m

    def is_reset(before: Indices, after: Indices) -> Mask:
        steps_m = np.linalg.norm(points_m[after] - points_m[before], axis=1)
        return np.asarray(steps_m > np.maximum(_RESET_M, _RESET_M_S * (times_s[after] - times_s[before])))

    rows = np.arange(len(times_s))
    starts = np.append(0, 1 + np.flatnonzero(is_reset(rows[:-1], rows[1:])))
    ends = np.append(starts[1:], len(rows)) - 1
    paths: list[int] = []
    for number, start in enumerate(starts.tolist()):
        earlier = np.flatnonzero(times_s[start] - times_s[ends[:number]] < _COMES_BACK_S)
        back = earlier[~is_reset(ends[earlier], np.full(len(earlier), start))]
        paths.append(paths[back[-1]] if len(back) else number)
    path = np.repeat(paths, ends - starts + 1)
    return np.asarray(path != np.bincount(path).argmax())


def even_stamps(trajectory: Trajectory) -> Trajectory:
    """Return a trajectory whose stamps, if they come in bursts, are at regular times.

    These are after the earliest of their neighbours, which waited least.
    """
    times_ns = trajectory.times_ns
    steps = np.diff(times_ns)
    if len(steps) < 10:
        return trajectory
    usual = (times_ns[-1] - times_ns[0]) / len(steps)
    if (steps < _SHORT_SHARE * usual).mean() < _BURST_SHARE or usual > gap_limit_s(
        times_ns / NS_PER_S
    ) * NS_PER_S:
        return trajectory
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    regular = np.arange(len(times_ns)) * usual
    late = (times_ns - times_ns[0]) - regular
    size = int(_BURST_WINDOW_S * NS_PER_S / usual) | 1
    earliest = uniform_filter1d(minimum_filter1d(late, size, mode="nearest"), size, mode="nearest")
    evened = times_ns[0] + np.round(regular + earliest).astype(np.int64)
    return replace(trajectory, times_ns=evened) if (np.diff(evened) > 0).all() else trajectory


def vertical_axis(trajectories: list[Array]) -> int:
    """Return the axis, 1 or 2, along which bodies on a floor do not move: y or z."""
    extents = np.max([np.ptp(np.quantile(p, [0.05, 0.95], axis=0), axis=0) for p in trajectories], axis=0)
    return 1 if extents[1] < 0.2 * min(extents[0], extents[2]) else 2
