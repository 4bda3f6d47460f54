"""Time offset and rigid alignment between ground truth of another system and the tracks of a run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Mask
from ipsys_log.statistics.path_pairs import (
    CommonInstants,
    PathPair,
    common_instants,
    search_offsets_s,
    without_jumps,
)
from ipsys_log.vision.poses import cross, rotate


class Freedom(NamedTuple):
    """The axes of rotation and translation that an alignment estimates, and the axes of its residuals."""

    turns: tuple[int, ...]
    shifts: tuple[int, ...]
    compared: tuple[int, ...]


ALIGNMENTS = {
    "2d": Freedom((2,), (0, 1), (0, 1)),
    "3d": Freedom((0, 1, 2), (0, 1, 2), (0, 1, 2)),
    "none": Freedom((), (), (0, 1)),
}
# The median length of a vector with normal components of unit variance, by their number.
_MEDIAN_LENGTH = {2: 1.1774, 3: 1.5382}
# Residuals above 5 sigma are outliers.
_OUTLIER = 5.0
# A smaller sigma than 0.1 mm is none of a camera.
_LEAST_SCALE_M = 1e-4
_ROUNDS = 40
# After so many rounds, the limit of the outliers stays: otherwise an instant at the limit can alternate.
_FREE_ROUNDS = 15
# Below this step, the estimate is exact to rounding.
_CONVERGED_M = 1e-11
# The velocity of a path holds for a short time only.
_LARGEST_OFFSET_STEP_S = 0.3
LEAST_INSTANTS = 8


@dataclass(frozen=True, slots=True, eq=False)
class RigidMotion:
    """A rotation (3, 3) and a translation (3,) in m, from the truth's coordinates to those of the lab."""

    rotation: Array
    shift_m: Array

    def apply(self, points_m: Array) -> Array:
        """Return points (n, 3) in the coordinates of the lab."""
        return points_m @ self.rotation.T + self.shift_m


class Fit(NamedTuple):
    """An estimate; the alignment rotates about ``pivot_m``, so ``centre_m`` is the image of the pivot."""

    offset_s: float
    rotation: Array
    centre_m: Array
    pivot_m: Array
    median_m: float
    cut_m: float

    @property
    def motion(self) -> RigidMotion:
        return RigidMotion(self.rotation, self.centre_m - self.rotation @ self.pivot_m)


def fit_truth(pairs: Sequence[PathPair], kind: str, start_s: float, free_offset: bool) -> Fit | None:
    """Estimate offset and alignment from a coarse offset; None with too few common instants."""
    common = common_instants(pairs, start_s)
    if len(common.track_m) < LEAST_INSTANTS:
        return None
    fit = _start(common, kind, start_s)
    for round_ in range(_ROUNDS):
        common = common_instants(pairs, fit.offset_s)
        if len(common.track_m) < LEAST_INSTANTS:
            return None
        fit = _weighed(common, fit, kind, keeps_cut=round_ >= _FREE_ROUNDS)
        kept, jacobian, residual = linearize(common, fit, kind, free_offset)
        if not jacobian.shape[2]:
            break
        step = _step(jacobian[kept], residual[kept])
        if free_offset:
            step *= min(1.0, _LARGEST_OFFSET_STEP_S / max(abs(float(step[0])), 1e-12))
        fit = _moved(fit, step, kind, free_offset)
        if np.abs(step).max() < _CONVERGED_M:
            break
    return _weighed(common_instants(pairs, fit.offset_s), fit, kind, keeps_cut=True)


def _step(jacobian: Array, residual: Array) -> Array:
    """Return the Gauss-Newton step (k,) by the scaled normal equations."""
    rows = jacobian.reshape(-1, jacobian.shape[2])
    norms = np.maximum(np.linalg.norm(rows, axis=0), 1e-300)
    normal = (rows.T @ rows) / np.outer(norms, norms)
    solution = np.linalg.lstsq(normal, (rows.T @ residual.reshape(-1)) / norms, rcond=1e-12)[0]
    return np.asarray(solution / norms)


