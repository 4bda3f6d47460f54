"""Trajectories of bodies: stationary poses, and paths over the floor as planar cubic B-splines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.joint.floor_field import spline_weights
from ipsys_log.joint.normal import NormalEquations
from ipsys_log.joint.parameters import Layout, State
from ipsys_log.joint.rotations import level_turns

__all__ = ["Paths", "Placement", "Trajectories"]

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

_POSE = 6
_KNOT = 3


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


_NO_INDICES = np.zeros(0, dtype=np.intp)
_NO_PATHS = Paths(np.zeros(0), np.zeros(0), _NO_INDICES, _NO_INDICES, _NO_INDICES)


@dataclass(frozen=True, slots=True, eq=False)
class Trajectories:
    """All trajectories: ``stationary`` poses with six local unknowns each, then the knots of ``paths``.

    ``acceleration_sigma`` and ``turn_sigma`` are the usual accelerations on a path, in m/s^2 and rad/s^2.
    """

    stationary: int
    paths: Paths = _NO_PATHS
    acceleration_sigma: float = np.inf
    turn_sigma: float = np.inf

    @property
    def local_count(self) -> int:
        """The number of local unknowns."""
        return _POSE * self.stationary + _KNOT * self.paths.knot_count

    @property
    def bandwidth(self) -> int:
        """The number of diagonals below the main diagonal of the local normal equations."""
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

    def add_accelerations(self, normal: NormalEquations, knots: Array) -> None:
        """Add the prior on accelerations of paths with ``knots`` (k, 3)."""
        middles, scales = self._accelerations()
        if not len(middles):
            return
        pattern = np.array([1.0, -2.0, 1.0])
        slopes = scales[:, :, None, None] * pattern[:, None] * np.eye(_KNOT)[:, None, :]
        residuals = self.acceleration_residuals(knots)
        normal.cost += float((residuals**2).sum()) / 2
        starts = _POSE * self.stationary + _KNOT * (middles - 1)
        normal.add_local(starts, slopes.reshape(len(middles), _KNOT, -1), residuals)

    def acceleration_residuals(self, knots: Array) -> Array:
        """Return second differences (n, 3) of knots (k, 3), in units of the usual acceleration."""
        middles, scales = self._accelerations()
        return np.asarray((knots[middles - 1] - 2 * knots[middles] + knots[middles + 1]) * scales)

    def _accelerations(self) -> tuple[Indices, Array]:
        """Return the inner knots (n,), and factors (n, 3) of their second differences."""
        paths = self.paths
        numbers = np.repeat(np.arange(len(paths)), paths.counts - 2)
        inner = np.concatenate(
            [np.arange(f + 1, f + c - 1) for f, c in zip(paths.first, paths.counts, strict=True)]
            or [np.zeros(0, dtype=np.intp)]
        )
        sigmas = np.array([self.acceleration_sigma, self.acceleration_sigma, self.turn_sigma])
        return inner, 1 / (paths.steps_s[numbers, None] ** 2 * sigmas)
