"""Camera poses relative to the floor, from markers on the floor (sect. 3 of the paper)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration, Mask
from ipsys_log.statistics.stationary import StationaryMarker
from ipsys_log.vision.poses import PosedCamera, invert_pose, make_pose, transform

# In the paper, a camera is parallel to the floor if the spread of Zc is below this value.
LEVEL_M = 0.05
# Relative error of a depth by the lens, for any number of frames.
_USUAL_DEPTH = 0.002
# The flatness of a floor: markers within this distance of the plane lie on it.
_FLAT_M = 0.015
# A slope with a larger sigma is unknown.
_LOOSE = math.radians(1.0)
# Markers farther from the plane, in sigmas of their depths, do not lie on it.
_FAR = 4.0
# Least number of markers to identify one outside the plane: of four, each three fit a plane exactly.
_LEAST_TO_NAME = 5
# With more triples of markers, a random subset of this size is tried.
_MOST_TRIPLES = 2000
# Triples of a smaller area do not determine a plane: a share of the largest one, and m^2.
_SLENDER = 0.05
_LEAST_AREA_M2 = 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The tilt and height of a camera from markers on the floor.

    Attributes
    ----------
    floor_markers : the markers of the fit. ``raised_markers`` are markers outside the plane of the others,
        each with its height above the plane in m.
    spread_m : spread of Zc, greatest minus least, corrected to the floor with measured heights; None for
        fewer than two markers. ``remaining_m`` is the remaining spread after the correction of the tilt.
    down : (3,), the plumb line in camera coordinates, a unit vector; None if it is unknown.
    sigma_rad : sigma of the tilt in its least accurate direction.
    axes : number of directions in which the tilt is known: 2; 1 for markers on a line; or 0.
    uneven_m : RMS distance of markers from a plane, if there are too few to identify a raised marker.
    """

    camera: str
    floor_markers: tuple[StationaryMarker, ...]
    raised_markers: tuple[tuple[StationaryMarker, float], ...] = ()
    spread_m: float | None = None
    remaining_m: float | None = None
    down: Array | None = None
    sigma_rad: float | None = None
    axes: int = 0
    uneven_m: float | None = None

    @property
    def level(self) -> bool | None:
        """Return whether the spread is below 5 cm; None if the markers do not determine it.

        This is the case if they are too close together, or on a line. The slope across the line is unknown.
        """
        if self.spread_m is None or self.axes == 0 or (self.axes == 1 and self.spread_m < LEVEL_M):
            return None
        return self.spread_m < LEVEL_M

    @property
    def tilt_rad(self) -> float | None:
        """Return the angle between the optical axis and the plumb line, in rad."""
        return None if self.down is None else math.acos(min(1.0, float(self.down[2])))

    @property
    def turns_rad(self) -> tuple[float, float]:
        """Return the rotations that level a camera, in rad: to the right of its image, then to its bottom."""
        x, y, z = (0.0, 0.0, 1.0) if self.down is None else self.down.tolist()
        return math.atan2(x, z), math.asin(y)

    @property
    def height_m(self) -> float | None:
        """Return the height of the camera above the floor, in m."""
        if self.down is None:
            return None
        return float(
            np.median([marker.point_m @ self.down + marker.height_m for marker in self.floor_markers])
        )


class _Plane(NamedTuple):
    """A plane Zc = ``start_m`` + ``slopes`` . (Xc, Yc) on the floor.

    ``axes`` is the number of known slopes, and ``sigma`` the sigma of the least accurate known slope.
    """

    start_m: float
    slopes: Array
    axes: int
    sigma: float

    @property
    def down(self) -> Array:
        normal = np.array([*-self.slopes, 1.0])
        return np.asarray(normal / np.linalg.norm(normal))

    def misses_m(self, markers: Sequence[StationaryMarker]) -> Array:
        """Return the apparent distances of markers below the floor, along Zc, (n,) in m."""
        points_m, depths_m = _on_floor(markers, self.down)
        return np.asarray(depths_m - self.start_m - points_m[:, :2] @ self.slopes)


