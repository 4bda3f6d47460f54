"""Printed markers: their corners, their black cells, and the outlines of the cells."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import CameraCalibration
from ipsys_log.messages.arrays import Array
from ipsys_log.vision.lenses import project
from ipsys_log.vision.markers import marker_corners, white_cells
from ipsys_log.vision.poses import transform


@dataclass(frozen=True, slots=True, eq=False)
class PlacedMarker:
    """A printed marker in the world.

    ``length_m`` is the side of its black square; a white margin of one cell is printed around it.
    ``world_from_marker`` is (4, 4), with the marker coordinates of
    :func:`ipsys_log.vision.markers.marker_corners`. The marker may have any orientation.
    """

    id: int
    length_m: float
    world_from_marker: Array


@dataclass(frozen=True, slots=True, eq=False)
class PlacedBoard:
    """A printed calibration board in the world.

    ``cells`` (rows, columns) is True for black cells, with the white margin, top row first. ``cell_m`` is the
    side of a cell. ``world_from_marker`` is (4, 4). The board coordinates have their origin in the centre of
    the print, x to the right, y up and z towards the viewer.
    """

    cells: NDArray[np.bool_]
    cell_m: float
    world_from_marker: Array


# A function from the time in s since the time of the frame to the marker at that time.
MovingMarker = Callable[[float], PlacedMarker]


@cache
def black_cells(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Return a mask of the black cells of a print, (n + 2, n + 2) with the white margin, top row first."""
    black: NDArray[np.bool_] = np.pad(~white_cells(dictionary, marker_id), 1)
    black.flags.writeable = False
    return black


def printed_cells(placed: PlacedMarker | PlacedBoard, dictionary: str) -> tuple[NDArray[np.bool_], float]:
    """Return a mask of the black cells of a print, (rows, columns) with margin, and the cells per m."""
    if isinstance(placed, PlacedBoard):
        return placed.cells, 1 / placed.cell_m
    cells = black_cells(dictionary, placed.id)
    return cells, (len(cells) - 2) / placed.length_m


def print_outline(placed: PlacedMarker | PlacedBoard, dictionary: str, per_side: int = 8) -> Array:
    """Return points around the edge of a print, white margin included, (4 per_side, 3) in world m."""
    cells, cells_per_m = printed_cells(placed, dictionary)
    corners = marker_corners(1 / cells_per_m) * [cells.shape[1], cells.shape[0], 1]
    step = np.linspace(0, 1, per_side, endpoint=False)[None, :, None]
    sides = corners[:, None] + step * (np.roll(corners, -1, axis=0) - corners)[:, None]
    return transform(placed.world_from_marker, sides.reshape(-1, 3))


def project_corners(lens: CameraCalibration, camera_from_world: Array, placed: PlacedMarker) -> Array:
    """Return the exact pixels of the corners of the black square, without noise, in OpenCV's order.

    Parameters
    ----------
    lens : intrinsics of the camera.
    camera_from_world : (4, 4), pose of the camera.
    placed : the marker.

    Returns
    -------
    (4, 2), in px, clockwise from the marker's own top left; (0, 0) is the centre of the first pixel.
    """
    camera_from_marker = camera_from_world @ placed.world_from_marker
    return project(transform(camera_from_marker, marker_corners(placed.length_m)), lens)


Point = tuple[int, int]

# Sides of a black cell in image coordinates (x right, y down), in the direction with black on the right:
# start, end, and offset of the neighbouring cell.
_SIDES = (
    ((0, 0), (1, 0), (0, -1)),
    ((1, 0), (1, 1), (1, 0)),
    ((1, 1), (0, 1), (0, 1)),
    ((0, 1), (0, 0), (-1, 0)),
)


def cell_outlines(black: NDArray[np.bool_]) -> list[NDArray[np.float64]]:
    """Trace the edges between black and white cells into closed polygons.

    Neighbouring black cells share one polygon, to avoid light seams between them in a renderer. The outlines
    of holes have the opposite direction, so the nonzero rule fills exactly the black cells.

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
    """Return the ends of the edges that start at each point."""
    padded = np.pad(black, 1)
    ends: dict[Point, list[Point]] = {}
    for row, column in np.argwhere(black).tolist():
        for (x1, y1), (x2, y2), (right, down) in _SIDES:
            if not padded[row + 1 + down, column + 1 + right]:
                ends.setdefault((column + x1, row + y1), []).append((column + x2, row + y2))
    return ends


def _walk(ends: dict[Point, list[Point]], start: Point) -> list[Point]:
    """Remove the edges of one polygon from ``ends``; return its points in order."""
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
    """Return the points at which a polygon turns."""
    outline = np.array(points, dtype=np.float64)
    before, after = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
    turns = before[:, 0] * after[:, 1] != before[:, 1] * after[:, 0]
    corners: NDArray[np.float64] = outline[turns]
    return corners
