"""Cleaning of trajectories: rows that are no poses, and headings that contradict those of the tracks."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Indices, Mask
from ipsys_log.statistics.ground_truth import wrap_angles
from ipsys_log.statistics.path_pairs import Body, gap_limit_s, jumps, search_turns, smooth_values
from ipsys_log.statistics.trajectories import Trajectory
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotate
from ipsys_log.vision.time_brackets import bracket_times

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


# Turns within 1 s that differ by more than this share are not of the same body; smaller turns tell nothing.
LARGEST_TURN_MISFIT, _LEAST_TURN_RAD = 0.5, 0.03


def _yaws(axes: Array) -> Array:
    """Return continuous headings (n,) of rotations (n, 3, 3), interpolated where they are unknown."""
    yaws = np.arctan2(axes[:, 1, 0], axes[:, 0, 0])
    known = np.flatnonzero(np.isfinite(yaws))
    return np.interp(np.arange(len(yaws)), known, np.unwrap(yaws[known]))


def turn_pairs(bodies: Sequence[Body]) -> list[tuple[Array, Array, Array, Array]]:
    """Return times and continuous headings of the other body, and those of the track, by robot."""
    pairs = []
    for body in bodies:
        seen = np.isfinite(body.heading_rad)
        pairs.append((body.other_s, _yaws(body.axes), body.track_s[seen], np.unwrap(body.heading_rad[seen])))
    return pairs


def turn_misfit(bodies: Sequence[Body], offset_s: float) -> float:
    """Return the median difference of the turns of both systems within 1 s, as a share of the turns."""
    apart, turned = [], []
    for other_s, other_rad, track_s, track_rad in turn_pairs(bodies):
        ends = [bracket_times(track_s, other_s + offset_s + late_s, 1.0) for late_s in (0.0, 1.0)]
        later = bracket_times(other_s, other_s + 1.0, 1.0)
        known = ends[0].is_known & ends[1].is_known & later.is_known
        track = (ends[1].mix(track_rad) - ends[0].mix(track_rad))[known]
        apart.append(np.abs(track - (later.mix(other_rad) - other_rad)[known]))
        turned.append(np.abs(track))
    turns, differences = np.concatenate(turned), np.concatenate(apart)
    if not len(turns) or float(np.quantile(turns, 0.75)) < _LEAST_TURN_RAD:
        return 0.0  # the robots do not turn
    return float(np.quantile(differences, 0.75) / np.quantile(turns, 0.75))


def _with_yaws(axes: Array, factor: float) -> Array:
    yaws = _yaws(axes) * factor
    turns = np.zeros((len(yaws), 3))
    turns[:, 2] = yaws
    return rotate(turns)


def _reordered(axes: Array, shift: int) -> Array:
    from scipy.spatial.transform import Rotation

    found = np.full_like(axes, np.nan)
    known = np.isfinite(axes).all(axis=(1, 2))
    found[known] = Rotation.from_quat(
        np.roll(Rotation.from_matrix(axes[known]).as_quat(), shift, 1)
    ).as_matrix()
    return found


# The faults of headings, each with the change that mends it.
_FAULTS: tuple[tuple[str, Callable[[Array], Array]], ...] = (
    ("they are degrees, not radians", lambda axes: _with_yaws(axes, np.pi / 180)),
    ("they are radians, not degrees", lambda axes: _with_yaws(axes, 180 / np.pi)),
    ("the quaternion is w x y z, not x y z w", lambda axes: _reordered(axes, -1)),
    ("the quaternion is x y z w, not w x y z", lambda axes: _reordered(axes, 1)),
    ("the rotations are inverted", lambda axes: np.swapaxes(axes, 1, 2)),
)


def use_right_headings(
    bodies: list[Body], offsets_s: Sequence[float], where: str
) -> tuple[list[Body], list[str]]:
    """Return the bodies, without rotations if these contradict the tracks, and a remark about that.

    Parameters
    ----------
    offsets_s : tried beside those at which the turn rates agree best.

    Raises
    ------
    IpsysError
        The headings agree only with another unit or another order of the quaternion.
    """

    def agree(some: Sequence[Body]) -> bool:
        tried = [*offsets_s, *(offset_s for offset_s, _ in search_turns(turn_pairs(some))[:2])]
        return any(turn_misfit(some, offset_s) < LARGEST_TURN_MISFIT for offset_s in tried)

    if agree(bodies):
        return bodies, []
    for reason, change in _FAULTS:
        if agree([body.with_axes(change(body.axes)) for body in bodies]):
            raise IpsysError(
                f"{where}: the headings do not fit the tracks, but do if {reason}; correct the file"
            )
    without = [body.with_axes(np.full_like(body.axes, np.nan)) for body in bodies]
    return without, ["its headings contradict the tracks, and are not used"]


def body_turn(body: Body, offset_s: float, rotation: Array) -> float:
    """Return the median turn from the axes of the marker to those of the other body, at an offset."""
    values, _, known = smooth_values(body.spline, body.track_s - offset_s)
    ahead = values[:, 3::3] @ rotation.T
    turns = np.arctan2(ahead[:, 1], ahead[:, 0]) - body.heading_rad
    turns = turns[known & np.isfinite(turns)]
    if not len(turns):
        return 0.0
    middle = float(np.angle(np.exp(1j * turns).mean()))
    return middle + float(np.median(wrap_angles(turns - middle)))
