"""Bundle adjustment: joint least squares of intrinsics, bending of the board, and board poses.

The pose of an image affects only the corners of this image. So the six unknowns of each pose are
eliminated before the solution for the intrinsics (Schur complement). The cost of a step grows linearly with
the number of corners.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.lens_models import LensModel, project_points, project_with_slopes
from ipsys_log.messages import Array

# Usual bending of a board (sagitta over half of its size), and the residual that such a bending costs in the
# prior. The corners of a few images outweigh it.
USUAL_BENDING_M, _PULL_PX = 0.0003, 0.1
_LEAST_GAIN = 1e-9
_MOST_DAMPING = 1e12


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """All corners of all images.

    ``board_m`` (n, 3) has the positions on the board, ``pixels`` (n, 2) the positions in the image.
    ``image_numbers`` (n,) has the number of the image, in ascending order. Each number from 0 to
    ``image_count`` - 1 occurs at least once.
    """

    board_m: Array
    pixels: Array
    image_numbers: NDArray[np.intp]
    image_count: int

    @property
    def arches(self) -> Array:
        """The height of each corner for a sagitta of 1 in x and in y: x^2 and y^2 with edges at 1, (n, 2)."""
        planar = self.board_m[:, :2]
        return np.asarray((planar / np.abs(planar).max(axis=0)) ** 2)

    @property
    def starts(self) -> NDArray[np.intp]:
        """The index of the first corner of each image."""
        return np.searchsorted(self.image_numbers, np.arange(self.image_count))

    def sums(self, values: Array) -> Array:
        """Return the sums of ``values`` over the corners of each image, (image_count, ...)."""
        return np.asarray(np.add.reduceat(values, self.starts, axis=0))

    def select(self, mask: NDArray[np.bool_]) -> tuple[Corners, NDArray[np.intp]]:
        """Return the corners of the mask ``mask`` (n,), and the numbers of images that still have corners."""
        remaining, numbers = np.unique(self.image_numbers[mask], return_inverse=True)
        return Corners(self.board_m[mask], self.pixels[mask], numbers, len(remaining)), remaining


@dataclass(frozen=True, slots=True, eq=False)
class LensFit:
    """The intrinsics (p,), and each board pose in camera coordinates: (f, 3, 3) and (f, 3) in m.

    ``bending_m`` (2,) is the bending of the board in all images, in x and in y: the depth of its edges behind
    its middle.
    """

    intrinsics: Array
    rotations: Array
    positions_m: Array
    cost: float = np.inf
    bending_m: Array = field(default_factory=lambda: np.zeros(2))

    @property
    def unknowns(self) -> Array:
        """The intrinsics and the bending, (p + 2,)."""
        return np.append(self.intrinsics, self.bending_m)


@dataclass(frozen=True, slots=True, eq=False)
class Normal:
    """The normal equations of the weighted corners.

    ``lens`` (f, q, q) and ``lens_gradient`` (f, q) are the parts of the intrinsics and the bending for each
    image. ``poses`` (f, 6, 6) and ``pose_gradient`` (f, 6) are the parts of the poses, ``between`` (f, 6, q)
    are the mixed parts. ``pull`` (q, q) and ``pull_gradient`` (q,) are the prior that draws coefficients and
    bending to 0. ``squares`` (f,) are the weighted squares of the residuals.
    """

    lens: Array
    lens_gradient: Array
    poses: Array
    pose_gradient: Array
    between: Array
    pull: Array
    pull_gradient: Array
    squares: Array


def camera_points(fit: LensFit, corners: Corners) -> Array:
    """Return the corners in camera coordinates, (n, 3) in m."""
    bent_m = corners.board_m + np.outer(corners.arches @ fit.bending_m, (0.0, 0.0, 1.0))
    rotated = np.einsum("nij,nj->ni", fit.rotations[corners.image_numbers], bent_m)
    return np.asarray(rotated + fit.positions_m[corners.image_numbers])


def residuals(model: LensModel, fit: LensFit, corners: Corners) -> Array:
    """Return the reprojection residuals of the corners, (n, 2) in px."""
    return project_points(model, fit.intrinsics, camera_points(fit, corners)) - corners.pixels


def _weights(residuals_px: Array, scale_px: float | None) -> tuple[Array, float]:
    """Return the weights of the corners and the cost, by Cauchy's loss, or by squares without a scale."""
    squares = (residuals_px**2).sum(axis=1)
    if scale_px is None:
        return np.ones(len(squares)), float(squares.sum())
    ratio = squares / scale_px**2
    return 1 / (1 + ratio), float(scale_px**2 * np.log1p(ratio).sum())