def _start(common: CommonInstants, kind: str, offset_s: float) -> Fit:
    """Return the best rotation and translation at an offset, after three rounds without outliers."""
    axes = list(ALIGNMENTS[kind].turns and ALIGNMENTS[kind].compared)
    kept = np.ones(len(common.track_m), dtype=np.bool_)
    pivot_m = np.median(common.true_m, axis=0)
    fit = Fit(offset_s, np.eye(3), pivot_m, pivot_m, np.inf, np.inf)
    for _ in range(3 if axes else 0):
        true_m, track_m = common.true_m[kept][:, axes], common.track_m[kept][:, axes]
        middle_m, target_m = true_m.mean(axis=0), track_m.mean(axis=0)
        u, _, v = np.linalg.svd((true_m - middle_m).T @ (track_m - target_m))
        signs = np.ones(len(axes))
        signs[-1] = np.sign(np.linalg.det(u @ v))
        rotation = np.eye(3)
        rotation[np.ix_(axes, axes)] = (v.T * signs) @ u.T
        pivot_m, centre_m = pivot_m.copy(), pivot_m.copy()
        pivot_m[axes], centre_m[axes] = middle_m, target_m
        fit = _weighed(common, Fit(offset_s, rotation, centre_m, pivot_m, np.inf, np.inf), kind, False)
        kept = _lengths_m(common, fit, kind) <= fit.cut_m
    return fit


def _lengths_m(common: CommonInstants, fit: Fit, kind: str) -> Array:
    residual_m = common.track_m - fit.motion.apply(common.true_m)
    return np.asarray(np.linalg.norm(residual_m[:, list(ALIGNMENTS[kind].compared)], axis=1))


def _weighed(common: CommonInstants, fit: Fit, kind: str, keeps_cut: bool) -> Fit:
    """Return the fit with its median residual, and the length above which a residual is an outlier."""
    median_m = float(np.median(_lengths_m(common, fit, kind))) if len(common.track_m) else np.inf
    scale_m = median_m / _MEDIAN_LENGTH[len(ALIGNMENTS[kind].compared)]
    cut_m = fit.cut_m if keeps_cut else _OUTLIER * max(scale_m, _LEAST_SCALE_M)
    return fit._replace(median_m=median_m, cut_m=cut_m)


def linearize(common: CommonInstants, fit: Fit, kind: str, free_offset: bool) -> tuple[Mask, Array, Array]:
    """Return which instants are no outliers, the derivatives (n, d, k) and the residuals (n, d)."""
    freedom = ALIGNMENTS[kind]
    arms_m = (common.true_m - fit.pivot_m) @ fit.rotation.T
    columns = [-common.velocity_m_s @ fit.rotation.T] if free_offset else []
    columns += [cross(np.broadcast_to(np.eye(3)[axis], arms_m.shape), arms_m) for axis in freedom.turns]
    columns += [np.broadcast_to(np.eye(3)[axis], arms_m.shape) for axis in freedom.shifts]
    axes = list(freedom.compared)
    residual = (common.track_m - arms_m - fit.centre_m)[:, axes]
    jacobian = np.stack(columns, axis=2)[:, axes] if columns else np.zeros((*residual.shape, 0))
    return np.linalg.norm(residual, axis=1) <= fit.cut_m, jacobian, residual


def _moved(fit: Fit, step: Array, kind: str, free_offset: bool) -> Fit:
    freedom = ALIGNMENTS[kind]
    first = 1 if free_offset else 0
    turn, shift = np.zeros(3), np.zeros(3)
    turn[list(freedom.turns)] = step[first : first + len(freedom.turns)]
    shift[list(freedom.shifts)] = step[first + len(freedom.turns) :]
    return fit._replace(
        offset_s=fit.offset_s + (float(step[0]) if free_offset else 0.0),
        rotation=rotate(turn[None])[0] @ fit.rotation,
        centre_m=fit.centre_m + shift,
    )


_LEAST_SPREAD_M = 0.1
_SINGULAR = 1e-9
# With larger standard deviations, the motion does not determine the alignment.
_LARGEST_TURN_SIGMA_RAD = np.radians(2.0)
_LARGEST_OFFSET_SIGMA_S = 0.1
# A larger median residual, as a share of the extent of the path, shows that the paths differ.
_LARGEST_SHARE = 0.2
# Two offsets are alike if their median residuals differ by less than this factor and this length. The length
# is for residuals near 0, as of a simulated truth.
_ALIKE = 1.5
_ALIKE_M = 1e-3


