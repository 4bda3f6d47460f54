"""Uncertainty of intrinsics: their change without some images, and with a richer lens model.

The richer model adds terms that the model lacks: one more radial term, and the terms of displaced or tilted
lens elements. These are decentering and thin prism (Brown 1966; Weng, Cohen and Herniou, PAMI 1992). One
linear step from the fit shows their size, and the change of the other parameters.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board_search import NEAR, group_outlines
from ipsys_log.calibration.bundle_adjustment import (
    USUAL_BENDING_M,
    Corners,
    LensFit,
    camera_points,
    corner_weights,
    normal_equations,
    reduce_to_lens,
    residuals,
)
from ipsys_log.calibration.lens_models import LensModel, project_points
from ipsys_log.messages import Array

# Usual size of the new terms. The radial term is at the farthest corner, in focal lengths. The other terms
# are per square of the distance from the principal point.
_RADIAL, _TANGENTIAL = 0.01, 0.003
# Terms count from this multiple of the mean chi^2 of noise on. Noise reaches it in about 10 % of fits.
_NOISE = 2.0
# The power of the next radial term, after the last fitted coefficient.
_NEXT_POWER = {"kannala_brandt": 10, "plumb_bob": 8, "rational_polynomial": 8}


class _Terms(NamedTuple):
    """Displacements of corners, (n, 2, k) in focal lengths, for a coefficient of 1, and their usual size."""

    displacements: Array
    usual: Array


def model_change(
    model: LensModel, fit: LensFit, corners: Corners, basis: Array, scale_px: float | None, variance: float
) -> Array:
    """Return the change of the unknowns along ``basis`` with a richer model, (q,).

    The change shrinks to 0 for less significant terms: noise alone mostly causes no change.

    Parameters
    ----------
    model, fit, corners, basis, scale_px : the values of the fit.
    variance : variance of a corner coordinate in px^2, with the errors that the corners of an image share.

    References
    ----------
    James and Stein, Estimation with quadratic loss, 1961: the shrinkage 1 - c / chi^2.
    """
    lens_count = basis.shape[1]
    distorted = model.distort(camera_points(fit, corners), fit.intrinsics[4:])
    terms = _terms(model, distorted)
    richer, richer_fit, richer_basis = _enrich(model, fit, basis, terms)
    normal = normal_equations(richer, richer_fit, corners, richer_basis, scale_px)
    matrices, gradients = reduce_to_lens(normal)
    whole = matrices.sum(axis=0) + normal.pull
    gradient = gradients.sum(axis=0) + normal.pull_gradient
    of_lens, of_terms = slice(lens_count), slice(lens_count, None)
    # Change of the intrinsics with the terms.
    following = np.linalg.solve(whole[of_lens, of_lens], whole[of_lens, of_terms])
    precision = (whole[of_terms, of_terms] - whole[of_terms, of_lens] @ following) / variance
    pulled = (gradient[of_terms] - following.T @ gradient[of_lens]) / variance
    posterior = np.linalg.inv(precision + np.diag(terms.usual**-2))
    size = -posterior @ pulled
    chi_squared, by_noise = float(pulled @ posterior @ pulled), float(np.trace(precision @ posterior))
    share = max(0.0, 1 - _NOISE * by_noise / chi_squared) if chi_squared > 0 else 0.0
    return np.asarray(-np.sqrt(share) * following @ size)


def _terms(model: LensModel, distorted: Array) -> _Terms:
    a, b = distorted.T
    square = a * a + b * b
    widest = float(square.max())
    zero, power = np.zeros_like(a), _NEXT_POWER[model.distortion_model] // 2
    if model.fitted < len(model.coefficients):
        power -= 1
    radial = distorted * ((square / widest) ** power)[:, None]
    prism = [np.stack([square, zero], axis=1), np.stack([zero, square], axis=1)]
    decentering = [
        np.stack([2 * a * b, square + 2 * b * b], axis=1),
        np.stack([square + 2 * a * a, 2 * a * b], axis=1),
    ]
    tangential = prism if "p1" in model.coefficients else [*prism, *decentering]
    usual = np.array([_RADIAL] + [_TANGENTIAL] * len(tangential))
    return _Terms(np.stack([radial, *tangential], axis=2), usual)


def _enrich(model: LensModel, fit: LensFit, basis: Array, terms: _Terms) -> tuple[LensModel, LensFit, Array]:
    """Return the richer model at the fitted corners, the same fit in it, and the basis with the terms."""
    count = len(terms.usual)

    def distort(points_m: Array, k: Array) -> tuple[Array, Array, Array]:
        distorted, by_point, by_coefficients = model.distort_with_slopes(points_m, k[:-count])
        return distorted, by_point, np.concatenate([by_coefficients, terms.displacements], axis=2)

    names = tuple(f"e{n}" for n in range(count))
    richer = model._replace(coefficients=(*model.coefficients, *names), distort_with_slopes=distort)
    # The terms come after the intrinsics, and before the bending.
    lens_count = len(fit.intrinsics)
    wider = np.zeros((len(basis) + count, basis.shape[1] + count))
    wider[:lens_count, : basis.shape[1]] = basis[:lens_count]
    wider[lens_count : lens_count + count, basis.shape[1] :] = np.eye(count)
    wider[lens_count + count :, : basis.shape[1]] = basis[lens_count:]
    return richer, replace(fit, intrinsics=np.append(fit.intrinsics, np.zeros(count))), wider


# Near boards form one group. The limit of the distance is halved up to so many times, until there are enough
# groups for a jackknife.
_HALVINGS = 4
_ENOUGH_GROUPS = 15
# A jackknife of few groups is uncertain itself. With so many groups it has the weight of least squares.
_EQUAL_GROUPS = 8


def group_similar_images(
    model: LensModel, fit: LensFit, corners: Corners, size_px: tuple[int, int]
) -> NDArray[np.intp]:
    """Return the group of each image, (f,): a group shows the board in nearly the same pose.

    Successive frames of a video have the same errors, so they give no new information.
    """
    low, high = corners.board_m.min(axis=0), corners.board_m.max(axis=0)
    outline_m = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
    seen_m = np.einsum("fij,kj->fki", fit.rotations, outline_m) + fit.positions_m[:, None]
    outlines = project_points(model, fit.intrinsics, seen_m.reshape(-1, 3)).reshape(-1, 4, 2)
    near_px = NEAR * float(np.hypot(*size_px))
    for _ in range(_HALVINGS):
        groups = group_outlines(outlines, near_px)
        if groups.max() + 1 >= _ENOUGH_GROUPS:
            return groups
        near_px /= 2
    return np.arange(len(outlines))


def lens_covariance(
    model: LensModel,
    fit: LensFit,
    corners: Corners,
    basis: Array,
    scale_px: float | None,
    groups: NDArray[np.intp],
) -> Array:
    """Return the covariance (q, q) of the unknowns along ``basis``.

    Corners of one image share errors (motion, blur), and these errors differ between images. With
    the assumption of independent errors, the covariance is too small. A jackknife over whole groups needs
    no such assumption; each group is left out in one linear step. With few groups the jackknife is
    uncertain itself: seven images may agree by chance. So it is averaged with the covariance of least
    squares, with the variance that the jackknife shows over all parameters. Student's distribution for
    the number of groups makes it wider. The change that a richer model shows is added.

    References
    ----------
    Efron and Stein, The jackknife estimate of variance, Annals of Statistics 1981.
    """
    normal = normal_equations(model, fit, corners, basis, scale_px)
    matrices, gradients = reduce_to_lens(normal)
    whole = matrices.sum(axis=0) + normal.pull
    jackknife = _jackknife(whole, matrices, gradients, groups)
    inverse = np.linalg.inv(whole)
    squares = inverse @ (whole - normal.pull) @ inverse
    variance = _variance_px2(model, fit, corners, scale_px, basis.shape[1])
    # The variance is not less than the residuals show.
    variance = max(variance, float(np.median(np.diag(jackknife) / np.diag(squares))))
    count = int(groups.max()) + 1
    share = count / (count + _EQUAL_GROUPS)
    widening = (count - 1) / max(count - 3, 1)
    covariance = widening * (share * jackknife + (1 - share) * variance * squares)
    shift = model_change(model, fit, corners, basis, scale_px, variance)
    # A parameter with a prior at 0 has an error of its usual size.
    usual = np.append(np.full(len(fit.intrinsics), model.usual), np.full(2, USUAL_BENDING_M))
    drawn = inverse @ normal.pull @ (np.linalg.pinv(basis) * np.where(np.isfinite(usual), usual, 0.0))
    return np.asarray(covariance + np.outer(shift, shift) + drawn @ drawn.T)


def held_out_squares(
    model: LensModel,
    fit: LensFit,
    corners: Corners,
    basis: Array,
    scale_px: float | None,
    groups: NDArray[np.intp],
) -> Array:
    """Return the squared residuals of each group of images for the fit without this group, (g,) in px^2.

    Each group is left out in one linear step from the fit of all images; the poses of its boards are fitted.
    """
    normal = normal_equations(model, fit, corners, basis, scale_px)
    matrices, gradients = reduce_to_lens(normal)
    of_group = (groups == np.arange(groups.max() + 1)[:, None]).astype(float)
    own, pulls = np.einsum("gf,fij->gij", of_group, matrices), of_group @ gradients
    shifts = np.linalg.solve(matrices.sum(axis=0) + normal.pull - own, pulls[..., None])[..., 0]
    linear = 2 * np.einsum("gi,gi->g", pulls, shifts)
    return np.asarray(of_group @ normal.squares + linear + np.einsum("gi,gij,gj->g", shifts, own, shifts))


def _jackknife(whole: Array, matrices: Array, gradients: Array, groups: NDArray[np.intp]) -> Array:
    of_group = (groups == np.arange(groups.max() + 1)[:, None]).astype(float)
    without = whole - np.einsum("gf,fij->gij", of_group, matrices)
    shifts = np.linalg.solve(without, (of_group @ gradients)[..., None])[..., 0]
    count = len(of_group)
    return np.asarray((count - 1) / count * shifts.T @ shifts)


def _variance_px2(
    model: LensModel, fit: LensFit, corners: Corners, scale_px: float | None, unknowns: int
) -> float:
    """Return the variance of a corner coordinate in px^2, for independent corners."""
    residuals_px = residuals(model, fit, corners)
    squares = float(corner_weights(residuals_px, scale_px) @ (residuals_px**2).sum(axis=1))
    return squares / max(residuals_px.size - 6 * corners.image_count - unknowns, 1)
