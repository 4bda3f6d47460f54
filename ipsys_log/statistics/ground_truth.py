"""Ground truth: true positions of markers; errors, ATE and RPE of positions and tracks against it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, ErrorStatistics, Indices, Mask, Message, Times, Tracks
from ipsys_log.statistics.accuracy import error_statistics
from ipsys_log.statistics.calibration_points import TimedPoints, still_interval
from ipsys_log.statistics.tape import RiggedMeasurement
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotate, turns_about_z
from ipsys_log.vision.time_brackets import TimeBrackets, bracket_times

_SAME_HEIGHT_M = 0.005
# Longest gap for linear interpolation. For a robot with 2 m/s and 2.5 rad/s, its error is 0.7 mm over 1/30 s,
# and 6 mm over 0.1 s.
LONGEST_GAP_NS = NS_PER_S // 10
_NO_ROTATION = (math.nan,) * 3


class TrackErrors(NamedTuple):
    """The 3D errors and the floor errors of tracks at the instants that count, and at the others.

    Attributes
    ----------
    space, floor : errors at the instants that count; over all instants if none counts.
    counted, instants : number of instants that count, and of all instants with a ground truth.
    others : the errors in space and on the floor at the instants that do not count; None if all count.
    whole : the errors in space and on the floor over all instants.
    """

    space: ErrorStatistics
    floor: ErrorStatistics
    counted: int
    instants: int
    others: tuple[ErrorStatistics, ErrorStatistics] | None
    whole: tuple[ErrorStatistics, ErrorStatistics]


@dataclass(frozen=True, slots=True, eq=False)
class TrackedPath:
    """The positions of a robot in order of time, and its headings (n,) in rad, NaN where there is none.

    ``rotations_rad`` (n, 3) are the rotation vectors of a body that is not level; None for a level one.
    """

    robot: str
    positions: TimedPoints
    headings_rad: Array
    rotations_rad: Array | None = None

    def axes_at(self, times_ns: Times) -> Array:
        """Return the rotations (k, 3, 3) to the world at times (k,); NaN in gaps and for a level robot."""
        rows = last_poses(self.positions)
        assert self.rotations_rad is not None
        brackets = bracket_times(self.positions.times_ns[rows], times_ns, LONGEST_GAP_NS)
        found = _mix_axes(brackets, rotate(self.rotations_rad[rows]))
        found[~brackets.is_known] = np.nan
        return found


def gather_tracks(messages: Iterable[Message]) -> dict[int, TimedPoints]:
    """Return positions of tracks by marker, in order of time; those of equal time in log order.

    Predicted positions of unseen robots are left out.
    """
    return {marker_id: path.positions for marker_id, path in gather_paths(messages).items()}


def gather_paths(messages: Iterable[Message]) -> dict[int, TrackedPath]:
    """Return the positions of :func:`gather_tracks` with headings and the names of the robots, by marker."""
    rows: dict[int, list[tuple[float, ...]]] = {}
    robots: dict[int, str] = {}
    for message in messages:
        if isinstance(message.payload, Tracks):
            for track in (one for one in message.payload.tracks if one.coasting_ns is None):
                heading_rad = math.nan if track.heading_rad is None else track.heading_rad
                turn_rad = () if track.rotation_rad is None else tuple(track.rotation_rad.tolist())
                row = (message.publish_time_ns, track.x_m, track.y_m, track.z_m, heading_rad, *turn_rad)
                rows.setdefault(track.id, []).append(row)
                robots.setdefault(track.id, track.robot)
    for values in rows.values():
        values.sort(key=lambda row: row[0])
    return {
        marker_id: TrackedPath(
            robots[marker_id],
            TimedPoints(
                np.array([row[0] for row in values], dtype=np.int64),
                np.array([row[1:4] for row in values], dtype=np.float64),
            ),
            np.array([row[4] for row in values], dtype=np.float64),
            np.array([row[5:] or _NO_ROTATION for row in values]) if any(row[5:] for row in values) else None,
        )
        for marker_id, values in rows.items()
    }


def true_points(
    places: Iterable[RiggedMeasurement], ground_truth: Mapping[int, TimedPoints]
) -> dict[str, NDArray[np.float64]]:
    """Return the true position of each measured marker, (3,) in m by id, if the ground truth is known."""
    points = {}
    for place in places:
        measurement = place.measurement
        known = ground_truth.get(measurement.marker_id if measurement.marker_id is not None else -1)
        if known is not None and (interval := still_interval(known, measurement.timestamp)) is not None:
            within = (known.times_ns >= interval[0]) & (known.times_ns <= interval[1])
            points[measurement.id] = known.points_m[within].mean(axis=0)
    return points


def track_errors(
    tracks: Mapping[int, TimedPoints], ground_truth: Mapping[int, TimedPoints], at_track_height: bool = False
) -> TrackErrors | None:
    """Return the 3D errors and the floor errors of tracks against the ground truth at the same instants.

    A rolling shutter exposes a marker some time after the frame's instant. The true position between two
    instants of the ground truth, up to 0.1 s apart, is therefore interpolated linearly.

    Parameters
    ----------
    at_track_height : True if only the instants count at which a marker has the height of its track. Models
        with a known marker height are not valid while a user lifts the marker for a measurement. The errors
        at the other instants stand beside.

    Returns
    -------
    The error statistics; None if no instant of a track has a ground truth.
    """
    offsets = []
    for marker_id, track in tracks.items():
        known = ground_truth.get(marker_id)
        if known is None:
            continue
        rows = last_poses(track)
        truth = bracket_times(known.times_ns, track.times_ns[rows], LONGEST_GAP_NS)
        offsets_m = track.points_m[rows] - truth.mix(known.points_m)
        offsets.append(offsets_m[truth.is_known])
    rows_m = np.vstack([np.zeros((0, 3)), *offsets])
    if not len(rows_m):
        return None
    counts = np.abs(rows_m[:, 2]) < _SAME_HEIGHT_M if at_track_height else np.ones(len(rows_m), dtype=bool)
    whole = _statistics(rows_m)
    space, floor = _statistics(rows_m[counts]) if counts.any() else whole
    others = None if counts.all() else _statistics(rows_m[~counts])
    return TrackErrors(space, floor, int(counts.sum()), len(rows_m), others, whole)


def last_poses(track: TimedPoints) -> Indices:
    """Return the rows of a track with the last pose of each instant, in order of time.

    Tracks of earlier versions have a pose of each camera at an instant; the last one uses all cameras.
    """
    return len(track.times_ns) - 1 - np.unique(track.times_ns[::-1], return_index=True)[1]


def _statistics(offsets_m: Array) -> tuple[ErrorStatistics, ErrorStatistics]:
    return (
        error_statistics(np.linalg.norm(offsets_m, axis=1), independent=False),
        error_statistics(np.linalg.norm(offsets_m[:, :2], axis=1), independent=False),
    )


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

    ``relation`` is ``translation_part``, which needs rotations, or ``point_distance``. ``errors_m`` is (n,).
    ``errors_rad`` (n,) are the angles of the rotation error; None without rotations.
    """

    delta: float
    unit: str
    relation: str
    errors_m: Array
    errors_rad: Array | None = None

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


