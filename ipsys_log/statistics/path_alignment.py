"""Clock, coordinate frames and lever between the tracks of a lab and the trajectories of another system.

The path of another system is either measured, such as that of motion capture: then its errors are a smooth
field over the floor. Or it is dead-reckoned and drifts. The likelihood of its residuals tells which.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Mask, Times
from ipsys_log.statistics.calibration_points import TimedPoints
from ipsys_log.statistics.ground_truth import LONGEST_GAP_NS
from ipsys_log.statistics.path_cleaning import REPEATED, repeated, select_rows
from ipsys_log.statistics.path_fit import LEAST_INSTANTS, PathFit, State, free_scale, linearize
from ipsys_log.statistics.path_pairs import Body
from ipsys_log.statistics.path_problem import NO_AGREEMENT, ChosenFit, Problem, extent_m
from ipsys_log.statistics.trajectories import KnownParts, Trajectory, TrajectoryPair
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import cross, rotation_vector
from ipsys_log.vision.time_brackets import bracket_times

# With larger standard deviations, the motion does not determine a part.
_LARGEST_TURN_SIGMA_RAD = np.radians(2.0)
_LARGEST_OFFSET_SIGMA_S = 0.1
_LARGEST_PIVOT_SIGMA_M = 0.03
# A robot that has moved this far while its pose repeats was lost.
_LOST_M = 0.02
_LEAST_SPREAD_M = 0.1
# A scale that differs from 1 by this share, and by so many standard deviations more than a tape can be wrong,
# is stated.
_LEAST_SCALE_SHARE, _SCALE_SIGMAS, _TAPE_SHARE = 0.003, 4.0, 0.001
_TOO_LITTLE_MOTION = (
    "too little motion to determine clock and alignment: drive curves at different speeds, and stop in "
    "between, or give --align none --time-offset S"
)


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion:
    """A rotation (3, 3) and a translation (3,) in m, from other coordinates to those of the lab."""

    rotation: Array
    shift_m: Array

    def apply(self, points_m: Array) -> Array:
        """Return points (n, 3) in the coordinates of the lab."""
        return points_m @ self.rotation.T + self.shift_m


@dataclass(frozen=True, slots=True)
class Residuals:
    """Root-mean-square distances between tracks and aligned poses, over all instants with both."""

    instants: int
    rmse_3d_m: float
    rmse_2d_m: float
    outliers: int = 0

    @classmethod
    def of(cls, squares_m2: Array, outliers: int = 0) -> Self:
        """Return the residuals of squared distances (n, 3) by axis."""
        rmse_3d_m, rmse_2d_m = (float(np.sqrt(squares_m2[:, :axes].sum(axis=1).mean())) for axes in (3, 2))
        return cls(len(squares_m2), rmse_3d_m, rmse_2d_m, outliers)


class BodyFrame(NamedTuple):
    """The origin and the axes of another body, relative to the marker of the robot.

    ``pivot_m`` and ``pivot_sigmas_m`` are (3,): from the marker to the origin of the body, in the axes of the
    marker. ``turn_rad`` is the constant turn about z from the axes of the marker to those of the body.
    """

    pivot_m: Array
    pivot_sigmas_m: Array
    turn_rad: float
    turn_sigma_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class PathAlignment:
    """The clock, the coordinates, the pivot and the axes of another system, relative to those of the lab.

    A standard deviation is NaN where the value was given or is not estimated.

    Attributes
    ----------
    offset_ns, offset_sigma_s : added to the times of the other system; at ``reference_ns`` with a drift.
    drift, drift_sigma : growth of the offset in s/s from ``reference_ns`` (in the clock of the other system).
    motion : from the coordinates of the other system to those of the lab. ``turn_rad`` (3,) is its rotation
        vector.
    names : of the robots, in the order of the pairs.
    bodies : the pivot and the axes of each body, in this order.
    scale, scale_sigma : the lengths in the lab, divided by those of the other system. The scale is applied
        only if it was asked for; otherwise it is a finding.
    residuals : of positions, at the instants of the tracks.
    axes : a text that names the axes found if they are not z up, such as ``y up``; else empty.
    poses : of each body, in the clock and the coordinates of the lab, without bad rows.
    remarks : what was left out, what is contradicted, and what the motion does not determine.
    """

    offset_ns: int
    offset_sigma_s: float
    drift: float
    drift_sigma: float
    reference_ns: int
    motion: RigidMotion
    turn_rad: Array
    turn_sigmas_rad: Array
    shift_sigmas_m: Array
    names: tuple[str, ...]
    bodies: tuple[BodyFrame, ...]
    scale: float
    scale_sigma: float
    residuals: Residuals
    axes: str = ""
    poses: tuple[Trajectory, ...] = ()
    remarks: tuple[str, ...] = ()

    def lab_times_ns(self, times_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return times of the other system in the clock of the lab."""
        late_ns = np.round((times_ns - self.reference_ns) * self.drift).astype(np.int64)
        return times_ns + self.offset_ns + late_ns

    def record_parameters(self, prefixes: Sequence[str] = ("",)) -> dict[str, str]:
        """Return clock, frames and bodies for the record of a run, with all digits, and their sigmas.

        Values that change no pose and were not estimated are left out. The names of a body have its prefix.
        """
        values = {
            "time_offset_s": (0.0, self.offset_sigma_s),
            "clock_drift": (self.drift, self.drift_sigma),
            "scale": (self.scale, self.scale_sigma),
        }
        vectors = {
            "rotation_{}_rad": (self.turn_rad, self.turn_sigmas_rad),
            "translation_{}_m": (self.motion.shift_m, self.shift_sigmas_m),
        }
        for prefix, body in zip(prefixes, self.bodies, strict=True):
            values[f"{prefix}body_turn_rad"] = body.turn_rad, body.turn_sigma_rad
            vectors[f"{prefix}pivot_{{}}_m"] = body.pivot_m, body.pivot_sigmas_m
        for name, (vector, sigmas) in vectors.items():
            values |= {name.format(axis): (vector[n], sigmas[n]) for n, axis in enumerate("xyz")}
        parameters: dict[str, str] = {}
        for name, (value, sigma) in values.items():
            if value != (name == "scale") or np.isfinite(sigma):
                parameters[name] = repr(float(value))
            if np.isfinite(sigma):
                parameters[sigma_name(name)] = f"{sigma:.4g}"
        parameters["time_offset_s"] = seconds_text(self.offset_ns)
        if self.drift:
            parameters["reference_s"] = seconds_text(self.reference_ns)
        texts = {"axes": self.axes, "remarks": "\n".join(self.remarks)}
        return parameters | {name: text for name, text in texts.items() if text}

    def lab_poses(self, other: Trajectory) -> Trajectory:
        """Return the poses of the other body in the clock and the coordinates of the lab."""
        from scipy.spatial.transform import Rotation

        quaternions = np.full_like(other.quaternions, np.nan)
        is_turned = np.isfinite(other.quaternions).all(axis=1)
        lab_from_other = Rotation.from_matrix(self.motion.rotation)
        quaternions[is_turned] = (lab_from_other * Rotation.from_quat(other.quaternions[is_turned])).as_quat()
        return replace(
            other,
            times_ns=self.lab_times_ns(other.times_ns),
            points_m=self.motion.apply(other.points_m),
            quaternions=quaternions,
        )


