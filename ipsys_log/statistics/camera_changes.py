"""The watch over calibrated cameras: a sudden motion of one is noticed, named and estimated.

A camera that was knocked changes its deviations at all places at once, as six unknowns explain. A marker that
was moved on its robot changes those of one robot only, a reference marker that was moved those of one
marker, and a clock those along the velocities. The watch tests all of these causes over the last seconds,
with each possible start (generalised likelihood ratio), and compares the best with a small motion of the same
kind, which temperature can cause.

References
----------
Basseville and Nikiforov, Detection of abrupt changes, 1993, sect. 2.4.3: unknown change time and magnitude.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array, Floor
from ipsys_log.statistics.deviations import REFERENCE, Deviation
from ipsys_log.statistics.drift import LEAST_SHIFT_M
from ipsys_log.statistics.floor_cameras import floor_grid, shift_floor_map
from ipsys_log.statistics.usual_deviations import UsualDeviations
from ipsys_log.vision.poses import PosedCamera

# Steps whose deviations are tested; older ones become usual.
TESTED_STEPS = 20
# Standard deviations of motions that are tried, the usual ones of temperature first. A camera: turn about
# each axis in rad, and shift along each axis in m;
_CAMERA_SIZES = ((1e-4, 1.5e-4), (1e-3, 2e-3), (5e-3, 5e-3), (3e-2, 1e-2))
# the height of a marker on its robot in m; a reference marker: shift in m, and turn in rad; a clock in s.
_HEIGHT_SIZES_M = (3e-4, 2e-3, 1e-2, 5e-2)
_REFERENCE_SIZES = ((1.5e-4, 1e-3), (5e-3, 2e-2), (5e-2, 0.3))
_CLOCK_SIZES_S = (2e-4, 5e-3, 5e-2)
# Standard deviation of the deviations of a marker that is carried, each by itself, in m and rad.
_CARRIED = 0.01
# Logarithm of the likelihood ratio to a usual change, from which on a change is reported,
_SURE = 10.0
# and by which the best cause exceeds all others before it alone is named.
_LEAD = 10.0
# Smaller changes are left: height of a marker, motion of a reference marker in m, and time of a clock in s.
_LEAST_HEIGHT_M, _LEAST_REFERENCE_M, _LEAST_CLOCK_S = 0.0015, 0.002, 0.0005
# An outlier among the deviations of a repair counts less from this many standard deviations on.
_HUBER = 4.0
# Standard deviation of a turn about an axis before the repair: this share of the turn by the first estimate,
# beside the least one. If two of three axes show, 95 % of random turns are within it. The mount turns about a
# point at this distance, or is shifted by some mm.
_UNSEEN_TURN, _LEAST_TURN_RAD, _LEVER_M, _UNSEEN_SHIFT_M = 1.6, 1e-3, 0.15, 2e-3
# At the start of a recording: standard deviations of a clock offset in s, and of the motion of a camera since
# the calibration in rad and m. Clocks are known below the third value in s; after the tested steps, below the
# fourth; after many steps, in any case. Smaller offsets than this number of standard deviations are 0.
_CLOCK_SIGMA_S, _START_MOTION, _KNOWN_CLOCK_S, _USABLE_CLOCK_S = 0.05, 5e-3, 5e-4, 1e-3
_MOST_START_STEPS, _CLOCK_SIGMAS = 60, 3.0
# Step of numeric slopes, in rad and in m.
_SMALL = 1e-6
_MOTION = 6


class Cause(NamedTuple):
    """A cause of a change, and its camera or marker id.

    The kind is ``camera``, ``robot`` (another height of its marker), ``carried`` (a marker that is not on a
    robot), ``reference`` or ``clock``.
    """

    kind: str
    name: str


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The log likelihood of a cause in a step: information (p, p), gradient (p,), constant of a parabola."""

    information: Array
    gradient: Array
    constant: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """A cause with the start of the change that explains the deviations best.

    Attributes
    ----------
    cause : what has changed.
    first : the number of the first step after the change.
    evidence : log of the likelihood ratio to no change; ``excess``: to a usual change.
    estimate, covariance : (p,) and (p, p), the change.
    """

    cause: Cause
    first: int
    evidence: float
    excess: float
    estimate: Array
    covariance: Array


