"""Camera poses above the floor, from markers that lie on it (sect. 3 of the paper)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.analysis.coverage import Hung
from ipsys_log.analysis.stationary import Lying
from ipsys_log.geometry.poses import invert_pose, make_pose, transform
from ipsys_log.messages import CameraCalibration

__all__ = ["LEVEL_M", "Alignment", "align_camera", "join_cameras"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# The paper calls a camera parallel to the floor below this spread of Zc.
LEVEL_M = 0.05
# What a lens leaves of a depth, relative, however many frames there are; and what is flat enough.
_USUAL_DEPTH, _FLAT_M = 0.002, 0.015
# A slope that is known no better than this is not known.
_LOOSE = math.radians(1.0)
_FAR = 4.0
# To tell one that lies elsewhere from the rest takes so many; of more triples than these, some.
_LEAST_TO_NAME, _MOST_TRIPLES = 5, 2000
_SLENDER, _LEAST_AREA_M2 = 0.05, 1e-4


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """What markers on the floor say of a camera.

    Attributes
    ----------
    lying : the markers that it rests on; ``raised`` those that do not lie in the plane of the others,
        each with how far above it, in m.
    spread_m : of Zc, greatest minus least, brought down to the floor where a height was measured; None
        for fewer than two markers. ``left_m`` is what is left of it when the camera has been tilted.
    down : (3,), the plumb line in the frame of the camera, a unit vector; None where nothing is known.
    sigma_rad : of the tilt, in the direction that is known worst.
    axes : in how many directions the tilt is known: 2; 1 along a line of markers only; or 0.
    uneven_m : by how much markers miss a plane (RMS), where too few are there to say which.
    """

    camera: str
    lying: tuple[Lying, ...]
    raised: tuple[tuple[Lying, float], ...] = ()
    spread_m: float | None = None
    left_m: float | None = None
    down: Array | None = None
    sigma_rad: float | None = None
    axes: int = 0
    uneven_m: float | None = None

    @property
    def level(self) -> bool | None:
        """Whether the spread is below 5 cm; None where markers lie too close together to tell, or on a line
        across which the floor may fall away."""
        if self.spread_m is None or self.axes == 0 or (self.axes == 1 and self.spread_m < LEVEL_M):
            return None
        return self.spread_m < LEVEL_M

    @property
    def tilt_rad(self) -> float | None:
        """Between the optical axis and the plumb line."""
        return None if self.down is None else math.acos(min(1.0, float(self.down[2])))

    @property
    def turns_rad(self) -> tuple[float, float]:
        """By how much it has to look further to the right of its picture, and then to its bottom."""
        x, y, z = (0.0, 0.0, 1.0) if self.down is None else self.down.tolist()
        return math.atan2(x, z), math.asin(y)

    @property
    def height_m(self) -> float | None:
        """Of the camera above the floor."""
        if self.down is None:
            return None
        return float(np.median([one.point_m @ self.down + one.height_m for one in self.lying]))


class _Plane(NamedTuple):
    """Zc = ``start_m`` + ``slopes`` . (Xc, Yc) on the floor; ``sigma`` that of the worst known slope."""

    start_m: float
    slopes: Array
    axes: int
    sigma: float

    @property
    def down(self) -> Array:
        normal = np.array([*-self.slopes, 1.0])
        return np.asarray(normal / np.linalg.norm(normal))

    def misses_m(self, lying: Sequence[Lying]) -> Array:
        """How much lower than the floor markers seem to lie, along Zc, (n,)."""
        points_m, depths_m = _on_floor(lying, self.down)
        return np.asarray(depths_m - self.start_m - points_m[:, :2] @ self.slopes)


def align_camera(camera: str, lying: Sequence[Lying]) -> Alignment:
    """The tilt of a camera against the plane of the markers that lie on the floor.

    With five markers or more those that lie in another plane, such as on a box, are found and left out.

    Parameters
    ----------
    camera : its name.
    lying : from :func:`ipsys_log.analysis.stationary.find_lying`, from camera points by ``--method pose``.
        Those by eq. (3) overstate a tilt by half: at (u, v) a tilt t makes Zc greater by a factor of
        about 1 + t u, and shortens the marker's perimeter by 1 - t u / 2 besides.

    References
    ----------
    Ou et al., Robotica 2023, sect. 3. Least quantile of squares: Rousseeuw, JASA 1984.

    Examples
    --------
    >>> corners = [(-1.0, -0.5), (1.0, -0.5), (1.0, 0.5), (-1.0, 0.5)]
    >>> points = [np.array([x, y, 2.0 - 0.02 * x]) for x, y in corners]
    >>> lying = [Lying(n, point, np.zeros((3, 3))) for n, point in enumerate(points)]
    >>> found = align_camera("red", lying)
    >>> round(found.spread_m, 3), round(math.degrees(found.tilt_rad), 2)
    (0.04, 1.15)
    >>> round(math.degrees(found.turns_rad[0]), 2)  # to the right, where markers are nearer
    1.15
    """
    kept = _on_one_plane(lying)
    used = tuple(one for one, keep in zip(lying, kept, strict=True) if keep)
    if len(used) < 2:
        return Alignment(camera, used)
    plane = _fit_plane(used)
    misses_m = plane.misses_m(used)
    raised = tuple(
        (one, -float(plane.misses_m([one])[0] * plane.down[2]))
        for one, keep in zip(lying, kept, strict=True)
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


def _on_floor(lying: Sequence[Lying], down: Array) -> tuple[Array, Array]:
    """Camera points (n, 3), and the depths (n,) of the floor beneath them: what was raised, brought down."""
    points_m = np.array([one.point_m for one in lying])
    # Along Zc, at the same (Xc, Yc), the floor is 1 / cos(tilt) as far away as along the plumb line.
    return points_m, points_m[:, 2] + np.array([one.height_m for one in lying]) / down[2]


def _sigmas(lying: Sequence[Lying], down: Array) -> Array:
    """Standard deviations (n,) in m of the depth of the floor beneath markers."""
    noise_m2 = np.array([down @ one.covariance_m2 @ down for one in lying])
    depths_m = np.array([one.point_m[2] for one in lying])
    return np.asarray(np.sqrt(noise_m2 + (_USUAL_DEPTH * depths_m) ** 2))


def _fit_plane(lying: Sequence[Lying]) -> _Plane:
    """By weighted least squares, in those directions in which markers lie far enough apart."""
    plane = _Plane(0.0, np.zeros(2), 0, math.inf)
    for _ in range(3):  # heights stand on the floor, which is found here
        sigmas_m = _sigmas(lying, plane.down)
        weights = sigmas_m**-2
        points_m, depths_m = _on_floor(lying, plane.down)
        middle_m, depth_m = (np.average(v, axis=0, weights=weights) for v in (points_m[:, :2], depths_m))
        across_m = points_m[:, :2] - middle_m
        spreads, directions = np.linalg.eigh((weights * across_m.T) @ across_m)
        known = spreads > _LOOSE**-2
        along = directions[:, known] / spreads[known]
        slopes = along @ (directions[:, known].T @ (weights * across_m.T) @ (depths_m - depth_m))
        sigma = 1 / math.sqrt(spreads[known].min()) if known.any() else math.inf
        plane = _Plane(float(depth_m - middle_m @ slopes), slopes, int(known.sum()), sigma)
    return plane


def _on_one_plane(lying: Sequence[Lying]) -> Mask:
    """Which markers share the plane that most of them lie in, (n,)."""
    count = len(lying)
    if count < _LEAST_TO_NAME:
        return np.ones(count, dtype=np.bool_)
    level = np.array([0.0, 0.0, 1.0])
    sigmas_m, (points_m, depths_m) = _sigmas(lying, level), _on_floor(lying, level)
    terms, triples = np.column_stack([points_m[:, :2], np.ones(count)]), _triples(count)
    areas = np.abs(np.linalg.det(terms[triples]))
    # Three on a line, or nearly so, say nothing of the plane beside it.
    triples = triples[areas > max(_SLENDER * float(areas.max()), _LEAST_AREA_M2)]
    if not len(triples):
        return np.ones(count, dtype=np.bool_)
    planes = np.linalg.solve(terms[triples], depths_m[triples][..., None])[..., 0]
    off = np.abs(planes @ terms.T - depths_m) / sigmas_m
    quantile = (count + 4) // 2 - 1
    scores = np.partition(off, quantile, axis=1)[:, quantile]
    best, off = float(scores.min()), off[scores.argmin()]
    # The best of many triples fits the better by chance, the fewer markers there are (Rousseeuw, Leroy 1987).
    limits = np.maximum(_FLAT_M / sigmas_m, _FAR * max(1.0, best * (1 + 5 / (count - 3))))
    kept = np.asarray(off <= limits)
    if kept.sum() >= 3:  # once more, by all that agree
        plane = _fit_plane([one for one, keep in zip(lying, kept, strict=True) if keep])
        kept = np.asarray(np.abs(plane.misses_m(lying)) / sigmas_m <= limits)
    return kept


def _triples(count: int) -> NDArray[np.int64]:
    """Three of so many, (n, 3): all of them, or some."""
    if math.comb(count, 3) <= _MOST_TRIPLES:
        return np.array([*combinations(range(count), 3)], dtype=np.int64)
    rng = np.random.default_rng(0)
    return np.array([rng.choice(count, 3, replace=False) for _ in range(_MOST_TRIPLES)], dtype=np.int64)


# Nearer together than that, places that two cameras see do not tell how these are turned.
_APART_M = 0.15
# What two cameras say of the same places differs by less; else these are not the same.
_ALIKE_M = 0.05


def join_cameras(alignments: Sequence[Alignment], lenses: Mapping[str, CameraCalibration]) -> list[Hung]:
    """The cameras that hang together with the first of them by markers that two see at the same time.

    The markers on the floor give the height and the plumb line of each camera; two places that both of two
    cameras see, how the one is turned and shifted against the other.

    Returns
    -------
    Places in a frame of which nothing is known but that its z = 0 is the floor; none for fewer than two.
    """
    known = {one.camera: one for one in alignments if one.axes == 2 and one.camera in lenses}
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
        Hung(name, lenses[name], invert_pose(joined[name] @ _floor_from_camera(known[name])))
        for name in known
        if name in joined
    ]


def _floor_from_camera(one: Alignment) -> Array:
    """In a frame of the camera's own: its foot the origin, z up, x as in its picture."""
    assert one.down is not None
    assert one.height_m is not None
    x = np.array([1.0, 0.0, 0.0]) - one.down[0] * one.down
    x /= np.linalg.norm(x)
    axes = np.column_stack([x, np.cross(-one.down, x), -one.down])
    return invert_pose(make_pose(axes, one.height_m * one.down))


