"""Next calibration points: the points that reduce the predicted error over the floor most.

A model's predicted error depends on the leverage of a position relative to the calibration points of the fit.
A new calibration point reduces the error in the whole field of view of each camera that sees it. The effect
is larger if the tape measures the point more accurately. Greedy I-optimal design selects, one after the
other, the point that gives the least mean error.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import ConvexHull, cKDTree

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration, Mask
from ipsys_log.messages.stage import Progress
from ipsys_log.models.rays import directions
from ipsys_log.models.uncertainty import Predict, Uncertainty, leverage_terms
from ipsys_log.vision.lenses import in_image
from ipsys_log.vision.poses import transform

# Number of tested points of a circle, which contains the corners of a marker of any heading.
_RIM = 12
# Without intrinsics, the field of view extends this far, in u and v, beyond the outermost calibration points.
_BEYOND = 0.05
# Directions (u, v) nearer together than this are equal.
_SAME_RAY = 1e-3
# Tangent of the largest angle of a field of view.
_GRAZED = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class FittedCamera:
    """A fitted camera: its field of view, and the uncertainty of its positions.

    Attributes
    ----------
    camera_from_world, bend : (4, 4) and (3,), the fitted pose, and the fitted lens correction for
        :func:`ipsys_log.models.rays.directions`.
    lens : its calibration, None if it is unknown.
    fitted_m : (n, 3), world points of the calibration points of the fit, in the order of ``uncertainty``.
    """

    camera: str
    camera_from_world: Array
    bend: Array
    lens: CameraCalibration | None
    predict: Predict
    uncertainty: Uncertainty
    fitted_m: Array

    def points(self, world_m: Array) -> Array:
        """Return camera points (n, 3) of world points (n, 3); NaN if a point has none."""
        inside_m = transform(self.camera_from_world, world_m)
        # At larger angles from the optical axis, no camera sees a point, and no model is valid.
        ahead = np.hypot(inside_m[:, 0], inside_m[:, 1]) < _GRAZED * inside_m[:, 2]
        depths_m = np.where(ahead, inside_m[:, 2], np.nan)[:, None]
        measured = exact = inside_m / depths_m
        for _ in range(5):  # invert the lens correction: its result must be the true direction
            measured = measured + exact - directions(measured, self.bend)
        lost = ~(np.abs(directions(measured, self.bend) - exact).max(axis=1) < _SAME_RAY)
        return np.where(lost[:, None], np.nan, measured * depths_m)

    def sees(self, world_m: Array, radius_m: float) -> Mask:
        """Return a mask (n,) of the level discs about world points (n, 3) that are completely in the image.

        Without intrinsics: a mask of the points that, in the image, are inside the convex hull of the
        calibration points of the fit, with a small margin.
        """
        if self.lens is None:
            fitted, uv = (p[:, :2] / p[:, 2:] for p in (self.uncertainty.points_m, self.points(world_m)))
            edges = ConvexHull(fitted).equations
            return np.asarray((uv @ edges[:, :2].T + edges[:, 2]).max(axis=1) <= _BEYOND, dtype=np.bool_)
        angles = np.linspace(0, 2 * np.pi, _RIM, endpoint=False)
        rim_m = radius_m * np.stack([np.cos(angles), np.sin(angles), np.zeros(_RIM)], axis=1)
        whole = in_image(self.points(world_m), self.lens)
        rims_m = (world_m[whole, None] + rim_m).reshape(-1, 3)
        whole[whole] = in_image(self.points(rims_m), self.lens).reshape(-1, _RIM).all(axis=1)
        return whole


# A function from measured points (n, 3) to the variance of x plus the variance of y, (n,).
Tape = Callable[[Array], Array]

# Points nearer to a known point may have the same error. A point farther away is better if it has at least
# this share of the effect.
_BESIDE_M = 0.2
_ALMOST = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class PlannedPlace:
    """A calibration point to measure: ``point_m`` (3,), and the ``cameras`` that see it.

    ``mean_before_m`` and ``mean_after_m`` are the mean predicted errors over the floor before and after its
    measurement. All points before it in the plan are already measured then.
    """

    point_m: Array
    cameras: tuple[str, ...]
    mean_before_m: float
    mean_after_m: float


@dataclass(frozen=True, slots=True, eq=False)
class MeasurementPlan:
    """Calibration points to measure, in order, and their effect.

    Attributes
    ----------
    places : the calibration points; the first one has the largest effect.
    before_m, after_m : (n,), predicted error at each point of the floor: the least error of the cameras that
        see it; NaN if no camera sees it.
    seen : (n,) by camera, mask of the points of the floor that the camera sees.
    """

    places: tuple[PlannedPlace, ...]
    before_m: Array
    after_m: Array
    seen: dict[str, Mask]


def plan_points(
    views: Sequence[FittedCamera],
    floor_m: Array,
    candidates_m: Array,
    tape_m2: Tape,
    radius_m: float,
    count: int,
    progress: Progress = lambda done, total: None,
) -> MeasurementPlan:
    """Choose the calibration points to measure next.

    The heights of the candidates alternate, so the numbers of measurements at all heights are similar.

    Parameters
    ----------
    views : the fitted cameras.
    floor_m : (n, 3), points of the floor. The mean error is that over the points that a camera sees.
    candidates_m : (c, 3), possible positions of a marker.
    tape_m2 : function for the variance of a tape measurement.
    radius_m : radius of the disc about a marker that a camera must see.
    count : number of calibration points to choose.
    progress : called after each point.

    References
    ----------
    V-optimality, also called I-: Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, ch. 10.

    Examples
    --------
    >>> from ipsys_log.vision.poses import invert_pose, look_down, transform
    >>> from ipsys_log.models.uncertainty import Uncertainty
    >>> pose = look_down(np.array([0.0, 0.0, 2.0]))
    >>> floor_m = np.array([[x, y, 0.0] for x in (-1.0, 0.0, 1.0) for y in (-0.5, 0.0, 0.5)])
    >>> fitted_m = np.delete(floor_m, 7, axis=0)
    >>> unsure = Uncertainty(3e-4, 1e-4, 1.0, 1e-5 * np.eye(3), transform(pose, fitted_m))
    >>> def predict(points_m, heights_m):
    ...     return transform(invert_pose(pose), points_m)
    >>> view = FittedCamera("over", pose, np.zeros(3), None, predict, unsure, fitted_m)
    >>> plan = plan_points([view], floor_m, floor_m, lambda at_m: np.full(len(at_m), 1e-5), 0.1, 1)
    >>> plan.places[0].point_m.tolist()
    [1.0, 0.0, 0.0]
    """
    if not len(candidates_m):
        raise IpsysError("the floor is too small for a marker; correct width_m and depth_m in lab.toml")
    shares = [_Share(view, floor_m, candidates_m, tape_m2, radius_m) for view in views]
    on_floor, near = (
        np.any([getattr(s, attribute) for s in shares], axis=0) for attribute in ("on_floor", "near")
    )
    seen_m = np.concatenate([floor_m[on_floor, 2], candidates_m[near, 2]])
    for height_m in np.setdiff1d(np.concatenate([floor_m[:, 2], candidates_m[:, 2]]), seen_m):
        raise IpsysError(f"no camera sees a whole marker {height_m:g} m above the floor; give another height")
    fitted_m = np.unique(np.vstack([view.fitted_m for view in views]), axis=0)
    apart_m: Array = np.asarray(cKDTree(fitted_m[:, :2]).query(candidates_m[:, :2])[0])
    levels, level = np.unique(candidates_m[:, 2], return_inverse=True)
    used = np.bincount(np.abs(fitted_m[:, 2:] - levels).argmin(axis=1), minlength=len(levels))
    before_m = after_m = _least(shares, len(floor_m))
    places = []
    for number in range(count):
        progress(number, count)
        allowed, mean_m = near & (used[level] == used.min()), float(np.nanmean(after_m))
        best = _choose(_means_with_each(shares, after_m, allowed), mean_m, apart_m)
        used[level[best]] += 1
        apart_m = np.minimum(apart_m, np.linalg.norm(candidates_m[:, :2] - candidates_m[best, :2], axis=1))
        for share in shares:
            share.add(best)
        after_m = _least(shares, len(floor_m))
        cameras = tuple(view.camera for view, share in zip(views, shares, strict=True) if share.near[best])
        places.append(PlannedPlace(candidates_m[best], cameras, mean_m, float(np.nanmean(after_m))))
    seen = {view.camera: share.on_floor for view, share in zip(views, shares, strict=True)}
    return MeasurementPlan(tuple(places), before_m, after_m, seen)


class _Share:
    """The visible floor points and candidates of one camera, and their leverage after each added point."""

    def __init__(
        self, view: FittedCamera, floor_m: Array, candidates_m: Array, tape_m2: Tape, radius_m: float
    ):
        self.on_floor, self.near = view.sees(floor_m, radius_m), view.sees(candidates_m, radius_m)
        fitted = leverage_terms(view.uncertainty.points_m)
        self._inverse = np.asarray(np.linalg.inv(fitted.T @ fitted + 1e-9 * np.eye(6)), dtype=np.float64)
        self._noise_m2, fit_m2, self._floor_terms = _parts(view, floor_m[self.on_floor])
        self._fit_m2 = fit_m2 / _leverage(self._floor_terms, self._inverse)
        noise_m2, _, self._terms = _parts(view, candidates_m[self.near])
        usual_m2 = np.median(tape_m2(view.fitted_m) + _parts(view, view.fitted_m)[0][:2].sum(axis=0))
        # A fit gives all calibration points the same weight: an unusually accurate point counts as one point.
        known_m2 = tape_m2(candidates_m[self.near]) + noise_m2[:2].sum(axis=0)
        self._weights = usual_m2 / np.maximum(known_m2, usual_m2)

    def errors(self) -> Array:
        """Return the predicted error (r,) at the visible points of the floor."""
        return mean_length(self._noise_m2 + self._fit_m2 * _leverage(self._floor_terms, self._inverse))

    def errors_with_each(self, allowed: Mask) -> Array:
        """Return the predicted errors (r, c) after measuring each visible and ``allowed`` candidate."""
        terms, weights = self._terms[allowed[self.near]], self._weights[allowed[self.near]]
        gain = weights / (1 + weights * _leverage(terms, self._inverse))
        lower = (self._floor_terms @ self._inverse @ terms.T) ** 2 * gain
        leverage = (_leverage(self._floor_terms, self._inverse)[:, None] - lower).astype(np.float32)
        noise_m2, fit_m2 = (part[..., None].astype(np.float32) for part in (self._noise_m2, self._fit_m2))
        return mean_length(noise_m2 + fit_m2 * leverage)

    def add(self, candidate: int) -> None:
        """Add a candidate to the measured points (Sherman-Morrison formula)."""
        if self.near[candidate]:
            row = int(self.near[:candidate].sum())
            terms, weight = self._terms[row], self._weights[row]
            step = self._inverse @ terms
            self._inverse -= np.outer(step, step) * (weight / (1 + weight * (terms @ step)))


def _parts(view: FittedCamera, world_m: Array) -> tuple[Array, Array, Array]:
    """Return the parts of the covariance of x and y, and the terms (n, 6) of the leverage.

    Each part contains the variances of x and y and their covariance, (3, n). The first part is noise, which
    no calibration point can reduce. The second part is the uncertainty of the fit.
    """
    if not len(world_m):
        return np.zeros((3, 0)), np.zeros((3, 0)), np.zeros((0, 6))
    points_m, certain = view.points(world_m), replace(view.uncertainty, fit=np.zeros((3, 3)))
    whole_m2, noise_m2 = (
        uncertainty.covariances(view.predict, points_m, world_m[:, 2])[:, [0, 1, 0], [0, 1, 1]].T
        for uncertainty in (view.uncertainty, certain)
    )
    return noise_m2, whole_m2 - noise_m2, leverage_terms(points_m)


def _leverage(terms: Array, inverse: Array) -> Array:
    return np.asarray(np.einsum("ni,ij,nj->n", terms, inverse, terms))


def mean_length(covariance: Array) -> Array:
    """Return the mean length of an error in the plane from variances of x and y, and covariance, (3, ...).

    It is sqrt(2 / pi) times a quarter of the perimeter of the ellipse of standard deviations. The perimeter
    follows from Ramanujan's first formula, which is 0.5 % too small for a degenerate ellipse.

    Examples
    --------
    >>> float(mean_length(np.array([1.0, 1.0, 0.0])).round(4))  # sqrt(pi / 2)
    1.2533
    """
    both = covariance[0] + covariance[1]
    root = np.sqrt(np.maximum(covariance[0] * covariance[1] - covariance[2] ** 2, 0))
    perimeter = 3 * np.sqrt(both + 2 * root) - np.sqrt(3 * both + 10 * root)
    return np.asarray(float(np.sqrt(np.pi / 8)) * perimeter)


def _least(shares: Sequence[_Share], count: int) -> Array:
    """Return the least error of the cameras at each point of the floor, (n,); NaN if no camera sees it."""
    least_m = np.full(count, np.nan)
    for share in shares:
        least_m[share.on_floor] = np.fmin(least_m[share.on_floor], share.errors())
    return least_m


def _means_with_each(shares: Sequence[_Share], now_m: Array, allowed: Mask) -> Array:
    """Return the mean error over the floor after measuring each candidate, (c,); inf if not allowed."""
    least_m = np.repeat(now_m[:, None].astype(np.float32), allowed.sum(), axis=1)
    column = np.cumsum(allowed) - 1
    for share in shares:
        cells = np.ix_(share.on_floor.nonzero()[0], column[share.near & allowed])
        least_m[cells] = np.fmin(least_m[cells], share.errors_with_each(allowed))
    means_m = np.full(len(allowed), np.inf)
    means_m[allowed] = np.nanmean(least_m, axis=0, dtype=np.float64)
    return means_m


def _choose(means_m: Array, now_m: float, apart_m: Array) -> int:
    """Return the best candidate.

    A candidate near a known calibration point is selected only if its effect is clearly larger than that of
    all candidates farther away.
    """
    elsewhere = np.where(apart_m >= _BESIDE_M, means_m, np.inf)
    best, other = int(means_m.argmin()), int(elsewhere.argmin())
    return other if now_m - elsewhere[other] >= _ALMOST * (now_m - means_m[best]) else best