def align_camera(camera: str, markers: Sequence[StationaryMarker]) -> Alignment:
    """Estimate the tilt of a camera against the plane of the markers on the floor.

    With five or more markers, the function detects and omits markers in another plane, such as on a box.

    Parameters
    ----------
    camera : its name.
    markers : markers from :func:`ipsys_log.statistics.stationary.find_stationary`, from camera points by
        ``--method pose``. Camera points by eq. (3) give a tilt that is too large by half. At (u, v), a tilt t
        increases Zc by a factor of about 1 + t u. It also reduces the marker's perimeter by 1 - t u / 2.

    References
    ----------
    Ou et al., Robotica 2023, sect. 3. Least quantile of squares: Rousseeuw, JASA 1984.

    Examples
    --------
    >>> corners = [(-1.0, -0.5), (1.0, -0.5), (1.0, 0.5), (-1.0, 0.5)]
    >>> points = [np.array([x, y, 2.0 - 0.02 * x]) for x, y in corners]
    >>> markers = [StationaryMarker(n, point, np.zeros((3, 3))) for n, point in enumerate(points)]
    >>> found = align_camera("red", markers)
    >>> round(found.spread_m, 3), round(math.degrees(found.tilt_rad), 2)
    (0.04, 1.15)
    >>> round(math.degrees(found.turns_rad[0]), 2)  # to the right, where markers are nearer
    1.15
    """
    kept = _on_one_plane(markers)
    used = tuple(marker for marker, keep in zip(markers, kept, strict=True) if keep)
    if len(used) < 2:
        return Alignment(camera, used)
    plane = _fit_plane(used)
    misses_m = plane.misses_m(used)
    raised = tuple(
        (marker, -float(plane.misses_m([marker])[0] * plane.down[2]))
        for marker, keep in zip(markers, kept, strict=True)
        if not keep
    )
    spread_m = float(np.ptp(_on_floor(used, plane.down)[1]))
    if plane.axes == 0:
        return Alignment(camera, used, raised, spread_m)
    left_m = float(np.ptp(misses_m) * plane.down[2])
    spare = len(used) - 1 - plane.axes
    rms_m = math.sqrt(float(misses_m @ misses_m) / spare) if spare > 0 else 0.0
    usual_m = float(np.median(_sigmas(used, plane.down)))
    uneven_m = rms_m if len(used) < _LEAST_TO_NAME and rms_m > max(_FLAT_M, 3 * usual_m) else None
    sigma_rad = float(plane.sigma * max(1.0, rms_m / usual_m))
    return Alignment(camera, used, raised, spread_m, left_m, plane.down, sigma_rad, plane.axes, uneven_m)


def _on_floor(markers: Sequence[StationaryMarker], down: Array) -> tuple[Array, Array]:
    """Return camera points (n, 3), and depths (n,) of the floor below them, corrected for marker heights."""
    points_m = np.array([marker.point_m for marker in markers])
    # Along Zc, at the same (Xc, Yc), the distance to the floor is 1 / cos(tilt) times the distance along the
    # plumb line.
    return points_m, points_m[:, 2] + np.array([marker.height_m for marker in markers]) / down[2]


def _sigmas(markers: Sequence[StationaryMarker], down: Array) -> Array:
    """Return the standard deviations (n,) in m of the depths of the floor below markers."""
    noise_m2 = np.array([down @ marker.covariance_m2 @ down for marker in markers])
    depths_m = np.array([marker.point_m[2] for marker in markers])
    # The covariance of one frame has the error of the lens; the mean of many frames still has it.
    return np.asarray(np.sqrt(np.maximum(noise_m2, (_USUAL_DEPTH * depths_m) ** 2)))


def _fit_plane(markers: Sequence[StationaryMarker]) -> _Plane:
    """Fit a plane by weighted least squares, in directions in which markers are far enough apart."""
    plane = _Plane(0.0, np.zeros(2), 0, math.inf)
    for _ in range(3):  # marker heights are relative to the floor, which is unknown at first
        sigmas_m = _sigmas(markers, plane.down)
        weights = sigmas_m**-2
        points_m, depths_m = _on_floor(markers, plane.down)
        middle_m, depth_m = (np.average(v, axis=0, weights=weights) for v in (points_m[:, :2], depths_m))
        across_m = points_m[:, :2] - middle_m
        spreads, directions = np.linalg.eigh((weights * across_m.T) @ across_m)
        known = spreads > _LOOSE**-2
        along = directions[:, known] / spreads[known]
        slopes = along @ (directions[:, known].T @ (weights * across_m.T) @ (depths_m - depth_m))
        sigma = 1 / math.sqrt(spreads[known].min()) if known.any() else math.inf
        plane = _Plane(float(depth_m - middle_m @ slopes), slopes, int(known.sum()), sigma)
    return plane


