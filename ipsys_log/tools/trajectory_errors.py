"""Trajectory metrics of tracks against ground truth: absolute trajectory error and relative pose error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, ErrorStatistics
from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.ground_truth import LONGEST_GAP_NS, TrackedPath, last_poses
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.time_brackets import TimeBrackets, bracket_times

Places = NDArray[np.int64]

# The distances (m) and times (s) of the relative pose error.
DELTAS = ((1.0, "m"), (1.0, "s"))
# A pair counts if its distance differs from the stated one by at most this share, as in evo;
_DISTANCE_SHARE = 0.1
# or if its time differs by at most this share of the usual interval.
_INTERVAL_SHARE = 0.5
TRANSLATION, DISTANCE = "translation_part", "point_distance"


class RelativeErrors(NamedTuple):
    """The relative pose error over a distance or a time.

    ``relation`` is ``translation_part``, which needs headings, or ``point_distance``. ``errors_m`` is (n,).
    """

    delta: float
    unit: str
    relation: str
    errors_m: Array

    @property
    def summary(self) -> ErrorStatistics:
        return error_statistics(self.errors_m, independent=False)


class TrajectoryErrors(NamedTuple):
    """The errors of the track of a robot, or of all with the name ``""``.

    ``offsets_m`` (n, 3) are the positions of the track minus the true ones. ``relative`` lacks a distance or
    a time that no pair has.
    """

    robot: str
    offsets_m: Array
    relative: tuple[RelativeErrors, ...]

    @property
    def absolute_3d(self) -> ErrorStatistics:
        """The absolute trajectory error (ATE) in space, without a further alignment."""
        return error_statistics(np.linalg.norm(self.offsets_m, axis=1), independent=False)

    @property
    def absolute_2d(self) -> ErrorStatistics:
        """The absolute trajectory error (ATE) on the floor."""
        return error_statistics(np.linalg.norm(self.offsets_m[:, :2], axis=1), independent=False)


def trajectory_errors(
    tracks: Mapping[int, TrackedPath],
    ground_truth: Mapping[int, TrackedPath],
    deltas: Sequence[tuple[float, str]] = DELTAS,
) -> list[TrajectoryErrors]:
    """Return the absolute trajectory error (ATE) and the relative pose error (RPE) of each robot.

    All instants of a track with a ground truth count. The truth is interpolated linearly between instants up
    to 0.1 s apart. A pair of the RPE is each instant with the later one that is nearest to ``delta``: within
    10 % of a distance along the true path, or within half an interval of a time.

    Parameters
    ----------
    deltas : distances in ``m`` or times in ``s`` of the relative pose error.

    References
    ----------
    Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, eq. (1) to (5), with one
    difference: the ATE is without an alignment. Grupp, evo, 2017: ``evo_ape`` and
    ``evo_rpe --all_pairs --pairs_from_reference``.
    """
    found = []
    for marker_id, track in sorted(tracks.items()):
        if marker_id in ground_truth:
            errors = _errors_of(track, ground_truth[marker_id], deltas)
            if errors is not None:
                found.append(errors)
    return found


def pool_trajectories(trajectories: Sequence[TrajectoryErrors]) -> TrajectoryErrors:
    """Return the errors of all robots as those of one; the pairs stay within each robot."""
    kinds = dict.fromkeys((r.delta, r.unit, r.relation) for one in trajectories for r in one.relative)
    relative = [
        RelativeErrors(
            *kind,
            np.concatenate([r.errors_m for one in trajectories for r in one.relative if r[:3] == kind]),
        )
        for kind in kinds
    ]
    return TrajectoryErrors("", np.vstack([one.offsets_m for one in trajectories]), tuple(relative))


def _errors_of(
    track: TrackedPath, truth: TrackedPath, deltas: Sequence[tuple[float, str]]
) -> TrajectoryErrors | None:
    rows = last_poses(track.positions)
    times_ns = track.positions.times_ns[rows]
    brackets = bracket_times(truth.positions.times_ns, times_ns, LONGEST_GAP_NS)
    is_known = brackets.is_known
    if not is_known.any():
        return None
    rows = rows[is_known]
    points_m, headings_rad = track.positions.points_m[rows], track.headings_rad[rows]
    times_ns, true_m = times_ns[is_known], brackets.mix(truth.positions.points_m)[is_known]
    true_rad = _mix_headings(brackets, truth.headings_rad)[is_known]
    has_headings = np.isfinite(headings_rad) & np.isfinite(true_rad)
    used = has_headings if has_headings.any() else np.ones(len(times_ns), dtype=np.bool_)
    relative = _relative_errors(
        times_ns[used],
        (points_m[used], true_m[used]),
        (headings_rad[used], true_rad[used]) if has_headings.any() else None,
        deltas,
    )
    return TrajectoryErrors(track.robot, points_m - true_m, tuple(relative))


def _mix_headings(brackets: TimeBrackets, known_rad: Array) -> Array:
    """Return headings (k,) between those of the truth (n,), along the shorter arc; NaN if unknown."""
    start_rad, end_rad = known_rad[brackets.before], known_rad[brackets.after]
    arc_rad = (end_rad - start_rad + np.pi) % (2 * np.pi) - np.pi
    return np.asarray(start_rad + brackets.share * arc_rad)


def _relative_errors(
    times_ns: NDArray[np.int64],
    points_m: tuple[Array, Array],
    headings_rad: tuple[Array, Array] | None,
    deltas: Sequence[tuple[float, str]],
) -> list[RelativeErrors]:
    steps_m = np.linalg.norm(np.diff(points_m[1], axis=0), axis=1)
    passed = {"m": np.append(0.0, np.cumsum(steps_m)), "s": (times_ns - times_ns[0]) / NS_PER_S}
    intervals_s = np.diff(passed["s"])
    half_s = _INTERVAL_SHARE * float(np.median(intervals_s)) if len(intervals_s) else 0.0
    found = []
    for delta, unit in deltas:
        start, end = pairs_at(passed[unit], delta, half_s if unit == "s" else _DISTANCE_SHARE * delta)
        if len(start):
            moves_m = [rows[end] - rows[start] for rows in points_m]
            if headings_rad is None:
                lengths_m = [np.linalg.norm(move_m, axis=1) for move_m in moves_m]
                found.append(RelativeErrors(delta, unit, DISTANCE, np.abs(lengths_m[0] - lengths_m[1])))
                continue
            own_m = [_turned_back(m, rad[start]) for m, rad in zip(moves_m, headings_rad, strict=True)]
            errors_m = np.linalg.norm(own_m[0] - own_m[1], axis=1)
            found.append(RelativeErrors(delta, unit, TRANSLATION, errors_m))
    return found


def pairs_at(passed: Array, delta: float, tolerance: float) -> tuple[Places, Places]:
    """Return pairs of places, (k,) and (k,), between which a quantity grows by ``delta``.

    Parameters
    ----------
    passed : (n,), not decreasing: the distance or the time since the start.
    tolerance : the largest difference from ``delta``, in the unit of ``passed``.

    Examples
    --------
    >>> [places.tolist() for places in pairs_at(np.array([0.0, 0.5, 1.0, 1.5]), 1.0, 0.1)]
    [[0, 1], [2, 3]]
    """
    start = np.arange(len(passed) - 1)
    above = np.searchsorted(passed, passed[start] + delta).clip(start + 1, len(passed) - 1)
    # The first place of a stop counts.
    below = np.maximum(np.searchsorted(passed, passed[np.maximum(above - 1, 0)]), start + 1)
    misses = [np.abs(passed[place] - passed[start] - delta) for place in (below, above)]
    end = np.where(misses[0] <= misses[1], below, above)
    kept = np.minimum(*misses) <= tolerance
    return start[kept], end[kept]


def _turned_back(moves_m: Array, headings_rad: Array) -> Array:
    """Return moves (n, 3) in the coordinates of a robot with headings (n,)."""
    cos, sin = np.cos(headings_rad), np.sin(headings_rad)
    x_m, y_m, z_m = moves_m.T
    return np.column_stack([cos * x_m + sin * y_m, cos * y_m - sin * x_m, z_m])
