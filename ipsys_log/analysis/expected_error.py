"""Expected error over the floor of a joint calibration, its gaps, and the points that reduce the error most.

The covariance of a joint calibration gives the expected error at each node of a grid, without ground truth.
The errors of all cameras are linear functions of the same independent normal numbers. So the effect of one
more taped point on the whole floor follows from a small linear system, without a fit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects, label
from scipy.spatial import cKDTree

from ipsys_log.analysis.floor_error import GRID_M, WALL_M, WHOLE_PRINT
from ipsys_log.analysis.plan import mean_length
from ipsys_log.geometry.lenses import in_image, project
from ipsys_log.geometry.markers import marker_corners
from ipsys_log.geometry.rotations import level_turns
from ipsys_log.joint.locate import locate_markers
from ipsys_log.joint.model import JointModel

__all__ = [
    "ExpectedErrors",
    "FloorGap",
    "FloorGrid",
    "TapeCovariances",
    "TapedPoint",
    "choose_points",
    "expect_errors",
    "find_gaps",
]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A node is covered if the camera saw a marker nearer than this: the floor changes little over this distance.
_COVERED_M = 0.35
# Smaller gaps are not reported.
_LEAST_GAP_M2 = 0.1
# Repeatable error of the position of a marker by one camera, for the choice of points.
_CORNER_SIGMA_M = 0.0003
# So many camera-nodes give the mean error over the floor accurately enough for the choice of points.
_ENOUGH_NODES = 800

# A function from points (n, 2) to the covariances (n, 2, 2) of their tape readings.
TapeCovariances = Callable[[Array], Array]


@dataclass(frozen=True, slots=True, eq=False)
class FloorGrid:
    """A grid over the floor: coordinates ``xs_m`` (a,) and ``ys_m`` (b,) of its nodes, ``step_m`` apart."""

    xs_m: Array
    ys_m: Array
    step_m: float

    @classmethod
    def over(cls, low_m: Array, high_m: Array, step_m: float = GRID_M) -> FloorGrid:
        """Return the grid over a rectangle, at least 0.3 m from its edges."""
        # The small number keeps a node that is exactly at the limit.
        axes = [
            np.arange(low + WALL_M, high - WALL_M + 1e-6, step_m)
            for low, high in zip(low_m, high_m, strict=True)
        ]
        return cls(axes[0], axes[1], step_m)

    @property
    def nodes_m(self) -> Array:
        """The nodes (b * a, 2), row by row."""
        return np.stack(np.meshgrid(self.xs_m, self.ys_m), axis=-1).reshape(-1, 2)


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedErrors:
    """Expected errors of the positions by one camera.

    Attributes
    ----------
    camera : its name.
    seen : (b * a,), mask of the nodes of the grid at which the image contains a whole marker.
    errors_m : (n,), expected 2D errors at the n seen nodes, by the calibration alone.
    modes_m : (n, 2, m), the same as functions of the m normal numbers of the calibration.
    """

    camera: str
    seen: Mask
    errors_m: Array
    modes_m: Array


@dataclass(frozen=True, slots=True, eq=False)
class FloorGap:
    """A part of the floor that a camera sees, but where it saw no marker.

    ``low_m`` and ``high_m`` (2,) are its corners, ``error_m`` is the mean expected error in it.
    """

    camera: str
    area_m2: float
    low_m: Array
    high_m: Array
    error_m: float


@dataclass(frozen=True, slots=True, eq=False)
class TapedPoint:
    """A point to measure: ``point_m`` (2,), the cameras that see it, and the expected mean error after it."""

    point_m: Array
    cameras: tuple[str, ...]
    mean_after_m: float


def expect_errors(
    models: Mapping[str, JointModel],
    sizes_px: Mapping[str, tuple[int, int]],
    grid: FloorGrid,
    height_m: float,
    length_m: float,
) -> list[ExpectedErrors]:
    """Return the expected errors of each camera, for markers at a height above the floor.

    Parameters
    ----------
    models : by camera.
    sizes_px : width and height of the images, by camera.
    grid : nodes of the floor.
    height_m : height of the markers.
    length_m : side of the markers.
    """
    expected = []
    for camera, model in models.items():
        seen, modes_m = _modes(model, sizes_px[camera], grid.nodes_m, height_m, length_m)
        expected.append(ExpectedErrors(camera, seen, _lengths(modes_m @ modes_m.swapaxes(1, 2)), modes_m))
    return expected


def _modes(
    model: JointModel, size_px: tuple[int, int], points_m: Array, height_m: float, length_m: float
) -> tuple[Mask, Array]:
    """Return a mask (p,) of the points (p, 2) at which a camera sees a whole marker, and their modes."""
    lens = replace(model.calibration, width=size_px[0], height=size_px[1])
    floor_m = model.floor.heights(points_m, model.amplitudes)[0]
    centres_m = np.column_stack([points_m, height_m + floor_m])

    turn = level_turns(np.zeros(1))[0]

    def corners_c(side_m: float, rows: Mask) -> Array:
        corners_m = centres_m[rows, None] + marker_corners(side_m) @ turn.T
        return np.asarray((corners_m.reshape(-1, 3) - model.origin_m) @ model.camera_from_world.T)

    everywhere = np.ones(len(points_m), dtype=np.bool_)
    around = corners_c(WHOLE_PRINT * length_m, everywhere)
    seen: Mask = np.asarray(in_image(around, lens).reshape(-1, 4).all(axis=1), dtype=np.bool_)
    corners_px = project(corners_c(length_m * model.scale, seen), lens).reshape(-1, 4, 2)
    count = len(corners_px)
    exact = np.broadcast_to(1e-6 * np.eye(8), (count, 8, 8))
    located = locate_markers(
        model, corners_px, exact, np.full(count, height_m), np.full(count, length_m), 0.0, tilt_sigma_rad=0.0
    )
    return seen, located.modes_m[:, :2]


def _lengths(covariances_m2: Array) -> Array:
    return mean_length(covariances_m2[:, [0, 1, 0], [0, 1, 1]].T)


def find_gaps(expected: ExpectedErrors, grid: FloorGrid, places_m: Array) -> tuple[float, list[FloorGap]]:
    """Return the share of the seen floor where a camera saw a marker, and the gaps, largest first.

    Parameters
    ----------
    expected : of the camera.
    grid : nodes of the floor.
    places_m : (k, 2), positions of the markers that the camera saw.
    """
    if not expected.seen.any():
        return 0.0, []
    nodes_m = grid.nodes_m[expected.seen]
    apart_m = cKDTree(places_m).query(nodes_m)[0] if len(places_m) else np.full(len(nodes_m), np.inf)
    open_nodes: Mask = np.asarray(apart_m > _COVERED_M)
    shape = len(grid.ys_m), len(grid.xs_m)
    mask = np.zeros(len(expected.seen), dtype=np.bool_)
    mask[expected.seen] = open_nodes
    errors_m = np.full(len(mask), np.nan)
    errors_m[expected.seen] = expected.errors_m
    labels, _ = label(mask.reshape(shape), np.ones((3, 3)))
    gaps = []
    for number, (rows, columns) in enumerate(find_objects(labels), 1):
        inside = labels == number
        area_m2 = float(inside.sum()) * grid.step_m**2
        if area_m2 < _LEAST_GAP_M2:
            continue
        x_m, y_m = grid.xs_m[columns], grid.ys_m[rows]
        low_m, high_m = np.array([x_m[0], y_m[0]]), np.array([x_m[-1], y_m[-1]])
        error_m = float(errors_m.reshape(shape)[inside].mean())
        gaps.append(FloorGap(expected.camera, area_m2, low_m, high_m, error_m))
    return float(1 - open_nodes.mean()), sorted(gaps, key=lambda gap: -gap.area_m2)


def choose_points(
    models: Mapping[str, JointModel],
    sizes_px: Mapping[str, tuple[int, int]],
    expected: Sequence[ExpectedErrors],
    candidates_m: Array,
    tape_m2: TapeCovariances,
    length_m: float,
    goal_m: float,
    count: int,
) -> list[TapedPoint]:
    """Choose the points on the floor whose tape readings reduce the mean expected error most, one by one.

    The choice ends when the error is at most ``goal_m``, after ``count`` points, or without a candidate that
    a camera sees.

    Parameters
    ----------
    models, sizes_px : by camera.
    expected : of all cameras.
    candidates_m : (c, 2), possible points.
    tape_m2 : function for the covariances of their tape readings.
    length_m : side of the marker.
    goal_m : wanted mean error.
    count : the largest number of points.

    References
    ----------
    V-optimality, also called I-: Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, ch. 10.
    """
    modes_m = np.concatenate([one.modes_m for one in expected])
    if not len(modes_m) or not len(candidates_m):
        return []
    modes_m = modes_m[:: max(1, len(modes_m) // _ENOUGH_NODES)]
    views = {
        camera: _modes(model, sizes_px[camera], candidates_m, 0.0, length_m)
        for camera, model in models.items()
    }
    rows = {camera: np.cumsum(seen) - 1 for camera, (seen, _) in views.items()}
    tapes_m2 = tape_m2(candidates_m)
    chosen: list[TapedPoint] = []
    slopes, noise_m2 = np.zeros((0, modes_m.shape[2])), np.zeros((0, 0))
    mean_m = float(_lengths(modes_m @ modes_m.swapaxes(1, 2)).mean())
    while len(chosen) < count and mean_m > goal_m:
        best: tuple[float, int, tuple[str, ...], Array, Array] | None = None
        for number in range(len(candidates_m)):
            cameras = tuple(camera for camera, (seen, _) in views.items() if seen[number])
            if not cameras:
                continue
            own = np.concatenate([views[camera][1][rows[camera][number]] for camera in cameras])
            own_m2 = np.tile(tapes_m2[number], (len(cameras), len(cameras)))
            own_m2 += _CORNER_SIGMA_M**2 * np.eye(len(own))
            together, together_m2 = np.concatenate([slopes, own]), _block_diagonal(noise_m2, own_m2)
            after_m = _mean_after(modes_m, together, together_m2)
            if best is None or after_m < best[0]:
                best = after_m, number, cameras, together, together_m2
        if best is None:
            break
        mean_m, number, cameras, slopes, noise_m2 = best
        chosen.append(TapedPoint(candidates_m[number], cameras, mean_m))
    return chosen


def _block_diagonal(first: Array, second: Array) -> Array:
    both = np.zeros((len(first) + len(second),) * 2)
    both[: len(first), : len(first)] = first
    both[len(first) :, len(first) :] = second
    return both


def _mean_after(modes_m: Array, slopes: Array, noise_m2: Array) -> float:
    """Return the mean expected error (n, 2, m) after observations with slopes (k, m) and noise (k, k)."""
    root = np.linalg.cholesky(slopes @ slopes.T + noise_m2)
    gain = np.linalg.solve(root, slopes @ modes_m.reshape(-1, modes_m.shape[2]).T)
    gain = gain.T.reshape(len(modes_m), 2, -1)
    covariances_m2 = modes_m @ modes_m.swapaxes(1, 2) - gain @ gain.swapaxes(1, 2)
    return float(_lengths(covariances_m2).mean())
