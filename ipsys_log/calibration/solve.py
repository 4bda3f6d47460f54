"""Camera intrinsics from corners: initial values, robust fit, removal of outliers, uncertainty.

Several focal lengths are tried. With each, a corner is a ray, and the plane of the board follows from
the rays alone, which may come from the side or from behind: nothing is divided by a depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import Corners, Fit, adjust, residuals
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.uncertainty import alike, lens_covariance

__all__ = [
    "Left",
    "Solved",
    "doubt_from_px",
    "find_start",
    "fitted_basis",
    "pose_from_rays",
    "rms_px",
    "solve",
    "tells_focal_length",
]

Array = NDArray[np.float64]

# Of the longer side of the image: from 200 degrees to a long lens.
_FOCAL_SHARES = {
    "kannala_brandt": (0.2, 0.26, 0.34, 0.45, 0.6, 0.8, 1.1, 1.6),
    "plumb_bob": (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0),
}
_FOCAL_SHARES["rational_polynomial"] = _FOCAL_SHARES["plumb_bob"]
_SCALE_PX = 2.0
# How many unknowns of the lens (None: all), for how many steps: poses, focal length, middle, the rest.
_FIRST = ((0, 10), (1, 15))
_THEN = ((3, 30), (None, 60))
_KEPT = 4
# A focal length so many times beyond those tried is none.
_FLED = 3.0
_HELD_STEPS = 30
# Fits so near in cost and focal length lead to the same place.
_ALIKE = 0.02


def find_start(model: LensModel, corners: Corners, size_px: tuple[int, int]) -> Fit:
    """The best of the fits that several focal lengths lead to, of focal length and middle alone.

    Parameters
    ----------
    model : the kind of lens.
    corners : of all pictures.
    size_px : width and height.
    """
    longer = max(size_px)
    shares = _FOCAL_SHARES[model.distortion_model]
    posed = [_posed(model, corners, size_px, share * longer) for share in shares]
    # The focal length alone shows which of them are hopeless.
    tried = [_freed(model, fit, corners, _FIRST) for fit in posed]
    best = _best(model, tried, corners)
    if shares[0] / _FLED <= best.lens[0] / longer <= shares[-1] * _FLED:
        return best
    # Boards that are hardly tilted look much the same at a far shorter focal length, tilted less still. While
    # lines may not bend, that looks better; so let them bend first.
    tried = [_bent(model, fit, corners) for fit in posed]
    return min(best, _best(model, tried, corners), key=lambda fit: fit.cost)


def _best(model: LensModel, tried: list[Fit], corners: Corners) -> Fit:
    """The best that the most promising fits lead to, each of those that are alike but once."""
    kept: list[Fit] = []
    for fit in sorted(tried, key=lambda fit: fit.cost):
        alike = any(_near(fit.cost, one.cost) and _near(fit.lens[0], one.lens[0]) for one in kept)
        kept += [] if alike or len(kept) == _KEPT else [fit]
    return min((_freed(model, fit, corners, _THEN) for fit in kept), key=lambda fit: fit.cost)


def _near(one: float, other: float) -> bool:
    return abs(one - other) <= _ALIKE * abs(other)


def _posed(model: LensModel, corners: Corners, size_px: tuple[int, int], focal_px: float) -> Fit:
    """Poses that follow from a focal length."""
    lens = np.zeros(len(model.names))
    lens[:4] = focal_px, focal_px, (size_px[0] - 1) / 2, (size_px[1] - 1) / 2
    rays = _rays(model, lens, corners.pixels)
    bounds = [*corners.starts, len(corners.picture)]
    poses = [pose_from_rays(corners.board_m[a:b], rays[a:b]) for a, b in pairwise(bounds)]
    return Fit(lens, np.stack([r for r, _ in poses]), np.stack([t for _, t in poses]))


def _freed(model: LensModel, fit: Fit, corners: Corners, plan: tuple[tuple[int | None, int], ...]) -> Fit:
    """A fit by ever more unknowns of the lens, each for so many steps."""
    basis = fitted_basis(model, square=True)
    for unknowns, steps in plan:
        fit = adjust(model, fit, corners, basis[:, :unknowns], _SCALE_PX, steps)
    return fit


def _bent(model: LensModel, fit: Fit, corners: Corners) -> Fit:
    """A fit of all but the focal length."""
    basis = fitted_basis(model, square=True)
    return adjust(
        model, _freed(model, fit, corners, _FIRST[:1]), corners, basis[:, 1:], _SCALE_PX, _HELD_STEPS
    )


def fitted_basis(model: LensModel, square: bool) -> Array:
    """The directions in which a lens may change, (p, q); one for fx and fy together if pixels are square."""
    basis = np.eye(len(model.names))[:, : 4 + model.fitted]
    if square:
        basis[1, 0] = 1.0
        basis = np.delete(basis, 1, axis=1)
    return basis


def _rays(model: LensModel, lens: Array, pixels: Array) -> Array:
    """Unit rays of pixels through a lens without distortion, (n, 3)."""
    planar = (pixels - lens[2:4]) / lens[:2]
    if model.distortion_model != "kannala_brandt":
        rays = np.column_stack([planar, np.ones(len(planar))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    # An angle of more than half a turn is none.
    angle = np.minimum(np.linalg.norm(planar, axis=1), 0.98 * np.pi)
    return np.column_stack([planar * np.sinc(angle / np.pi)[:, None], np.cos(angle)])


def pose_from_rays(board_m: Array, rays: Array) -> tuple[Array, Array]:
    """The board in the frame of the camera from the rays to its corners.

    Parameters
    ----------
    board_m : (n, 3), z = 0, at least 4 that span a plane.
    rays : (n, 3), of length 1, in any direction.

    Returns
    -------
    Rotation (3, 3) and place (3,) in m.
    """
    middle = board_m[:, :2].mean(axis=0)
    spread = float(np.abs(board_m[:, :2] - middle).max())
    plane = np.column_stack([(board_m[:, :2] - middle) / spread, np.ones(len(board_m))])
    # ray x (H p) = 0, linear in the nine numbers of H.
    x, y, z = rays.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    rows = np.einsum("nij,nk->nijk", cross, plane).reshape(-1, 9)
    h = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    if np.einsum("ni,ij,nj->", rays, h, plane) < 0:
        h = -h
    one, two = h[:, 0] / spread, h[:, 1] / spread
    scale = 2 / (np.linalg.norm(one) + np.linalg.norm(two))
    axes = np.column_stack([one * scale, two * scale, np.cross(one, two) * scale**2])
    u, _, v = np.linalg.svd(axes)
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return turn, h[:, 2] * scale - turn[:, :2] @ middle


# The median of a two-dimensional normal distance, in standard deviations of one coordinate.
_MEDIAN = float(np.sqrt(2 * np.log(2)))
# Corners count for half that are so many standard deviations off, and are left out so many off;
# a picture is left out whose RMS is so many times the usual one.
_DOUBTED = 5.0
_FAR_CORNER = 12.0
_FAR_PICTURE = 3.5
_LEAST_CORNERS = 6
_MOST_ROUNDS = 8
# Nothing is far off that is this near: pixels are no better.
_NEAR_PX = 0.05
# Pixels are square unless the pictures say otherwise: by this and by three standard deviations, or by ten.
_SQUARE, _SURE, _QUITE_SURE = 0.01, 3.0, 10.0
# What focal length is tried against that found, and by how many standard deviations it has to fit worse.
_OTHER_FOCALS, _WORSE, _OTHER_STEPS = (0.7, 1.3), 3.0, 40


@dataclass(frozen=True, slots=True, eq=False)
class Left:
    """A picture that the fit left out: its number, and why."""

    picture: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """A lens, its covariance (p, p), the corners it rests on, which pictures they are of, and their
    residuals (n, 2) in px; pictures left out, how many single corners of the others, and how many groups of
    pictures differ; whether fx and fy are one number."""

    model: LensModel
    fit: Fit
    covariance: Array
    corners: Corners
    pictures: NDArray[np.intp]
    residuals_px: Array
    left: tuple[Left, ...]
    far_corners: int
    groups: int
    square: bool


def solve(model: LensModel, corners: Corners, size_px: tuple[int, int], start: Fit | None = None) -> Solved:
    """Estimate the intrinsics from corners of a board in several pictures.

    Parameters
    ----------
    model : the lens model.
    corners : of all pictures, at least 6 in each.
    size_px : width and height of the pictures.
    start : a fit to start from; without it, one is searched for.
    """
    start = start or find_start(model, corners, size_px)
    purged = _purge(model, start, corners, square=True)
    fit, covariance, groups, square = _finish(model, purged, size_px)
    if not square:
        # What did not belong to square pixels may well belong now.
        purged = _purge(model, start, corners, square=False)
        fit, covariance, groups, square = _finish(model, purged, size_px)
    kept = purged.corners
    far = int(np.isin(corners.picture, purged.pictures).sum()) - len(kept.picture)
    missed_px = residuals(model, fit, kept)
    return Solved(
        model, fit, covariance, kept, purged.pictures, missed_px, purged.left, far, groups, square
    )  # fmt: skip


class _Purged(NamedTuple):
    """A fit to what belongs together, of which pictures, and those that were left out."""

    fit: Fit
    corners: Corners
    pictures: NDArray[np.intp]
    left: tuple[Left, ...]


def _purge(model: LensModel, fit: Fit, corners: Corners, square: bool) -> _Purged:
    """Fit, leave out outliers, and fit again, until there are none."""
    basis, pictures, left = fitted_basis(model, square), np.arange(corners.pictures), []
    for _ in range(_MOST_ROUNDS):
        fit = adjust(model, fit, corners, basis, doubt_from_px(model, fit, corners))
        kept, gone = _belonging(corners, residuals(model, fit, corners))
        if kept.all() or len(pictures) - len(gone) < 3:
            break
        left += [Left(int(pictures[g.picture]), g.reason) for g in gone]
        corners, still = corners.keep(kept)
        pictures = pictures[still]
        fit = Fit(fit.lens, fit.rotations[still], fit.places_m[still])
    return _Purged(fit, corners, pictures, tuple(left))


def _finish(model: LensModel, purged: _Purged, size_px: tuple[int, int]) -> tuple[Fit, Array, int, bool]:
    """Return the last fit, its covariance (p, p), the number of groups, and whether fx = fy was assumed."""
    start, corners = purged.fit, purged.corners
    groups = alike(model, start, corners, size_px)
    found = []
    for square in (False, True):
        basis = fitted_basis(model, square)
        fit = adjust(model, start, corners, basis, doubt_from_px(model, start, corners))
        covariance = lens_covariance(model, fit, corners, basis, doubt_from_px(model, fit, corners), groups)
        found.append((fit, basis @ covariance @ basis.T, int(groups.max()) + 1, square))
    free, covariance = found[0][:2]
    ratio = np.array([1.0, -1.0]) / free.lens[:2]
    sigma = float(np.sqrt(ratio @ covariance[:2, :2] @ ratio))
    off = abs(float(np.log(free.lens[0] / free.lens[1])))
    return found[0] if off > max(_SURE * sigma, min(_SQUARE, _QUITE_SURE * sigma)) else found[1]


def tells_focal_length(solved: Solved) -> bool:
    """Return whether a focal length that differs by 30 % fits worse, with all other parameters free.

    If the pictures hardly determine it, the cost is no parabola, and a standard deviation is too small.
    """
    model, fit, corners = solved.model, solved.fit, solved.corners
    # Without what fx and fy have to themselves.
    rest = fitted_basis(model, square=True)[:, 1:]
    scale_px = doubt_from_px(model, fit, corners)
    most = fit.cost + (_WORSE * _spread(solved.residuals_px)) ** 2
    for factor in _OTHER_FOCALS:
        lens, nearer = fit.lens * ([factor] * 2 + [1.0] * (len(fit.lens) - 2)), [1.0, 1.0, factor]
        other = Fit(lens, fit.rotations, fit.places_m * nearer)
        for basis in (rest[:, :0], rest):
            other = adjust(model, other, corners, basis, scale_px, _OTHER_STEPS)
        if other.cost < most:
            return False
    return True


def doubt_from_px(model: LensModel, fit: Fit, corners: Corners) -> float:
    """Return the error in px from which a corner has at most half the weight."""
    return max(_DOUBTED * _spread(residuals(model, fit, corners)), _NEAR_PX)


def rms_px(solved: Solved) -> float:
    """Return the RMS reprojection error in px."""
    return float(np.sqrt((solved.residuals_px**2).sum(axis=1).mean()))


def _spread(missed_px: Array) -> float:
    """Standard deviation of one coordinate, whatever a few corners do."""
    return float(np.median(np.linalg.norm(missed_px, axis=1))) / _MEDIAN


def _belonging(corners: Corners, missed_px: Array) -> tuple[NDArray[np.bool_], list[Left]]:
    """Return a mask of the corners of the fit, (n,), and the pictures that are left out."""
    distances = np.linalg.norm(missed_px, axis=1)
    near = distances <= max(_FAR_CORNER * _spread(missed_px), _NEAR_PX)
    counts = corners.sums(np.ones_like(distances))
    remaining = corners.sums(near.astype(float))
    # Single corners aside, a picture as a whole may be off.
    rest_px = np.sqrt(corners.sums(distances**2 * near) / np.maximum(remaining, 1))
    usual_px = float(np.median(rest_px))
    scattered = remaining < np.maximum(_LEAST_CORNERS, counts / 2)
    off = rest_px > max(_FAR_PICTURE * usual_px, _NEAR_PX)
    gone = []
    for n in np.flatnonzero(scattered | off):
        if scattered[n]:
            reason = f"corners far off: {counts[n] - remaining[n]:.0f} of {counts[n]:.0f}"
        else:
            reason = f"does not fit: its corners are {rest_px[n]:.2f} px off, usually {usual_px:.2f}"
        gone.append(Left(int(n), reason))
    return near & ~(scattered | off)[corners.picture], gone
