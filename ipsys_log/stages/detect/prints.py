"""The printed pattern of a marker: its edges and cells, and profiles of grey levels across the edges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration, Grey
from ipsys_log.vision.decode import levels_at
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners, white_cells
from ipsys_log.vision.poses import rotation

# Positions of points along the side of a cell, away from its corners, because the blur rounds the corners.
_ALONG_CELL = np.array([0.3, 0.7])
# Reach across an edge, in cells; step of a numerical derivative, in sides of the marker.
_REACH, _NUDGE = 0.15, 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Prints:
    """Printed markers of side 1 around (0, 0), with x to their right and y to their top.

    Attributes
    ----------
    points : (m, s, 2), points on the edges between black and white of m markers.
    ends : (m, 2 s + 1, 2), the points ``reach`` before and behind each of these points, across the edge; and
        the middle of the marker.
    along_x : (m, s), 0.0 if the edge runs along y and so measures x; else 1.0.
    rotation_derivative : (m, s), motion of a point across its edge when the marker turns about its centre.
    polarity : (m, s), 1.0 if white is on the side of the greater coordinate, else -1.0; 0.0 for a point that
        pads the array, because another marker has more points.
    outline : (12 + c, 2), the corners, the corners moved by ``nudge`` in x, the corners moved by ``nudge`` in
        y, and the middles of the cells, black border included.
    white : (m, c), True for white cells.
    by_axis : (m, s, 2), maps values at points to their means over the edges along y, and along x.
    by_side : (m, s, 4), maps them to means over the top, right, bottom and left side of the square.
    inner : (m, s, 1), maps them to the mean over the edges between cells.
    by_colour : (m, c, 2), maps values at cells to their means over the white cells and the black cells.
    cells : number of cells along a side.
    """

    points: Array
    ends: Array
    along_x: Array
    rotation_derivative: Array
    polarity: Array
    outline: Array
    white: NDArray[np.bool_]
    by_axis: Array
    by_side: Array
    inner: Array
    by_colour: Array
    cells: int
    reach: float
    nudge: float


# The prints of 40 markers have 250 kB, and each marker that comes or goes makes a new set.
@lru_cache(maxsize=32)
def build_prints(dictionary: str, marker_ids: tuple[int, ...]) -> Prints:
    """Return the prints of markers; ``dictionary`` is OpenCV's name, such as DICT_4X4_100."""
    edges = [_edges(dictionary, marker_id) for marker_id in marker_ids]
    most = max(len(rows) for rows in edges)
    rows = np.stack(
        [np.vstack([row, np.repeat(row[:1] * [1, 1, 1, 0], most - len(row), 0)]) for row in edges]
    )
    white = np.stack([white_cells(dictionary, marker_id) for marker_id in marker_ids])
    cells = white.shape[1]
    points, level, real = rows[..., :2].copy(), rows[..., 2], np.abs(rows[..., 3])
    reach = _REACH / cells
    on_sides = _on_sides(points, level)
    aside = np.stack([1 - level, level], axis=2) * reach
    return Prints(
        points,
        np.concatenate([points - aside, points + aside, np.zeros_like(points[:, :1])], axis=1),
        level.copy(),
        level * points[..., 0] - (1 - level) * points[..., 1],
        rows[..., 3].copy(),
        _outline(cells),
        white.reshape(len(white), -1),
        _means(np.stack([real * (1 - level), real * level], axis=2)),
        _means(real[..., None] * on_sides),
        _means(real[..., None] * ~on_sides.any(axis=2, keepdims=True)),
        _means(np.stack([white, ~white], axis=3).reshape(len(white), -1, 2).astype(np.float64)),
        cells,
        reach,
        _NUDGE,
    )


def _means(shares: Array) -> Array:
    return np.asarray(shares / shares.sum(axis=1, keepdims=True))


def _on_sides(points: Array, level: Array) -> NDArray[np.bool_]:
    along_x, end = level == 1, 0.5 - 1e-6
    x, y = points[..., 0], points[..., 1]
    sides = [along_x & (y > end), ~along_x & (x > end), along_x & (y < -end), ~along_x & (x < -end)]
    return np.stack(sides, axis=2)