def gather_evidence(
    usual: UsualDeviations, deviations: Sequence[Deviation], time_ns: int, without: Collection[str] = ()
) -> dict[Cause, Evidence]:
    """Return the evidence for each cause in the deviations of a step.

    Parameters
    ----------
    usual : the usual deviations; places that are not known have no evidence.
    deviations : of the step, at ``time_ns``.
    without : cameras that are left out.
    """
    rows: dict[Cause, list[tuple[Array, Array, Array]]] = {}
    for one in deviations:
        compared = None if set(one.cameras) & set(without) else usual.compare(one, time_ns)
        if compared is not None:
            for cause, slopes in _causes(one):
                rows.setdefault(cause, []).append((slopes, *compared))
    evidence = {cause: _sum_evidence(own) for cause, own in rows.items()}
    carried = {
        Cause("carried", cause.name): Evidence(np.zeros((0, 0)), np.zeros(0), sum(map(_carried, own)))
        for cause, own in rows.items()
        if cause.kind == "robot"
    }
    return evidence | carried


def _causes(one: Deviation) -> Iterator[tuple[Cause, Array]]:
    """Yield the causes of a deviation, with its slopes (k, p) by their changes."""
    for camera, slopes in one.slopes.items():
        yield Cause("camera", camera), slopes
    yield Cause("reference" if one.kind is REFERENCE else "robot", str(one.marker_id)), one.by_marker
    if one.by_clock is not None:
        yield Cause("clock", one.cameras[0]), -one.by_clock
        yield Cause("clock", one.cameras[1]), one.by_clock


def _carried(row: tuple[Array, Array, Array]) -> float:
    """Return the log likelihood ratio of a deviation with an error of its own, to one without."""
    _, difference, variance = row
    wider = variance + _CARRIED**2
    return float((difference**2 * (1 / variance - 1 / wider) - np.log(wider / variance)).sum()) / 2


def _sum_evidence(rows: Sequence[tuple[Array, Array, Array]]) -> Evidence:
    slopes, differences, variances = (np.concatenate(column) for column in zip(*rows, strict=True))
    weighted: Array = slopes / variances[:, None]
    return Evidence(slopes.T @ weighted, weighted.T @ differences)


def find_causes(steps: Sequence[Mapping[Cause, Evidence]]) -> Iterator[Explanation]:
    """Yield an explanation for each cause.

    Parameters
    ----------
    steps : the evidence of successive steps; a change lasts from one of them to the last.
    """
    for cause in sorted({cause for step in steps for cause in step}):
        own = [(number, step[cause]) for number, step in enumerate(steps) if cause in step]
        information = np.cumsum([one.information for _, one in reversed(own)], axis=0)
        gradient = np.cumsum([one.gradient for _, one in reversed(own)], axis=0)
        constant = np.cumsum([one.constant for _, one in reversed(own)])
        starts = [number for number, _ in reversed(own)]
        if cause.kind == "carried":
            best = int(constant.argmax())
            zero = float(constant[best])
            yield Explanation(cause, starts[best], zero, zero, np.zeros(0), np.zeros((0, 0)))
        else:
            yield _best_start(cause, information, gradient, starts)


def _sizes(cause: Cause) -> list[Array]:
    """Return the standard deviations (p,) of the changes that are tried, the usual ones first."""
    if cause.kind == "camera":
        return [np.repeat(size, 3) for size in _CAMERA_SIZES]
    if cause.kind == "reference":
        return [np.repeat(size, 3) for size in _REFERENCE_SIZES]
    return [np.array([size]) for size in (_CLOCK_SIZES_S if cause.kind == "clock" else _HEIGHT_SIZES_M)]


