"""A lens and poses to start from, when nothing is known of the focal length.

Several focal lengths are tried. With each, a corner is a ray, and the plane of the board follows from
the rays alone, which may come from the side or from behind: nothing is divided by a depth.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.bundle_adjustment import Corners, Fit, adjust
from ipsys_log.calibration.lens_models import LensModel

__all__ = ["find_start", "fitted_basis", "pose_from_rays"]

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