def sigma_name(name: str) -> str:
    """Return the parameter of a record with the standard deviation of another one.

    Examples
    --------
    >>> sigma_name("pivot_x_m"), sigma_name("scale")
    ('pivot_x_sigma_m', 'scale_sigma')
    """
    return re.sub(r"(_(?:m|rad|s))?$", r"_sigma\1", name, count=1)


def seconds_text(time_ns: int) -> str:
    """Return a time in s with all of its nanoseconds."""
    return f"{Decimal(time_ns).scaleb(-9):f}"


def align_trajectories(pairs: Sequence[TrajectoryPair], known: KnownParts, where: str) -> PathAlignment:
    """Estimate clock, coordinates, pivots and axes of the trajectories of another system.

    All robots share the clock and the coordinates; pivot and axes are those of each body. The coarse offsets
    come from turn rates where both systems have headings, and from speeds. Gauss-Newton then estimates all
    parts, with the noise of the residuals by restricted maximum likelihood: a white part, and a smooth field
    over the floor, or the random walk of a dead-reckoned path. So the standard deviations hold for errors
    that are alike along the path.

    Parameters
    ----------
    where : the start of an error text.

    Raises
    ------
    IpsysError
        There are too few common instants or too little motion, the paths differ or are mirrored, or two
        offsets agree equally well.

    References
    ----------
    Start of the rotation: Umeyama, IEEE PAMI 1991, eq. (40).
    """
    problem = Problem(pairs, known, where)
    _check_motion(problem.bodies, where)
    problem.check_headings()
    candidates = problem.candidates()
    if not candidates:
        few = f"both recordings have fewer than {LEAST_INSTANTS} common instants; check --time-offset"
        raise IpsysError(f"{where}: {NO_AGREEMENT if known.offset_ns is None else few}")
    fit = problem.refined(candidates)
    found = _result(problem, fit)
    problem.check_alike(candidates)
    return found