def _outline(cells: int) -> Array:
    corners = marker_corners(1.0)[:, :2]
    middles = (np.arange(cells) + 0.5) / cells - 0.5
    x, y = np.meshgrid(middles, -middles)
    nudged = [corners + np.array(nudge) for nudge in ([_NUDGE, 0.0], [0.0, _NUDGE])]
    return np.concatenate([corners, *nudged, np.column_stack([x.ravel(), y.ravel()])])


@cache
def _edges(dictionary: str, marker_id: int) -> Array:
    """Return points on edges as rows of x, y, axis, polarity; (s, 4)."""
    margin = np.pad(white_cells(dictionary, marker_id), 1, constant_values=True)
    cells = len(margin) - 2
    lines = np.arange(cells + 1) / cells - 0.5
    steps = _ALONG_CELL / cells
    upright = [
        (lines[column], -(lines[row] + step), 0, 1 if margin[row + 1, column + 1] else -1)
        for row in range(cells)
        for column in range(cells + 1)
        if margin[row + 1, column] != margin[row + 1, column + 1]
        for step in steps
    ]
    level = [
        (lines[column] + step, -lines[row], 1, 1 if margin[row, column + 1] else -1)
        for row in range(cells + 1)
        for column in range(cells)
        if margin[row, column + 1] != margin[row + 1, column + 1]
        for step in steps
    ]
    return np.array(upright + level, dtype=np.float64)


# In grey levels: a smaller rise is no edge.
LEAST_CONTRAST = 8.0

# Reach of near and of far profiles to each side, and their largest reach in cells. Profiles do not reach the
# middle of a cell.
_NEAR_PX, _FAR_PX, _OF_CELL = 3.0, 12.0, 0.45
_TAPS = np.linspace(-1, 1, 7)
# Standard deviation of a blurred step: the usual effect of optics, pixels and JPEG on an edge.
USUAL_BLUR_PX = 0.8
BLURS_PX = np.arange(0.5, 2.35, 0.05).round(2)
# Edges wider than this get less weight.
_SHARP_PX = 4.0
# Edges of less than this share of the mean contrast are covered, or in glare.
_WEAK = 0.3
# Largest distance in sides of a marker: a farther marker is smaller than a pixel.
_HORIZON = 1e4


class MarkerView(NamedTuple):
    """An image, the intrinsics of its camera, and the prints of the markers to measure in it."""

    grey: Grey
    lens: CameraCalibration
    prints: Prints
    row_time_s: float
    blur_px: float | None


class Poses(NamedTuple):
    """Poses of m markers in camera coordinates: rotations (m, 3, 3) and centres (m, 3)."""

    rotations: Array
    centres: Array

    def into_camera(self, points: Array) -> Array:
        """Return points of prints, (m, n, 2), in camera coordinates, (m, n, 3)."""
        return points @ self.rotations[:, :, :2].transpose(0, 2, 1) + self.centres[:, None]

    def camera_positions(self) -> Array:
        """Return the camera positions in print coordinates, (m, 3)."""
        return -(self.centres[:, None] @ self.rotations)[:, 0]

    def move(self, twists: Array) -> Poses:
        """Return the poses after translations and rotations ``twists`` (m, 6), in print coordinates."""
        shifts = (self.rotations @ twists[:, :3, None])[..., 0]
        turns = np.array([rotation(vector) for vector in twists[:, 3:]])
        return Poses(self.rotations @ turns, self.centres + shifts)

    def is_visible(self) -> NDArray[np.bool_]:
        """Return a mask (m,) of the poses that a camera can completely see.

        Such poses are finite, and the distance of the marker is larger than its side.
        """
        away = self.centres[:, 2]
        known = np.isfinite(self.rotations.sum(axis=(1, 2)) + self.centres.sum(axis=1))
        return np.asarray(known & (away > 1.0) & (away < _HORIZON))

    def select(self, good: NDArray[np.bool_], other: Poses) -> Poses:
        """Return these poses where they are good, and the other poses elsewhere."""
        return Poses(
            np.where(good[:, None, None], self.rotations, other.rotations),
            np.where(good[:, None], self.centres, other.centres),
        )


