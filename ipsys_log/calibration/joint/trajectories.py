"""Trajectories of bodies: stationary poses, paths over the floor, and free paths, as cubic B-splines."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import Enum
from math import comb
from typing import NamedTuple

import numpy as np

from ipsys_log.calibration.joint.floor_field import spline_weights
from ipsys_log.calibration.joint.normal import NormalEquations
from ipsys_log.calibration.joint.parameters import Layout, State
from ipsys_log.messages import Array, Indices
from ipsys_log.vision.poses import left_jacobians, level_turns, rotate

_POSE = 6
_KNOT = 3
_FREE_KNOT = 6


@dataclass(frozen=True, slots=True, eq=False)
class Placement:
    """Poses of n bodies, and their derivatives.

    Attributes
    ----------
    positions_m, turns : (n, 3) and (n, 3, 3), in the world.
    starts : (n,), the first local unknown that each pose depends on.
    slopes : (n, 6, k), motion and turn by k consecutive local unknowns; None: these are the pose itself.
    velocities : (n, 6), motion and turn per second; None for a stationary body.
    modes : (n, m), derivatives of z by the modes of the floor; None for a stationary body.
    """

    positions_m: Array
    turns: Array
    starts: Indices
    slopes: Array | None = None
    velocities: Array | None = None
    modes: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """Paths of robots: uniform cubic B-splines of x, y and heading.

    Path i begins at ``starts_s[i]``, has ``counts[i]`` knots from ``first[i]`` on, ``steps_s[i]`` apart, and
    carries the body ``bodies[i]``.
    """

    starts_s: Array
    steps_s: Array
    first: Indices
    counts: Indices
    bodies: Indices

    def __len__(self) -> int:
        return len(self.first)

    @property
    def knot_count(self) -> int:
        """The number of knots of all paths."""
        return int(self.counts.sum())

    def weights(self, path: Indices, times_s: Array) -> tuple[Indices, Array, Array]:
        """Return the first of four knots (n,), their weights (n, 4), and the weights of the speed (n, 4)."""
        places = (times_s - self.starts_s[path]) / self.steps_s[path]
        knots = np.clip(np.floor(places).astype(np.intp), 0, self.counts[path] - 4)
        weights, slopes = spline_weights(places - knots)
        return self.first[path] + knots, weights, slopes / self.steps_s[path][:, None]


class Kind(Enum):
    """The kind of a trajectory."""

    STATIONARY = 0
    FLOOR = 1
    FREE = 2


_NO_INDICES = np.zeros(0, dtype=np.intp)
_NO_PATHS = Paths(np.zeros(0), np.zeros(0), _NO_INDICES, _NO_INDICES, _NO_INDICES)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """All trajectories, in the order of their local unknowns.

    Attributes
    ----------
    stationary : number of stationary poses, with six unknowns each.
    paths : paths over the floor, with three unknowns at each knot.
    acceleration_sigma, turn_sigma : usual accelerations on a path, in m/s^2 and rad/s^2.
    free_paths : free paths, with six unknowns at each knot.
    free_turns : (i, 3, 3), mean orientation of the body on each free path.
    jerk_density, turn_jerk_density : roots of the power densities of the jerk on a free path, in m/s^2.5 and
        rad/s^2.5.
    """

    stationary: int
    paths: Paths = _NO_PATHS
    acceleration_sigma: float = np.inf
    turn_sigma: float = np.inf
    free_paths: Paths = _NO_PATHS
    free_turns: Array = field(default_factory=lambda: np.zeros((0, 3, 3)))
    jerk_density: float = np.inf
    turn_jerk_density: float = np.inf

    @property
    def local_count(self) -> int:
        """The number of local unknowns."""
        return self._free_start + _FREE_KNOT * self.free_paths.knot_count

    @property
    def path_starts(self) -> Indices:
        """The first local unknown of the stationary poses, and of each path over the floor, (1 + paths,)."""
        return np.concatenate([[0], _POSE * self.stationary + _KNOT * self.paths.first]).astype(np.intp)

    @property
    def _free_start(self) -> int:
        return _POSE * self.stationary + _KNOT * self.paths.knot_count

    @property
    def bandwidth(self) -> int:
        """The number of diagonals below the main diagonal of the local normal equations."""
        if len(self.free_paths):
            return 4 * _FREE_KNOT - 1
        return 4 * _KNOT - 1 if len(self.paths) else _POSE - 1

    def place_stationary(self, points: Indices, state: State) -> Placement:
        """Return the stationary poses with the indices ``points`` (n,)."""
        return Placement(state.positions_m[points], state.turns[points], _POSE * points)

    def place_moving(self, paths: Indices, times_s: Array, state: State, layout: Layout) -> Placement:
        """Return the poses on paths (n,) at times (n,). The body is level, at its height above the floor."""
        knots, weights, speeds = self.paths.weights(paths, times_s)
        near = state.knots[knots[:, None] + np.arange(4)]
        x, y, heading = np.einsum("nk,nkd->dn", weights, near)
        vx, vy, turn = np.einsum("nk,nkd->dn", speeds, near)
        flat = np.stack([x, y], axis=1)
        floor_m, slopes, modes = layout.floor.evaluate(flat, state.values[layout.modes])
        z = floor_m + state.values[layout.heights][self.paths.bodies[paths]]
        by_knots = np.zeros((len(paths), _POSE, 4, _KNOT))
        by_knots[:, 0, :, 0] = by_knots[:, 1, :, 1] = by_knots[:, 5, :, 2] = weights
        by_knots[:, 2, :, :2] = weights[:, :, None] * slopes[:, None, :]
        velocities = np.zeros((len(paths), _POSE))
        velocities[:, 0], velocities[:, 1], velocities[:, 5] = vx, vy, turn
        velocities[:, 2] = slopes[:, 0] * vx + slopes[:, 1] * vy
        return Placement(
            np.stack([x, y, z], axis=1),
            level_turns(heading),
            _POSE * self.stationary + _KNOT * knots,
            by_knots.reshape(len(paths), _POSE, -1),
            velocities,
            modes,
        )

    def place_free(self, paths: Indices, times_s: Array, state: State) -> Placement:
        """Return the poses on free paths (n,) at times (n,)."""
        knots, weights, speeds = self.free_paths.weights(paths, times_s)
        near = state.free_knots[knots[:, None] + np.arange(4)]
        values, velocities = (np.einsum("nk,nkd->nd", one, near) for one in (weights, speeds))
        by_vector = left_jacobians(values[:, 3:])
        by_knots = np.zeros((len(paths), _POSE, 4, _FREE_KNOT))
        by_knots[:, [0, 1, 2], :, [0, 1, 2]] = weights
        by_knots[:, 3:, :, 3:] = by_vector[:, :, None, :] * weights[:, None, :, None]
        velocities[:, 3:] = (by_vector @ velocities[:, 3:, None])[:, :, 0]
        return Placement(
            values[:, :3],
            rotate(values[:, 3:]) @ self.free_turns[paths],
            self._free_start + _FREE_KNOT * knots,
            by_knots.reshape(len(paths), _POSE, -1),
            velocities,
        )

    def add_smoothness(self, normal: NormalEquations, state: State) -> None:
        """Add the prior on accelerations of paths over the floor, and on the jerk of free paths."""
        for start, first, factors in self._smoothness(state):
            residuals = factors.residuals
            normal.cost += float((residuals**2).sum()) / 2
            if len(first):
                size = residuals.shape[1]
                units = factors.weights[:, None] * np.eye(size)[:, None]
                slopes = factors.scales[:, :, None, None] * units
                normal.add_local(start + size * first, slopes.reshape(len(first), size, -1), residuals)

    def smoothness_residuals(self, state: State) -> Array:
        """Return differences of the knots, in units of the usual acceleration or jerk."""
        return np.concatenate([factors.residuals.ravel() for _, _, factors in self._smoothness(state)])

    def _smoothness(self, state: State) -> Iterator[tuple[int, Indices, _Differences]]:
        """Yield the first local unknown, the first knot of each factor, and the factors, for both kinds."""
        sigmas = np.array([self.acceleration_sigma, self.acceleration_sigma, self.turn_sigma])
        yield _POSE * self.stationary, *_differences(self.paths, state.knots, 2, 2.0, sigmas)
        densities = np.repeat([self.jerk_density, self.turn_jerk_density], 3)
        yield self._free_start, *_differences(self.free_paths, state.free_knots, 3, 2.5, densities)


class _Differences(NamedTuple):
    """Differences of n times order + 1 consecutive knots of d unknowns, by their standard deviations.

    ``weights`` (order + 1,) are those of the knots, ``scales`` and ``residuals`` are (n, d).
    """

    weights: Array
    scales: Array
    residuals: Array


def _differences(
    paths: Paths, knots: Array, order: int, power: float, sigmas: Array
) -> tuple[Indices, _Differences]:
    """Return the first knot of each difference of an order, and the differences.

    The standard deviation of a difference is ``sigmas`` (d,) times the interval to a ``power``. White jerk of
    the density s has third differences of the standard deviation s h^2.5 at knots h apart.
    """
    numbers = np.repeat(np.arange(len(paths)), paths.counts - order)
    first = np.concatenate(
        [np.arange(f, f + c - order) for f, c in zip(paths.first, paths.counts, strict=True)]
        or [np.zeros(0, dtype=np.intp)]
    )
    weights = np.array([(-1.0) ** (order - k) * comb(order, k) for k in range(order + 1)])
    scales = 1 / (paths.steps_s[numbers, None] ** power * sigmas)
    differences = np.zeros((len(first), knots.shape[1]))
    for k, weight in enumerate(weights.tolist()):
        differences += weight * knots[first + k]
    return first, _Differences(weights, scales, differences * scales)