def _best_start(cause: Cause, information: Array, gradient: Array, starts: Sequence[int]) -> Explanation:
    """Return the explanation with the best start, from the sums over the steps since each start."""
    usual: Array | None = None
    best: Explanation | None = None
    for sizes in _sizes(cause):
        scaled = sizes[:, None] * information * sizes + np.eye(len(sizes))
        pulled = gradient * sizes
        solved = np.linalg.solve(scaled, pulled[..., None])[..., 0]
        ratios = ((pulled * solved).sum(axis=1) - np.linalg.slogdet(scaled)[1]) / 2
        if usual is None:
            usual = np.maximum(ratios, 0.0)
            continue
        row = int(ratios.argmax())
        if best is None or ratios[row] > best.evidence:
            covariance = sizes[:, None] * np.linalg.inv(scaled[row]) * sizes
            excess = float(ratios[row] - usual[row])
            estimate = sizes * solved[row]
            best = Explanation(cause, starts[row], float(ratios[row]), excess, estimate, covariance)
    assert best is not None
    return best


@dataclass(slots=True, eq=False)
class Repair:
    """The estimate of the motion of a camera from all deviations since it was named.

    Attributes
    ----------
    turn_rad : the turn by the first estimate; other axes may have turned as far, unseen.
    motion : (6,), from the pose that the deviations refer to.
    information, gradient, squares : the log likelihood of a motion, as a parabola.
    count, values : number of deviations, and of their values.
    """

    turn_rad: float
    motion: Array = field(default_factory=lambda: np.zeros(_MOTION))
    information: Array = field(default_factory=lambda: np.zeros((_MOTION, _MOTION)))
    gradient: Array = field(default_factory=lambda: np.zeros(_MOTION))
    squares: float = 0.0
    count: int = 0
    values: int = 0

    def add(self, usual: UsualDeviations, deviations: Sequence[Deviation], camera: str, time_ns: int) -> None:
        """Add the deviations of a step; outliers count less."""
        for one in deviations:
            compared = usual.compare(one, time_ns) if camera in one.cameras else None
            if compared is None:
                continue
            difference, variance = compared
            slopes = one.slopes[camera]
            # The motion so far has its own uncertainty: it does not make an outlier.
            spread = variance + ((slopes @ self.covariance) * slopes).sum(axis=1)
            square = float(((difference - slopes @ self.motion) ** 2 / spread).mean())
            share = min(1.0, _HUBER / np.sqrt(square)) if square > 0 else 1.0
            weighted = share * slopes / variance[:, None]
            self.information = self.information + slopes.T @ weighted
            self.gradient = self.gradient + weighted.T @ difference
            self.squares += share * float((difference**2 / variance).sum())
            self.count, self.values = self.count + 1, self.values + len(difference)
        self.motion = self.covariance @ self.gradient

    def rebase(self) -> None:
        """Refer to the pose with the motion so far from now on."""
        self.squares -= float(self.motion @ (2 * self.gradient - self.information @ self.motion))
        self.gradient = self.gradient - self.information @ self.motion
        self.motion = np.zeros(_MOTION)

    @property
    def covariance(self) -> Array:
        """The covariance (6, 6) of the motion."""
        turn_rad = _UNSEEN_TURN * self.turn_rad + _LEAST_TURN_RAD
        sizes = np.repeat([turn_rad, _LEVER_M * turn_rad + _UNSEEN_SHIFT_M], 3)
        return np.asarray(np.linalg.inv(self.information + np.diag(sizes**-2)))

    @property
    def misfit(self) -> float:
        """The mean square of the residuals: near 1 if a motion of the camera explains the deviations."""
        left = self.squares - float(self.motion @ (2 * self.gradient - self.information @ self.motion))
        return max(left, 0.0) / self.values if self.values else 1.0


