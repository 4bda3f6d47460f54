"""Test of camera intrinsics by the images of markers: squares that lie level, and all at one distance.

The image of a marker gives the Jacobian of its print at its centre, without its size. In the plane in which
the marker lies, the Jacobian is a rotation times a scale. For a marker of another tilt, or through wrong
intrinsics, its shape deviates by ``beta / alpha`` (the Beltrami coefficient: axes differ by twice its
size). These deviations are linear in the errors of corners everywhere in the image, unlike tilts. Least
squares explain them by the tilt of the floor, by one tilt of the top of each robot, and by a correction of
the image: scale, aspect, skew, centre and two radial terms. The intrinsics are contradicted if the correction
is much larger than the errors of a calibration, beside its own uncertainty. Markers in a hand explain
nothing: their scatter makes the correction uncertain.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.lenses import undistort
from ipsys_log.geometry.square_pose import is_convex, reprojection_px, solve_squares
from ipsys_log.messages import CameraCalibration, Marker, Markers, Rig
from ipsys_log.units import NS_PER_S

__all__ = ["Contradiction", "IntrinsicsTest", "find_contradictions"]

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

# Frames in this interval show no other places of a moving robot.
_EVERY_NS = NS_PER_S // 5
# Numbers of sightings at which the test is made. Then a new window begins, because a lens can be changed
# later; it is tested at its end.
_TESTED_AT = (8, 32, 64, 128, 256)
# With fewer, chance and the unknowns explain too much.
_LEAST_LEVEL = 24
# The correction: scale, centre x and y, radial terms at half the width of the image, aspect, skew. Sigmas of
# any camera, and of the error of a good calibration: 0.4 % of the focal length, 4 px of 1920 for the centre.
_ANY = np.array([0.3, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1])
_CALIBRATED = np.array([0.004, 0.004, 0.004, 0.003, 0.003, 0.002, 0.002])
_NONE = 1e-6 * _ANY
_PARAMETERS = len(_ANY)
# Sigma of the tilt of the top of a robot, in rad; of the floor to the image, any tilt.
_TOP_TILT, _ANY_TILT = 0.035, 3.0
# Error of the shape of a print: stretched by the printer by 0.3 %, bent, on a floor that is not flat.
_SHAPE_SIGMA = 0.002
_HUBER = 2.5
# Chi-square of seven parameters: chance exceeds it once in 10,000 tests. Least deviation of shapes that the
# correction explains: a good calibration has 0.4 % at the border of the image. Least ratio of the deviations
# before and after the correction.
_CHI2, _LEAST_EFFECT, _LEAST_RATIO = 30.0, 0.005, 1.5
_ITERATIONS, _SETTLED, _STEP = 12, 0.05, 1e-5
# Square fit of raw corners: error of a blurred photograph, and error in shares of the side (a bent print);
# least ratio of the median. In real videos of a moving board, the median is up to 1.4 px.
_FIT_PX, _FIT_SHARE, _FIT_FACTOR = 0.7, 0.01, 3.0
# Corners with a smaller residual are those of a fitted square: they say nothing about their shape.
_FITTED_PX = 1e-4
# Size of a marker: least contradiction, and in units of the scatter of distances.
_SIZE_SHARE, _SIZE_SCATTER = 0.03, 4.0
# Level markers have a smaller scatter of shapes; least number of sightings of a marker.
_LEVEL_SCATTER, _LEAST_OF_MARKER = 0.02, 5


class Contradiction(NamedTuple):
    """A sentence about a camera, or about one of its markers."""

    text: str
    marker_id: int | None = None


class IntrinsicsTest:
    """The test of the intrinsics of one camera, as markers arrive; each contradiction is returned once.

    Parameters
    ----------
    camera : name of the camera, for texts.
    lens : intrinsics of the camera.
    rig : lengths and heights of the markers.
    """

    def __init__(self, camera: str, lens: CameraCalibration, rig: Rig) -> None:
        self.camera, self.lens, self.rig = camera, lens, rig
        self._next_ns: int | None = None
        self._tested_at: tuple[int, ...] = _TESTED_AT
        self._places: dict[int, list[tuple[float, float]]] = {}
        self._fitted_places: dict[int, list[tuple[float, float]]] = {}
        self._ids: list[int] = []
        self._times_ns: list[int] = []
        self._corners_px: list[Array] = []
        self._fits_px: list[tuple[float, float]] = []
        self._is_contradicted = False
        self._wrong_markers: set[int] = set()

    def add(self, time_ns: int, markers: Sequence[Marker]) -> Iterator[Contradiction]:
        """Add the markers of a frame."""
        is_soon = self._next_ns is not None and self._next_ns - _EVERY_NS <= time_ns < self._next_ns
        if self._is_contradicted or is_soon:
            return
        self._next_ns = time_ns + _EVERY_NS
        for marker in markers:
            if _is_elsewhere(marker, self._places):
                self._fit(marker)
                self._ids.append(marker.id)
                self._times_ns.append(time_ns)
                self._corners_px.append(marker.corners_px)
                if len(self._ids) in self._tested_at:
                    yield from self._test()
        if len(self._ids) >= _TESTED_AT[-1]:
            self._tested_at = _TESTED_AT[-1:]
            self._forget()

    def finish(self) -> Iterator[Contradiction]:
        """Test the last markers."""
        if not self._is_contradicted:
            yield from self._test()

    def add_squares(self, markers: Sequence[Marker]) -> Iterator[Contradiction]:
        """Add raw corners of markers whose edges are fitted, or cannot be fitted: fitted ones are square."""
        if self._is_contradicted:
            return
        for marker in markers:
            if _is_elsewhere(marker, self._fitted_places):
                self._fit(marker)
                yield from self._test_squares()

    def is_contradicted(self, marker_id: int) -> bool:
        """Return whether the intrinsics, or the length of a marker, are contradicted so far."""
        return self._is_contradicted or marker_id in self._wrong_markers

    def _forget(self) -> None:
        for sightings in (self._ids, self._times_ns, self._corners_px, self._fits_px):
            sightings.clear()
        self._places.clear()
        self._fitted_places.clear()

    def _fit(self, marker: Marker) -> None:
        """Note the residual (RMS) of the square fit and the usual one, in px."""
        uv = undistort(marker.corners_px, self.lens)
        side_px = float(
            np.linalg.norm(marker.corners_px - np.roll(marker.corners_px, 1, axis=0), axis=1).mean()
        )
        expected_px = float(np.hypot(_FIT_PX, _FIT_SHARE * side_px))
        if not np.isfinite(uv).all() or not is_convex(uv):
            self._fits_px.append((side_px / 2, expected_px))
            return
        length = np.ones(1)
        poses = solve_squares(uv[None], length)
        misses_px = reprojection_px(*poses, length, marker.corners_px[None], self.lens)
        fit_px = float(np.nanmin(misses_px))
        if fit_px > _FITTED_PX:
            self._fits_px.append((fit_px, expected_px))

    def _test_squares(self) -> Iterator[Contradiction]:
        if self._is_contradicted or len(self._fits_px) < _TESTED_AT[0]:
            return
        fit_px, expected_px = np.median(np.array(self._fits_px), axis=0).tolist()
        if fit_px > _FIT_FACTOR * expected_px:
            yield self._contradict(f"square fit {fit_px:.1f} px, {expected_px:.1f} px expected")

    def _contradict(self, figures: str) -> Contradiction:
        self._is_contradicted = True
        return Contradiction(
            f"camera {self.camera}: markers do not fit its calibration ({figures}); is it the file of this "
            "camera, size and lens model?"
        )

    def _test(self) -> Iterator[Contradiction]:
        yield from self._test_squares()
        if self._is_contradicted or len(self._ids) < _LEAST_LEVEL:
            return
        seen = _Seen.of(self._ids, self._times_ns, self._corners_px, self.lens)
        if len(seen.ids) < _LEAST_LEVEL:
            return
        with np.errstate(invalid="ignore", divide="ignore"):  # a correction can move corners out of the lens
            given, corrected = _explain(seen, False), _explain(seen, True)
        if given is None or corrected is None:
            return
        if (
            corrected.chi2 > _CHI2
            and corrected.rms < _LEVEL_SCATTER
            and given.rms**2 - corrected.rms**2 > _LEAST_EFFECT**2
            and given.rms > _LEAST_RATIO * corrected.rms
        ):
            sides_px = np.linalg.norm(seen.corners_px - np.roll(seen.corners_px, 1, axis=1), axis=2)
            px = float(np.median(sides_px)) / np.sqrt(2)
            yield self._contradict(
                f"shapes of level markers {given.rms * px:.1f} px wrong, "
                f"{max(corrected.rms, _SHAPE_SIGMA) * px:.1f} px expected"
            )
        elif given.rms < _LEVEL_SCATTER:
            yield from self._test_sizes(seen, given)

    def _floor_distances(self, seen: _Seen, fit: _Explanation) -> dict[int, Array]:
        """Return distances of the floor from the camera in m, by the marker of known height."""
        floors_m: dict[int, Array] = {}
        for marker_id in seen.known_ids:
            height_m = self.rig.height_of(marker_id)
            distances_m = fit.distances[seen.ids == marker_id] * self.rig.length_of(marker_id)
            if height_m is not None and len(distances_m) >= _LEAST_OF_MARKER:
                floors_m[marker_id] = distances_m + height_m
        return floors_m

    def _test_sizes(self, seen: _Seen, fit: _Explanation) -> Iterator[Contradiction]:
        """Find markers that are at another height than the rig says, as those of a wrong length are."""
        floors_m = self._floor_distances(seen, fit)
        if len(floors_m) < 2:
            return
        centres_m = {marker_id: float(np.median(values_m)) for marker_id, values_m in floors_m.items()}
        middle_m = float(np.median(list(centres_m.values())))
        scatter_m = 1.48 * float(np.median([np.median(abs(v - np.median(v))) for v in floors_m.values()]))
        bound_m = max(_SIZE_SHARE * middle_m, _SIZE_SCATTER * scatter_m)
        # The middle of two markers has half of their contradiction on each side.
        bound = bound_m / 2 if len(floors_m) == 2 else bound_m
        wrong = [n for n, centre_m in centres_m.items() if abs(centre_m - middle_m) > bound]
        if set(wrong) <= self._wrong_markers or len(wrong) > (2 if len(floors_m) == 2 else 1):
            return
        self._wrong_markers.update(wrong)
        if len(floors_m) == 2:
            share = max(centres_m.values()) / min(centres_m.values()) - 1
            yield Contradiction(
                f"camera {self.camera}: the sizes of markers {wrong[0]} and {wrong[1]} contradict each other "
                f"by {100 * share:.0f} %; measure their sides, and correct length_m or the height in the rig"
            )
            return
        for marker_id in wrong:
            share = centres_m[marker_id] / middle_m - 1
            yield Contradiction(
                f"camera {self.camera}: marker {marker_id} looks {100 * abs(share):.0f} % too "
                f"{'small' if share > 0 else 'large'} beside the others; measure its side, and correct its "
                "length_m or its height in the rig",
                marker_id,
            )


def find_contradictions(
    frames: Iterable[tuple[str, Markers]], lenses: Mapping[str, CameraCalibration], rig: Rig
) -> Iterator[Contradiction]:
    """Yield each contradiction of the frames of cameras to their intrinsics, which are not nominal ones."""
    tests = {camera: IntrinsicsTest(camera, lens, rig) for camera, lens in lenses.items() if lens.D.any()}
    for camera, frame in frames:
        if camera in tests:
            yield from tests[camera].add(frame.timestamp, frame.markers)
    for test in tests.values():
        yield from test.finish()


def _is_elsewhere(marker: Marker, places_px: dict[int, list[tuple[float, float]]]) -> bool:
    """Return whether a marker is farther than its side from all its places so far; remember the place."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = marker.corners_px.tolist()
    x, y = (x0 + x1 + x2 + x3) / 4, (y0 + y1 + y2 + y3) / 4
    side_px2 = max((x1 - x0) ** 2 + (y1 - y0) ** 2, (x3 - x0) ** 2 + (y3 - y0) ** 2)
    places = places_px.setdefault(marker.id, [])
    if any((x - left) ** 2 + (y - top) ** 2 < side_px2 for left, top in places):
        return False
    places.append((x, y))
    return True