def corner_weights(residuals_px: Array, scale_px: float | None) -> Array:
    """Return the weight of each corner, (n,): 1, or less for an outlier."""
    return _weights(residuals_px, scale_px)[0]


def _cost(model: LensModel, fit: LensFit, corners: Corners, scale_px: float | None) -> float:
    return _weights(residuals(model, fit, corners), scale_px)[1] + float(_pull(model) @ fit.unknowns**2)


def _pull(model: LensModel) -> Array:
    """Return the weight of the prior that draws each intrinsic and each bending to 0, (p + 2,)."""
    return np.append(model.pull, np.full(2, (_PULL_PX / USUAL_BENDING_M) ** 2))


def normal_equations(
    model: LensModel, fit: LensFit, corners: Corners, basis: Array, scale_px: float | None
) -> Normal:
    """Return the normal equations of a step.

    ``basis`` (p + 2, q) has the free directions of the intrinsics and the bending.
    """
    points_m = camera_points(fit, corners)
    pixels, by_point, by_lens = project_with_slopes(model, fit.intrinsics, points_m)
    residuals_px = pixels - corners.pixels
    x, y, z = (points_m - fit.positions_m[corners.image_numbers]).T
    # Columns: the intrinsics (q), rotation and translation of the board (6), and the residual.
    count = basis.shape[1]
    rows = np.empty((len(points_m), 2, count + 7))
    normals = fit.rotations[corners.image_numbers, :, 2]
    by_bending = (by_point @ normals[:, :, None]) * corners.arches[:, None]
    rows[..., :count] = np.concatenate([by_lens, by_bending], axis=2) @ basis
    # A small rotation w moves a point by w x (R X).
    by_x, by_y, by_z = (by_point[..., n] for n in range(3))
    x, y, z = x[:, None], y[:, None], z[:, None]
    rows[..., count] = by_z * y - by_y * z
    rows[..., count + 1] = by_x * z - by_z * x
    rows[..., count + 2] = by_y * x - by_x * y
    rows[..., count + 3 : count + 6] = by_point
    rows[..., count + 6] = residuals_px
    rows *= np.sqrt(_weights(residuals_px, scale_px)[0])[:, None, None]
    squares = np.stack([_squares(part) for part in np.split(rows, corners.starts[1:])])
    lens, pose, pull = slice(count), slice(count, count + 6), _pull(model)
    return Normal(
        squares[:, lens, lens],
        squares[:, lens, -1],
        squares[:, pose, pose],
        squares[:, pose, -1],
        squares[:, pose, lens],
        (basis.T * pull) @ basis,
        basis.T @ (pull * fit.unknowns),
        squares[:, -1, -1],
    )


def _squares(rows: Array) -> Array:
    """Return the products (m, m) of the columns of the rows (n, 2, m) of one image."""
    flat = rows.reshape(-1, rows.shape[2])
    return np.asarray(flat.T @ flat)


def reduce_to_lens(normal: Normal) -> tuple[Array, Array]:
    """Return the equations of the intrinsics without the poses: matrices (f, q, q), gradients (f, q)."""
    gradients = normal.pose_gradient[..., None]
    solved = np.linalg.solve(normal.poses, np.concatenate([normal.between, gradients], axis=2))
    transposed = normal.between.transpose(0, 2, 1)
    matrices = normal.lens - transposed @ solved[:, :, :-1]
    return matrices, normal.lens_gradient - (transposed @ solved[:, :, -1:])[..., 0]


