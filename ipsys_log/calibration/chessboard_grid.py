"""Grids of chessboard corners: remove false rows, add rows that the detector missed.

A detector for a given size may take the edge of the paper before a dark background for one more row. An inner
corner has four whole squares around it, alternately black and white. The edge of the paper does not: the
squares end there.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["complete_grid", "crop_grid"]

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Least and largest number of rows of a grid.
_LEAST, _MOST = 3, 100
# Sample points in the four squares around a corner, in squares from the corner: deep inside, and close
# to each of its two edges. Nearer to the corner, blur counts; farther, outer squares may be narrower.
_DEEP, _CLOSE = (0.2, 0.32, 0.45), (0.06, 0.12)
_READINGS = (
    [(a, b) for a in _DEEP for b in _DEEP],
    *([(close, b) for b in _DEEP] for close in _CLOSE),
    *([(a, close) for a in _DEEP] for close in _CLOSE),
)
# Blur makes a close reading useless in which black and white differ by less than this share of what they do.
_BLURRED = 0.3
# A corner is whole if its contrast is this share of the usual one; a row is real if so many of its corners
# are whole.
_WHOLE, _REAL = 0.35, 0.6
# Least difference of grey levels between black and white of a board.
_LEAST_CONTRAST = 8.0
# Number of rows to compare: the added row and those next to it.
_COMPARED = 4
# Search distance for a corner of an added row from its predicted position, in squares.
_REACH = 0.25


def complete_grid(grey: Grey, corners: Array) -> Array | None:
    """Return the largest grid of real corners, starting from a detected grid.

    Parameters
    ----------
    grey : (height, width).
    corners : (rows, columns, 2) in px.

    Returns
    -------
    (rows, columns, 2) in px, or None if fewer than 3 x 3 corners are real.
    """
    grid = _trim(grey, corners)
    return None if grid is None else _grow(grey, grid)


def _trim(grey: Grey, grid: Array) -> Array | None:
    """Remove outer rows and columns, the worst one first, until all are real."""
    while min(grid.shape[:2]) >= _LEAST:
        shares = _edge_shares(_whole(grey, grid))
        worst = int(np.argmin(shares))
        if shares[worst] >= _REAL:
            return grid
        grid = _turn(_turn(grid, worst)[1:], -worst)
    return None


def _grow(grey: Grey, grid: Array) -> Array:
    """Add rows and columns on all sides while they are real."""
    grown = True
    while grown and max(grid.shape[:2]) < _MOST:
        grown = False
        for side in range(4):
            longer = _add_row(grey, _turn(grid, side))
            if longer is not None:
                grid, grown = _turn(longer, -side), True
    return grid


def _turn(grid: Array, side: int) -> Array:
    """Turn a grid so that one of its sides (upper, right, lower, left) is its first row."""
    return np.rot90(grid, side)


def _add_row(grey: Grey, grid: Array) -> Array | None:
    """Return the grid with one more row before its first, or None if there is no such row."""
    expected = 3 * grid[0] - 3 * grid[1] + grid[2]
    spacing_px = np.linalg.norm(grid[0] - grid[1], axis=1)
    height, width = grey.shape
    if not ((expected >= 0) & (expected <= (width - 1, height - 1))).all():
        return None
    window = max(2, round(_REACH * float(spacing_px.min())))
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 20, 0.02)
    start = expected.astype(np.float32).reshape(-1, 1, 2)
    row = cv2.cornerSubPix(grey, start, (window, window), (-1, -1), criteria).reshape(-1, 2)
    near = np.linalg.norm(row - expected, axis=1) <= np.maximum(_REACH * spacing_px, 1.0)
    if not near.all():
        return None
    longer = np.concatenate([row[None].astype(np.float64), grid])
    return longer if _edge_shares(_whole(grey, longer[:_COMPARED]))[0] >= _REAL else None


def _edge_shares(whole: NDArray[np.bool_]) -> Array:
    """Return the share of whole corners in the upper, right, lower and left edge of a grid, (4,)."""
    return np.array([whole[0].mean(), whole[:, -1].mean(), whole[-1].mean(), whole[:, 0].mean()])


def _whole(grey: Grey, grid: Array) -> NDArray[np.bool_]:
    """Return a mask (rows, columns) of corners between four squares, alternately black and white."""
    padded = _pad(grid)
    deep, *close = (_contrasts(grey, padded, np.array(points)) for points in _READINGS)
    usual = float(np.median(deep))
    whole = deep >= max(_WHOLE * usual, _LEAST_CONTRAST)
    for contrasts in close:
        middle = float(np.median(contrasts))
        if middle >= _BLURRED * usual:
            whole &= contrasts >= _WHOLE * middle
    return np.asarray(whole)


def _contrasts(grey: Grey, padded: Array, points: Array) -> Array:
    """Return the contrast of the darker white square to the lighter black square around each corner.

    The position in the grid decides the colours, so a corner of opposite colours is negative. The result is
    (rows, columns), in grey levels, read at ``points`` (k, 2) in squares.
    """
    levels = np.stack([_square_levels(grey, padded, step, points) for step in _SQUARES])
    first = np.minimum(levels[0], levels[2]) - np.maximum(levels[1], levels[3])
    second = np.minimum(levels[1], levels[3]) - np.maximum(levels[0], levels[2])
    even = np.indices(first.shape).sum(axis=0) % 2 == 0
    ways = np.where(even, first, second), np.where(even, second, first)
    return np.asarray(max(ways, key=lambda contrasts: float(np.median(contrasts))))


# Squares around a corner, one after the other in a circle: steps down and to the right.
_SQUARES = ((-1, -1), (-1, 1), (1, 1), (1, -1))


def _pad(grid: Array) -> Array:
    """Return a grid with one more row and column on each side, at the spacing of the last ones."""
    for _ in range(2):
        grid = np.concatenate([[2 * grid[0] - grid[1]], grid, [2 * grid[-1] - grid[-2]]]).swapaxes(0, 1)
    return grid


def _square_levels(grey: Grey, padded: Array, step: tuple[int, int], points: Array) -> Array:
    """Return the mean grey level of one of the squares around each corner, (rows, columns)."""
    rows, columns = padded.shape[0] - 2, padded.shape[1] - 2
    corner = padded[1:-1, 1:-1]
    down = padded[1 + step[0] : 1 + step[0] + rows, 1:-1] - corner
    right = padded[1:-1, 1 + step[1] : 1 + step[1] + columns] - corner
    at = corner[..., None, :] + points[:, :1] * down[..., None, :] + points[:, 1:] * right[..., None, :]
    maps = at.reshape(rows, -1, 2).astype(np.float32)
    levels = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels.reshape(rows, columns, -1).mean(axis=2, dtype=np.float64))


def crop_grid(grey: Grey, grid: Array, size: tuple[int, int]) -> Array:
    """Return the part of a grid with the given size, without the outer rows of least contrast.

    Parameters
    ----------
    grey : (height, width).
    grid : (rows, columns, 2) in px, at least of that size, perhaps turned by 90 degrees.
    size : columns and rows.

    Returns
    -------
    (rows, columns, 2) in px: columns to the right of the rows' direction, as in a view of the front.
    """
    columns, rows = size
    if not (grid.shape[0] >= rows and grid.shape[1] >= columns):
        grid = np.rot90(grid)
    for quarter, length in ((0, rows), (1, columns)):
        while _turn(grid, quarter).shape[0] > length:
            turned = _turn(grid, quarter)
            deep = _contrasts(grey, _pad(turned), np.array(_READINGS[0]))
            weaker_first = deep[0].mean() < deep[-1].mean()
            grid = _turn(turned[1:] if weaker_first else turned[:-1], -quarter)
    right, down = (
        grid[:, -1].mean(axis=0) - grid[:, 0].mean(axis=0),
        grid[-1].mean(axis=0) - grid[0].mean(axis=0),
    )
    return grid if right[0] * down[1] > right[1] * down[0] else grid[::-1]