class _Seen(NamedTuple):
    """Sightings: ids (n,), numbers of the ids in ``known_ids`` (n,), times (n,), and corners (n, 4, 2)."""

    ids: NDArray[np.int64]
    indices: NDArray[np.intp]
    known_ids: list[int]
    times_ns: NDArray[np.int64]
    corners_px: Array
    lens: CameraCalibration

    @classmethod
    def of(
        cls, ids: Sequence[int], times_ns: Sequence[int], corners_px: Sequence[Array], lens: CameraCalibration
    ) -> _Seen:
        """Return the sightings that the lens can see."""
        corners = np.array(corners_px)
        uv = undistort(corners.reshape(-1, 2), lens).reshape(-1, 4, 2)
        good: NDArray[np.bool_] = np.asarray(np.isfinite(uv).all(axis=(1, 2)))
        good[good] = [is_convex(square) for square in uv[good]]
        known, indices = np.unique(np.array(ids)[good], return_inverse=True)
        times = np.array(times_ns, dtype=np.int64)[good]
        return cls(np.array(ids)[good], indices, known.tolist(), times, corners[good], lens)

    def jacobians(self, correction: Array) -> tuple[Array, Array]:
        """Return the Jacobians of the prints at their centres (n, 2, 2), and the centres in (u, v) (n, 2)."""
        scale, x, y, radial, outer, aspect, skew = correction
        half_px, centre_px = self.lens.width / 2, self.lens.K[:2, 2]
        moved = (self.corners_px - centre_px) / half_px - np.array([x, y])
        radii2 = (moved * moved).sum(axis=-1, keepdims=True)
        moved = moved @ np.array([[1 + aspect, skew], [skew, 1 - aspect]])
        moved *= 1 + scale + (radial + outer * radii2) * radii2
        uv = undistort((moved * half_px + centre_px).reshape(-1, 2), self.lens).reshape(-1, 4, 2)
        return _at_centres(uv)


