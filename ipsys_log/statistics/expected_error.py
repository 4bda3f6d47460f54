"""Expected error over the floor of a joint calibration, its gaps, and the tape readings that reduce it.

The covariance of a joint calibration gives the expected error at each node of a grid, without ground truth.

The errors of all cameras are linear functions of the same independent normal numbers. So the effect of one
more taped point on the whole floor follows from a small linear system, without a fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.model import JointModel
from ipsys_log.messages import Array, Mask
from ipsys_log.messages.stage import Progress
from ipsys_log.statistics.floor_cameras import FloorGrid
from ipsys_log.statistics.plan import mean_length
from ipsys_log.statistics.tape import TapeCovariances
from ipsys_log.vision.lenses import in_image, project
from ipsys_log.vision.markers import marker_corners
from ipsys_log.vision.poses import level_turns

# A marker counts as visible if a square of this multiple of its side is wholly in the image.
WHOLE_PRINT = 1.4
# A node is covered if the camera saw a marker nearer than this: the floor changes little over this distance.
_COVERED_M = 0.35
# Smaller gaps are not reported.
_LEAST_GAP_M2 = 0.1
# So many nodes at once have modes of a few dozen megabytes, in a hall of 24 cameras.
_AT_ONCE = 1000
_ALL = slice(None)


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedErrors:
    """Expected errors of the positions by one camera.

    Attributes
    ----------
    camera : its name.
    seen : (b * a,), mask of the nodes of the grid at which the image contains a whole marker.
    errors_m : (n,), expected 2D errors at the n seen nodes, by the calibration alone.
    model, size_px : the calibrated camera, and the width and height of its images.
    view, length_m : the markers at these nodes, and their side.
    """

    camera: str
    seen: Mask
    errors_m: Array
    model: JointModel
    size_px: tuple[int, int]
    view: "VisibleMarkers"
    length_m: float

    def modes_m(self, rows: slice = _ALL) -> Array:
        """Return the errors at some nodes as functions of the m normal numbers of the calibration, (r, 2, m).

        They are computed again in each call: those of all nodes of a hall take gigabytes.
        """
        return _modes_at(self.model, self.view, self.length_m, rows)


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
        size_px = sizes_px[camera]
        view = see_markers(model, size_px, grid.nodes_m, height_m, length_m)
        errors_m = np.zeros(len(view.corners_px))
        for first in range(0, len(errors_m), _AT_ONCE):
            rows = slice(first, first + _AT_ONCE)
            modes_m = _modes_at(model, view, length_m, rows)
            errors_m[rows] = mean_lengths(modes_m @ modes_m.swapaxes(1, 2))
        expected.append(ExpectedErrors(camera, view.seen, errors_m, model, size_px, view, length_m))
    return expected


def _modes_at(model: JointModel, view: "VisibleMarkers", length_m: float, rows: slice) -> Array:
    """Return the modes (r, 2, m) of some of the seen markers."""
    corners_px, heights_m = view.corners_px[rows], view.heights_m[rows]
    count = len(corners_px)
    if not count:
        return np.zeros((0, 2, model.modes.shape[1]))
    exact = np.broadcast_to(1e-6 * np.eye(8), (count, 8, 8))
    lengths_m = np.full(count, length_m)
    located = locate_markers(model, corners_px, exact, heights_m, lengths_m, 0.0, tilt_sigma_rad=0.0)
    return located.modes_m[:, :2]


class VisibleMarkers(NamedTuple):
    """Markers on the floor as a camera sees them: a mask (p,), and the n seen ones.

    ``corners_px`` (n, 4, 2) are exact, ``centres_m`` (n, 3) and ``turns`` (n, 3, 3) are the poses in the
    world, ``heights_m`` (n,) the heights above the floor.
    """

    seen: Mask
    corners_px: Array
    centres_m: Array
    turns: Array
    heights_m: Array


def see_markers(
    model: JointModel,
    size_px: tuple[int, int],
    points_m: Array,
    heights_m: Array | float,
    length_m: float,
    headings_rad: Array | float = 0.0,
) -> VisibleMarkers:
    """Return the markers at points (p, 2) that are whole in the image of a camera, with their margins."""
    lens = replace(model.calibration, width=size_px[0], height=size_px[1])
    floor_m = model.floor.heights(points_m, model.amplitudes)[0]
    heights_m = np.broadcast_to(heights_m, floor_m.shape)
    centres_m = np.column_stack([points_m, heights_m + floor_m])
    turns = level_turns(np.broadcast_to(headings_rad, floor_m.shape))

    def corners_c(side_m: float, rows: Mask) -> Array:
        corners_m = centres_m[rows, None] + marker_corners(side_m) @ turns[rows].swapaxes(1, 2)
        return np.asarray((corners_m.reshape(-1, 3) - model.origin_m) @ model.camera_from_world.T)

    everywhere = np.ones(len(points_m), dtype=np.bool_)
    around = corners_c(WHOLE_PRINT * length_m, everywhere)
    seen: Mask = np.asarray(in_image(around, lens).reshape(-1, 4).all(axis=1), dtype=np.bool_)
    corners_px = project(corners_c(length_m * model.scale, seen), lens).reshape(-1, 4, 2)
    return VisibleMarkers(seen, corners_px, centres_m[seen], turns[seen], heights_m[seen])


def mean_lengths(covariances_m2: Array) -> Array:
    """Return the mean lengths (n,) of errors in the plane with covariances (n, 2, 2)."""
    return mean_length(covariances_m2[:, [0, 1, 0], [0, 1, 1]].T)


def find_floor_gaps(
    expected: ExpectedErrors, grid: FloorGrid, places_m: Array
) -> tuple[float, list[FloorGap]]:
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
    gaps = [
        FloorGap(
            expected.camera,
            patch.area_m2,
            patch.low_m,
            patch.high_m,
            float(errors_m.reshape(shape)[patch.inside].mean()),
        )
        for patch in grid.patches(mask.reshape(shape), _LEAST_GAP_M2)
    ]
    return float(1 - open_nodes.mean()), gaps


# Repeatable error of the position of a marker by one camera, for the choice of points.
_CORNER_SIGMA_M = 0.0003
# So many camera-nodes give the mean error over the floor accurately enough for the choice of points.
_ENOUGH_NODES = 800


@dataclass(frozen=True, slots=True, eq=False)
class TapedPoint:
    """A point to measure.

    Attributes
    ----------
    point_m : (2,); ``height_m`` is its height above the floor.
    cameras : those that see it.
    mean_after_m : the expected mean error after it.
    update : (m, m). The modes of the calibration after this point, and all before it, are the present modes
        times this matrix.
    """

    point_m: Array
    height_m: float
    cameras: tuple[str, ...]
    mean_after_m: float
    update: Array


def choose_points(
    expected: Sequence[ExpectedErrors],
    candidates_m: Array,
    tape_m2: TapeCovariances,
    goal_m: float,
    count: int,
    heights_m: Array | float = 0.0,
    progress: Progress = lambda done, total: None,
) -> list[TapedPoint]:
    """Choose the points on the floor whose tape readings reduce the mean expected error most, one by one.

    The choice ends when the error is at most ``goal_m``, after ``count`` points, or without a candidate that
    a camera sees. No point is chosen twice.

    Parameters
    ----------
    expected : of all cameras.
    candidates_m : (c, 2), possible points.
    tape_m2 : function for the covariances of their tape readings.
    goal_m : wanted mean error.
    count : the largest number of points.
    heights_m : heights of the candidates above the floor, a number or (c,).
    progress : called after each point.

    References
    ----------
    V-optimality, also called I-: Atkinson, Donev and Tobias, Optimum Experimental Designs, 2007, ch. 10.
    """
    modes_m = some_modes(expected)
    if not len(modes_m) or not len(candidates_m):
        return []
    heights_m = np.broadcast_to(heights_m, (len(candidates_m),))
    candidates = _Candidates(expected, candidates_m, heights_m, tape_m2(candidates_m))
    chosen: list[TapedPoint] = []
    update = np.eye(modes_m.shape[2])
    mean_m = mean_error(modes_m)
    while len(chosen) < count and mean_m > goal_m:
        progress(len(chosen), count)
        best = candidates.choose(modes_m @ update, update)
        if best is None:
            break
        number, step = best
        update = update @ step
        mean_m = mean_error(modes_m @ update)
        cameras = candidates.take(number)
        chosen.append(TapedPoint(candidates_m[number], float(heights_m[number]), cameras, mean_m, update))
    return chosen


def some_modes(expected: Sequence[ExpectedErrors]) -> Array:
    """Return the modes (n, 2, m) of enough camera-nodes for a mean over the floor."""
    counts = [len(one.errors_m) for one in expected]
    every = max(1, sum(counts) // _ENOUGH_NODES)
    firsts = np.cumsum([0, *counts[:-1]])
    # Every n-th node of all cameras: the first one of a camera depends on the number of nodes before it.
    parts = [
        one.modes_m(slice(-first % every, None, every))
        for one, first in zip(expected, firsts.tolist(), strict=True)
    ]
    return np.concatenate(parts)


def mean_error(modes_m: Array) -> float:
    """Return the mean expected error of camera-nodes with modes (n, 2, m)."""
    return float(mean_lengths(modes_m @ modes_m.swapaxes(1, 2)).mean())


def posterior_root(slopes: Array, noise_m2: Array) -> Array:
    """Return a root (m, m) of the covariance of m independent normal numbers after an observation.

    Parameters
    ----------
    slopes, noise_m2 : (k, m) and (k, k), of the observation.
    """
    gain = np.linalg.solve(slopes @ slopes.T + noise_m2, slopes)
    covariance = np.eye(slopes.shape[1]) - slopes.T @ gain
    return np.asarray(np.linalg.cholesky((covariance + covariance.T) / 2))


class _Candidates:
    """Possible points for a taped marker, and the observations that they would give."""

    def __init__(
        self, expected: Sequence[ExpectedErrors], points_m: Array, heights_m: Array, tapes_m2: Array
    ) -> None:
        self._seen, self._slopes = {}, {}
        for one in expected:
            view = see_markers(one.model, one.size_px, points_m, heights_m, one.length_m)
            modes_m = _modes_at(one.model, view, one.length_m, _ALL)
            slopes = np.zeros((len(points_m), *modes_m.shape[1:]))
            slopes[view.seen] = modes_m
            self._seen[one.camera], self._slopes[one.camera] = view.seen, slopes
        self._tapes_m2 = tapes_m2
        self._free = np.any([*self._seen.values()], axis=0)

    def choose(self, modes_m: Array, update: Array) -> tuple[int, Array] | None:
        """Return the free point that gives the least mean error, and the update of the modes by it.

        ``modes_m`` (n, 2, m) are those after ``update`` (m, m), which has the points that are taken.
        """
        base_m2 = modes_m @ modes_m.swapaxes(1, 2)
        best: tuple[float, int, tuple[Array, Array]] | None = None
        for number in np.flatnonzero(self._free).tolist():
            observed = self._observe(number, update)
            after_m = _mean_after(base_m2, modes_m, *observed)
            if best is None or after_m < best[0]:
                best = after_m, number, observed
        return None if best is None else (best[1], posterior_root(*best[2]))

    def take(self, number: int) -> tuple[str, ...]:
        """Take a point out of the choice; return the cameras that see it."""
        self._free[number] = False
        return tuple(camera for camera, seen in self._seen.items() if seen[number])

    def _observe(self, number: int, update: Array) -> tuple[Array, Array]:
        """Return slopes (k, m) and noise (k, k) of a tape reading: all cameras see the same tape error."""
        own = [self._slopes[camera][number] for camera, seen in self._seen.items() if seen[number]]
        noise_m2 = np.tile(self._tapes_m2[number], (len(own), len(own)))
        noise_m2 += _CORNER_SIGMA_M**2 * np.eye(len(noise_m2))
        return np.concatenate(own) @ update, noise_m2


def _mean_after(base_m2: Array, modes_m: Array, slopes: Array, noise_m2: Array) -> float:
    """Return the mean expected error after an observation; ``base_m2`` (n, 2, 2) is the product of modes."""
    root = np.linalg.cholesky(slopes @ slopes.T + noise_m2)
    gain = np.linalg.solve(root, slopes @ modes_m.reshape(-1, modes_m.shape[2]).T)
    gain = gain.T.reshape(len(modes_m), 2, -1)
    return float(mean_lengths(base_m2 - gain @ gain.swapaxes(1, 2)).mean())