class EdgePositions(NamedTuple):
    """Positions of edges in an image: ``middle`` (m, s, 2) in px.

    ``across`` (m, s, 2) are vectors from there across the edge, ``lengths_px`` (m, s) long. ``slopes`` (m, s)
    are px per side of the print. ``late`` (m, s) are px per speed along their axis, for rows that are exposed
    later.
    """

    middle: Array
    across: Array
    lengths_px: Array
    slopes: Array
    late: Array


class EdgeMeasurements(NamedTuple):
    """Observed edges of prints, (m, s) each.

    ``off_px`` is their displacement along their axis. ``certainty`` is between 1.0 and 0.0 (a missing edge).
    ``slopes`` and ``late`` are as in :class:`EdgePositions`. ``blurs_px`` (m,) is the blur of the edges.
    ``profiles`` (m, s, t) are grey levels across the edges, up to ``near_px`` (m,) on each side if they are
    not wide.
    """

    off_px: Array
    certainty: Array
    slopes: Array
    late: Array
    blurs_px: Array
    profiles: Array
    near_px: Array

    def heights(self, prints: Prints) -> Array:
        """Return the rises of edges within the usual blur, (m, s), in grey levels."""
        usual = np.array([_template(reach_px, USUAL_BLUR_PX)[:, :1] for reach_px in self.near_px.tolist()])
        return np.asarray((self.profiles @ usual)[..., 0] * prints.polarity)

    def ends(self) -> Array:
        """Return the levels at both ends of profiles, (m, s, 2)."""
        return self.profiles[..., :: len(_TAPS) - 1]


def locate(view: MarkerView, poses: Poses, motions: Array) -> EdgePositions:
    """Return the predicted positions of edges.

    Parameters
    ----------
    motions : (m, 3), as in :class:`~ipsys_log.stages.detect.adjustment.Guess`.
    """
    prints, count = view.prints, len(poses.centres)
    points_px = project(poses.into_camera(prints.ends).reshape(-1, 3), view.lens).reshape(count, -1, 2)
    ends_px = points_px[:, :-1].reshape(count, 2, -1, 2)
    across = (ends_px[:, 1] - ends_px[:, 0]) / 2
    middle = ends_px[:, 0] + across
    lengths_px = np.maximum(np.hypot(across[..., 0], across[..., 1]), 1e-6)
    slopes = lengths_px / prints.reach
    late = np.zeros_like(slopes)
    if view.row_time_s:
        late = slopes * (middle[..., 1] - points_px[:, -1:, 1]) * view.row_time_s
        speed = (
            np.where(prints.along_x, motions[:, 1:2], motions[:, :1])
            + prints.rotation_derivative * motions[:, 2:]
        )
        middle = middle + (late * speed / lengths_px)[..., None] * across
    return EdgePositions(middle, across, lengths_px, slopes, late)


def read_profiles(grey: Grey, sites: EdgePositions, reaches_px: Array, taps: Array) -> Array:
    """Return grey levels across edges, (m, s, t).

    Parameters
    ----------
    reaches_px : (m, 1) or (m, s), reach of profiles to each side.
    taps : (t,), positions in shares of that reach.
    """
    positions = (reaches_px / sites.lengths_px)[..., None] * taps
    x = (sites.middle[..., :1] + sites.across[..., :1] * positions).astype(np.float32)
    y = (sites.middle[..., 1:] + sites.across[..., 1:] * positions).astype(np.float32)
    return levels_at(grey, x, y)