@dataclass(frozen=True, slots=True)
class Residuals:
    """Root-mean-square distances between tracks and aligned truth, over all instants with both."""

    instants: int
    rmse_3d_m: float
    rmse_2d_m: float
    outliers: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class TruthAlignment:
    """The time offset to add to the times of the truth, and its rigid motion to the lab.

    Attributes
    ----------
    offset_sigma_s : standard deviation of the offset; None if it was given.
    turn_rad : (3,), the rotation vector. ``turn_sigmas_rad`` and ``shift_sigmas_m`` are (3,), with NaN for
        axes that are not estimated.
    """

    offset_s: float
    offset_sigma_s: float | None
    motion: RigidMotion
    turn_rad: Array
    turn_sigmas_rad: Array
    shift_sigmas_m: Array
    residuals: Residuals


def align_truth(
    pairs: Sequence[PathPair], kind: str, where: str, offset_s: float | None = None
) -> TruthAlignment:
    """Estimate the time offset and the rigid alignment of ground truth to tracks, without a scale.

    The coarse offsets of :func:`~ipsys_log.statistics.path_pairs.search_offsets_s` start a
    Gauss-Newton estimate of offset and alignment together. It compares the tracks with the true positions at
    their instants, by cubic Hermite interpolation. Residuals above 5 sigma are left out. All robots share one
    offset and one alignment. The standard deviations hold for errors that are alike over 2 s.

    Parameters
    ----------
    kind : a key of ``ALIGNMENTS``: ``2d`` (heading and floor position), ``3d``, or ``none``.
    where : the start of an error text.
    offset_s : the known offset; None to estimate it.

    Raises
    ------
    IpsysError
        The recordings have too few common instants or too little motion, their paths differ, or two offsets
        agree equally well.

    References
    ----------
    Start of the rotation: Umeyama, IEEE PAMI 1991, eq. (40), without the scale. Standard deviations: Liang
    and Zeger, Biometrika 1986, eq. (5), with a block of 2 s as a cluster.
    """
    _check_motion(pairs, where)
    raw, pairs = pairs, [without_jumps(pair) for pair in pairs]
    offsets = [offset_s] if offset_s is not None else search_offsets_s(pairs)
    fits = [
        fit for start_s in offsets if (fit := fit_truth(pairs, kind, start_s, offset_s is None)) is not None
    ]
    if not fits and offset_s is not None:
        raise IpsysError(
            f"{where}: truth and tracks have fewer than {LEAST_INSTANTS} common instants; check the files, "
            "and --time-offset"
        )
    if not fits:
        raise _no_agreement(where)
    fits.sort(key=lambda fit: fit.median_m)
    best = fits[0]
    _check_agreement(pairs, fits, where)
    result = _result(pairs, kind, best, offset_s is None, where)
    return replace(result, residuals=_residuals(common_instants(raw, best.offset_s), best.motion, best.cut_m))


def residuals_of(pairs: Sequence[PathPair], offset_s: float, motion: RigidMotion) -> Residuals | None:
    """Return the residuals of a given offset and motion; None without a common instant."""
    common = common_instants(pairs, offset_s)
    return _residuals(common, motion, np.inf) if len(common.track_m) else None


def _check_motion(pairs: Sequence[PathPair], where: str) -> None:
    for name, points in (("truth", [p.true_m for p in pairs]), ("track", [p.track_m for p in pairs])):
        # Two stationary robots determine an alignment, but no offset.
        extent_m = max(_extent_m(one) for one in points)
        if extent_m < _LEAST_SPREAD_M:
            raise IpsysError(
                f"{where}: too little motion for an alignment: the {name} moves by {extent_m:.2f} m; "
                "drive through the lab, or give --align none --time-offset S"
            )


def _extent_m(points_m: Array) -> float:
    """Return the extent of a path on the floor without its outliers, in m."""
    low, high = np.quantile(points_m[:, :2], [0.05, 0.95], axis=0)
    return float(np.linalg.norm(high - low))


def _check_agreement(pairs: Sequence[PathPair], fits: Sequence[Fit], where: str) -> None:
    best = fits[0]
    extent_m = max(_extent_m(pair.track_m) for pair in pairs)
    if best.median_m > _LARGEST_SHARE * extent_m:
        raise _no_agreement(where)
    for other in fits[1:]:
        is_other = abs(other.offset_s - best.offset_s) > 0.5
        if is_other and other.median_m < _ALIKE * best.median_m + _ALIKE_M:
            raise IpsysError(
                f"{where}: two time offsets, {abs(other.offset_s - best.offset_s):.1f} s apart, fit equally "
                "well: the path repeats itself; give --time-offset S"
            )


