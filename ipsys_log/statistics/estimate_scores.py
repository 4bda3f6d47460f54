"""Scores of a robot's own estimate against its tracks: ATE by alignment, RPE, coverage, drift, NEES."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, ErrorStatistics, Mask, Times
from ipsys_log.models.tracking.track_messages import TrackRows, interpolate
from ipsys_log.statistics.ground_truth import (
    DELTAS,
    PosePairs,
    RelativeErrors,
    TrajectoryErrors,
    relative_errors,
    turns_between,
)
from ipsys_log.statistics.path_pairs import gap_limit_s
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotation_between, turns_about_z
from ipsys_log.vision.time_brackets import bracket_times

# Alignments of an estimate before its absolute error, in the order of the table.
NONE, FIRST_POSE, YAW, SE3, SIM3 = "none", "first_pose", "yaw", "se3", "sim3"
# The drift is stated over the longest of these distances that is at most half of the path.
_DRIFT_DISTANCES_M = (50.0, 20.0, 10.0, 5.0, 2.0, 1.0, 0.5)
_DRIFT_SHARE = 0.02
# After a longer gap, a robot can have been carried: the way between is no drive.
_BREAK_NS = NS_PER_S
# Side of the squares of the floor whose coverage is counted.
CELL_M = 0.5
LEAST_POSES = 3


class EstimateFrame(NamedTuple):
    """The frame of an estimate and of its body, relative to the lab and to the marker of the robot.

    ``yaw_rad``, ``shift_m`` (3,) and ``scale`` map the own coordinates of the estimate, levelled, to the lab.
    ``pivot_m`` (3,) and ``turn_rad`` are those of a ``BodyFrame``.
    """

    yaw_rad: float
    shift_m: Array
    scale: float
    pivot_m: Array
    turn_rad: float


class AlignedErrors(NamedTuple):
    """The absolute errors of an estimate after an alignment.

    ``points_m`` (n, 3) are the aligned positions. ``turns_rad`` (n,) are the angles of the rotation errors,
    about the vertical for a level robot, and NaN where a rotation is unknown.
    """

    alignment: str
    scale: float
    points_m: Array
    errors: TrajectoryErrors
    turns_rad: Array


class Coverage(NamedTuple):
    """The part of the tracks with an estimate.

    ``time_share`` counts the instants of the tracks, and ``area_share`` squares of the floor of 0.5 m.
    """

    time_share: float
    area_share: float
    gaps: int
    longest_gap_s: float


class ScoreRow(NamedTuple):
    """One error of an estimate: the ATE after an alignment, or the RPE over a distance or a time."""

    metric: str
    alignment: str
    delta: str
    space: ErrorStatistics
    floor: ErrorStatistics | None
    rotation_rmse_rad: float | None


@dataclass(frozen=True, slots=True, eq=False)
class EstimateScore:
    """The errors of an estimate at the instants that have a track.

    Attributes
    ----------
    pairs : the poses of the estimate in its own coordinates, levelled, and the true ones of the same body,
        from the tracks, at the instants of the estimate.
    turn : ``heading`` of a level robot, or ``rotation``: the name of the errors of rotations.
    tracks_m : RMS of the errors that the covariances of the tracks expect, in 3D; None without covariances.
    drift : the relative errors over the distance of the drift; None for a short path.
    nees : mean normalised squared error of positions on the floor, by degree of freedom; None without
        covariances.
    """

    pairs: PosePairs
    turn: str
    aligned: tuple[AlignedErrors, ...]
    relative: tuple[RelativeErrors, ...]
    tracks_m: float | None
    coverage: Coverage
    drift: RelativeErrors | None
    nees: float | None

    @property
    def times_ns(self) -> Times:
        return self.pairs.times_ns

    @property
    def true_m(self) -> Array:
        return self.pairs.true_m

    @property
    def passed_m(self) -> Array:
        """The distance (n,) since the first instant, along the true path, without its gaps."""
        steps_m = np.linalg.norm(np.diff(self.true_m, axis=0), axis=1)
        return np.append(0.0, np.cumsum(np.where(np.diff(self.times_ns) > _BREAK_NS, 0.0, steps_m)))

    def after(self, alignment: str) -> AlignedErrors:
        """Return the errors after an alignment that needs no headings."""
        return next(row for row in self.aligned if row.alignment == alignment)

    def rows(self) -> list[ScoreRow]:
        """Return all errors, as the rows of a table."""
        return [
            *(
                ScoreRow("ATE", name, "", errors.absolute_3d, errors.absolute_2d, _rms(turns_rad))
                for name, _, _, errors, turns_rad in self.aligned
            ),
            *(
                ScoreRow("RPE", "", f"{one.delta:g} {one.unit}", one.summary, None, _rms(one.errors_rad))
                for one in self.relative
            ),
        ]


def _rms(errors_rad: Array | None) -> float | None:
    known = () if errors_rad is None else errors_rad[np.isfinite(errors_rad)]
    return float(np.sqrt(np.mean(np.square(known)))) if len(known) else None


def score_estimate(
    estimate: TrackRows,
    tracks: TrackRows,
    frame: EstimateFrame,
    with_scale: bool,
    where: str,
    rotations: tuple[Array, Array] | None = None,
) -> EstimateScore:
    """Score an estimate against the tracks of its robot.

    The tracks are moved to the origin of the body by the pivot. An instant of the estimate counts if the
    poses of the tracks around it are close in time.

    Parameters
    ----------
    estimate : poses of the body in the clock and the coordinates of the lab, one after the other.
    tracks : rows of the marker, without predicted poses.
    with_scale : True to add the alignment with a scale.
    rotations : of the body of the estimate and of the marker, to the lab, at the instants of the estimate,
        each (n, 3, 3); None for a level robot, which has headings alone.

    References
    ----------
    Alignments and errors: Grupp, evo, 2017 (``evo_ape``, ``evo_rpe --all_pairs --pairs_from_reference``);
    Umeyama, IEEE PAMI 1991. Alignment of yaw and translation: Zhang and Scaramuzza, IROS 2018.
    """
    limit_ns = gap_limit_s(tracks.times_ns / NS_PER_S) * NS_PER_S
    samples = interpolate(tracks, estimate.times_ns)
    own_axes, true_axes = rotations or (
        turns_about_z(estimate.headings_rad),
        turns_about_z(samples.headings_rad),
    )
    lever_m = _lever_m(true_axes, frame.pivot_m)
    cov_m2 = samples.covariances_m2 + _turned_by(lever_m, samples.heading_sigmas_rad)
    known = bracket_times(tracks.times_ns, estimate.times_ns, limit_ns).is_known
    known &= np.isfinite(samples.points_m + lever_m).all(axis=1)
    if known.sum() < LEAST_POSES:
        raise IpsysError(
            f"{where}: fewer than {LEAST_POSES} poses are at the times of the tracks; check --time-offset"
        )
    yaw, turn = turns_about_z(np.array([frame.yaw_rad, frame.turn_rad]))
    pairs = PosePairs(
        estimate.times_ns,
        (estimate.points_m - frame.shift_m) @ yaw / frame.scale,
        yaw.T @ own_axes,
        samples.points_m + lever_m,
        true_axes @ turn,
    ).part(known)
    is_level = rotations is None
    aligned = [
        _aligned(pairs, kind, is_level)
        for kind in (NONE, FIRST_POSE, YAW, SE3, *([SIM3] if with_scale else []))
    ]
    rows = tuple(row for row in aligned if row is not None)
    scaled = pairs._replace(points_m=pairs.points_m * rows[-1].scale)
    variances_m2 = np.trace(cov_m2[known], axis1=1, axis2=2)
    has_variance = np.isfinite(variances_m2)
    first = next((row for row in rows if row.alignment == FIRST_POSE), None)
    sigmas_rad = estimate.heading_sigmas_rad[known], samples.heading_sigmas_rad[known]
    return EstimateScore(
        pairs,
        "heading" if is_level else "rotation",
        rows,
        tuple(relative_errors(scaled, DELTAS)),
        float(np.sqrt(variances_m2[has_variance].mean())) if has_variance.any() else None,
        _coverage(estimate.times_ns, tracks, frame.pivot_m),
        _drift(scaled),
        _nees(pairs, first or rows[1], (estimate.covariances_m2[known], cov_m2[known]), sigmas_rad, yaw),
    )


def _lever_m(axes: Array, pivot_m: Array) -> Array:
    """Return the vectors (n, 3) from a marker with axes (n, 3, 3) to the origin of a body, in the lab."""
    return axes @ pivot_m if pivot_m.any() else np.zeros((len(axes), 3))


def _turned_by(lever_m: Array, sigmas_rad: Array) -> Array:
    """Return the covariance (n, 3, 3) of levers (n, 3) with an unknown turn about z."""
    across_m = np.column_stack([-lever_m[:, 1], lever_m[:, 0], np.zeros(len(lever_m))])
    return across_m[:, :, None] * across_m[:, None, :] * (np.nan_to_num(sigmas_rad) ** 2).reshape(-1, 1, 1)


def _aligned(pairs: PosePairs, kind: str, is_level: bool) -> AlignedErrors | None:
    """Return the absolute errors after an alignment; None if no pair has the rotations that it needs."""
    scale, rotation, shift_m = 1.0, np.eye(3), np.zeros(3)
    if kind == FIRST_POSE:
        if not pairs.is_turned[0]:
            return None
        rotation = pairs.true_axes[0] @ pairs.axes[0].T
        shift_m = pairs.true_m[0] - rotation @ pairs.points_m[0]
    elif kind != NONE:
        scale, rotation, shift_m = _fit(pairs.points_m, pairs.true_m, kind)
    points_m = scale * pairs.points_m @ rotation.T + shift_m
    axes = rotation @ pairs.axes
    if is_level:  # the alignment may tilt it
        axes = turns_about_z(np.arctan2(axes[:, 1, 0], axes[:, 0, 0]))
    turns_rad = turns_between(axes, pairs.true_axes)
    return AlignedErrors(kind, scale, points_m, TrajectoryErrors("", points_m - pairs.true_m, ()), turns_rad)


def _fit(points_m: Array, true_m: Array, kind: str) -> tuple[float, Array, Array]:
    """Return scale, rotation and translation with the least squared distances, from points to true ones."""
    middle_m, target_m = points_m.mean(axis=0), true_m.mean(axis=0)
    rotation, axes = np.eye(3), 2 if kind == YAW else 3
    from_m, to_m = (points_m - middle_m)[:, :axes], (true_m - target_m)[:, :axes]
    rotation[:axes, :axes], best = rotation_between(from_m, to_m)
    scale = best if kind == SIM3 else 1.0
    return scale, rotation, target_m - scale * rotation @ middle_m


def _coverage(times_ns: Times, tracks: TrackRows, pivot_m: Array) -> Coverage:
    limit_ns = gap_limit_s(times_ns / NS_PER_S) * NS_PER_S
    covered = bracket_times(times_ns, tracks.times_ns, limit_ns).is_known
    places_m = tracks.points_m + _lever_m(turns_about_z(tracks.headings_rad), pivot_m)
    placed = np.isfinite(places_m).all(axis=1)
    cells = np.floor(places_m[:, :2] / CELL_M)
    areas = [len(np.unique(cells[mask], axis=0)) for mask in (placed & covered, placed)]
    gaps_s = _gaps_s(tracks.times_ns, covered)
    return Coverage(float(covered.mean()), areas[0] / max(areas[1], 1), len(gaps_s), max(gaps_s, default=0.0))


def _gaps_s(times_ns: Times, covered: Mask) -> list[float]:
    """Return the lengths of the intervals of the tracks without an estimate."""
    edges = np.flatnonzero(np.diff(np.concatenate([[True], covered, [True]]).astype(np.int8)))
    return [
        float(times_ns[min(end, len(times_ns) - 1)] - times_ns[max(begin - 1, 0)]) / NS_PER_S
        for begin, end in edges.reshape(-1, 2).tolist()
    ]


def _drift(pairs: PosePairs) -> RelativeErrors | None:
    """Return the errors over the longest distance that fits twice into an unbroken part of the path."""
    breaks = np.flatnonzero(np.diff(pairs.times_ns) > _BREAK_NS) + 1
    parts = [pairs.part(rows) for rows in np.split(np.arange(len(pairs.times_ns)), breaks)]
    lengths_m = [float(np.linalg.norm(np.diff(part.true_m, axis=0), axis=1).sum()) for part in parts]
    longest = parts[int(np.argmax(lengths_m))]
    for distance_m in _DRIFT_DISTANCES_M:
        deltas = [(distance_m, "m")] if 2 * distance_m <= max(lengths_m) else []
        found = relative_errors(longest, deltas, _DRIFT_SHARE)
        if found:
            return found[0]
    return None


def _nees(
    pairs: PosePairs,
    row: AlignedErrors,
    covariances_m2: tuple[Array, Array],
    sigmas_rad: tuple[Array, Array],
    yaw: Array,
) -> float | None:
    """Return the mean normalised squared error on the floor, by degree of freedom.

    The covariance of an odometry grows from its start. So the poses are compared after an alignment of the
    first ones, whose covariances and turns count, too.
    """
    own_m2, true_m2 = covariances_m2
    if not np.isfinite(own_m2).all(axis=(1, 2)).any():
        return None
    together_m2 = np.nan_to_num(true_m2)
    if row.alignment == FIRST_POSE:
        turn = pairs.true_axes[0] @ pairs.axes[0].T @ yaw.T
        own_m2 = turn @ own_m2 @ turn.T
        first_rad = float(np.hypot(*(np.nan_to_num(sigmas[0]) for sigmas in sigmas_rad)))
        levers_m = pairs.true_m - pairs.true_m[0]
        together_m2 = together_m2 + together_m2[0] + np.nan_to_num(own_m2[0])
        together_m2 = together_m2 + _turned_by(levers_m, np.full(len(levers_m), first_rad))
    together_m2 = (own_m2 + together_m2)[:, :2, :2]
    used = np.isfinite(together_m2).all(axis=(1, 2)) & (np.linalg.det(together_m2) > 0)
    used[0] &= row.alignment != FIRST_POSE
    if not used.any():
        return None
    offsets_m = row.errors.offsets_m[used, :2]
    weighted = np.linalg.solve(together_m2[used], offsets_m[:, :, None])[:, :, 0]
    return float((offsets_m * weighted).sum(axis=1).mean() / 2)