def _result(problem: Problem, fit: ChosenFit) -> PathAlignment:
    """Return the alignment with its standard deviations and remarks."""
    measured, drifting = fit.measured, fit.drifting
    state, sigma = measured.state, measured.sigma
    turn_sigmas_rad, shift_sigmas_m = _motion_sigmas(measured)
    scale, scale_sigma = float(np.exp(state.log_scale)), sigma("scale")
    if drifting is not None:
        shared = np.sqrt(np.diag(drifting.covariance))
        scale, scale_sigma = float(np.exp(drifting.log_scale)), float(shared[4] * scale)
        turn_sigmas_rad = np.where(np.isfinite(turn_sigmas_rad), drifting.turn_sigma_rad, np.nan)
        shift_sigmas_m = np.where(np.isfinite(shift_sigmas_m), drifting.shift_sigma_m, np.nan)
        pivots = [(drifting.pivot_m, shared[1:3])]
        turns = [(drifting.body_turn_rad, float(shared[3]))]
        offset_sigma_s = float(shared[0])
    else:
        numbers = range(len(problem.bodies))
        sigmas = [np.array([sigma(f"pivot {n}", axis) for axis in (0, 1)]) for n in numbers]
        pivots = [(state.pivots_m[n, :2], sigmas[n]) for n in numbers]
        turns = [(float(state.body_turns_rad[n]), sigma(f"body {n}")) for n in numbers]
        offset_sigma_s = sigma("offset")
        if measured.freedom.turns and not problem.known.with_scale:
            scale, scale_sigma = free_scale(problem.bodies, measured)
    _check_determined(problem, offset_sigma_s, turn_sigmas_rad)
    bodies = tuple(_body_frame(problem, *pivots[n], *turns[n]) for n in range(len(problem.bodies)))
    if not problem.known.with_scale:
        problem.remarks += _scale_remarks(scale, scale_sigma)
    rotation = state.rotation * (scale if problem.known.with_scale else 1.0)
    motion = RigidMotion(rotation @ problem.upright, state.centre_m - rotation @ state.origin_m)
    offset_ns = problem.zero_ns + round(state.offset_s * NS_PER_S)
    alignment = PathAlignment(
        offset_ns if problem.known.offset_ns is None else problem.known.offset_ns,
        offset_sigma_s,
        state.drift,
        sigma("drift") if drifting is None else float("nan"),
        problem.other_ns + round((state.reference_s - state.offset_s) * NS_PER_S),
        motion,
        rotation_vector(motion.rotation / np.cbrt(np.linalg.det(motion.rotation))),
        turn_sigmas_rad,
        shift_sigmas_m,
        tuple(pair.track.robot for pair in problem.pairs),
        bodies,
        scale,
        scale_sigma,
        _residuals(problem, state, bodies, measured),
        problem.axes,
    )
    poses = tuple(_lab_poses(problem, alignment, number) for number in range(len(problem.pairs)))
    return replace(alignment, poses=poses, remarks=tuple(problem.remarks))


def _check_determined(problem: Problem, offset_sigma_s: float, turn_sigmas_rad: Array) -> None:
    is_late = offset_sigma_s > _LARGEST_OFFSET_SIGMA_S
    if is_late or np.nanmax(turn_sigmas_rad, initial=0.0) > _LARGEST_TURN_SIGMA_RAD:
        raise IpsysError(f"{problem.where}: {_TOO_LITTLE_MOTION}")


def _body_frame(
    problem: Problem, pivot_m: Array, sigmas_m: Array, turn: float, turn_sigma: float
) -> BodyFrame:
    """Return pivot and axes of a body; a pivot that the motion does not determine is 0."""
    if problem.known.pivot_m is not None:
        return BodyFrame(np.array(problem.known.pivot_m), np.full(3, np.nan), turn, turn_sigma)
    full_m, full_sigmas_m = np.zeros(3), np.full(3, np.nan)
    if np.isfinite(sigmas_m).all():
        if sigmas_m.max() <= _LARGEST_PIVOT_SIGMA_M:
            full_m[:2], full_sigmas_m[:2] = pivot_m, sigmas_m
        else:
            problem.remarks.append(
                f"the pivot is not determined (sigma {100 * sigmas_m.max():.0f} cm) and is taken as 0: "
                "turn on the spot, or give --pivot X,Y,Z"
            )
    return BodyFrame(full_m, full_sigmas_m, turn, turn_sigma)