def _no_agreement(where: str) -> IpsysError:
    return IpsysError(
        f"{where}: no time offset and alignment bring truth and tracks together; check that the files are of "
        "the same drive and robot, and the units"
    )


def _result(pairs: Sequence[PathPair], kind: str, fit: Fit, free_offset: bool, where: str) -> TruthAlignment:
    from scipy.spatial.transform import Rotation

    common, freedom = common_instants(pairs, fit.offset_s), ALIGNMENTS[kind]
    kept, jacobian, residual = linearize(common, fit, kind, free_offset)
    covariance = _covariance(jacobian[kept], residual[kept], common.block[kept], where)
    first = 1 if free_offset else 0
    free = [*range(first, len(covariance))]
    full = np.zeros((6, 6))
    places = [*freedom.turns, *(3 + axis for axis in freedom.shifts)]
    full[np.ix_(places, places)] = covariance[np.ix_(free, free)]
    # The shift is the image of the origin: a rotation about the pivot moves it, too.
    lever = -fit.rotation @ fit.pivot_m
    to_origin = np.hstack([cross(np.eye(3), np.broadcast_to(lever, (3, 3))).T, np.eye(3)])
    shift_sigmas_m = np.sqrt(np.diag(to_origin @ full @ to_origin.T))
    turn_sigmas_rad = np.sqrt(np.diag(full)[:3])
    offset_sigma_s = float(np.sqrt(covariance[0, 0])) if free_offset else None
    if max(turn_sigmas_rad) > _LARGEST_TURN_SIGMA_RAD or (offset_sigma_s or 0) > _LARGEST_OFFSET_SIGMA_S:
        raise _too_little_motion(where)
    is_turned, is_shifted = (np.isin(np.arange(3), axes) for axes in (freedom.turns, freedom.shifts))
    return TruthAlignment(
        fit.offset_s,
        offset_sigma_s,
        fit.motion,
        Rotation.from_matrix(fit.rotation).as_rotvec(),
        np.where(is_turned, turn_sigmas_rad, np.nan),
        np.where(is_shifted, shift_sigmas_m, np.nan),
        _residuals(common, fit.motion, fit.cut_m),
    )


def _covariance(jacobian: Array, residual: Array, block: NDArray[np.int64], where: str) -> Array:
    """Return the covariance (k, k): the larger one of independent errors and of errors alike in a block."""
    count = jacobian.shape[2]
    rows = jacobian.reshape(-1, count)
    norms = np.linalg.norm(rows, axis=0) if count else np.zeros(0)
    if count and (norms == 0).any():
        raise _too_little_motion(where)
    if count and np.linalg.eigvalsh((rows / norms).T @ (rows / norms))[0] < _SINGULAR:
        raise _too_little_motion(where)
    inverse = np.linalg.inv(rows.T @ rows)
    independent = inverse * float((residual**2).sum()) / max(residual.size - count, 1)
    gradients = np.einsum("ndk,nd->nk", jacobian, residual)
    _, numbers = np.unique(block, return_inverse=True)
    sums = np.array([np.bincount(numbers, column) for column in gradients.T]).T
    blocks = len(sums)
    if blocks < 2:
        return np.asarray(independent)
    clustered = inverse @ (sums.T @ sums) @ inverse * blocks / (blocks - 1)
    growth = np.sqrt(np.maximum(np.diag(clustered) / np.maximum(np.diag(independent), 1e-300), 1.0))
    return np.asarray(independent * np.outer(growth, growth))


def _too_little_motion(where: str) -> IpsysError:
    return IpsysError(
        f"{where}: too little motion for an alignment: the path determines no offset or rotation; drive "
        "curves and stop in between, or give --align none --time-offset S"
    )


def _residuals(common: CommonInstants, motion: RigidMotion, cut_m: float) -> Residuals:
    apart_m = common.track_m - motion.apply(common.true_m)
    return Residuals(
        len(apart_m),
        float(np.sqrt((apart_m**2).sum(axis=1).mean())),
        float(np.sqrt((apart_m[:, :2] ** 2).sum(axis=1).mean())),
        int((np.linalg.norm(apart_m[:, :2], axis=1) > cut_m).sum()),
    )