class PosePairs(NamedTuple):
    """Poses of a trajectory and the true ones at the same n instants.

    ``axes`` and ``true_axes`` (n, 3, 3) are rotations, NaN where unknown. Those of a level robot are of its
    heading.
    """

    times_ns: NDArray[np.int64]
    points_m: Array
    axes: Array
    true_m: Array
    true_axes: Array

    @property
    def is_turned(self) -> Mask:
        """The instants with both rotations (n,)."""
        return np.asarray(np.isfinite(self.axes + self.true_axes).all(axis=(1, 2)))

    def part(self, rows: Mask | Indices) -> "PosePairs":
        """Return the pairs of some instants."""
        return PosePairs(self.times_ns[rows], *(values[rows] for values in self[1:]))


def trajectory_errors(
    tracks: Mapping[int, TrackedPath], ground_truth: Mapping[int, TrackedPath]
) -> list[TrajectoryErrors]:
    """Return the absolute trajectory error (ATE) and the relative pose error (RPE) of each robot.

    All instants of a track with a ground truth count. The truth is interpolated linearly between instants up
    to 0.1 s apart. A pair of the RPE is each instant with the later one that is nearest to a distance
    or a time of ``DELTAS``: within 10 % of a distance along the true path, or half an interval of a time.

    References
    ----------
    Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, eq. (1) to (5), with one
    difference: the ATE is without an alignment. Grupp, evo, 2017: ``evo_ape`` and
    ``evo_rpe --all_pairs --pairs_from_reference``.
    """
    found = []
    for marker_id, track in sorted(tracks.items()):
        if marker_id in ground_truth:
            errors = _errors_of(track, ground_truth[marker_id])
            if errors is not None:
                found.append(errors)
    return found


def pool_trajectories(trajectories: Sequence[TrajectoryErrors]) -> TrajectoryErrors:
    """Return the errors of all robots as those of one; the pairs stay within each robot."""
    kinds = dict.fromkeys((r.delta, r.unit, r.relation) for one in trajectories for r in one.relative)
    relative = [
        RelativeErrors(
            *kind, np.concatenate([r.errors_m for one in trajectories for r in one.relative if r[:3] == kind])
        )
        for kind in kinds
    ]
    return TrajectoryErrors("", np.vstack([one.offsets_m for one in trajectories]), tuple(relative))


