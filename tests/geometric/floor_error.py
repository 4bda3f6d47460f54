"""Error over the floor: 2D errors of positions on a grid, against the ground truth of a simulated lab.

At each node that a camera sees, the true camera gives the noise-free corners of a marker. A locator turns
them into a position. The difference from the true centre is the error of the calibration alone: it contains
no noise of an image.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, CameraCalibration, Mask, Model
from ipsys_log.models.table import AppliedModel
from ipsys_log.statistics.expected_error import WHOLE_PRINT
from ipsys_log.statistics.floor_cameras import GRID_M, WALL_M
from ipsys_log.vision.lenses import in_image, project, undistort
from ipsys_log.vision.markers import camera_point
from ipsys_log.vision.poses import transform

# From poses (n, 4), which are x, y, height above the floor and heading, and a side in m: the corners of
# squares, (n, 4, 3) in world m.
Placement = Callable[[Array, float], Array]

# Squared Mahalanobis distances in two dimensions that hold 68 and 95 %.
_SQUARE_68, _SQUARE_95 = -2 * np.log(1 - 0.68), -2 * np.log(1 - 0.95)
_FREEDOM = 2


class Locator(Protocol):
    """A function from corners in the image of a camera to positions on the floor."""

    def __call__(
        self, camera: str, corners_px: Array, heights_m: Array, covariances_px2: Array | None = None
    ) -> tuple[Array, Array | None]:
        """Return positions and their covariances.

        Parameters
        ----------
        camera : its name.
        corners_px : (n, 4, 2).
        heights_m : (n,), known heights above the floor.
        covariances_px2 : (n, 8, 8), of the corners; None for corners without noise.

        Returns
        -------
        Positions (n, 2) or (n, 3) in m, NaN if unknown; and covariances (n, 2, 2) or (n, 3, 3), or None.
        """


@dataclass(frozen=True, slots=True, eq=False)
class KnownSightings:
    """Sightings by one camera of markers with known positions.

    Attributes
    ----------
    camera : its name.
    truth_m : (n, 2), true centres of the markers.
    corners_px : (n, 4, 2).
    heights_m : (n,), heights above the floor.
    covariances_px2 : (n, 8, 8), of the corners; None for corners without noise.
    """

    camera: str
    truth_m: Array
    corners_px: Array
    heights_m: Array
    covariances_px2: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class SightingErrors:
    """The errors of the positions of one camera.

    ``errors_m`` (n, 2) is located minus true; NaN if the locator gives no position. ``covariances_m2`` is
    (n, 2, 2).
    """

    sightings: KnownSightings
    errors_m: Array
    covariances_m2: Array | None = None


@dataclass(frozen=True, slots=True)
class RegionShares:
    """Shares of errors inside the 68 % and 95 % regions of their covariances.

    ``nees`` is the mean normalised squared error per degree of freedom. It is 1 for a true covariance.
    """

    inside_68: float
    inside_95: float
    nees: float


@dataclass(frozen=True, slots=True)
class FloorError:
    """The error over the floor of a lab: all cameras and nodes together.

    Attributes
    ----------
    count, missing : number of camera-nodes, and of those without a position. The latter are in no mean.
    mean_m, p95_m : of the 2D distances.
    aligned_mean_m, aligned_p95_m : the same after the best rigid alignment of all cameras together.
    outside_count, outside_mean_m, outside_p95_m : at the nodes outside the hull of the measured points; NaN
        if there are none.
    shares : None without covariances.
    """

    count: int
    missing: int
    mean_m: float
    p95_m: float
    aligned_mean_m: float
    aligned_p95_m: float
    outside_count: int
    outside_mean_m: float
    outside_p95_m: float
    shares: RegionShares | None


def grid_nodes(
    lens: CameraCalibration,
    camera_from_world: Array,
    place: Placement,
    size_m: tuple[float, float],
    height_m: float,
    length_m: float,
) -> KnownSightings:
    """Return markers at the nodes of a grid of 0.1 m, at least 0.3 m from the walls, that a camera sees.

    The corners have no noise. The heading of all markers is 0.

    Parameters
    ----------
    lens, camera_from_world : the true camera.
    place : the true floor; a marker can be higher or tilted where the floor is uneven.
    size_m : width and depth of the floor; it starts at the origin of the world.
    height_m : height of the robots' markers above the floor.
    length_m : side of the marker's black square.
    """
    first = round(WALL_M / GRID_M)
    # The small number keeps a node that is exactly at the limit.
    axes = [np.arange(first, int((size - WALL_M) / GRID_M + 1e-6) + 1) for size in size_m]
    grid_m = GRID_M * np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    poses = np.column_stack([grid_m, np.full(len(grid_m), height_m), np.zeros(len(grid_m))])
    around_m = place(poses, WHOLE_PRINT * length_m).reshape(-1, 3)
    whole = in_image(transform(camera_from_world, around_m), lens).reshape(-1, 4).all(axis=1)
    corners_m = place(poses[whole], length_m)
    corners_px = project(transform(camera_from_world, corners_m.reshape(-1, 3)), lens).reshape(-1, 4, 2)
    heights_m = np.full(len(corners_px), height_m)
    return KnownSightings(lens.frame_id, corners_m.mean(axis=1)[:, :2], corners_px, heights_m)


def compute_errors(cameras: Sequence[KnownSightings], locator: Locator) -> list[SightingErrors]:
    """Return the errors of a locator for the sightings of each camera."""
    errors = []
    for seen in cameras:
        positions_m, covariances_m2 = locator(
            seen.camera, seen.corners_px, seen.heights_m, seen.covariances_px2
        )
        flat = None if covariances_m2 is None else covariances_m2[:, :2, :2]
        errors.append(SightingErrors(seen, positions_m[:, :2] - seen.truth_m, flat))
    return errors


def summarize(errors: Sequence[SightingErrors], measured_m: Array) -> FloorError:
    """Return the error over the floor of a lab.

    Parameters
    ----------
    errors : of all cameras.
    measured_m : (p, 2) or (p, 3), the measured points.

    Raises
    ------
    IpsysError
        No camera sees a node, or the locator gives no position at all.
    """
    truth_m = np.concatenate([one.sightings.truth_m for one in errors]) if errors else np.empty((0, 2))
    errors_m = np.concatenate([one.errors_m for one in errors]) if errors else np.empty((0, 2))
    known = np.isfinite(errors_m).all(axis=1)
    if not known.any():
        raise IpsysError("the error over the floor has no nodes: no camera gives a position there")
    apart_m = np.linalg.norm(errors_m[known], axis=1)
    aligned_m = align_rigidly(truth_m[known] + errors_m[known], truth_m[known]) - truth_m[known]
    aligned = np.linalg.norm(aligned_m, axis=1)
    outside_m = apart_m[outside_hull(truth_m[known], measured_m)]
    return FloorError(
        len(known),
        int((~known).sum()),
        float(apart_m.mean()),
        float(np.percentile(apart_m, 95)),
        float(aligned.mean()),
        float(np.percentile(aligned, 95)),
        len(outside_m),
        float(outside_m.mean()) if len(outside_m) else float("nan"),
        float(np.percentile(outside_m, 95)) if len(outside_m) else float("nan"),
        _shares(errors),
    )


def _shares(errors: Sequence[SightingErrors]) -> RegionShares | None:
    if any(one.covariances_m2 is None for one in errors):
        return None
    errors_m = np.concatenate([one.errors_m for one in errors])
    covariances_m2 = np.concatenate([c for one in errors if (c := one.covariances_m2) is not None])
    known = np.isfinite(errors_m).all(axis=1) & np.isfinite(covariances_m2).all(axis=(1, 2))
    return region_shares(errors_m[known], covariances_m2[known]) if known.any() else None


def region_shares(errors_m: Array, covariances_m2: Array) -> RegionShares:
    """Return the shares of errors (n, 2) inside the regions of their covariances (n, 2, 2).

    Examples
    --------
    >>> errors_m = np.random.default_rng(0).normal(0.0, 0.002, (100_000, 2))
    >>> shares = region_shares(errors_m, np.broadcast_to(0.002**2 * np.eye(2), (100_000, 2, 2)))
    >>> round(shares.inside_68, 2), round(shares.inside_95, 2), round(shares.nees, 2)
    (0.68, 0.95, 1.0)
    """
    squares = (errors_m * np.linalg.solve(covariances_m2, errors_m[..., None])[..., 0]).sum(axis=1)
    return RegionShares(
        float((squares <= _SQUARE_68).mean()),
        float((squares <= _SQUARE_95).mean()),
        float(squares.mean() / _FREEDOM),
    )


def align_rigidly(points_m: Array, targets_m: Array) -> Array:
    """Return points (n, 2) after the rotation and translation that bring them nearest to targets (n, 2).

    The sum of the squared distances is least; there is no change of scale.

    References
    ----------
    Umeyama, PAMI 1991, in two dimensions: with complex numbers p and q about their means, the angle is that
    of the sum of conj(p) q.

    Examples
    --------
    >>> points_m = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    >>> align_rigidly(points_m, np.array([[3.0, 1.0], [3.0, 2.0], [1.0, 1.0]])).round(9).tolist()
    [[3.0, 1.0], [3.0, 2.0], [1.0, 1.0]]
    """
    points, targets = (values @ np.array([1, 1j]) for values in (points_m, targets_m))
    centred = points - points.mean()
    turn = np.exp(1j * np.angle((centred.conj() * (targets - targets.mean())).sum()))
    moved = turn * centred + targets.mean()
    return np.stack([moved.real, moved.imag], axis=1)


def outside_hull(points_m: Array, measured_m: Array) -> Mask:
    """Return the points (n, 2) outside the convex hull, on the floor, of measured points (p, 2) or (p, 3).

    Fewer than three measured points, or points on a line, have no hull: all points are outside.
    """
    from scipy.spatial import ConvexHull, QhullError  # late: most commands need no hull

    try:
        edges = ConvexHull(measured_m[:, :2]).equations
    except (QhullError, ValueError, IndexError):
        return np.ones(len(points_m), dtype=bool)
    return np.asarray((points_m @ edges[:, :2].T + edges[:, 2]).max(axis=1) > 0)


def locate_with_model(
    model: Model, calibrations: Mapping[str, CameraCalibration], length_m: float
) -> Locator:
    """Return the locator of a model of the table: corners, camera points by eq. (3) to (5), the model.

    Parameters
    ----------
    model : a fitted model.
    calibrations : the intrinsics that the user has, by camera.
    length_m : side of the marker's black square.
    """
    applied = {camera.camera: AppliedModel(model.name, camera) for camera in model.cameras}

    def locate(
        camera: str, corners_px: Array, heights_m: Array, covariances_px2: Array | None = None
    ) -> tuple[Array, Array | None]:
        if camera not in applied:
            return np.full((len(corners_px), 3), np.nan), None
        uv = undistort(corners_px.reshape(-1, 2), calibrations[camera]).reshape(-1, 4, 2)
        points_m = camera_point(uv, length_m)
        return applied[camera].predict(points_m, heights_m), applied[camera].covariances(points_m, heights_m)

    return locate