def _at_centres(uv: Array) -> tuple[Array, Array]:
    """Return slopes of (u, v) by the print's x and y, (n, 2, 2), and (u, v), at the centres of squares.

    References
    ----------
    Heckbert, Fundamentals of texture mapping, 1989, for the homography from the unit square.
    """
    first, right, across, down = (uv[:, n] for n in range(4))
    off, along, beside = first - right + across - down, right - across, down - across
    area = along[:, 0] * beside[:, 1] - beside[:, 0] * along[:, 1]
    g = ((off[:, 0] * beside[:, 1] - beside[:, 0] * off[:, 1]) / area)[:, None]
    h = ((along[:, 0] * off[:, 1] - off[:, 0] * along[:, 1]) / area)[:, None]
    by_x, by_y = right - first + g * right, down - first + h * down
    depth = 1 + (g + h) / 2
    centres = ((by_x + by_y) / 2 + first) / depth
    return np.stack([by_x - g * centres, h * centres - by_y], axis=2) / depth[..., None], centres


class _Explanation(NamedTuple):
    """A least-squares explanation of shapes.

    ``rms`` is the deviation that remains, and ``chi2`` the square of the correction in units of its sigma.
    ``distances`` (n,) are those of the markers from the camera, along the normal of the floor, in sides.
    """

    rms: float
    chi2: float
    distances: Array


