"""The estimation problem: all factors of a lab, its unknowns, and their prior."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ipsys_log.calibration.joint.normal import Block, NormalEquations
from ipsys_log.calibration.joint.parameters import Layout, State
from ipsys_log.calibration.joint.point_factors import PointFactors
from ipsys_log.calibration.joint.robust import limit_of, robust_loss
from ipsys_log.calibration.joint.sighting_factors import SightingFactors
from ipsys_log.calibration.joint.trajectories import Kind, Trajectories
from ipsys_log.messages import Array


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """All factors of a lab and the order of its unknowns.

    The elimination of the local unknowns goes through ``blocks``, or through all of them at once if there are
    none. Both give the same equations.
    """

    layout: Layout
    trajectories: Trajectories
    sightings: tuple[SightingFactors, ...]
    points: PointFactors
    blocks: tuple[Block, ...] = ()

    def cost(self, state: State, ease: float) -> float:
        """Return half the sum of the losses; ``ease`` multiplies the limits between error and outlier."""
        total = self.points.cost(state, self.layout, ease)
        for factors in self.sightings:
            chi2 = factors.chi2(state, self.layout, self.trajectories)
            total += float(robust_loss(chi2, factors.limit * ease)[0].sum()) / 2
        total += float((self.trajectories.smoothness_residuals(state) ** 2).sum()) / 2
        return total + float(self._prior_loss(state)[1].sum()) / 2

    def permits(self, state: State) -> bool:
        """Return whether all focal lengths are positive."""
        return all((state.values[block.lens][:2] > 0).all() for block in self.layout.cameras)

    def prior_residuals(self, state: State) -> Array:
        """Return the differences from the prior, (g,), in standard deviations."""
        sigma = self.layout.sigma
        known = np.isfinite(sigma) & (sigma > 0)
        return np.where(known, (state.values - self.layout.mean) / np.where(known, sigma, 1.0), 0.0)

    def linearise(self, state: State, ease: float) -> NormalEquations:
        """Return the normal equations at a state."""
        layout, trajectories = self.layout, self.trajectories
        counts = trajectories.local_count, len(layout.mean)
        normal = NormalEquations(*counts, trajectories.bandwidth, self.blocks)
        for factors in self.sightings:
            factors.add_to(normal, state, layout, trajectories, ease)
        self.points.add_to(normal, state, layout, ease)
        trajectories.add_smoothness(normal, state)
        residuals, loss, weights = self._prior_loss(state)
        normal.cost += float(loss.sum()) / 2
        sigma = layout.sigma
        scales = np.where(np.isfinite(sigma) & (sigma > 0), 1 / np.where(sigma > 0, sigma, 1.0), 0.0)
        normal.dense[np.diag_indices_from(normal.dense)] += weights * scales**2
        normal.global_gradient += weights * scales * residuals
        return normal

    def _prior_loss(self, state: State) -> tuple[Array, Array, Array]:
        """Return standardised differences from the prior, their losses, and their weights, all (g,).

        The size and the height of a marker in the rig may be wrong: then they must not distort the rest.
        """
        residuals = self.prior_residuals(state)
        loss, weights = residuals**2, np.ones(len(residuals))
        bodies = slice(self.layout.scales.start, self.layout.heights.stop)
        loss[bodies], weights[bodies] = robust_loss(residuals[bodies] ** 2, float(limit_of(1.0)))
        return residuals, loss, weights

    def reweighted(self, state: State, tilt_sigma_rad: float, tilt_time_s: float) -> Problem:
        """Return the problem with the wobble of moving bodies in the covariances of their corners."""
        return replace(
            self,
            sightings=tuple(
                factors.reweighted(state, self.layout, self.trajectories, tilt_sigma_rad, tilt_time_s)
                if factors.kind is Kind.FLOOR
                else factors
                for factors in self.sightings
            ),
        )

    def ease(self, state: State) -> float:
        """Return the factor by which the limits of the loss must grow so that half of the sightings fit."""
        shares = self.shares_of_limit(state)
        return max(1.0, 2 * float(np.median(shares))) if len(shares) else 1.0

    def shares_of_limit(self, state: State) -> Array:
        """Return chi2 of all sightings, (n,), as shares of the largest chi2 of a normal error."""
        shares = [one.chi2(state, self.layout, self.trajectories) / one.limit for one in self.sightings]
        return np.concatenate([np.zeros(0), *shares])

    def excess_loss(self, state: State, most: float) -> float:
        """Return the losses of readings above ``most``, and of moving outliers above their limit."""
        excess = self.points.excess_loss(state, self.layout, most)
        for factors in self.sightings:
            if factors.kind is not Kind.STATIONARY:
                chi2 = factors.chi2(state, self.layout, self.trajectories)
                excess += float(np.maximum(robust_loss(chi2, factors.limit)[0] - factors.limit, 0).sum())
        return excess


def find_blocks(
    layout: Layout, trajectories: Trajectories, sightings: Sequence[SightingFactors]
) -> tuple[Block, ...]:
    """Return one block for all stationary poses, and one for each path over the floor.

    A block has the cameras and the bodies of its sightings, and all modes of the floor. The tape belongs to
    the stationary poses.
    """
    starts = trajectories.path_starts
    used = np.zeros((len(starts), len(layout.mean)), dtype=np.bool_)
    used[:, layout.modes] = True
    used[0, layout.tape] = True
    for factors in sightings:
        block, bodies = layout.cameras[factors.camera], factors.sightings.body
        moving = factors.kind is Kind.FLOOR
        numbers = factors.trajectory + 1 if moving else np.zeros_like(factors.trajectory)
        used[np.unique(numbers), block.start : block.stop] = True
        used[np.unique(numbers), layout.clock(factors.camera, factors.recording)] = True
        used[numbers, layout.scales.start + bodies] = True
        used[numbers, layout.heights.start + bodies] |= moving
    ends = [*starts[1:].tolist(), trajectories.local_count]
    return tuple(
        Block(start, end, np.flatnonzero(own))
        for start, end, own in zip(starts.tolist(), ends, used, strict=True)
    )
