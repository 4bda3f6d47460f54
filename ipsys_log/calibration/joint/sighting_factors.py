"""Factors of sightings: reprojection residuals of the points of bodies, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.normal import NormalEquations
from ipsys_log.calibration.joint.observations import Body, Sightings
from ipsys_log.calibration.joint.parameters import Layout, State
from ipsys_log.calibration.joint.robust import limit_of, robust_loss
from ipsys_log.calibration.joint.trajectories import Kind, Placement, Trajectories
from ipsys_log.calibration.lens_models import project_points, project_with_slopes
from ipsys_log.messages import Array, Indices
from ipsys_log.vision.poses import cross

# A covariance of lower rank has no noise in some directions, because a fitted pose removed it there.
_NO_VARIANCE = 1e-4
_SQUARE = 4


@dataclass(frozen=True, slots=True, eq=False)
class Slopes:
    """Derivatives of the pixels of n sightings, (n, 2 p, ...), by pose (6) and global unknowns (u)."""

    pixels: Array
    by_pose: Array
    by_global: Array


@dataclass(frozen=True, slots=True, eq=False)
class WeightedRows:
    """Weighted residuals of n sightings, and their derivatives.

    Attributes
    ----------
    loss : the sum of the robust losses.
    residuals : (n, 2 p).
    starts, by_local : (n,), first local unknown of each sighting; (n, 2 p, k), by k local unknowns.
    by_global : (n, 2 p, u), by the unknowns of :meth:`SightingFactors.columns`.
    by_height, modes : (n, 2 p) and (n, m); their product is the derivative by the modes of the floor below
        moving bodies. None for stationary bodies.
    """

    loss: float
    residuals: Array
    starts: Indices
    by_local: Array
    by_global: Array
    by_height: Array
    modes: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class SightingFactors:
    """Sightings of one camera, of bodies on trajectories of one kind.

    Attributes
    ----------
    camera : index of the camera.
    sightings : the n sightings, of p points each.
    trajectory : (n,), index of the stationary pose or of the path.
    kind : kind of the trajectories.
    points_m : (n, p, 3), the points in body coordinates, at their nominal size.
    pixels, rows : (n, p, 2) and (n, p), the measured points, and their rows. A point that is not visible has
        the mean of the others, and no weight.
    inward : (n, p, 2), motion of a point in the image by an edge offset of 1 px.
    variances : (n, 2 p, 2 p), covariances with the repeatable part of the errors.
    whitening : (n, 2 p, 2 p), matrices that turn residuals into numbers of variance 1.
    recording : index of the recording, whose clock gives the times of moving bodies.
    """

    camera: int
    sightings: Sightings
    trajectory: Indices
    kind: Kind
    points_m: Array
    pixels: Array
    rows: Array
    inward: Array
    variances: Array
    whitening: Array
    recording: int = 0

    @property
    def limit(self) -> Array:
        """The largest chi2 of a normal error, (n,)."""
        visible = np.isfinite(self.sightings.pixels[:, :, 0]).sum(axis=1)
        return np.asarray(limit_of(2.0 * visible))

    def place(self, state: State, layout: Layout, trajectories: Trajectories) -> Placement:
        """Return the poses of the bodies at the instants of the sightings."""
        if self.kind is Kind.STATIONARY:
            return trajectories.place_stationary(self.trajectory, state)
        clock_s = state.values[layout.clock(self.camera, self.recording)]
        row_s = state.values[layout.cameras[self.camera].edge + 2]
        times_s = self.sightings.times_s + clock_s + row_s * self.rows.mean(axis=1)
        if self.kind is Kind.FREE:
            return trajectories.place_free(self.trajectory, times_s, state)
        return trajectories.place_moving(self.trajectory, times_s, state, layout)

    def residuals(self, state: State, layout: Layout, trajectories: Trajectories) -> Array:
        """Return the whitened residuals, (n, 2 p)."""
        points_c, _ = self._points(self.place(state, layout, trajectories), state, layout)
        block = layout.cameras[self.camera]
        pixels = project_points(block.model, state.values[block.lens], points_c.reshape(-1, 3))
        return self._whiten(pixels, state.values[block.edge])

    def chi2(self, state: State, layout: Layout, trajectories: Trajectories) -> Array:
        """Return the sums of the squares of the whitened residuals, (n,)."""
        return np.asarray((self.residuals(state, layout, trajectories) ** 2).sum(axis=1))

    def add_to(
        self, normal: NormalEquations, state: State, layout: Layout, trajectories: Trajectories, ease: float
    ) -> None:
        """Add the weighted factors to normal equations; ``ease`` multiplies the limit of the loss."""
        rows = self.weighted_rows(state, layout, trajectories, ease)
        normal.cost += rows.loss / 2
        columns = self.columns(layout)
        normal.add_local(rows.starts, rows.by_local, rows.residuals)
        normal.add_mixed(rows.starts, rows.by_local, columns, rows.by_global)
        normal.add_global(columns, rows.by_global, rows.residuals)
        if rows.modes is not None and layout.floor.count:
            by_height = rows.by_height
            modes = np.arange(layout.modes.start, layout.modes.stop)
            by_knots = (rows.by_local * by_height[:, :, None]).sum(axis=1)[:, None]
            normal.add_mixed(rows.starts, by_knots, layout.modes, rows.modes[:, None])
            across = (rows.by_global * by_height[:, :, None]).sum(axis=1)
            normal.add_global_block(columns, modes, across.T @ rows.modes)
            strengths = (by_height**2).sum(axis=1)[:, None]
            normal.dense[layout.modes, layout.modes] += (rows.modes * strengths).T @ rows.modes
            normal.global_gradient[modes] += (by_height * rows.residuals).sum(axis=1) @ rows.modes

    def weighted_rows(
        self, state: State, layout: Layout, trajectories: Trajectories, ease: float = 1.0
    ) -> WeightedRows:
        """Return the whitened residuals with the weights of the robust loss, and their derivatives."""
        place = self.place(state, layout, trajectories)
        slopes = self.slopes(place, state, layout)
        residuals = self._whiten(slopes.pixels, state.values[layout.cameras[self.camera].edge])
        loss, weights = robust_loss((residuals**2).sum(axis=1), self.limit * ease)
        roots = np.sqrt(weights)
        weighing = self.whitening * roots[:, None, None]
        by_pose = weighing @ slopes.by_pose
        return WeightedRows(
            float(loss.sum()),
            residuals * roots[:, None],
            place.starts,
            by_pose if place.slopes is None else by_pose @ place.slopes,
            weighing @ slopes.by_global,
            by_pose[:, :, 2],
            place.modes,
        )

    def columns(self, layout: Layout) -> Indices:
        """Return the global unknowns (u,) of these factors, less the modes of the floor."""
        block, bodies = layout.cameras[self.camera], np.unique(self.sightings.body)
        camera = np.arange(block.start, block.stop)
        camera[block.edge + 1 - block.start] = layout.clock(self.camera, self.recording)
        parts = [camera, layout.scales.start + bodies]
        return np.concatenate([*parts, layout.heights.start + bodies] if self.kind is Kind.FLOOR else parts)

    def slopes(self, place: Placement, state: State, layout: Layout) -> Slopes:
        """Return the pixels of the points, and their derivatives."""
        points_c, arms_m = self._points(place, state, layout)
        count, size = points_c.shape[:2]
        block, turn = layout.cameras[self.camera], state.camera_turns[self.camera]
        lens = state.values[block.lens]
        pixels, by_point, by_lens = project_with_slopes(block.model, lens, points_c.reshape(-1, 3))
        by_point = by_point.reshape(count, size, 2, 3)
        by_world = by_point @ turn
        by_pose = np.concatenate([by_world, cross(arms_m[:, :, None], by_world)], axis=3)
        bodies, which = np.unique(self.sightings.body, return_inverse=True)
        by_global = np.zeros((count, size, 2, len(self.columns(layout))))
        by_global[..., :3] = cross(points_c[:, :, None], by_point)
        by_global[..., 3:6] = -by_world
        by_global[..., 6 : 6 + len(lens)] = by_lens.reshape(count, size, 2, -1)
        edge = 6 + len(lens)
        by_global[..., edge] = self.inward
        if place.velocities is not None:
            by_global[..., edge + 1] = by_time = (by_pose * place.velocities[:, None, None]).sum(axis=3)
            by_global[..., edge + 2] = by_time * self.rows[:, :, None]
        if self.kind is Kind.FLOOR:
            by_global[np.arange(count), ..., edge + 3 + len(bodies) + which] = by_world[..., 2]
        sizes = state.values[layout.scales][self.sightings.body][:, None, None]
        by_size = (by_world * (arms_m / sizes)[:, :, None]).sum(axis=3)
        by_global[np.arange(count), ..., edge + 3 + which] = by_size
        rows = 2 * size
        return Slopes(pixels, by_pose.reshape(count, rows, 6), by_global.reshape(count, rows, -1))

    def reweighted(
        self,
        state: State,
        layout: Layout,
        trajectories: Trajectories,
        tilt_sigma_rad: float,
        tilt_time_s: float,
    ) -> SightingFactors:
        """Return these factors with the tilts of moving bodies as noise of their points.

        Sightings within the correlation time share one tilt, so an average over them does not reduce it.
        White noise of a larger variance has the same effect on all unknowns that change slowly: the variance
        of a tilt, times the sum of its correlations with all other sightings of the path.

        Parameters
        ----------
        tilt_sigma_rad, tilt_time_s : standard deviation of the tilt about either axis, and the time t for
            which the correlation after d seconds is exp(-d^2 / (2 t^2)).
        """
        by_pose = self.slopes(self.place(state, layout, trajectories), state, layout).by_pose
        tilts = tilt_sigma_rad * np.sqrt(self._sharing(tilt_time_s)) * by_pose[:, :, 3:5]
        return replace(self, whitening=_whitening(self.variances + tilts @ tilts.swapaxes(1, 2)))

    def jittered(
        self, state: State, layout: Layout, trajectories: Trajectories, jitter_s: Array
    ) -> SightingFactors:
        """Return these factors with random errors of their times, ``jitter_s`` (n,), as noise of points."""
        place = self.place(state, layout, trajectories)
        clock = layout.cameras[self.camera].edge + 1 - layout.cameras[self.camera].start
        by_time = self.slopes(place, state, layout).by_global[:, :, clock : clock + 1] * self._visible
        by_time = by_time * jitter_s[:, None, None]
        noise = by_time @ by_time.swapaxes(1, 2)
        return replace(self, whitening=_whitening(self.variances + noise) * self._visible)

    @property
    def _visible(self) -> Array:
        """1 for each coordinate of a visible point, 0 for others, (n, 2 p, 1)."""
        return np.repeat(np.isfinite(self.sightings.pixels[:, :, :1]), 2, axis=1).astype(np.float64)

    def log_weights(self) -> float:
        """Return the logarithm of the product of all weights of the residuals."""
        return float(np.log(np.diagonal(self.whitening, axis1=1, axis2=2)[self._visible[:, :, 0] > 0]).sum())

    def _sharing(self, tilt_time_s: float) -> float:
        """Return how many sightings of a path share one tilt: at least 1."""
        order = np.lexsort((self.sightings.times_s, self.trajectory))
        intervals_s = np.diff(self.sightings.times_s[order])[np.diff(self.trajectory[order]) == 0]
        if not len(intervals_s):
            return 1.0
        # The sum over a Gaussian correlation function is its integral, divided by the interval.
        return max(1.0, float(np.sqrt(2 * np.pi) * tilt_time_s / np.median(intervals_s)))

    def _points(self, place: Placement, state: State, layout: Layout) -> tuple[Array, Array]:
        """Return the points in camera coordinates, and their arms in world axes, both (n, p, 3) in m."""
        sizes = state.values[layout.scales][self.sightings.body]
        arms_m = self.points_m @ (place.turns.swapaxes(1, 2) * sizes[:, None, None])
        points_m = arms_m + place.positions_m[:, None]
        block = layout.cameras[self.camera]
        row_s = state.values[block.edge + 2]
        if place.velocities is not None and row_s:
            later_s = row_s * (self.rows - self.rows.mean(axis=1, keepdims=True))
            speeds = place.velocities[:, None, :3] + cross(place.velocities[:, None, 3:], arms_m)
            points_m = points_m + later_s[:, :, None] * speeds
        origin_m = state.values[block.start + 3 : block.start + 6]
        return (points_m - origin_m) @ state.camera_turns[self.camera].T, arms_m

    def _whiten(self, pixels: Array, edge_px: float) -> Array:
        count, size = self.points_m.shape[:2]
        misses = pixels.reshape(count, size, 2) + edge_px * self.inward - self.pixels
        return np.asarray((self.whitening @ misses.reshape(count, 2 * size, 1))[:, :, 0])


def make_sighting_factors(
    camera: int,
    sightings: Sightings,
    trajectory: Indices,
    kind: Kind,
    bodies: tuple[Body, ...],
    floor_px: float,
    recording: int = 0,
) -> SightingFactors:
    """Return the factors of sightings; ``floor_px`` is the repeatable part of the error of a point."""
    visible: NDArray[np.bool_] = np.isfinite(sightings.pixels[:, :, 0])
    size = visible.shape[1]
    means = np.where(visible[:, :, None], sightings.pixels, 0.0).sum(axis=1) / visible.sum(axis=1)[:, None]
    pixels = np.where(visible[:, :, None], sightings.pixels, means[:, None])
    variances = _fill(sightings.covariances_px2) if size == _SQUARE else sightings.covariances_px2
    variances = variances + floor_px**2 * np.eye(2 * size)
    whitening = _whitening(variances) * np.repeat(visible, 2, axis=1)[:, :, None]
    return SightingFactors(
        camera,
        sightings,
        trajectory,
        kind,
        np.stack([bodies[body].points_m for body in sightings.body.tolist()]),
        pixels,
        pixels[:, :, 1],
        _inward(pixels),
        variances,
        whitening,
        recording,
    )


def at_one_instant(factors: SightingFactors) -> SightingFactors:
    """Return factors of points that are those of one instant.

    With a row time, whether right or wrong, detection gives such points.
    """
    rows_px = factors.rows.mean(axis=1, keepdims=True)
    return replace(factors, rows=np.broadcast_to(rows_px, factors.rows.shape))


def _fill(covariances: Array) -> Array:
    """Return covariances in which directions without variance have the mean of the others."""
    variances, axes = np.linalg.eigh(covariances)
    has = variances > _NO_VARIANCE * variances[:, -1:]
    means = (variances * has).sum(axis=1) / has.sum(axis=1)
    filled = np.where(has, variances, means[:, None])
    return np.asarray((axes * filled[:, None]) @ axes.swapaxes(1, 2))


def _whitening(covariances: Array) -> Array:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def _inward(pixels: Array) -> Array:
    """Return the motion of the corners of squares (n, 4, 2) if each edge moves inwards by 1 px.

    The directions of the measured edges are used, so that the motion is a constant. Bodies that are not
    squares have no edges.
    """
    if pixels.shape[1] != _SQUARE:
        return np.zeros_like(pixels)
    after, before = (np.roll(pixels, shift, axis=1) - pixels for shift in (-1, 1))
    units = [side / np.linalg.norm(side, axis=2, keepdims=True) for side in (after, before)]
    return np.asarray(units[0] + units[1])