def _on_one_plane(markers: Sequence[StationaryMarker]) -> Mask:
    """Return a mask (n,) of the markers in the plane that contains most of them."""
    count = len(markers)
    if count < _LEAST_TO_NAME:
        return np.ones(count, dtype=np.bool_)
    level = np.array([0.0, 0.0, 1.0])
    sigmas_m, (points_m, depths_m) = _sigmas(markers, level), _on_floor(markers, level)
    terms, triples = np.column_stack([points_m[:, :2], np.ones(count)]), _triples(count)
    areas = np.abs(np.linalg.det(terms[triples]))
    # Three markers that are nearly on a line do not determine a plane.
    triples = triples[areas > max(_SLENDER * float(areas.max()), _LEAST_AREA_M2)]
    if not len(triples):
        return np.ones(count, dtype=np.bool_)
    planes = np.linalg.solve(terms[triples], depths_m[triples][..., None])[..., 0]
    off = np.abs(planes @ terms.T - depths_m) / sigmas_m
    quantile = (count + 4) // 2 - 1
    scores = np.partition(off, quantile, axis=1)[:, quantile]
    best, off = float(scores.min()), off[scores.argmin()]
    # With few markers, the best of many triples fits too well by chance (Rousseeuw, Leroy 1987).
    limits = np.maximum(_FLAT_M / sigmas_m, _FAR * max(1.0, best * (1 + 5 / (count - 3))))
    kept = np.asarray(off <= limits)
    if kept.sum() >= 3:  # repeat the fit with all consistent markers
        plane = _fit_plane([marker for marker, keep in zip(markers, kept, strict=True) if keep])
        kept = np.asarray(np.abs(plane.misses_m(markers)) / sigmas_m <= limits)
    return kept


def _triples(count: int) -> NDArray[np.int64]:
    """Return triples of indices below ``count``, (n, 3): all of them, or a random subset."""
    if math.comb(count, 3) <= _MOST_TRIPLES:
        return np.array([*combinations(range(count), 3)], dtype=np.int64)
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, 3, replace=False) for _ in range(_MOST_TRIPLES)], dtype=np.int64)


# Least distance between common markers of two cameras, to determine the rotation between the cameras.
_APART_M = 0.15
# Largest difference between the positions of common markers by two cameras. A larger difference shows that
# the markers are not the same.
_ALIKE_M = 0.05


def join_cameras(
    alignments: Sequence[Alignment], lenses: Mapping[str, CameraCalibration]
) -> list[PosedCamera]:
    """Return the cameras that common markers connect to the first camera, in common coordinates.

    Two cameras must see a common marker at the same time. The markers on the floor give the height and the
    plumb line of each camera. Two common markers give the rotation and translation between two cameras.

    Returns
    -------
    Cameras in arbitrary coordinates with the floor at z = 0; an empty list for fewer than two cameras.
    """
    known = {
        alignment.camera: alignment
        for alignment in alignments
        if alignment.axes == 2 and alignment.camera in lenses
    }
    waiting = list(known)
    joined = {waiting.pop(0): np.eye(4)} if waiting else {}
    while pairs := [(new, old, _turn(known[new], known[old])) for new in waiting for old in joined]:
        met = [(new, joined[old] @ turn) for new, old, turn in pairs if turn is not None]
        if not met:
            break
        joined[met[0][0]] = met[0][1]
        waiting.remove(met[0][0])
    if len(joined) < 2:
        return []
    return [
        PosedCamera.at_pose(name, lenses[name], invert_pose(joined[name] @ _floor_from_camera(known[name])))
        for name in known
        if name in joined
    ]


def _floor_from_camera(one: Alignment) -> Array:
    """Return the pose (4, 4) from camera coordinates to the camera's own floor coordinates.

    The floor coordinates have their origin at the foot point of the camera, z up, and x as in its image.
    """
    assert one.down is not None
    assert one.height_m is not None
    x = np.array([1.0, 0.0, 0.0]) - one.down[0] * one.down
    x /= np.linalg.norm(x)
    axes = np.column_stack([x, np.cross(-one.down, x), -one.down])
    return invert_pose(make_pose(axes, one.height_m * one.down))


def _turn(one: Alignment, other: Alignment) -> Array | None:
    """Return the pose from the floor coordinates of one camera to those of another, (4, 4), or None."""
    pairs = [(a, b) for a in one.floor_markers for b in other.floor_markers if _same(a, b)]
    if len(pairs) < 2:
        return None
    own_m, other_m = (
        transform(_floor_from_camera(camera), np.array([pair[n].point_m for pair in pairs]))[:, :2]
        for n, camera in enumerate((one, other))
    )
    # With points as complex numbers, the best rotation is the direction of their product.
    a, b = (points_m @ np.array([1, 1j]) for points_m in (own_m, other_m))
    product = np.vdot(a - a.mean(), b - b.mean())
    if np.abs(a - a.mean()).max() < _APART_M / 2 or product == 0:
        return None
    turn = product / abs(product)
    shift = b.mean() - turn * a.mean()
    if np.abs(turn * a + shift - b).max() > _ALIKE_M:
        return None
    rotation = np.array([[turn.real, -turn.imag, 0.0], [turn.imag, turn.real, 0.0], [0.0, 0.0, 1.0]])
    return make_pose(rotation, np.array([shift.real, shift.imag, 0.0]))


def _same(one: StationaryMarker, other: StationaryMarker) -> bool:
    """Return whether two cameras saw the same marker in overlapping stationary intervals."""
    return one.marker_id == other.marker_id and one.start_ns <= other.end_ns and other.start_ns <= one.end_ns