def _errors_of(track: TrackedPath, truth: TrackedPath) -> TrajectoryErrors | None:
    pairs = pose_pairs(track, truth)
    if not len(pairs.times_ns):
        return None
    return TrajectoryErrors(track.robot, pairs.points_m - pairs.true_m, tuple(relative_errors(pairs)))


def pose_pairs(track: TrackedPath, truth: TrackedPath) -> PosePairs:
    """Return the poses of a track with a ground truth, and the true ones at the same instants."""
    rows = last_poses(track.positions)
    times_ns = track.positions.times_ns[rows]
    brackets = bracket_times(truth.positions.times_ns, times_ns, LONGEST_GAP_NS)
    is_known = brackets.is_known
    rows = rows[is_known]
    if track.rotations_rad is not None and truth.rotations_rad is not None:
        axes, true_axes = rotate(track.rotations_rad[rows]), truth.axes_at(times_ns[is_known])
    else:
        # Most commands turn nothing about other axes, and scipy takes long to load.
        start_rad, end_rad = truth.headings_rad[brackets.before], truth.headings_rad[brackets.after]
        true_rad = start_rad + brackets.share * wrap_angles(end_rad - start_rad)
        axes, true_axes = turns_about_z(track.headings_rad[rows]), turns_about_z(true_rad[is_known])
    true_m = brackets.mix(truth.positions.points_m)[is_known]
    return PosePairs(times_ns[is_known], track.positions.points_m[rows], axes, true_m, true_axes)


def _mix_axes(brackets: TimeBrackets, axes: Array) -> Array:
    """Return rotations (k, 3, 3) between known ones (n, 3, 3), along the shortest turn; NaN if unknown."""
    from scipy.spatial.transform import Rotation

    start, end = axes[brackets.before], axes[brackets.after]
    found = np.full_like(start, np.nan)
    known = np.isfinite(start + end).all(axis=(1, 2))
    if known.any():
        turns = Rotation.from_matrix(start[known].swapaxes(1, 2) @ end[known]).as_rotvec()
        found[known] = start[known] @ rotate(brackets.share[known, None] * turns)
    return found


def turns_between(first: Array, second: Array) -> Array:
    """Return the angles (n,) in rad between rotations (n, 3, 3): exact for small ones, too."""
    sines = np.linalg.norm(first - second, axis=(1, 2)) / np.sqrt(8.0)
    return np.asarray(2 * np.arcsin(np.minimum(sines, 1.0)))


def wrap_angles(angles_rad: Array) -> Array:
    """Return angles between -pi and pi."""
    return np.asarray((angles_rad + np.pi) % (2 * np.pi) - np.pi)


def relative_errors(
    pairs: PosePairs, deltas: Sequence[tuple[float, str]] = DELTAS, share: float = _DISTANCE_SHARE
) -> list[RelativeErrors]:
    """Return the relative pose errors over distances and times; none for one that no two instants have.

    With rotations, only the instants with a rotation count. A pair is within ``share`` of a distance.
    """
    if is_turned := bool(pairs.is_turned.any()):
        pairs = pairs.part(pairs.is_turned)
    steps_m = np.linalg.norm(np.diff(pairs.true_m, axis=0), axis=1)
    passed = {"m": np.append(0.0, np.cumsum(steps_m)), "s": (pairs.times_ns - pairs.times_ns[0]) / NS_PER_S}
    intervals_s = np.diff(passed["s"])
    half_s = _INTERVAL_SHARE * float(np.median(intervals_s)) if len(intervals_s) else 0.0
    found = []
    for delta, unit in deltas:
        start, end = pairs_at(passed[unit], delta, half_s if unit == "s" else share * delta)
        if len(start):
            moves_m = [rows[end] - rows[start] for rows in (pairs.points_m, pairs.true_m)]
            if not is_turned:
                lengths_m = [np.linalg.norm(move_m, axis=1) for move_m in moves_m]
                found.append(RelativeErrors(delta, unit, DISTANCE, np.abs(lengths_m[0] - lengths_m[1])))
                continue
            back = [rows[start].swapaxes(1, 2) for rows in (pairs.axes, pairs.true_axes)]
            own_m = [np.einsum("nij,nj->ni", turn, m) for turn, m in zip(back, moves_m, strict=True)]
            errors_m = np.linalg.norm(own_m[0] - own_m[1], axis=1)
            errors_rad = turns_between(back[0] @ pairs.axes[end], back[1] @ pairs.true_axes[end])
            found.append(RelativeErrors(delta, unit, TRANSLATION, errors_m, errors_rad))
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
