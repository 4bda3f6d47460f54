"""Least-squares fit of clock, frames, pivots and body axes between tracks and another system."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ipsys_log.messages import Array, Mask
from ipsys_log.statistics.ground_truth import wrap_angles
from ipsys_log.statistics.path_noise import (
    Channel,
    Modes,
    Noise,
    estimate_noise,
    field_modes,
    rough_noise,
    solve_white,
    solve_with_noise,
)
from ipsys_log.statistics.path_pairs import Body, smooth_values, thin
from ipsys_log.vision.poses import cross, rotate

# Standard deviations that are known beforehand: of a clock's rate, of a scale, of a pivot in m.
PRIOR_DRIFT, PRIOR_LOG_SCALE, PRIOR_PIVOT_M = 1e-4, 0.05, 0.3
# Smaller noise than 0.1 mm and 0.01 degrees is none of a camera.
LEAST_M, LEAST_RAD = 1e-4, 2e-4
# The median length of a vector with normal components of unit variance, by their number.
_MEDIAN_LENGTH = {1: 0.6745, 2: 1.1774, 3: 1.5382}
# Residuals above 5 sigma are outliers.
_OUTLIER = 5.0
_ROUNDS, _FREE_ROUNDS, _WHITE_ROUNDS = 15, 5, 4
_NOISE_ESTIMATES = 2
_CONVERGED = 1e-10
_LARGEST_SCALE_CHANGE = 1.0
_LARGEST_OFFSET_STEP_S = 0.02
# Offsets around the start whose likelihoods are compared.
SCAN_S, _SCAN_STEP_S, _FINE_STEP_S, _SCAN_INSTANTS = 0.4, 0.02, 0.005, 1000
LEAST_INSTANTS = 8


@dataclass(frozen=True, slots=True)
class Freedom:
    """The parts that are estimated: axes of rotations, shifts and pivots, and whether clock and scale are.

    ``compared`` are the axes of the residuals of positions. With ``uses_other_axes``, the rotations of the
    other body turn the pivot; otherwise the headings of the track do.
    """

    turns: tuple[int, ...]
    shifts: tuple[int, ...]
    compared: tuple[int, ...]
    offset: bool = True
    drift: bool = False
    scale: bool = False
    pivots: tuple[int, ...] = ()
    headings: bool = False
    uses_other_axes: bool = False

    def names(self, bodies: int) -> list[tuple[str, int]]:
        """Return the unknowns in their order: a name, with the number of a body behind, and an axis."""
        found = [("offset", 0)] * self.offset + [("drift", 0)] * self.drift
        found += [("turn", axis) for axis in self.turns] + [("shift", axis) for axis in self.shifts]
        found += [("scale", 0)] * self.scale
        for number in range(bodies):
            found += [(f"pivot {number}", axis) for axis in self.pivots]
            found += [(f"body {number}", 0)] * self.headings
        return found


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """The values of all unknowns. The alignment turns about ``origin_m``, whose image is ``centre_m``."""

    offset_s: float
    drift: float
    reference_s: float
    rotation: Array
    origin_m: Array
    centre_m: Array
    log_scale: float
    pivots_m: Array
    body_turns_rad: Array


class Linear(NamedTuple):
    """The residuals at common instants and their derivatives: pooled over all bodies.

    Attributes
    ----------
    places_m : (n, 2), where the track is, at ``times_s`` (n,).
    position, heading : (n, d) and (n, 1), the residuals; NaN for a missing heading.
    """

    places_m: Array
    times_s: Array
    position: Array
    position_jacobian: Array
    heading: Array
    heading_jacobian: Array


def linearize(bodies: Sequence[Body], state: State, freedom: Freedom) -> Linear | None:
    """Return residuals and derivatives at the instants of the tracks; None without a common instant."""
    parts = [_linearize_body(body, number, len(bodies), state, freedom) for number, body in enumerate(bodies)]
    parts = [part for part in parts if len(part.times_s)]
    if not parts:
        return None
    return Linear(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class _Prediction(NamedTuple):
    """The prediction of a state for a body at common instants, in the lab.

    Attributes
    ----------
    arm_m : (n, 3), from the centre of the alignment to the other body; ``lever_m`` from the marker to it.
    late_m_s : (n, 3), how a later clock moves the residual, and ``yaw_rate`` (n,) of the other body.
    axes, marker : (n, 3, 3), rotations of the other body and of the marker.
    since_s : (n,), the time since the reference of the drift.
    """

    arm_m: Array
    lever_m: Array
    late_m_s: Array
    yaw_rate: Array
    axes: Array
    marker: Array
    since_s: Array


def _linearize_body(body: Body, number: int, count: int, state: State, freedom: Freedom) -> Linear:
    at_s = body.track_s - state.offset_s - state.drift * (body.track_s - state.reference_s)
    value, slope, known = smooth_values(body.spline, at_s)
    if freedom.pivots:
        known &= np.isfinite(value[:, 3] if freedom.uses_other_axes else body.heading_rad)
    times_s, track_m, heading_rad = body.track_s[known], body.track_m[known], body.heading_rad[known]
    found = _predict(value[known], slope[known], heading_rad, number, state, freedom)
    found = found._replace(since_s=times_s - state.reference_s)
    residual = track_m + found.lever_m - found.arm_m - state.centre_m
    heading = (
        heading_rad + state.body_turns_rad[number] - np.arctan2(found.axes[:, 1, 0], found.axes[:, 0, 0])
    )
    columns, turning = [np.zeros((len(residual), 3, 0))], [np.zeros((len(residual), 1, 0))]
    for name, axis in freedom.names(count):
        kind, _, owner = name.partition(" ")
        moves, turns = np.zeros((len(residual), 3)), np.zeros(len(residual))
        if not owner or int(owner) == number:
            moves, turns = _derivatives(kind, axis, found, freedom)
        columns.append(moves[:, :, None])
        turning.append(turns[:, None, None])
    compared = list(freedom.compared)
    return Linear(
        (track_m - residual)[:, :2],  # the noise of the track would look like a steep field
        times_s,
        residual[:, compared],
        np.concatenate(columns, axis=2)[:, compared],
        wrap_angles(heading)[:, None],
        np.concatenate(turning, axis=2),
    )


def _predict(
    value: Array, slope: Array, heading_rad: Array, number: int, state: State, freedom: Freedom
) -> _Prediction:
    scaled = float(np.exp(state.log_scale)) * state.rotation.T
    axes, spin = (state.rotation @ rows[:, 3:].reshape(-1, 3, 3) for rows in (value, slope))
    if freedom.uses_other_axes:
        back = rotate(np.array([[0.0, 0.0, -state.body_turns_rad[number]]]))[0]
        marker, marker_spin = axes @ back, spin @ back
    else:
        turns = np.zeros((len(value), 3))
        turns[:, 2] = np.nan_to_num(heading_rad)
        marker, marker_spin = rotate(turns), np.zeros((len(value), 3, 3))
    ahead, change = axes[:, :2, 0], spin[:, :2, 0]
    return _Prediction(
        (value[:, :3] - state.origin_m) @ scaled,
        marker @ state.pivots_m[number],
        marker_spin @ state.pivots_m[number] - slope[:, :3] @ scaled,
        (ahead[:, 0] * change[:, 1] - ahead[:, 1] * change[:, 0]) / (ahead**2).sum(axis=1),
        axes,
        marker,
        np.zeros(0),
    )


def _derivatives(kind: str, axis: int, found: _Prediction, freedom: Freedom) -> tuple[Array, Array]:
    """Return by how much a step of an unknown lessens residuals of positions (n, 3) and headings (n,)."""
    unit, none = np.broadcast_to(np.eye(3)[axis], found.arm_m.shape), np.zeros(len(found.arm_m))
    if kind == "offset":
        return found.late_m_s, -found.yaw_rate
    if kind == "drift":
        return found.late_m_s * found.since_s[:, None], -found.yaw_rate * found.since_s
    if kind == "turn":
        return cross(unit, found.arm_m - found.lever_m * freedom.uses_other_axes), none + (axis == 2)
    moves = {"shift": unit, "scale": found.arm_m, "pivot": -found.marker[:, :, axis]}
    if kind in moves:
        return moves[kind], none
    return cross(found.axes[:, :, 2], found.lever_m) * freedom.uses_other_axes, none - 1.0


@dataclass(frozen=True, slots=True, eq=False)
class PathFit:
    """A fit: the state, the covariance of its unknowns, its noise, and its log likelihood.

    ``kept`` are the instants that are no outliers, among those of ``linear``.
    """

    state: State
    names: list[tuple[str, int]]
    covariance: Array
    noise: Noise | None
    likelihood: float
    linear: Linear
    kept: Mask
    freedom: Freedom
    channels: list[Channel]

    def sigma(self, name: str, axis: int = 0) -> float:
        """Return the standard deviation of an unknown; NaN if it is not estimated."""
        if (name, axis) not in self.names:
            return float("nan")
        place = self.names.index((name, axis))
        return float(np.sqrt(self.covariance[place, place]))


def fit_paths(
    bodies: Sequence[Body], state: State, freedom: Freedom, scan_s: float = SCAN_S
) -> PathFit | None:
    """Fit all unknowns by Gauss-Newton, with the noise by restricted likelihood; None if they do not overlap.

    Gauss-Newton finds the offset only from a few hundredths of a second: stops and turns of a robot are
    sharp. So the likelihood is first compared over offsets within ``scan_s``, at some of the instants.
    """
    fixed = replace(freedom, offset=False, drift=False)
    few = thin(bodies, _SCAN_INSTANTS)
    best = _converged(few, state, fixed, None, _WHITE_ROUNDS)
    if best is None:
        return None
    if freedom.offset:
        noise = _rough(best)
        for half_s, step_s in ((scan_s, _SCAN_STEP_S), (_SCAN_STEP_S, _FINE_STEP_S)):
            for late_s in np.arange(-half_s, half_s + step_s / 2, step_s):
                moved = replace(best.state, offset_s=state.offset_s + float(late_s))
                fit = _converged(few, moved, fixed, noise, 2)
                if fit is not None and (best.noise is None or fit.likelihood > best.likelihood):
                    best = fit
            state = best.state
    return _refined(bodies, best, freedom)


def _refined(bodies: Sequence[Body], fit: PathFit, freedom: Freedom) -> PathFit | None:
    """Return the fit with all instants and the noise of its own residuals."""
    for _ in range(_NOISE_ESTIMATES):
        found = _converged(bodies, fit.state, freedom, fit.noise or _rough(fit), _ROUNDS)
        if found is None:
            return None
        fit = replace(found, noise=_estimated(found))
    return _converged(bodies, fit.state, freedom, fit.noise, _ROUNDS)


def free_scale(bodies: Sequence[Body], fit: PathFit) -> tuple[float, float]:
    """Return the scale and its standard deviation if a fit had it free, too; NaN if such a fit fails.

    The noise is estimated again: without the scale, its errors look like a smooth field over the floor.
    """
    free = _refined(bodies, fit, replace(fit.freedom, scale=True))
    if free is None:
        return float("nan"), float("nan")
    scale = float(np.exp(free.state.log_scale))
    return scale, scale * free.sigma("scale")


def fit_white(bodies: Sequence[Body], state: State, freedom: Freedom) -> PathFit | None:
    """Fit all unknowns with white noise, from a state that is nearly right."""
    return _converged(bodies, state, freedom, None, _ROUNDS)


def _rough(fit: PathFit) -> Noise:
    return rough_noise(fit.linear.places_m[fit.kept], fit.channels)


def _estimated(fit: PathFit) -> Noise:
    prior, values = _prior(fit.names, fit.state)
    return estimate_noise(fit.linear.places_m[fit.kept], fit.channels, prior, values)


def _converged(
    bodies: Sequence[Body], state: State, freedom: Freedom, noise: Noise | None, rounds: int
) -> PathFit | None:
    """Return the fit after some rounds of Gauss-Newton with a noise; None if the paths do not overlap."""
    names, start_log_scale = freedom.names(len(bodies)), state.log_scale
    cut: tuple[float, float] | None = None
    found: PathFit | None = None
    modes: list[Modes] | None = None
    rows_of_modes: list[Mask] = []
    for round_ in range(rounds):
        linear = linearize(bodies, state, freedom)
        if linear is None or len(linear.times_s) < LEAST_INSTANTS:
            return None
        # Otherwise an instant at the limit can alternate.
        cut = _limits(linear) if cut is None or round_ < _FREE_ROUNDS else cut
        kept = np.linalg.norm(linear.position, axis=1) <= cut[0]
        channels = _channels(linear, kept, freedom, cut[1])
        if kept.sum() < LEAST_INSTANTS or len(channels) < 1 + freedom.headings:
            return None  # far away from any fit
        prior, values = _prior(names, state)
        if noise is None:
            solution = solve_white(channels, prior, values)
        else:
            # The places move by less than the field changes over; their modes take most of the time.
            rows = [kept, *(channel.rows for channel in channels)]
            if modes is None or not all(map(np.array_equal, rows, rows_of_modes)):
                modes, rows_of_modes = field_modes(linear.places_m[kept], channels, noise.field), rows
            solution = solve_with_noise(channels, noise, modes, prior, values)
        step = solution.step.copy()
        if freedom.offset:
            step *= min(1.0, _LARGEST_OFFSET_STEP_S / max(abs(float(step[0])), 1e-12))
        state = _moved(state, names, step)
        if not abs(state.log_scale - start_log_scale) < _LARGEST_SCALE_CHANGE:
            return None  # another drive
        found = PathFit(
            state, names, solution.covariance, noise, solution.likelihood, linear, kept, freedom, channels
        )
        if np.abs(step).max(initial=0.0) < _CONVERGED:
            break
    return found


def _limits(linear: Linear) -> tuple[float, float]:
    """Return the lengths above which residuals of positions and headings are outliers."""
    lengths_m = np.linalg.norm(linear.position, axis=1)
    scale_m = float(np.median(lengths_m)) / _MEDIAN_LENGTH[linear.position.shape[1]]
    angles = np.abs(linear.heading[np.isfinite(linear.heading)])
    scale_rad = float(np.median(angles)) / _MEDIAN_LENGTH[1] if len(angles) else 0.0
    return _OUTLIER * max(scale_m, LEAST_M), _OUTLIER * max(scale_rad, LEAST_RAD)


def _channels(linear: Linear, kept: Mask, freedom: Freedom, limit_rad: float) -> list[Channel]:
    rows = np.ones(int(kept.sum()), dtype=np.bool_)
    found = [Channel(rows, linear.position[kept], linear.position_jacobian[kept], LEAST_M)]
    if freedom.headings:
        heading = linear.heading[kept]
        rows = np.isfinite(heading[:, 0]) & (np.abs(heading[:, 0]) <= limit_rad)
        if rows.any():
            found.append(Channel(rows, heading[rows], linear.heading_jacobian[kept][rows], LEAST_RAD))
    return found


def _prior(names: Sequence[tuple[str, int]], state: State) -> tuple[Array, Array]:
    """Return the information of the unknowns (p,) that is known beforehand, and their values (p,)."""
    information, values = np.zeros(len(names)), np.zeros(len(names))
    for place, (name, axis) in enumerate(names):
        if name == "drift":
            information[place], values[place] = PRIOR_DRIFT**-2, state.drift
        elif name.startswith("pivot"):
            number = int(name.split()[1])
            information[place], values[place] = PRIOR_PIVOT_M**-2, state.pivots_m[number, axis]
    return information, values


def _moved(state: State, names: Sequence[tuple[str, int]], step: Array) -> State:
    turn, shift = np.zeros(3), np.zeros(3)
    pivots_m, body_turns_rad = state.pivots_m.copy(), state.body_turns_rad.copy()
    single = {"offset": 0.0, "drift": 0.0, "scale": 0.0}
    for (name, axis), value in zip(names, step.tolist(), strict=True):
        kind, _, owner = name.partition(" ")
        if kind == "turn":
            turn[axis] = value
        elif kind == "shift":
            shift[axis] = value
        elif kind == "pivot":
            pivots_m[int(owner), axis] += value
        elif kind == "body":
            body_turns_rad[int(owner)] += value
        else:
            single[kind] = value
    return replace(
        state,
        offset_s=state.offset_s + single["offset"],
        drift=state.drift + single["drift"],
        log_scale=state.log_scale + single["scale"],
        rotation=rotate(turn[None])[0] @ state.rotation,
        centre_m=state.centre_m + shift,
        pivots_m=pivots_m,
        body_turns_rad=body_turns_rad,
    )
