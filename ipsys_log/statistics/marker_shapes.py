"""Shapes of level markers, explained by the tilt of the floor and, if wanted, by other intrinsics.

The image of a marker gives the Jacobian of its print at its centre, without its size. In the plane in which
the marker lies, the Jacobian is a rotation times a scale. For a marker of another tilt, or through wrong
intrinsics, its shape deviates by ``beta / alpha`` (the Beltrami coefficient: axes differ by twice its
size). These deviations are linear in the errors of corners everywhere in the image, unlike tilts. Least
squares explain them by the tilt of the floor, by one tilt of the top of each robot, and by a correction of
the image: scale, aspect, skew, centre and two radial terms.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration, Marker
from ipsys_log.units import NS_PER_S
from ipsys_log.vision.lenses import undistort
from ipsys_log.vision.square_pose import is_convex

Complex = NDArray[np.complex128]

# Frames in this interval show no other places of a moving robot.
_EVERY_NS = NS_PER_S // 5
# Numbers of sightings at which tests are made. Then a new window begins, because a lens can be changed later;
# it is tested at its end.
_TESTED_AT = (8, 32, 64, 128, 256)
# With fewer, chance and the unknowns explain too much.
_LEAST_LEVEL = 24
# Level markers have a smaller scatter of shapes.
LEVEL_SCATTER = 0.02
# The correction: scale, centre x and y, radial terms at half the width of the image, aspect, skew. Sigmas of
# any camera, and of the error of a good calibration: 0.4 % of the focal length, 4 px of 1920 for the centre.
_ANY = np.array([0.3, 0.3, 0.3, 0.3, 0.1, 0.1, 0.1])
_CALIBRATED = np.array([0.004, 0.004, 0.004, 0.003, 0.003, 0.002, 0.002])
_NONE = 1e-6 * _ANY
_PARAMETERS = len(_ANY)
# Sigma of the tilt of the top of a robot, in rad: 2 degrees.
_TOP_TILT = 0.035
# The floor has any tilt to the image.
_ANY_TILT = 3.0
# Error of the shape of a print: stretched by the printer by 0.3 %, bent, on a floor that is not flat.
SHAPE_SIGMA = 0.002
# Larger deviations, in units of the spread, have less weight.
_HUBER = 2.5
_ITERATIONS = 12
# A step that changes the cost and, relatively, the spread by less is the last one.
_SETTLED = 0.05
# Step of numerical slopes.
_STEP = 1e-5


class MarkerPlaces:
    """The places of markers in an image that are farther than a side from each other."""

    def __init__(self) -> None:
        self._places_px: dict[int, list[tuple[float, float]]] = {}

    def add(self, marker: Marker) -> bool:
        """Return whether a marker is at a new place; remember it."""
        (x0, y0), (x1, y1), (x2, y2), (x3, y3) = marker.corners_px.tolist()
        x, y = (x0 + x1 + x2 + x3) / 4, (y0 + y1 + y2 + y3) / 4
        side_px2 = max((x1 - x0) ** 2 + (y1 - y0) ** 2, (x3 - x0) ** 2 + (y3 - y0) ** 2)
        places = self._places_px.setdefault(marker.id, [])
        if any((x - left) ** 2 + (y - top) ** 2 < side_px2 for left, top in places):
            return False
        places.append((x, y))
        return True


class MarkerSightings:
    """The markers of a camera at new places, until a window is full; then a new window begins."""

    def __init__(self) -> None:
        self._next_ns: int | None = None
        self._tested_at: tuple[int, ...] = _TESTED_AT
        self._begin()

    def _begin(self) -> None:
        self._places = MarkerPlaces()
        self._ids: list[int] = []
        self._times_ns: list[int] = []
        self._corners_px: list[Array] = []

    def __len__(self) -> int:
        return len(self._ids)

    def add(self, time_ns: int, markers: Sequence[Marker]) -> Iterator[tuple[Marker, bool]]:
        """Add the markers of a frame; yield those at new places, and whether a test is due after each."""
        if self._next_ns is not None and self._next_ns - _EVERY_NS <= time_ns < self._next_ns:
            return
        self._next_ns = time_ns + _EVERY_NS
        for marker in markers:
            if self._places.add(marker):
                self._ids.append(marker.id)
                self._times_ns.append(time_ns)
                self._corners_px.append(marker.corners_px)
                yield marker, len(self) in self._tested_at

    def renew(self) -> bool:
        """Begin a new window if this one is full; return whether it was."""
        if len(self) < _TESTED_AT[-1]:
            return False
        self._tested_at = _TESTED_AT[-1:]
        self._begin()
        return True

    def shapes(self, lens: CameraCalibration) -> "SeenShapes | None":
        """Return the shapes of the markers that the lens can see; None if there are too few."""
        if len(self) < _LEAST_LEVEL:
            return None
        seen = SeenShapes.of(self._ids, self._times_ns, self._corners_px, lens)
        return seen if len(seen.ids) >= _LEAST_LEVEL else None


class SeenShapes(NamedTuple):
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
    ) -> "SeenShapes":
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


class ShapeFit(NamedTuple):
    """A least-squares explanation of shapes.

    ``rms`` is the deviation that remains, and ``chi2`` the square of the correction in units of its sigma.
    ``distances`` (n,) are those of the markers from the camera, along the normal of the floor, in sides.
    """

    rms: float
    chi2: float
    distances: Array


def fit_shapes(seen: SeenShapes, is_corrected: bool) -> ShapeFit | None:
    """Fit the tilts and, if wanted, a correction of the image to shapes; None if the fit fails."""
    tops = 2 * len(seen.known_ids)
    sigmas = np.concatenate([_ANY if is_corrected else _NONE, [_ANY_TILT] * 2, np.full(tops, _TOP_TILT)])
    values, spread, damping = np.zeros(len(sigmas)), 10 * SHAPE_SIGMA, 1e-3
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
        before, spread = spread, max(SHAPE_SIGMA, float(np.median(np.hypot(*off.T))) / 1.18)
        if costs[1] - costs[0] < _SETTLED and abs(spread - before) < _SETTLED * spread:
            break
    return _finish_fit(seen, values, off, spread, sigmas, is_corrected) if np.isfinite(off).all() else None


def _finish_fit(
    seen: SeenShapes, values: Array, off: Array, spread: float, sigmas: Array, is_corrected: bool
) -> ShapeFit:
    slopes, weights = _slopes(seen, values, off, is_corrected), _weights(off, spread)
    weighted = weights[:, None] * off
    freedom = max(weights.sum() * 2 - len(values), 2.0)
    variance = max(SHAPE_SIGMA**2, float((weighted * off).sum()) / freedom)
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
    return ShapeFit(rms, chi2, distances)


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


def _slopes(seen: SeenShapes, values: Array, off: Array, is_corrected: bool) -> Array:
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


def _deviations(seen: SeenShapes, values: Array, shapes: tuple[Array, Array] | None = None) -> Array:
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