def _turn(one: Alignment, other: Alignment) -> Array | None:
    """From the floor frame of one camera to that of another, (4, 4)."""
    pairs = [(a, b) for a in one.lying for b in other.lying if _same(a, b)]
    if len(pairs) < 2:
        return None
    here, there = (
        transform(_floor_from_camera(camera), np.array([pair[n].point_m for pair in pairs]))[:, :2]
        for n, camera in enumerate((one, other))
    )
    # As complex numbers: the best turn is the direction of their product.
    a, b = (points_m @ np.array([1, 1j]) for points_m in (here, there))
    product = np.vdot(a - a.mean(), b - b.mean())
    if np.abs(a - a.mean()).max() < _APART_M / 2 or product == 0:
        return None
    turn = product / abs(product)
    shift = b.mean() - turn * a.mean()
    if np.abs(turn * a + shift - b).max() > _ALIKE_M:
        return None
    rotation = np.array([[turn.real, -turn.imag, 0.0], [turn.imag, turn.real, 0.0], [0.0, 0.0, 1.0]])
    return make_pose(rotation, np.array([shift.real, shift.imag, 0.0]))


def _same(one: Lying, other: Lying) -> bool:
    """Whether two cameras saw one marker at one place."""
    return one.marker_id == other.marker_id and one.start_ns <= other.end_ns and other.start_ns <= one.end_ns
