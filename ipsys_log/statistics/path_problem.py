"""The paths of robots in two systems: what is free between them, the coarse offsets, and the best fit."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array
from ipsys_log.statistics import path_cleaning, path_fit
from ipsys_log.statistics.ground_truth import TrackedPath, last_poses
from ipsys_log.statistics.path_drift import ROUNDS, DriftFit, fit_drifting
from ipsys_log.statistics.path_pairs import Body, PathPair, search_speeds, search_turns, smooth_values, thin
from ipsys_log.statistics.trajectories import KnownParts, Trajectory, TrajectoryPair
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.poses import rotate, rotation_between

ALIGNMENTS = {"2d": ((2,), (0, 1), (0, 1)), "3d": ((0, 1, 2), (0, 1, 2), (0, 1, 2)), "none": ((), (), (0, 1))}
# More instants cost time, and their errors are those of their neighbours.
_MOST_INSTANTS = 12_000
# The drift of a clock shows in recordings of at least this length.
_DRIFT_FROM_S = 120.0
# Larger median residuals, as a share of the extent of the path, show that the paths differ.
_LARGEST_SHARE = 0.2
# A field over the floor with larger errors than these, in m and rad, is the drift of dead reckoning.
_LARGEST_FIELD = (0.06, 0.06)
# Two offsets further apart than this are alike if their likelihoods differ by less than this.
_APART_S, _ALIKE = 0.5, 20.0
# Offsets with fewer common instants than this share of the most are no candidates.
_LEAST_SHARE = 0.3
# So many instants suffice to compare candidates.
_ROUGH_INSTANTS, _ROUGH_ROUNDS = 600, 12
# Coarse offsets whose misfit is larger than this multiple of the least one, and this, are left out.
_NEAR_MISFIT, _NEAR_MISFIT_M = 3.0, 0.02
# A fit as a dead-reckoned path gives the offset to this.
_NEAR_S = 0.06
# Distances above this many medians are outliers of a first rotation.
_OUTLIER_SHARE = 4.0
# A mirrored path fits better than a turned one by this factor.
_MIRRORED = 3.0
NO_AGREEMENT = (
    "no time offset and alignment bring both paths together; check that the files are of the same drive and "
    "robot, and the units"
)
# Lengths of both systems that differ by more than this have different units.
_LARGEST_SCALE_SHARE = 0.2


class _Candidate(NamedTuple):
    """An offset with the log likelihood of a fit at so many instants, and its fit as a path that drifts."""

    offset_s: float
    likelihood: float
    instants: int
    drifting: DriftFit | None

    def advantage(self, other: "_Candidate") -> float:
        """Return by how much the log likelihood is greater, over the instants that both have."""
        apart = self.likelihood / self.instants - other.likelihood / other.instants
        return apart * min(self.instants, other.instants)


class ChosenFit(NamedTuple):
    """The fit as a measured path, and that as a dead-reckoned one if this is more likely."""

    measured: path_fit.PathFit
    drifting: DriftFit | None


class Problem:
    """The paths of all robots in both systems, in s since the zero of each, and what is free."""

    def __init__(self, pairs: Sequence[TrajectoryPair], known: KnownParts, where: str) -> None:
        self.pairs, self.known, self.where = pairs, known, where
        self.remarks: list[str] = []
        self.others = [path_cleaning.even_stamps(pair.other) for pair in pairs]
        self.cleaned = [path_cleaning.clean_trajectory(one) for one in self.others]
        self.other_ns = min(int(one.times_ns[0]) for one in self.cleaned)
        self.track_ns = min(int(pair.track.positions.times_ns[0]) for pair in pairs)
        self.upright, self.axes = self._upright()
        self.bodies = self._bodies()
        if known.align != "none" and self._is_mirrored():
            if self.axes:
                raise IpsysError(
                    f"{where}: is mirrored: its axes are left-handed; export it with one axis negated"
                )
            self.upright, self.axes = np.diag([1.0, -1.0, -1.0]), "z down"
            self.bodies = self._bodies()

    def _bodies(self) -> list[Body]:
        return [self._body(pair.track, one) for pair, one in zip(self.pairs, self.cleaned, strict=True)]

    def _is_mirrored(self) -> bool:
        """Return whether the mirrored path fits the tracks much better, at any coarse offset."""
        for offset_s in self._coarse_s()[:3]:
            other_m, track_m = self._common(offset_s, np.zeros((len(self.bodies), 3)))
            if len(other_m) < path_fit.LEAST_INSTANTS:
                continue
            medians_m = [_turned_misfit_m(other_m[:, :2] * [1, sign], track_m[:, :2]) for sign in (1.0, -1.0)]
            if medians_m[1] < min(medians_m[0] / _MIRRORED, _LARGEST_SHARE / 2 * extent_m(track_m)):
                return True
        return False

    def _upright(self) -> tuple[Array, str]:
        """Return the rotation (3, 3) that makes z the vertical axis, and a text about it."""
        is_free = self.known.align != "none"
        if is_free and path_cleaning.vertical_axis([one.points_m for one in self.cleaned]) == 1:
            return np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]), "y up"
        return np.eye(3), ""

    def _body(self, track: TrackedPath, other: Trajectory) -> Body:
        rows = last_poses(track.positions)
        rows = rows[:: -(-len(rows) * len(self.pairs) // _MOST_INSTANTS)]
        track_s = (track.positions.times_ns[rows] - self.track_ns) / NS_PER_S
        other_s = (other.times_ns - self.other_ns) / NS_PER_S
        seen = track_s, track.positions.points_m[rows], track.headings_rad[rows]
        return Body.of(seen, other_s, other.points_m @ self.upright.T, self.upright @ other.axes)

    @property
    def zero_ns(self) -> int:
        """The offset in ns of an offset of 0 s between both zeros."""
        return self.track_ns - self.other_ns

    @property
    def has_headings(self) -> bool:
        return all(np.isfinite(b.axes).any() and np.isfinite(b.heading_rad).any() for b in self.bodies)

    @property
    def can_drift(self) -> bool:
        """Return whether a fit as a dead-reckoned path is possible."""
        return (
            len(self.bodies) == 1
            and self.has_headings
            and self.known.align == "2d"
            and not self.known.with_scale
        )

    def check_headings(self) -> None:
        """Leave out headings that are not of the same body; see :func:`use_right_headings`."""
        if self.has_headings:
            offsets_s = self._coarse_s()[:1]
            self.bodies, remarks = path_cleaning.use_right_headings(self.bodies, offsets_s, self.where)
            self.remarks += remarks

    def _given(self) -> list[float]:
        given_ns = self.known.offset_ns
        return [] if given_ns is None else [(given_ns - self.zero_ns) / NS_PER_S]

    def _coarse_s(self) -> list[float]:
        return self._given() or [offset_s for offset_s, _ in self._by_speed()]

    def _by_speed(self) -> list[tuple[float, float]]:
        return search_speeds([PathPair(b.other_s, b.other_m, b.track_s, b.track_m) for b in self.bodies])

    def _by_turn(self) -> list[tuple[float, float]]:
        return search_turns(path_cleaning.turn_pairs(self.bodies)) if self.has_headings else []

    def agreement(self) -> float:
        """Return the correlation of the turn rates of both systems, or else of their speeds."""
        return next((correlation for _, correlation in self._by_turn() or self._by_speed()), 0.0)

    def freedom(self) -> path_fit.Freedom:
        turns, shifts, compared = ALIGNMENTS[self.known.align]
        has_axes = all(np.isfinite(body.axes).any() for body in self.bodies)
        has_headings = all(np.isfinite(body.heading_rad).any() for body in self.bodies)
        length_s = max(float(body.track_s[-1] - body.track_s[0]) for body in self.bodies)
        pivots = (0, 1) if self.known.pivot_m is None and (has_axes or has_headings) else ()
        is_free = self.known.offset_ns is None
        return path_fit.Freedom(
            turns,
            shifts,
            compared,
            offset=is_free,
            drift=is_free and length_s > _DRIFT_FROM_S,
            scale=self.known.with_scale,
            pivots=pivots,
            headings=has_axes and has_headings,
            uses_other_axes=has_axes,
        )

    def start(self, offset_s: float, pivots_m: Array | None = None) -> path_fit.State | None:
        """Return the best rotation and translation at an offset; None without common instants."""
        if pivots_m is None:
            pivots_m = np.tile(self.known.pivot_m or (0.0, 0.0, 0.0), (len(self.bodies), 1))
        other_m, track_m = self._common(offset_s, pivots_m)
        if len(other_m) < path_fit.LEAST_INSTANTS:
            return None
        turns, _, compared = ALIGNMENTS[self.known.align]
        origin_m, centre_m = np.median(other_m, axis=0), np.median(track_m, axis=0)
        rotation, scale = np.eye(3), 1.0
        if turns:
            axes = list(compared)
            rotation[np.ix_(axes, axes)], scale = _turn_between(other_m[:, axes], track_m[:, axes])
            origin_m[axes], centre_m[axes] = other_m[:, axes].mean(axis=0), track_m[:, axes].mean(axis=0)
        else:
            centre_m = origin_m
        body_turns = [path_cleaning.body_turn(body, offset_s, rotation) for body in self.bodies]
        middle_s = float(np.median(np.concatenate([body.track_s for body in self.bodies])))
        log_scale = float(np.log(scale)) if self.known.with_scale else 0.0
        return path_fit.State(
            offset_s, 0.0, middle_s, rotation, origin_m, centre_m, log_scale, pivots_m, np.array(body_turns)
        )

    def _common(self, offset_s: float, pivots_m: Array) -> tuple[Array, Array]:
        """Return the other positions (n, 3) and those of the tracks at the pivots, at common instants."""
        both = [_common(body, offset_s, pivot_m) for body, pivot_m in zip(self.bodies, pivots_m, strict=True)]
        other_m, track_m = (np.concatenate(part) for part in zip(*both, strict=True))
        return other_m, track_m

    def candidates(self) -> list[_Candidate]:
        """Return all coarse offsets with the likelihood of a rough fit, the best one first."""
        offsets_s = self._given()
        if not offsets_s:
            for offset_s, _ in (*self._by_turn(), *self._by_speed()):
                if all(abs(offset_s - other_s) > _APART_S for other_s in offsets_s):
                    offsets_s.append(offset_s)
        if not self.can_drift:
            offsets_s = self._near_fits(offsets_s)
        found = [one for offset_s in offsets_s if (one := self._candidate(offset_s)) is not None]
        most = max((one.instants for one in found), default=0)
        found = [one for one in found if one.instants >= _LEAST_SHARE * most]
        return sorted(found, key=lambda one: -one.likelihood / one.instants)

    def _near_fits(self, offsets_s: Sequence[float]) -> list[float]:
        """Return the offsets at which a constant alignment fits nearly as well as at the best one."""
        misfits_m = []
        for offset_s in offsets_s:
            other_m, track_m = self._common(offset_s, np.zeros((len(self.bodies), 3)))
            is_enough = len(other_m) >= path_fit.LEAST_INSTANTS
            own_m, seen_m = other_m[:, :2], track_m[:, :2]
            if is_enough and self.known.with_scale:
                own_m = own_m * _turn_between(own_m, seen_m)[1]
            misfits_m.append(_turned_misfit_m(own_m, seen_m) if is_enough else np.inf)
        limit_m = _NEAR_MISFIT * min(misfits_m, default=0.0) + _NEAR_MISFIT_M
        return [offset_s for offset_s, one in zip(offsets_s, misfits_m, strict=True) if one <= limit_m]

    def _drifting(self, body: Body, offset_s: float, rounds: int = ROUNDS) -> DriftFit | None:
        return fit_drifting(body, offset_s, self.known.offset_ns is not None, self.known.pivot_m, rounds)

    def _candidate(self, offset_s: float) -> _Candidate | None:
        if self.can_drift:
            drifting = self._drifting(thin(self.bodies, _ROUGH_INSTANTS)[0], offset_s, _ROUGH_ROUNDS)
            if drifting is not None:
                return _Candidate(drifting.offset_s, drifting.likelihood, drifting.instants, drifting)
        state = self.start(offset_s)
        if state is None:
            return None
        fit = path_fit.fit_paths(thin(self.bodies, _ROUGH_INSTANTS), state, self.freedom())
        if fit is None:
            return None
        return _Candidate(fit.state.offset_s, fit.likelihood, int(fit.kept.sum()), None)

    def refined(self, candidates: Sequence[_Candidate]) -> ChosenFit:
        """Return the fit with all instants at the best candidate."""
        first = candidates[0]
        fit = self._refined(first)
        if fit is None or self._differs(fit):
            self._check_scale()
            raise IpsysError(f"{self.where}: {NO_AGREEMENT}")
        if fit.drifting is not None and abs(fit.drifting.log_scale) > _LARGEST_SCALE_SHARE:
            raise self._other_scale(float(np.exp(fit.drifting.log_scale)))
        return fit

    def check_alike(self, candidates: Sequence[_Candidate]) -> None:
        """Raise an error if another offset agrees as well as the first one."""
        first = candidates[0]
        for other in candidates[1:]:
            apart_s = abs(other.offset_s - first.offset_s)
            if apart_s > _APART_S and first.advantage(other) < _ALIKE:
                raise IpsysError(
                    f"{self.where}: two time offsets, {apart_s:.1f} s apart, fit equally well: the path "
                    "repeats itself; give --time-offset S"
                )

    def _refined(self, first: _Candidate) -> ChosenFit | None:
        state = self.start(first.offset_s)
        if state is None:
            return None
        drifting = first.drifting and self._drifting(self.bodies[0], first.offset_s)
        measured = path_fit.fit_paths(
            self.bodies, state, self.freedom(), path_fit.SCAN_S if drifting is None else _NEAR_S
        )
        if measured is not None and (drifting is None or _is_measured(measured, drifting)):
            return ChosenFit(measured, None)
        if drifting is None:
            return None
        # A path that drifts has no alignment of its own: this is the best constant one.
        pivots_m = np.array([[*drifting.pivot_m, 0.0]])
        aligned = self.start(drifting.offset_s, pivots_m)
        assert aligned is not None
        fixed = replace(self.freedom(), offset=False, drift=False, pivots=())
        constant = path_fit.fit_white(self.bodies, aligned, fixed)
        return None if constant is None else ChosenFit(constant, drifting)

    def _differs(self, fit: ChosenFit) -> bool:
        if fit.drifting is not None:
            return (
                path_cleaning.turn_misfit(self.bodies, fit.drifting.offset_s)
                > path_cleaning.LARGEST_TURN_MISFIT
            )
        largest_m = max(extent_m(body.track_m) for body in self.bodies)
        lengths_m = np.linalg.norm(fit.measured.linear.position, axis=1)
        return float(np.median(lengths_m)) > _LARGEST_SHARE * largest_m

    def _check_scale(self) -> None:
        """Raise an error that names the unit if lengths of both systems differ by a factor."""
        offset_s = self._coarse_s()[0]
        other_m, track_m = self._common(offset_s, np.zeros((len(self.bodies), 3)))
        if len(other_m) < path_fit.LEAST_INSTANTS:
            return
        _, scale = _turn_between(other_m[:, :2], track_m[:, :2])
        misfit_m = _turned_misfit_m(scale * other_m[:, :2], track_m[:, :2])
        fits = misfit_m < _LARGEST_SHARE / 2 * extent_m(track_m)
        if fits and abs(np.log(scale)) > _LARGEST_SCALE_SHARE:
            start = self.start(offset_s)
            assert start is not None
            free = replace(self.freedom(), offset=False, drift=False, scale=True)
            fit = path_fit.fit_white(self.bodies, replace(start, log_scale=float(np.log(scale))), free)
            scale = scale if fit is None else float(np.exp(fit.state.log_scale))
            raise self._other_scale(scale)

    def _other_scale(self, scale: float) -> IpsysError:
        return IpsysError(
            f"{self.where}: its lengths are {1 / scale:.4g} times those of the tracks; correct the unit, "
            "or add --scale if it has none"
        )


def _is_measured(measured: path_fit.PathFit, drifting: DriftFit) -> bool:
    """Return whether a path has the errors of a measurement rather than those of dead reckoning."""
    assert measured.noise is not None
    if any(one > limit for one, limit in zip(measured.noise.smooth, _LARGEST_FIELD, strict=False)):
        return False
    count = int(measured.kept.sum())
    one = _Candidate(0.0, measured.likelihood, count, None)
    return one.advantage(_Candidate(0.0, drifting.likelihood, drifting.instants, None)) > 0


def _turn_between(other_m: Array, track_m: Array) -> tuple[Array, float]:
    """Return the best rotation (d, d) and scale from points (n, d) to others, without outliers."""
    kept = np.ones(len(other_m), dtype=np.bool_)
    for _ in range(3):
        middle_m, target_m = other_m[kept].mean(axis=0), track_m[kept].mean(axis=0)
        rotation, scale = rotation_between(other_m[kept] - middle_m, track_m[kept] - target_m)
        apart_m = np.linalg.norm(track_m - target_m - (other_m - middle_m) @ rotation.T, axis=1)
        kept = apart_m <= _OUTLIER_SHARE * float(np.median(apart_m))
    return rotation, scale


def _turned_misfit_m(other_m: Array, track_m: Array) -> float:
    """Return the median distance of points (n, 2) from others after the best rotation and translation."""
    rotation, _ = _turn_between(other_m, track_m)
    apart_m = track_m - other_m @ rotation.T
    return float(np.median(np.linalg.norm(apart_m - np.median(apart_m, axis=0), axis=1)))


def _common(body: Body, offset_s: float, pivot_m: Array) -> tuple[Array, Array]:
    value, _, known = smooth_values(body.spline, body.track_s - offset_s)
    turns = np.zeros((len(body.track_s), 3))
    turns[:, 2] = np.nan_to_num(body.heading_rad)
    return value[known, :3], (body.track_m + rotate(turns) @ pivot_m)[known]


def extent_m(points_m: Array) -> float:
    """Return the extent of a path on the floor without its outliers, in m."""
    low, high = np.quantile(points_m[:, :2], [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))
