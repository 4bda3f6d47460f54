"""The printed pattern of a marker: its edges between black and white, and the colours of its cells."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages.arrays import Array
from ipsys_log.vision.markers import marker_corners, white_cells

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