class StartingClocks:
    """The clock offsets of the cameras at the start of a recording, by deviations along the velocities.

    Motions of the cameras are further unknowns, so that a camera that moved before the recording does not
    look like a clock.

    Parameters
    ----------
    cameras : names of the cameras.
    """

    def __init__(self, cameras: Sequence[str]) -> None:
        self._cameras = sorted(cameras)
        sigmas = np.repeat([_CLOCK_SIGMA_S, _START_MOTION], [len(cameras), _MOTION * len(cameras)])
        self._information, self._gradient = np.diag(sigmas**-2), np.zeros(len(sigmas))
        self._seen: set[int] = set()
        self._steps = 0

    def add(self, usual: UsualDeviations, deviations: Sequence[Deviation], time_ns: int) -> None:
        """Add the deviations of a step."""
        rows = [(one, one.by_clock[:, 0]) for one in deviations if one.by_clock is not None]
        self._steps += bool(rows)
        for one, by_clock in rows:
            unknown = one.value, one.kind.passes**2 + one.kind.places**2 + one.noise
            difference, variance = usual.compare(one, time_ns) or unknown
            slopes = np.zeros((len(difference), len(self._gradient)))
            for sign, (camera, by_motion) in zip((-1.0, 1.0), one.slopes.items(), strict=True):
                number = self._cameras.index(camera)
                first = len(self._cameras) + _MOTION * number
                slopes[:, number], slopes[:, first : first + _MOTION] = sign * by_clock, by_motion
                self._seen.add(number)
            weighted = slopes / variance[:, None]
            self._information += slopes.T @ weighted
            self._gradient += weighted.T @ difference

    def offsets_s(self) -> dict[str, float] | None:
        """Return by how much the stamps of cameras are late, beside their mean; None before it is known."""
        is_late = self._steps >= _MOST_START_STEPS
        if not (is_late or len(self._seen) == len(self._cameras)):
            return None
        seen = sorted(self._seen)
        covariance = np.linalg.inv(self._information)
        beside_mean = np.eye(len(seen)) - 1 / len(seen)
        offsets_s = beside_mean @ (covariance @ self._gradient)[seen]
        sigmas_s = np.sqrt((beside_mean @ covariance[np.ix_(seen, seen)] @ beside_mean).diagonal())
        enough_s = _USABLE_CLOCK_S if self._steps >= TESTED_STEPS else _KNOWN_CLOCK_S
        if sigmas_s.max() > enough_s and not is_late:
            return None
        certain = np.where(np.abs(offsets_s) > _CLOCK_SIGMAS * sigmas_s, offsets_s, 0.0)
        return {self._cameras[number]: float(one) for number, one in zip(seen, certain, strict=True)}


@dataclass(frozen=True, slots=True, eq=False)
class ViewedFloor:
    """The floor that a camera sees: slopes (n, 2, 6) of positions there by a motion of the camera."""

    slopes: Array

    @classmethod
    def of_camera(cls, model: JointModel, width: int, height: int, floor: Floor | None) -> ViewedFloor:
        """Return the part of the floor in an image of ``width`` x ``height`` px."""
        lens = replace(model.calibration, width=width, height=height)
        camera = PosedCamera("", lens, model.camera_from_world, model.origin_m)
        points_m = floor_grid(camera, floor)
        shifts = [shift_floor_map(camera, points_m, motion) for motion in _SMALL * np.eye(_MOTION)]
        return cls(np.stack(shifts, axis=-1) / _SMALL)

    def mean_shift(self, motion: Array) -> float:
        """Return the mean shift of positions by a motion (6,), in m."""
        return float(np.linalg.norm(self.slopes @ motion, axis=1).mean()) if len(self.slopes) else 0.0

    def mean_sigma(self, covariance: Array) -> float:
        """Return the root of the mean variance of positions by the covariance of a motion, in m."""
        variances = np.einsum("nai,ij,naj->n", self.slopes, covariance, self.slopes)
        return float(np.sqrt(variances.mean())) if len(variances) else np.inf


def is_change(explanation: Explanation, floors: Mapping[str, ViewedFloor]) -> bool:
    """Return whether an explanation is certain, and large enough for a report."""
    if explanation.excess <= _SURE:
        return False
    if explanation.cause.kind == "camera":
        return floors[explanation.cause.name].mean_shift(explanation.estimate) > LEAST_SHIFT_M
    if explanation.cause.kind == "carried":
        return True
    size = float(np.linalg.norm(explanation.estimate[:3]))
    least = {"robot": _LEAST_HEIGHT_M, "reference": _LEAST_REFERENCE_M, "clock": _LEAST_CLOCK_S}
    return size > least[explanation.cause.kind]


def likely_causes(explanations: Sequence[Explanation]) -> list[Explanation]:
    """Return the explanations that are nearly as likely as the best one, the best first."""
    ordered = sorted(explanations, key=lambda one: -one.evidence)
    return [one for one in ordered if one.evidence > ordered[0].evidence - _LEAD]