def _explain(seen: _Seen, is_corrected: bool) -> _Explanation | None:
    """Fit the tilts and, if wanted, a correction of the image to shapes; None if the fit fails."""
    tops = 2 * len(seen.known_ids)
    sigmas = np.concatenate([_ANY if is_corrected else _NONE, [_ANY_TILT] * 2, np.full(tops, _TOP_TILT)])
    values, spread, damping = np.zeros(len(sigmas)), 10 * _SHAPE_SIGMA, 1e-3
    off = _deviations(seen, values)
    for _ in range(_ITERATIONS):
        slopes, weights = _slopes(seen, values, off, is_corrected), _weights(off, spread)
        normal = _normal(slopes, weights) / spread**2 + np.diag(sigmas**-2)
        gradient = np.einsum("n,nij,ni->j", weights, slopes, off) / spread**2 + values / sigmas**2
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), -gradient)
        tried = _deviations(seen, values + step)
        costs = [_cost(o, v, spread, sigmas) for o, v in ((tried, values + step), (off, values))]
        if not costs[0] <= costs[1]:
            damping *= 100
            continue
        values, off, damping = values + step, tried, damping / 10
        before, spread = spread, max(_SHAPE_SIGMA, float(np.median(np.hypot(*off.T))) / 1.18)
        if costs[1] - costs[0] < _SETTLED and abs(spread - before) < _SETTLED * spread:
            break
    return _explanation(seen, values, off, spread, sigmas, is_corrected) if np.isfinite(off).all() else None


def _explanation(
    seen: _Seen, values: Array, off: Array, spread: float, sigmas: Array, is_corrected: bool
) -> _Explanation:
    slopes, weights = _slopes(seen, values, off, is_corrected), _weights(off, spread)
    weighted = weights[:, None] * off
    freedom = max(weights.sum() * 2 - len(values), 2.0)
    variance = max(_SHAPE_SIGMA**2, float((weighted * off).sum()) / freedom)
    inverse = np.linalg.inv(_normal(slopes, weights) / variance + np.diag(sigmas**-2))
    # Sightings in one frame can deviate alike, such as markers of one board, and small images scatter more.
    pulls = np.einsum("nij,ni->nj", slopes, weighted) / variance
    _, frames = np.unique(seen.times_ns, return_inverse=True)
    sums = np.zeros((frames.max() + 1, len(values)))
    np.add.at(sums, frames, pulls)
    scatter = inverse @ (sums.T @ sums) @ inverse * (2 * len(off) / freedom)
    covariance = (inverse + scatter)[:_PARAMETERS, :_PARAMETERS] + np.diag(_CALIBRATED**2)
    correction = values[:_PARAMETERS]
    chi2 = float(correction @ np.linalg.solve(covariance, correction))
    shapes, centres = seen.jacobians(correction)
    normals = _normals(values, len(seen.ids))
    alpha, _ = _similarity(shapes, centres, normals)
    rays = np.column_stack([centres, np.ones(len(centres))])
    distances = np.abs((rays * normals).sum(axis=1)) / np.abs(alpha)
    rms = float(np.sqrt((weighted * off).sum() / weights.sum()))
    return _Explanation(rms, chi2, distances)