def measure(view: MarkerView, poses: Poses, motions: Array, wide: NDArray[np.bool_]) -> EdgeMeasurements:
    """Measure profiles across the edges, near their predicted positions.

    Parameters
    ----------
    motions : (m, 3), as in :class:`~ipsys_log.stages.detect.adjustment.Guess`.
    wide : (m, 2), True if profiles reach far to both sides, across edges along y and along x.
    """
    prints = view.prints
    sites = locate(view, poses, motions)
    farthest_px = np.minimum(np.maximum(_OF_CELL * sites.slopes.min(axis=1) / prints.cells, 0.5), _FAR_PX)
    near_px = np.minimum(_NEAR_PX, farthest_px).round(1)
    reaches_px = near_px[:, None]
    widened = bool(wide.any())
    if widened:
        wide_edges = np.where(prints.along_x, wide[:, 1:], wide[:, :1])
        reaches_px = np.where(wide_edges, farthest_px[:, None], reaches_px)
    profiles = read_profiles(view.grey, sites, reaches_px, _TAPS)
    blurs_px = _blurs(view, profiles, near_px, widened)
    shapes = list(zip(near_px.tolist(), blurs_px.tolist(), strict=True))
    fitted = profiles @ np.array([_template(reach_px, blur_px) for reach_px, blur_px in shapes])
    height = fitted[..., 0] * prints.polarity
    present = height > np.maximum(_WEAK * height.mean(axis=1), LEAST_CONTRAST)[:, None]
    off_px = np.divide(fitted[..., 1], fitted[..., 0], out=np.zeros_like(height), where=present)
    certainty = present.astype(np.float64)
    if widened:
        by_area, width_px, shown = _by_area(prints, profiles, reaches_px)
        off_px = np.where(wide_edges, by_area, off_px)
        certainty = np.where(wide_edges, shown * np.minimum(1.0, _SHARP_PX / width_px) ** 2, certainty)
    off_px = np.minimum(np.maximum(off_px, -reaches_px), reaches_px)
    return EdgeMeasurements(off_px, certainty, sites.slopes, sites.late, blurs_px, profiles, near_px)


def _by_area(prints: Prints, profiles: Array, reaches_px: Array) -> tuple[Array, Array, Array]:
    """Return the displacements of edges from the share of white in their profiles.

    The method is valid for sharp edges far from their prediction, and for edges with more blur than a
    profile shows.

    Returns
    -------
    Displacements (m, s) in px, widths of the edges (m, s) in px, and a mask (m, s) of the visible edges.
    """
    real = prints.polarity != 0
    low, high = profiles.min(axis=(1, 2))[:, None], profiles.max(axis=(1, 2))[:, None]
    contrast = np.maximum(high - low, 1.0)
    white = (profiles.mean(axis=2) - low) / contrast
    rise = (profiles @ _TAPS) / (_TAPS @ _TAPS) / reaches_px * prints.polarity
    rises = rise[:, None] @ prints.by_axis
    width_px = contrast / np.maximum(np.where(prints.along_x, rises[..., 1], rises[..., 0]), 1e-3)
    width_px = np.maximum(width_px, 2 * reaches_px)
    return (0.5 - white) * width_px * prints.polarity, width_px, real & (rise > 0)


def _blurs(view: MarkerView, profiles: Array, reaches_px: Array, wide: bool) -> Array:
    """Estimate the blur of the edges of each marker in px, by the least residual of the mean profile."""
    if view.blur_px is not None or wide:
        return np.full(len(profiles), view.blur_px or USUAL_BLUR_PX)
    means = (view.prints.polarity[:, None] @ profiles)[:, 0]
    left = [_residues(reach_px) @ mean for reach_px, mean in zip(reaches_px.tolist(), means, strict=True)]
    squares = np.square(left).reshape(len(profiles), len(BLURS_PX), -1)
    return np.asarray(BLURS_PX[squares.sum(axis=2).argmin(axis=1)], dtype=np.float64)


@cache
def _residues(reach_px: float) -> Array:
    """Return the residual matrix of a profile about the best step of each blur, (blurs * taps, taps)."""
    steps = [_step(reach_px, blur_px) for blur_px in BLURS_PX.tolist()]
    return np.concatenate([np.eye(len(_TAPS)) - step @ np.linalg.pinv(step) for step in steps])


@cache
def _template(reach_px: float, blur_px: float) -> Array:
    """Return the matrix (taps, 2) from a profile to the height, and height times shift, of a blurred step."""
    return np.asarray(np.linalg.pinv(_step(reach_px, blur_px))[1:].T.copy(), dtype=np.float64)


def _step(reach_px: float, blur_px: float) -> Array:
    """Return foot, height and shift of a blurred step as profiles, (taps, 3)."""
    from scipy.special import ndtr  # late: commands that detect nothing start 0.2 s earlier

    x = reach_px * _TAPS / blur_px
    bell = np.exp(-(x**2) / 2) / (np.sqrt(2 * np.pi) * blur_px)
    return np.column_stack([np.ones_like(x), ndtr(x), -bell])