def _solve(normal: Normal, damping: float) -> tuple[Array, Array]:
    """Return a damped step of the intrinsics (q,) and of the poses (f, 6)."""
    poses = normal.poses + damping * _diagonals(normal.poses)
    lens = normal.lens.sum(axis=0) + normal.pull
    lens = lens + damping * np.diag(np.diag(lens))
    solved = np.linalg.solve(poses, np.concatenate([normal.between, normal.pose_gradient[..., None]], axis=2))
    transposed = normal.between.transpose(0, 2, 1)
    reduced = lens - (transposed @ solved[:, :, :-1]).sum(axis=0)
    gradient = normal.lens_gradient.sum(axis=0) + normal.pull_gradient
    gradient = gradient - (transposed @ solved[:, :, -1:]).sum(axis=0)[:, 0]
    step = -np.linalg.solve(reduced, gradient) if gradient.size else gradient
    return step, -solved[:, :, -1] - solved[:, :, :-1] @ step


def _diagonals(matrices: Array) -> Array:
    return np.asarray(matrices * np.eye(matrices.shape[-1]))


def _apply_step(fit: LensFit, lens_step: Array, pose_steps: Array) -> LensFit:
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_rotvec(pose_steps[:, :3]).as_matrix()
    return LensFit(
        fit.intrinsics + lens_step[:-2],
        turns @ fit.rotations,
        fit.positions_m + pose_steps[:, 3:],
        bending_m=fit.bending_m + lens_step[-2:],
    )


def adjust(
    model: LensModel,
    start: LensFit,
    corners: Corners,
    basis: Array,
    scale_px: float | None,
    most_steps: int = 100,
) -> LensFit:
    """Minimise the cost near ``start`` by the damped steps of Levenberg and Marquardt; return the fit.

    Parameters
    ----------
    model, start, corners : the lens model, the first fit, and the corners to fit.
    basis : (p + 2, q), the directions in which the intrinsics and the bending of the board may change;
        (p + 2, 0) keeps them constant.
    scale_px : scale of Cauchy's loss, which gives outliers a small weight; None: plain squares.
    most_steps : the largest number of steps.

    References
    ----------
    Triggs, McLauchlan, Hartley and Fitzgibbon, Bundle adjustment - a modern synthesis, 2000.
    """
    fit = replace(start, cost=_cost(model, start, corners, scale_px))
    damping, steps = 1e-3, 0
    while steps < most_steps and damping < _MOST_DAMPING:
        steps += 1
        normal = normal_equations(model, fit, corners, basis, scale_px)
        cost_before = fit.cost
        while damping < _MOST_DAMPING:
            trial = _try_step(model, fit, corners, basis, normal, damping, scale_px)
            if trial is not None and trial.cost <= cost_before:
                fit, damping = trial, max(damping / 10, 1e-12)
                break
            damping *= 8
        if cost_before - fit.cost <= _LEAST_GAIN * cost_before:
            break
    return fit


def _try_step(
    model: LensModel,
    fit: LensFit,
    corners: Corners,
    basis: Array,
    normal: Normal,
    damping: float,
    scale_px: float | None,
) -> LensFit | None:
    """Return the result of a step, or None if there is none."""
    try:
        lens_step, pose_steps = _solve(normal, damping)
    except np.linalg.LinAlgError:
        return None
    trial = _apply_step(fit, basis @ lens_step, pose_steps)
    if not (np.isfinite(trial.intrinsics).all() and (trial.intrinsics[:2] > 0).all()):
        return None
    with np.errstate(over="ignore", invalid="ignore"):
        cost = _cost(model, trial, corners, scale_px)
    return replace(trial, cost=cost) if np.isfinite(cost) else None