def _cost(off: Array, values: Array, spread: float, sigmas: Array) -> float:
    sizes = np.hypot(*off.T) / spread
    far = sizes > _HUBER
    return float(
        np.where(far, 2 * _HUBER * sizes - _HUBER**2, sizes**2).sum() + ((values / sigmas) ** 2).sum()
    )


def _weights(off: Array, spread: float) -> Array:
    return np.asarray(1 / np.maximum(1, np.hypot(*off.T) / (_HUBER * spread)))


def _normal(slopes: Array, weights: Array) -> Array:
    return np.asarray(np.einsum("n,nij,nik->jk", weights, slopes, slopes))


def _slopes(seen: _Seen, values: Array, off: Array, is_corrected: bool) -> Array:
    """Return the derivatives of the deviations by the values, (n, 2, values)."""
    slopes = np.zeros((*off.shape, len(values)))
    shapes = seen.jacobians(values[:_PARAMETERS])
    first = 0 if is_corrected else _PARAMETERS
    for n in range(first, _PARAMETERS + 2):
        step = np.zeros(len(values))
        step[n] = _STEP
        slopes[..., n] = (_deviations(seen, values + step, None if n < _PARAMETERS else shapes) - off) / _STEP
    for n in (0, 1):  # each sighting depends on the top of its own robot
        step = np.zeros(len(values))
        step[_PARAMETERS + 2 + n :: 2] = _STEP
        by_top = (_deviations(seen, values + step, shapes) - off) / _STEP
        slopes[np.arange(len(off)), :, _PARAMETERS + 2 + n + 2 * seen.indices] = by_top
    return slopes


def _deviations(seen: _Seen, values: Array, shapes: tuple[Array, Array] | None = None) -> Array:
    """Return the deviations of shapes (n, 2) from squares on the floor with tilted tops."""
    jacobians, centres = seen.jacobians(values[:_PARAMETERS]) if shapes is None else shapes
    normals = _normals(values, len(seen.ids))
    alpha, _ = _similarity(jacobians, centres, normals)
    tops = values[_PARAMETERS + 2 :].reshape(-1, 2)[seen.indices]
    tilts = (tops[:, 0] + 1j * tops[:, 1]) * alpha / np.abs(alpha)
    across, down = _axes(normals)
    tilted = normals + across * tilts.real[:, None] + down * tilts.imag[:, None]
    tilted /= np.linalg.norm(tilted, axis=1)[:, None]
    alpha, beta = _similarity(jacobians, centres, tilted)
    deviations = beta / alpha.conj()
    return np.column_stack([deviations.real, deviations.imag])


def _normals(values: Array, count: int) -> Array:
    """Return the normal of the floor towards the camera, once for each sighting, (n, 3)."""
    normal = np.array([values[_PARAMETERS], values[_PARAMETERS + 1], -1.0])
    return np.tile(normal / np.linalg.norm(normal), (count, 1))


def _axes(normals: Array) -> tuple[Array, Array]:
    """Return two axes (n, 3) each in the planes with the normals."""
    across = np.cross([0.0, 1.0, 0.0], normals)
    across /= np.linalg.norm(across, axis=1)[:, None]
    return across, np.cross(normals, across)


def _similarity(jacobians: Array, centres: Array, normals: Array) -> tuple[Complex, Complex]:
    """Return alpha and beta of the maps z -> alpha z + beta conj(z) from prints to planes at distance 1."""
    axes = [axis[:, :2] - centres * axis[:, 2:] for axis in _axes(normals)]
    maps = np.linalg.solve(np.stack(axes, axis=2), jacobians)
    (xx, xy), (yx, yy) = maps[:, 0].T, maps[:, 1].T
    return ((xx + yy) + 1j * (yx - xy)) / 2, ((xx - yy) + 1j * (yx + xy)) / 2