def _scale_remarks(scale: float, sigma: float) -> list[str]:
    share = abs(scale - 1)
    if not share >= max(_LEAST_SCALE_SHARE, _SCALE_SIGMAS * sigma + _TAPE_SHARE):
        return []
    word = "shorter" if scale > 1 else "longer"
    numbers = f"{100 * share:.2g} % {word} than those of the tracks (sigma {100 * sigma:.2g} %)"
    return [f"its lengths are {numbers}; they stay as they are"]


def _residuals(problem: Problem, state: State, bodies: Sequence[BodyFrame], fit: PathFit) -> Residuals:
    pivots_m = np.array([body.pivot_m for body in bodies])
    linear = linearize(
        problem.bodies, replace(state, pivots_m=pivots_m), replace(fit.freedom, compared=(0, 1, 2))
    )
    assert linear is not None
    squares = linear.position**2
    outliers = int((~fit.kept).sum())
    return Residuals.of(squares, outliers)


def _lab_poses(problem: Problem, alignment: PathAlignment, number: int) -> Trajectory:
    """Return the poses of a body in the lab; repeated ones stay where the robot stands."""
    pair, other, cleaned = problem.pairs[number], problem.others[number], problem.cleaned[number]
    is_lost = _lost(pair.track.positions, other, alignment.lab_times_ns(other.times_ns))
    about = f"{pair.track.robot}: " * (len(problem.pairs) > 1)
    if is_lost.any():
        problem.remarks.append(
            f"{about}{int(is_lost.sum())} poses repeat while the robot moves, and are left out"
        )
    problem.remarks += [
        f"{about}{count} {reason} are left out"
        for reason, count in cleaned.left_out[len(other.left_out) :]
        if reason != REPEATED
    ]
    is_pose = np.isin(other.times_ns, cleaned.times_ns) | repeated(other)
    return alignment.lab_poses(select_rows(other, is_pose & ~is_lost))


def _lost(track: TimedPoints, other: Trajectory, lab_ns: Times) -> Mask:
    """Return the rows (n,) that repeat a pose while the robot moves: the other system had lost its body."""
    is_repeated = repeated(other)
    brackets = bracket_times(track.times_ns, lab_ns, LONGEST_GAP_NS)
    first = np.maximum.accumulate(np.where(is_repeated, 0, np.arange(len(lab_ns))))
    track_m = brackets.mix(track.points_m)
    moved_m = np.linalg.norm(track_m - track_m[first], axis=1)
    has_moved = is_repeated & brackets.is_known & brackets.is_known[first] & (moved_m > _LOST_M)
    return np.asarray(is_repeated & np.isin(first, first[has_moved]))


def _check_motion(bodies: Sequence[Body], where: str) -> None:
    for name, points in (("other path", [b.other_m for b in bodies]), ("track", [b.track_m for b in bodies])):
        # Two stationary robots determine an alignment, but no offset.
        largest_m = max(extent_m(one) for one in points)
        if largest_m < _LEAST_SPREAD_M:
            raise IpsysError(
                f"{where}: too little motion for an alignment: the {name} moves by {largest_m:.2f} m; "
                "drive through the lab, or give --align none --time-offset S"
            )


def _motion_sigmas(fit: PathFit) -> tuple[Array, Array]:
    """Return the standard deviations (3,) of the rotation, and of the image of the origin."""
    full = np.zeros((6, 6))
    places = [
        (n, 3 * (name == "shift") + axis)
        for n, (name, axis) in enumerate(fit.names)
        if name in ("turn", "shift")
    ]
    if places:
        rows, cells = np.array(places).T
        full[np.ix_(cells, cells)] = fit.covariance[np.ix_(rows, rows)]
    # The shift is the image of the origin: a rotation about the middle of the path moves it, too.
    lever_m = -fit.state.rotation @ fit.state.origin_m
    to_origin = np.hstack([cross(np.eye(3), np.broadcast_to(lever_m, (3, 3))).T, np.eye(3)])
    shift_sigmas_m = np.sqrt(np.diag(to_origin @ full @ to_origin.T))
    is_turned, is_shifted = (np.isin(np.arange(3), axes) for axes in (fit.freedom.turns, fit.freedom.shifts))
    return np.where(is_turned, np.sqrt(np.diag(full)[:3]), np.nan), np.where(
        is_shifted, shift_sigmas_m, np.nan
    )
