"""Fit of clock and pivot to a dead-reckoned path, whose coordinates drift away from those of the lab.

The path is cut into short segments. Each has a rotation and a translation of its own to the lab; those of
neighbours differ by a random walk, which grows with the motion. So the drift does not pull clock and pivot.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Indices
from ipsys_log.statistics.path_fit import LEAST_INSTANTS, LEAST_M, LEAST_RAD, PRIOR_LOG_SCALE, PRIOR_PIVOT_M
from ipsys_log.statistics.path_noise import factorize
from ipsys_log.statistics.path_pairs import Body, smooth_values

# A segment takes at least this long; a longer path has longer ones.
_LEAST_SEGMENT_S = 1.0
_MOST_SEGMENTS = 200
# Turning by 1 rad drifts like driving 0.3 m; standing drifts little.
_TURN_M, _STANDING_M_S = 0.3, 1e-3
ROUNDS = 40
_CONVERGED = 1e-4
# The standard deviation of a given value.
_EXACT = 1e-7
_LARGEST_STEP_S = 0.05
# Residuals are alike over so many segments.
_BLOCK_SEGMENTS = 3
# Columns of the spline of a body: x and y, and its x axis on the floor.
_USED = [0, 1, 3, 6]
# Offset, pivot x and y, turn of the body, logarithm of the scale.
_SHARED = 5

Complex = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class DriftFit:
    """Clock, pivot, body turn and scale of a dead-reckoned path, and their covariance in this order, (5, 5).

    ``offset_s``, ``pivot_m`` (2,), ``body_turn_rad`` and ``log_scale`` are as in
    :class:`~ipsys_log.statistics.path_fit.State`. ``likelihood`` compares with that of
    :class:`~ipsys_log.statistics.path_fit.PathFit`.
    """

    offset_s: float
    pivot_m: Array
    body_turn_rad: float
    log_scale: float
    covariance: Array
    likelihood: float
    turn_sigma_rad: float
    shift_sigma_m: float
    instants: int


@dataclass(frozen=True, slots=True, eq=False)
class _Chain:
    """All unknowns: the shared ones (5,), and rotation (s,) and position (s, 2) of each segment.

    ``walk`` are the variances of the random walk of rotation and position for each metre of motion; ``white``
    those of the residuals of positions and headings.
    """

    shared: Array
    turns_rad: Array
    centres_m: Array
    walk: tuple[float, float]
    white: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """Instants with both poses, as complex numbers: x + iy, and unit vectors of headings.

    ``marker`` and ``ahead`` are of the lab; ``other``, ``axis``, ``speed`` and ``rate`` of the other body.
    ``segment`` (n,) is that of each instant. ``starts`` (s,) are the other positions at which segments begin,
    and ``motion_m`` (s - 1,) the motion between their starts.
    """

    marker: Complex
    ahead: Complex
    other: Complex
    axis: Complex
    speed: Complex
    rate: Array
    segment: Indices
    starts: Complex
    motion_m: Array


def fit_drifting(
    body: Body,
    offset_s: float,
    is_given: bool = False,
    pivot_m: Sequence[float] | None = None,
    rounds: int = ROUNDS,
) -> DriftFit | None:
    """Fit a path that drifts, from a coarse offset; None without enough poses with headings in both systems.

    The offset stays if it is given, and the pivot is the given one. Gauss-Newton over all unknowns; the
    variances are improved by expectation and maximisation in each round.
    """
    segments = _segments(body)
    rows = _rows(body, offset_s, segments)
    if rows is None:
        return None
    chain = _start(rows, offset_s)
    expected, sigmas = chain.shared.copy(), np.array([np.inf, PRIOR_PIVOT_M, PRIOR_PIVOT_M, np.inf, np.inf])
    expected[4], sigmas[4] = 0.0, PRIOR_LOG_SCALE
    if is_given:
        sigmas[0] = _EXACT
    if pivot_m is not None:
        expected[1:3], sigmas[1:3] = pivot_m[:2], _EXACT
    for _ in range(rounds):
        rows = _rows(body, float(chain.shared[0]), segments)
        if rows is None:
            return None
        chain, covariance, likelihood, change = _improve(chain, rows, expected, 1 / sigmas**2)
        if change < _CONVERGED:
            break
    middle = _SHARED + 3 * (len(chain.turns_rad) // 2)
    sigmas = np.sqrt(np.diag(covariance))
    shared = _with_blocks(chain, rows, covariance)
    offset, *pivot_m, body_turn_rad, log_scale = chain.shared.tolist()
    return DriftFit(
        offset,
        np.array(pivot_m),
        body_turn_rad,
        log_scale,
        shared,
        likelihood,
        float(sigmas[middle]),
        float(sigmas[middle + 1 : middle + 3].max()),
        len(rows.marker),
    )


class _Segments(NamedTuple):
    """Times (s,) and other positions (s,) at which segments begin, and the motion (s - 1,) between them."""

    times_s: Array
    starts: Complex
    motion_m: Array


def _segments(body: Body) -> _Segments:
    """Return segments of equal motion of the other body, of at least 1 s."""
    ahead, other = _ahead(body.axes), body.other_m[:, 0] + 1j * body.other_m[:, 1]
    turned = np.abs(np.nan_to_num(np.angle(ahead[1:] / ahead[:-1])))
    steps_m = np.abs(np.diff(other)) + _TURN_M * turned + _STANDING_M_S * np.diff(body.other_s)
    passed_m = np.append(0.0, np.cumsum(steps_m))
    count = int(np.clip((body.other_s[-1] - body.other_s[0]) / _LEAST_SEGMENT_S, 1, _MOST_SEGMENTS))
    kept = [0]
    for place in np.unique(np.searchsorted(passed_m, np.arange(count) / count * passed_m[-1])).tolist():
        if body.other_s[place] - body.other_s[kept[-1]] >= _LEAST_SEGMENT_S:
            kept.append(place)
    return _Segments(body.other_s[kept], other[kept], np.diff(passed_m[kept]))


def _ahead(axes: Array) -> Complex:
    return np.asarray(axes[:, 0, 0] + 1j * axes[:, 1, 0])


def _rows(body: Body, offset_s: float, segments: _Segments) -> _Rows | None:
    """Return the instants with poses in both systems."""
    at_s = body.track_s - offset_s
    value, slope, known = smooth_values(body.spline, at_s)
    value, slope = value[:, _USED], slope[:, _USED]
    known &= np.isfinite(value).all(axis=1) & np.isfinite(body.heading_rad)
    if known.sum() < LEAST_INSTANTS:
        return None
    value, slope, at_s = value[known], slope[known], at_s[known]
    axis, spin = value[:, 2] + 1j * value[:, 3], slope[:, 2] + 1j * slope[:, 3]
    segment = np.searchsorted(segments.times_s, at_s, side="right") - 1
    return _Rows(
        body.track_m[known, 0] + 1j * body.track_m[known, 1],
        np.exp(1j * body.heading_rad[known]),
        value[:, 0] + 1j * value[:, 1],
        np.asarray(axis / np.abs(axis), dtype=np.complex128),
        slope[:, 0] + 1j * slope[:, 1],
        np.imag(spin / axis),
        segment,
        segments.starts,
        segments.motion_m,
    )


def _start(rows: _Rows, offset_s: float) -> _Chain:
    """Return a chain in which each segment has the rotation of its headings."""
    lag = max(len(rows.marker) // 100, 1)
    # The same movement in the axes of the marker and in those of the other body.
    by_marker = (rows.marker[lag:] - rows.marker[:-lag]) / rows.ahead[:-lag]
    by_other = (rows.other[lag:] - rows.other[:-lag]) / rows.axis[:-lag]
    body_turn = np.angle(np.sum(by_marker * np.conj(by_other)))
    count, numbers = len(rows.starts), np.arange(len(rows.starts))
    sizes = np.bincount(rows.segment, minlength=count)
    turns = rows.ahead * np.exp(1j * body_turn) / rows.axis
    turn = np.bincount(rows.segment, turns.real, count) + 1j * np.bincount(rows.segment, turns.imag, count)
    # A segment without an instant starts like its nearest neighbour.
    filled = numbers[sizes > 0]
    near = filled[np.abs(filled[None] - numbers[:, None]).argmin(axis=1)]
    turn = (turn / np.where(sizes > 0, np.abs(turn), 1.0))[near]
    apart = rows.marker - turn[rows.segment] * (rows.other - rows.starts[rows.segment])
    centre = np.bincount(rows.segment, apart.real, count) + 1j * np.bincount(rows.segment, apart.imag, count)
    centre = (centre / np.maximum(sizes, 1))[near] + turn * (rows.starts - rows.starts[near])
    centres = (centre.real, centre.imag)
    shared = np.array([offset_s, 0.0, 0.0, body_turn, 0.0])
    return _Chain(shared, np.angle(turn), np.column_stack(centres), (1e-3, 1e-3), (1e-4, 1e-4))


def _improve(
    chain: _Chain, rows: _Rows, expected: Array, information: Array
) -> tuple[_Chain, Array, float, float]:
    """Return the chain after a step, the covariance of all unknowns, the likelihood, and the change.

    The shared unknowns are ``expected`` (5,) with an ``information`` (5,).
    """
    residual, jacobian, kinds = _system(chain, rows)
    count, steps = len(rows.marker), np.tile(rows.motion_m, 3)
    variances = np.concatenate(
        [
            np.full(2 * count, chain.white[0]),
            np.full(count, chain.white[1]),
            np.repeat([chain.walk[0], chain.walk[1], chain.walk[1]], len(rows.motion_m)) * steps,
        ]
    )
    weighed = jacobian.multiply(1 / variances[:, None]).tocsr()
    prior = np.zeros(jacobian.shape[1])
    prior[:_SHARED] = information
    values = np.zeros(len(prior))
    values[:_SHARED] = chain.shared - expected
    normal = (jacobian.T @ weighed).toarray() + np.diag(prior)
    right = weighed.T @ residual - prior * values
    scale = 1 / np.sqrt(np.diag(normal))
    factor = factorize(normal * np.outer(scale, scale))
    inverse = np.linalg.inv(factor) * scale
    covariance = inverse.T @ inverse
    step = covariance @ right
    log_det = 2 * (np.log(np.diag(factor)).sum() - np.log(scale).sum())
    misfit = float(residual**2 @ (1 / variances) + prior @ values**2 - step @ right)
    likelihood = -0.5 * (misfit + np.log(variances).sum() + log_det) - np.log(PRIOR_LOG_SCALE)
    step *= min(1.0, _LARGEST_STEP_S / max(abs(float(step[0])), 1e-12))
    spread = np.asarray(jacobian.multiply(jacobian @ covariance).sum(axis=1)).ravel()
    squares = (residual - jacobian @ step) ** 2 + spread
    walks = squares / np.concatenate([np.ones(3 * count), steps])
    white = [
        max(float(walks[kinds == kind].mean()), least**2) for kind, least in ((0, LEAST_M), (1, LEAST_RAD))
    ]
    walk = [
        max(float(walks[kinds == kind].mean()), 1e-12) if (kinds == kind).any() else 1e-3 for kind in (2, 3)
    ]
    segments = step[_SHARED:].reshape(-1, 3)
    change = max(float(np.abs(step[:4]).max()), abs(float(np.log(walk[0] / chain.walk[0]))) * 1e-2)
    moved = replace(
        chain,
        shared=chain.shared + step[:_SHARED],
        turns_rad=chain.turns_rad + segments[:, 0],
        centres_m=chain.centres_m + segments[:, 1:],
        walk=(walk[0], walk[1]),
        white=(white[0], white[1]),
    )
    return moved, covariance, likelihood, change


def _with_blocks(chain: _Chain, rows: _Rows, covariance: Array) -> Array:
    """Return the covariance of the shared unknowns (5, 5), enlarged by residuals that are alike in a block.

    A robot follows its commands late, in each manoeuvre by another time.

    References
    ----------
    Liang and Zeger, Biometrika 1986, eq. (5), with a few segments as a cluster.
    """
    residual, jacobian, _ = _system(chain, rows)
    count = len(rows.marker)
    weights = np.repeat([1 / chain.white[0], 1 / chain.white[1]], [2 * count, count])
    scores = jacobian[: 3 * count].multiply((weights * residual[: 3 * count])[:, None]).tocsr()
    block = np.tile(rows.segment // _BLOCK_SEGMENTS, 3)
    sums = np.array([np.asarray(scores[block == one].sum(axis=0)).ravel() for one in np.unique(block)])
    effects = sums @ covariance[:, :_SHARED]
    clustered = effects.T @ effects * len(sums) / max(len(sums) - 1, 1)
    own = covariance[:_SHARED, :_SHARED]
    factors = np.sqrt(np.maximum(np.diag(clustered) / np.diag(own), 1.0))
    return np.asarray(own * np.outer(factors, factors))


def _system(chain: _Chain, rows: _Rows) -> tuple[Array, Any, Indices]:
    """Return residuals, sparse derivatives, and the kind of each: position, heading, and both walks."""
    from scipy.sparse import coo_array

    pivot_x, pivot_y, body_turn, log_scale = chain.shared[1:].tolist()
    pivot, scale, count = complex(pivot_x, pivot_y), np.exp(log_scale), len(rows.marker)
    turn = np.exp(1j * chain.turns_rad)
    own, centre = turn[rows.segment], (chain.centres_m[:, 0] + 1j * chain.centres_m[:, 1])
    axes = own * rows.axis * np.exp(-1j * body_turn)
    arm = scale * own * (rows.other - rows.starts[rows.segment])
    position = rows.marker + axes * pivot - arm - centre[rows.segment]
    heading = np.angle(rows.ahead * np.exp(1j * body_turn) / (rows.axis * own))
    moves = scale * turn[:-1] * np.diff(rows.starts)
    bends = np.angle(turn[1:] / turn[:-1])
    slips = np.diff(centre) - moves
    place = _SHARED + 3 * rows.segment
    ones = np.ones(count)
    columns = [
        (np.zeros(count, int), 1j * rows.rate * axes * pivot - scale * own * rows.speed, -rows.rate),
        (np.full(count, 1), -axes, None),
        (np.full(count, 2), -1j * axes, None),
        (np.full(count, 3), 1j * axes * pivot, -ones),
        (np.full(count, 4), arm, None),
        (place, 1j * (arm - axes * pivot), ones),
        (place + 1, ones + 0j, None),
        (place + 2, 1j * ones, None),
    ]
    entries: list[tuple[Indices, Indices, Array]] = []
    numbers = np.arange(count)
    for column, complex_part, angle_part in columns:
        entries += [(numbers, column, complex_part.real), (count + numbers, column, complex_part.imag)]
        if angle_part is not None:
            entries.append((2 * count + numbers, column, angle_part))
    walk, before = np.arange(len(moves)), _SHARED + 3 * np.arange(len(moves))
    unit, first = np.ones(len(moves)), 3 * count
    entries += [(first + walk, before, unit), (first + walk, before + 3, -unit)]
    for row, part in ((first + len(moves) + walk, np.real), (first + 2 * len(moves) + walk, np.imag)):
        entries += [(row, before, part(1j * moves)), (row, np.full(len(moves), 4), part(moves))]
        axis = 1 if part is np.real else 2
        entries += [(row, before + axis, unit), (row, before + 3 + axis, -unit)]
    row, column, value = (np.concatenate(parts) for parts in zip(*entries, strict=True))
    residual = np.concatenate([position.real, position.imag, heading, bends, slips.real, slips.imag])
    kinds = np.repeat([0, 1, 2, 3], [2 * count, count, len(moves), 2 * len(moves)])
    shape = (len(residual), _SHARED + 3 * len(turn))
    return residual, coo_array((value, (row, column)), shape=shape).tocsr(), kinds
