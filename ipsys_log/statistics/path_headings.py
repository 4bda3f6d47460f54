"""Headings of another system beside those of the tracks: faults that their turns show."""

from collections.abc import Callable, Sequence

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array
from ipsys_log.statistics.ground_truth import wrap_angles
from ipsys_log.statistics.path_pairs import Body, search_turns, smooth_values
from ipsys_log.vision.poses import rotate
from ipsys_log.vision.time_brackets import bracket_times

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
