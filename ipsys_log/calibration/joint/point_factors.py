"""Factors of calibration points: tape distances, heights, given world points, and tilts."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.joint.normal import NormalEquations
from ipsys_log.calibration.joint.observations import CalibrationPoint, Tape
from ipsys_log.calibration.joint.parameters import Layout, State
from ipsys_log.calibration.joint.robust import limit_of, robust_loss
from ipsys_log.messages import Array, Indices


@dataclass(frozen=True, slots=True, eq=False)
class PointResiduals:
    """Standardised residuals: distances (d,), heights (h,), places (w, 2), tilts (t, 2), baselines (b,)."""

    distances: Array
    heights: Array
    places: Array
    tilts: Array
    baselines: Array


@dataclass(frozen=True, slots=True, eq=False)
class PointFactors:
    """Measurements at calibration points.

    Attributes
    ----------
    distance_points : (d,), indices of the calibration points of the tape distances.
    references_m, distances_m, distance_sigmas_m : (d, 2), (d,), (d,).
    height_points, heights_m, height_sigmas_m : (h,), heights above the floor.
    place_points, places_m, place_whitening : (w,), (w, 2), (w, 2, 2), given world points.
    place_on_reference : (w,), which of them are reference points.
    tape : the readings of distances between reference points.
    count : number of calibration points t; each has a prior on its tilts, with ``tilt_sigma_rad``.
    """

    distance_points: Indices
    references_m: Array
    distances_m: Array
    distance_sigmas_m: Array
    height_points: Indices
    heights_m: Array
    height_sigmas_m: Array
    place_points: Indices
    places_m: Array
    place_whitening: Array
    place_on_reference: NDArray[np.bool_]
    tape: Tape
    count: int
    tilt_sigma_rad: float

    def residuals(self, state: State, layout: Layout) -> PointResiduals:
        """Return the standardised residuals."""
        positions_m, tape = state.positions_m, self.tape
        scale, size = state.values[layout.tape]
        ranges_m = np.linalg.norm(self._arms(state, layout), axis=1)
        at = positions_m[self.height_points]
        floor_m, _ = layout.floor.heights(at, state.values[layout.modes])
        offsets_m = positions_m[self.place_points, :2] - self.places_m - (size - 1) * self.place_arms_m
        return PointResiduals(
            (scale * ranges_m - self.distances_m) / self.distance_sigmas_m,
            (at[:, 2] - floor_m - self.heights_m) / self.height_sigmas_m,
            (self.place_whitening @ offsets_m[:, :, None])[:, :, 0],
            state.turns[:, :2, 2] / self.tilt_sigma_rad,
            (scale * size * tape.baselines_m - tape.readings_m) / tape.reading_sigmas_m,
        )

    def _arms(self, state: State, layout: Layout) -> Array:
        """Return the vectors (d, 2) from the reference points, with their estimated scale, to the points."""
        middle_m, size = self.tape.middle_m, state.values[layout.tape][1]
        references_m = middle_m + size * (self.references_m - middle_m)
        return np.asarray(state.positions_m[self.distance_points, :2] - references_m)

    def distance_slopes(self, state: State, layout: Layout) -> tuple[Array, Array]:
        """Return the derivatives of the expected readings: by the point (d, 2), and by both scales (d, 2)."""
        arms_m, scale = self._arms(state, layout), state.values[layout.tape][0]
        ranges_m = np.maximum(np.linalg.norm(arms_m, axis=1), 1e-9)
        slopes = scale * arms_m / ranges_m[:, None]
        by_size_m = -(slopes * (self.references_m - self.tape.middle_m)).sum(axis=1)
        return slopes, np.stack([ranges_m, by_size_m], axis=1)

    @property
    def place_arms_m(self) -> Array:
        """Return the derivatives (w, 2) of the given world points by the scale of the reference points."""
        return np.where(self.place_on_reference[:, None], self.places_m - self.tape.middle_m, 0.0)

    def cost(self, state: State, layout: Layout, ease: float) -> float:
        """Return half the sum of the losses."""
        residuals = self.residuals(state, layout)
        losses = [robust_loss(chi2, limit * ease)[0].sum() for chi2, limit in _robust_parts(residuals)]
        return float(sum(losses) + (residuals.tilts**2).sum()) / 2

    def excess_loss(self, state: State, layout: Layout, most: float) -> float:
        """Return the sum of the losses of readings above ``most``."""
        parts = _robust_parts(self.residuals(state, layout))
        return float(sum(np.maximum(robust_loss(chi2, limit)[0] - most, 0).sum() for chi2, limit in parts))

    def add_to(self, normal: NormalEquations, state: State, layout: Layout, ease: float) -> None:
        """Add the weighted factors to normal equations; ``ease`` multiplies the limits of the loss."""
        residuals = self.residuals(state, layout)
        normal.cost += self.cost(state, layout, ease)
        roots = [np.sqrt(robust_loss(chi2, limit * ease)[1]) for chi2, limit in _robust_parts(residuals)]
        self._add_distances(normal, state, layout, residuals.distances * roots[0], roots[0])
        self._add_heights(normal, state, layout, residuals.heights * roots[1], roots[1])
        self._add_places(normal, layout, residuals.places * roots[2][:, None], roots[2])
        self._add_baselines(normal, state, layout, residuals.baselines * roots[3], roots[3])
        self._add_tilts(normal, state, residuals.tilts)

    def _add_distances(
        self, normal: NormalEquations, state: State, layout: Layout, residuals: Array, roots: Array
    ) -> None:
        weights = (roots / self.distance_sigmas_m)[:, None]
        slopes, by_tape = ((weights * one)[:, None] for one in self.distance_slopes(state, layout))
        starts = 6 * self.distance_points
        normal.add_local(starts, slopes, residuals[:, None])
        normal.add_mixed(starts, slopes, layout.tape, by_tape)
        normal.add_global(_columns(layout.tape), by_tape, residuals[:, None])

    def _add_places(self, normal: NormalEquations, layout: Layout, residuals: Array, roots: Array) -> None:
        starts, whitening = 6 * self.place_points, self.place_whitening * roots[:, None, None]
        by_size = -(whitening @ self.place_arms_m[:, :, None])
        size = slice(layout.tape.stop - 1, layout.tape.stop)
        normal.add_local(starts, whitening, residuals)
        normal.add_mixed(starts, whitening, size, by_size)
        normal.add_global(_columns(size), by_size, residuals)

    def _add_baselines(
        self, normal: NormalEquations, state: State, layout: Layout, residuals: Array, roots: Array
    ) -> None:
        weights = roots * self.tape.baselines_m / self.tape.reading_sigmas_m
        slopes = weights[:, None, None] * state.values[layout.tape][::-1]
        normal.add_global(_columns(layout.tape), slopes, residuals[:, None])

    def _add_heights(
        self, normal: NormalEquations, state: State, layout: Layout, residuals: Array, roots: Array
    ) -> None:
        at = state.positions_m[self.height_points]
        scale = roots / self.height_sigmas_m
        _, floor_slopes = layout.floor.heights(at, state.values[layout.modes])
        slopes = np.concatenate([-floor_slopes, np.ones((len(at), 1))], axis=1) * scale[:, None]
        starts = 6 * self.height_points
        normal.add_local(starts, slopes[:, None], residuals[:, None])
        if layout.floor.count:
            modes = _columns(layout.modes)
            by_modes = -layout.floor.modes(at)[:, None] * scale[:, None, None]
            normal.add_mixed(starts, slopes[:, None], layout.modes, by_modes)
            normal.add_global(modes, by_modes, residuals[:, None])

    def _add_tilts(self, normal: NormalEquations, state: State, residuals: Array) -> None:
        up = state.turns[:, :, 2]
        slopes = np.zeros((self.count, 2, 6))
        # A small turn w moves the direction by w x up.
        slopes[:, 0, 4], slopes[:, 0, 5] = up[:, 2], -up[:, 1]
        slopes[:, 1, 5], slopes[:, 1, 3] = up[:, 0], -up[:, 2]
        normal.add_local(6 * np.arange(self.count), slopes / self.tilt_sigma_rad, residuals)


def _robust_parts(residuals: PointResiduals) -> list[tuple[Array, float]]:
    """Return chi2 of distances, heights, world points and baselines, each with its limit."""
    one, two = float(limit_of(1.0)), float(limit_of(2.0))
    return [
        (residuals.distances**2, one),
        (residuals.heights**2, one),
        ((residuals.places**2).sum(axis=1), two),
        (residuals.baselines**2, one),
    ]


def _columns(part: slice) -> Indices:
    return np.arange(part.start, part.stop)


def make_point_factors(
    points: tuple[CalibrationPoint, ...], tape: Tape, tilt_sigma_rad: float
) -> PointFactors:
    """Return the factors of calibration points."""
    counts = [len(point.distances_m) for point in points]
    heights = [n for n, point in enumerate(points) if point.height_m is not None]
    placed = [n for n, point in enumerate(points) if point.point_m is not None]
    covariances = np.array([points[n].covariance_m2 for n in placed], dtype=np.float64).reshape(-1, 2, 2)
    return PointFactors(
        np.repeat(np.arange(len(points)), counts),
        np.concatenate([np.zeros((0, 2)), *(point.references_m for point in points)]),
        np.concatenate([np.zeros(0), *(point.distances_m for point in points)]),
        np.concatenate([np.zeros(0), *(point.distance_sigmas_m for point in points)]),
        np.array(heights, dtype=np.intp),
        np.array([points[n].height_m for n in heights], dtype=np.float64),
        np.array([points[n].height_sigma_m for n in heights], dtype=np.float64),
        np.array(placed, dtype=np.intp),
        np.array([points[n].point_m for n in placed], dtype=np.float64).reshape(-1, 2),
        np.linalg.inv(np.linalg.cholesky(covariances)) if placed else covariances,
        np.array([points[n].on_reference for n in placed], dtype=np.bool_),
        tape,
        len(points),
        tilt_sigma_rad,
    )
