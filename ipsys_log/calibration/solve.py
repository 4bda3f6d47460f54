"""Camera intrinsics from corners: initial values, robust fit, removal of outliers, uncertainty.

The search tries several focal lengths. With a focal length, each corner gives a ray, and the rays give the
plane of the board. No equation divides by a depth, so the rays may also come from the side or from behind.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import Corners, LensFit, adjust, residuals
from ipsys_log.calibration.lens_models import LensModel
from ipsys_log.calibration.uncertainty import group_similar_images, held_out_squares, lens_covariance
from ipsys_log.messages import Array

# Shares of the longer image side: from a field of view of 200 degrees to a telephoto lens.
_FOCAL_SHARES = {
    "kannala_brandt": (0.2, 0.26, 0.34, 0.45, 0.6, 0.8, 1.1, 1.6),
    "plumb_bob": (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0),
}
_FOCAL_SHARES["rational_polynomial"] = _FOCAL_SHARES["plumb_bob"]
_SCALE_PX = 2.0
# Number of free intrinsics (None: all), and number of steps: poses, focal length, principal point, the rest.
_FIRST = ((0, 10), (1, 15))
_THEN = ((3, 30), (None, 60))
_KEPT = 4
# A focal length is not valid if it lies outside of the tried range by this factor.
_FLED = 3.0
_HELD_STEPS = 30
# Fits with a smaller relative difference in cost and in focal length lead to the same result.
_ALIKE = 0.02


def find_start(model: LensModel, corners: Corners, size_px: tuple[int, int]) -> LensFit:
    """Return the best of the fits from several focal lengths."""
    longer = max(size_px)
    shares = _FOCAL_SHARES[model.distortion_model]
    posed = [_estimate_poses(model, corners, size_px, share * longer) for share in shares]
    # A fit of the poses and the focal length is enough to sort out bad start values.
    fits = [_fit_stages(model, fit, corners, _FIRST) for fit in posed]
    best = _best(model, fits, corners)
    if shares[0] / _FLED <= best.intrinsics[0] / longer <= shares[-1] * _FLED:
        return best
    # Boards with little tilt look almost the same at a far shorter focal length with even less tilt. Without
    # distortion coefficients the wrong fit may have the lower cost, so the second try fits them first.
    fits = [_fit_distortion(model, fit, corners) for fit in posed]
    return min(best, _best(model, fits, corners), key=lambda fit: fit.cost)


def _best(model: LensModel, tried: list[LensFit], corners: Corners) -> LensFit:
    """Return the best result of the most promising fits; use only one of several similar fits."""
    promising: list[LensFit] = []
    for fit in sorted(tried, key=lambda fit: fit.cost):
        is_similar = any(
            _near(fit.cost, other.cost) and _near(fit.intrinsics[0], other.intrinsics[0])
            for other in promising
        )
        promising += [] if is_similar or len(promising) == _KEPT else [fit]
    return min((_fit_stages(model, fit, corners, _THEN) for fit in promising), key=lambda fit: fit.cost)


def _near(one: float, other: float) -> bool:
    return abs(one - other) <= _ALIKE * abs(other)


def _estimate_poses(model: LensModel, corners: Corners, size_px: tuple[int, int], focal_px: float) -> LensFit:
    """Return a fit with the given focal length, and with the poses that follow from it."""
    lens = np.zeros(len(model.names))
    lens[:4] = focal_px, focal_px, (size_px[0] - 1) / 2, (size_px[1] - 1) / 2
    rays = _rays(model, lens, corners.pixels)
    bounds = [*corners.starts, len(corners.image_numbers)]
    poses = [pose_from_rays(corners.board_m[a:b], rays[a:b]) for a, b in pairwise(bounds)]
    return LensFit(lens, np.stack([r for r, _ in poses]), np.stack([t for _, t in poses]))


def _fit_stages(
    model: LensModel, fit: LensFit, corners: Corners, plan: tuple[tuple[int | None, int], ...]
) -> LensFit:
    """Fit in stages with more and more free intrinsics; ``plan`` has their number and the number of steps."""
    basis = fitted_basis(model, square=True)
    for unknowns, steps in plan:
        fit = adjust(model, fit, corners, basis[:, :unknowns], _SCALE_PX, steps)
    return fit


def _fit_distortion(model: LensModel, fit: LensFit, corners: Corners) -> LensFit:
    """Fit all parameters except the focal length."""
    basis = fitted_basis(model, square=True)
    return adjust(
        model, _fit_stages(model, fit, corners, _FIRST[:1]), corners, basis[:, 1:], _SCALE_PX, _HELD_STEPS
    )


def fitted_basis(model: LensModel, square: bool, bent: bool = False) -> Array:
    """Return the free directions of the intrinsics and of the bending of the board, (p + 2, q).

    fx and fy have a common direction if ``square``. The board stays flat unless it is ``bent``.
    """
    count = len(model.names)
    basis = np.delete(np.eye(count + 2), np.s_[4 + model.fitted : count + (0 if bent else 2)], axis=1)
    if square:
        basis[1, 0] = 1.0
        basis = np.delete(basis, 1, axis=1)
    return basis


def _rays(model: LensModel, lens: Array, pixels: Array) -> Array:
    """Return the unit rays of pixels without lens distortion, (n, 3)."""
    planar = (pixels - lens[2:4]) / lens[:2]
    if model.distortion_model != "kannala_brandt":
        rays = np.column_stack([planar, np.ones(len(planar))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
    # An angle above 180 degrees is not possible.
    angle = np.minimum(np.linalg.norm(planar, axis=1), 0.98 * np.pi)
    return np.column_stack([planar * np.sinc(angle / np.pi)[:, None], np.cos(angle)])


def pose_from_rays(board_m: Array, rays: Array) -> tuple[Array, Array]:
    """Estimate the board pose in camera coordinates from the rays to its corners.

    Parameters
    ----------
    board_m : (n, 3), z = 0, at least 4 that span a plane.
    rays : (n, 3), of length 1, in any direction.

    Returns
    -------
    Rotation (3, 3) and position (3,) in m.
    """
    center = board_m[:, :2].mean(axis=0)
    spread = float(np.abs(board_m[:, :2] - center).max())
    plane = np.column_stack([(board_m[:, :2] - center) / spread, np.ones(len(board_m))])
    # ray x (H p) = 0, linear in the nine numbers of H.
    x, y, z = rays.T
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)
    rows = np.einsum("nij,nk->nijk", cross, plane).reshape(-1, 9)
    h = np.linalg.svd(rows, full_matrices=False)[2][-1].reshape(3, 3)
    if np.einsum("ni,ij,nj->", rays, h, plane) < 0:
        h = -h
    first_axis, second_axis = h[:, 0] / spread, h[:, 1] / spread
    scale = 2 / (np.linalg.norm(first_axis) + np.linalg.norm(second_axis))
    axes = np.column_stack(
        [first_axis * scale, second_axis * scale, np.cross(first_axis, second_axis) * scale**2]
    )
    u, _, v = np.linalg.svd(axes)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ v)]) @ v
    return rotation, h[:, 2] * scale - rotation[:, :2] @ center


# The median of a two-dimensional normal distance, in standard deviations of one coordinate.
_MEDIAN = float(np.sqrt(2 * np.log(2)))
# Errors of a corner with half the weight, and of an outlier corner, in standard deviations. RMS of an image
# that is left out, as a multiple of the usual RMS.
_DOUBTED = 5.0
_OUTLIER_CORNER = 12.0
_OUTLIER_IMAGE = 3.5
_LEAST_CORNERS = 6
_MOST_ROUNDS = 8
# A smaller error is never an outlier: pixels are not more accurate.
_NEAR_PX = 0.05
# Pixels are square unless the squares of held-out images become smaller without this, by this many standard
# errors of the change.
_HELD_OUT_GAIN = 1.0
# Factors of other focal lengths to try;
_OTHER_FOCALS = (0.7, 1.3)
# their fits must be worse by so many standard deviations,
_WORSE = 3.0
# after at most so many steps.
_OTHER_STEPS = 40


@dataclass(frozen=True, slots=True, eq=False)
class ExcludedImage:
    """An image that the fit left out: its number, and the reason."""

    number: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class SolveResult:
    """The result of a calibration.

    ``covariance`` (p, p) is the covariance of the intrinsics, ``bending_sigma_m`` (2,) the standard deviation
    of the bending of the board. ``corners`` are the corners of the fit,
    ``image_numbers`` the numbers of their images, ``residuals_px`` (n, 2) their residuals in px. ``excluded``
    lists the images that were left out, ``outlier_corners`` counts the single corners left out of other
    images.
    ``groups`` is the number of groups of images that differ. ``square`` says that fx and fy are one number.
    """

    model: LensModel
    fit: LensFit
    covariance: Array
    bending_sigma_m: Array
    corners: Corners
    image_numbers: NDArray[np.intp]
    residuals_px: Array
    excluded: tuple[ExcludedImage, ...]
    outlier_corners: int
    groups: int
    square: bool


def solve(
    model: LensModel, corners: Corners, size_px: tuple[int, int], start: LensFit | None = None
) -> SolveResult:
    """Estimate the intrinsics from corners of a board in several images.

    Parameters
    ----------
    model : the lens model.
    corners : corners of all images, at least 6 in each image.
    size_px : width and height of the images.
    start : the first fit; without it, the function searches for a first fit.
    """
    start = start or find_start(model, corners, size_px)
    purged = _purge(model, start, corners, square=True)
    square = _are_pixels_square(model, purged, size_px)
    if not square:
        # Outliers of the fit with square pixels may fit now.
        purged = _purge(model, start, corners, square=False)
    fit, used = purged.fit, purged.corners
    groups, basis = group_similar_images(model, fit, used, size_px), fitted_basis(model, square, bent=True)
    free = lens_covariance(model, fit, used, basis, loss_scale_px(model, fit, used), groups)
    covariance = basis @ free @ basis.T
    far = int(np.isin(corners.image_numbers, purged.image_numbers).sum()) - len(used.image_numbers)
    return SolveResult(
        model, fit, covariance[:-2, :-2], np.sqrt(np.diag(covariance)[-2:]), used, purged.image_numbers,
        residuals(model, fit, used), purged.excluded, far, int(groups.max()) + 1, square,
    )  # fmt: skip


class _Purged(NamedTuple):
    """A fit without outliers, with its corners and images, and the images that were left out."""

    fit: LensFit
    corners: Corners
    image_numbers: NDArray[np.intp]
    excluded: tuple[ExcludedImage, ...]


def _purge(model: LensModel, fit: LensFit, corners: Corners, square: bool) -> _Purged:
    """Fit, leave out outliers, and fit again, until there are no outliers."""
    basis, numbers, all_excluded = fitted_basis(model, square, bent=True), np.arange(corners.image_count), []
    for _ in range(_MOST_ROUNDS):
        fit = adjust(model, fit, corners, basis, loss_scale_px(model, fit, corners))
        keep_mask, excluded = _split_outliers(corners, residuals(model, fit, corners))
        if keep_mask.all() or len(numbers) - len(excluded) < 3:
            break
        all_excluded += [ExcludedImage(int(numbers[one.number]), one.reason) for one in excluded]
        corners, remaining = corners.select(keep_mask)
        numbers = numbers[remaining]
        fit = replace(fit, rotations=fit.rotations[remaining], positions_m=fit.positions_m[remaining])
    return _Purged(fit, corners, numbers, tuple(all_excluded))


def _are_pixels_square(model: LensModel, purged: _Purged, size_px: tuple[int, int]) -> bool:
    """Return whether separate fx and fy do not fit images better that were left out of the fit."""
    fit, corners = purged.fit, purged.corners
    groups, scale_px = group_similar_images(model, fit, corners, size_px), loss_scale_px(model, fit, corners)
    squares = []
    for square in (True, False):
        basis = fitted_basis(model, square, bent=True)
        fit = adjust(model, fit, corners, basis, scale_px)
        squares.append(held_out_squares(model, fit, corners, basis, scale_px, groups))
    gains = squares[0] - squares[1]
    return bool(gains.mean() <= _HELD_OUT_GAIN * gains.std(ddof=1) / np.sqrt(len(gains)))


def determines_focal_length(solved: SolveResult) -> bool:
    """Return whether a focal length that differs by 30 % fits worse, with all other parameters free.

    If the images hardly determine the focal length, the cost is not a parabola, and the standard deviation is
    too small.
    """
    model, fit, corners = solved.model, solved.fit, solved.corners
    # All free directions except the focal length.
    rest = fitted_basis(model, square=True, bent=True)[:, 1:]
    scale_px = loss_scale_px(model, fit, corners)
    most = fit.cost + (_WORSE * _spread(solved.residuals_px)) ** 2
    for factor in _OTHER_FOCALS:
        lens, nearer = fit.intrinsics * ([factor] * 2 + [1.0] * (len(fit.intrinsics) - 2)), [1.0, 1.0, factor]
        other = replace(fit, intrinsics=lens, positions_m=fit.positions_m * nearer)
        for basis in (rest[:, :0], rest):
            other = adjust(model, other, corners, basis, scale_px, _OTHER_STEPS)
        if other.cost < most:
            return False
    return True


def loss_scale_px(model: LensModel, fit: LensFit, corners: Corners) -> float:
    """Return the error in px from which a corner has at most half the weight."""
    return max(_DOUBTED * _spread(residuals(model, fit, corners)), _NEAR_PX)


def rms_px(solved: SolveResult) -> float:
    """Return the RMS reprojection error in px."""
    return float(np.sqrt((solved.residuals_px**2).sum(axis=1).mean()))


def _spread(residuals_px: Array) -> float:
    """Return the standard deviation of one coordinate; a few outliers have no effect."""
    return float(np.median(np.linalg.norm(residuals_px, axis=1))) / _MEDIAN


def _split_outliers(corners: Corners, residuals_px: Array) -> tuple[NDArray[np.bool_], list[ExcludedImage]]:
    """Return a mask of the corners of the fit, (n,), and the images that are left out."""
    distances = np.linalg.norm(residuals_px, axis=1)
    near = distances <= max(_OUTLIER_CORNER * _spread(residuals_px), _NEAR_PX)
    counts = corners.sums(np.ones_like(distances))
    remaining = corners.sums(near.astype(float))
    # An image may also have large errors as a whole, without its single outlier corners.
    rest_px = np.sqrt(corners.sums(distances**2 * near) / np.maximum(remaining, 1))
    usual_px = float(np.median(rest_px))
    scattered = remaining < np.maximum(_LEAST_CORNERS, counts / 2)
    off = rest_px > max(_OUTLIER_IMAGE * usual_px, _NEAR_PX)
    excluded = []
    for n in np.flatnonzero(scattered | off):
        if scattered[n]:
            reason = f"wrong corners: {counts[n] - remaining[n]:.0f} of {counts[n]:.0f}"
        else:
            reason = (
                f"does not fit: its reprojection error is {rest_px[n]:.2f} px, but usually {usual_px:.2f} px"
            )
        excluded.append(ExcludedImage(int(n), reason))
    return near & ~(scattered | off)[corners.image_numbers], excluded
