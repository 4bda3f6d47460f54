"""Outlines of the black parts of a grid of cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["cell_outlines"]

Point = tuple[int, int]

# In image coordinates (x right, y down); around a black cell with the black on the right-hand side.
_SIDES = (
    ((0, 0), (1, 0), (0, -1)),
    ((1, 0), (1, 1), (1, 0)),
    ((1, 1), (0, 1), (0, 1)),
    ((0, 1), (0, 0), (-1, 0)),
)


def cell_outlines(black: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """Trace the edges between black and white cells into closed polygons.

    Neighbouring black cells share one polygon, so that no renderer leaves a light seam between them. The
    outlines of holes have the opposite direction, so that the nonzero rule fills exactly the black cells.

    Parameters
    ----------
    black : (rows, columns), the top row first.

    Returns
    -------
    Polygons (n, 2): x to the right and y down, in cells from the top left; the last point is not repeated.

    Examples
    --------
    >>> [polygon.tolist() for polygon in cell_outlines(np.array([[True, True], [False, True]]))]
    [[[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [1.0, 2.0], [1.0, 1.0], [0.0, 1.0]]]
    """
    ends = _directed_edges(black)
    polygons = []
    while ends:
        start = min(ends)
        polygons.append(_corners(_walk(ends, start)))
    return polygons


def _directed_edges(black: NDArray[np.bool_]) -> dict[Point, list[Point]]:
    """The ends of the edges that start at each point."""
    padded = np.pad(black, 1)
    ends: dict[Point, list[Point]] = {}
    for row, column in np.argwhere(black).tolist():
        for (x1, y1), (x2, y2), (right, down) in _SIDES:
            if not padded[row + 1 + down, column + 1 + right]:
                ends.setdefault((column + x1, row + y1), []).append((column + x2, row + y2))
    return ends


def _walk(ends: dict[Point, list[Point]], start: Point) -> list[Point]:
    """Take the edges of one polygon out of ``ends``; the points that it passes."""
    points, point = [start], _take(ends, start)
    while point != start:
        points.append(point)
        point = _take(ends, point)
    return points


def _take(ends: dict[Point, list[Point]], point: Point) -> Point:
    end = ends[point].pop()
    if not ends[point]:
        del ends[point]
    return end


def _corners(points: list[Point]) -> NDArray[np.float64]:
    """The points at which a polygon turns."""
    outline = np.array(points, dtype=np.float64)
    before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
    turns = before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]
    corners: NDArray[np.float64] = outline[turns]
    return corners
