"""Detection of a chessboard in an image: its corners, without false rows, and the largest grid of them.

A detector for a given size may mistake the edge of the paper on a dark background for one more row. An inner
corner has four whole squares around it, alternately black and white. A corner at the edge of the paper does
not have four whole squares.
"""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Grey

# Least and largest number of rows of a grid.
_LEAST, _MOST = 3, 100
# Sample points in the four squares around a corner, in squares from the corner: deep inside, and close
# to each of its two edges. Blur disturbs points nearer to the corner. Points farther away may lie outside
# of the outer squares, which may be narrower.
_DEEP, _CLOSE = (0.2, 0.32, 0.45), (0.06, 0.12)
_READINGS = (
    [(a, b) for a in _DEEP for b in _DEEP],
    *([(close, b) for b in _DEEP] for close in _CLOSE),
    *([(a, close) for a in _DEEP] for close in _CLOSE),
)
# Blur makes close sample points useless if their contrast is less than this share of the usual contrast.
_BLURRED = 0.3
# A corner is whole if its contrast is at least this share of the usual contrast. A row is real if at least
# this share of its corners is whole.
_WHOLE, _REAL = 0.35, 0.6
# Least difference of grey levels between black and white of a board.
_LEAST_CONTRAST = 8.0
# Number of rows to compare: the added row and the rows next to it.
_COMPARED = 4
# Search distance for a corner of an added row from its predicted position, in squares.
_REACH = 0.25


def complete_grid(grey: Grey, corners: Array) -> Array | None:
    """Return the largest grid of real corners, starting from a detected grid.

    Parameters
    ----------
    grey : the image, (height, width).
    corners : (rows, columns, 2) in px.

    Returns
    -------
    (rows, columns, 2) in px, or None if fewer than 3 x 3 corners are real.
    """
    grid = _trim(grey, corners)
    return None if grid is None else _grow(grey, grid)


def _trim(grey: Grey, grid: Array) -> Array | None:
    """Remove outer rows and columns, the worst first, until all are real; return None if too few are left."""
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
        median = float(np.median(contrasts))
        if median >= _BLURRED * usual:
            whole &= contrasts >= _WHOLE * median
    return np.asarray(whole)


def _contrasts(grey: Grey, padded: Array, points: Array) -> Array:
    """Return the contrast of the darker white square to the lighter black square around each corner.

    The position in the grid gives the expected colours, so a corner with opposite colours has a negative
    contrast. The result is (rows, columns), in grey levels, sampled at ``points`` (k, 2) in squares.
    """
    levels = np.stack([_square_levels(grey, padded, step, points) for step in _SQUARES])
    first = np.minimum(levels[0], levels[2]) - np.maximum(levels[1], levels[3])
    second = np.minimum(levels[1], levels[3]) - np.maximum(levels[0], levels[2])
    even = np.indices(first.shape).sum(axis=0) % 2 == 0
    ways = np.where(even, first, second), np.where(even, second, first)
    return np.asarray(max(ways, key=lambda contrasts: float(np.median(contrasts))))


# Squares around a corner, in circular order: steps down and to the right.
_SQUARES = ((-1, -1), (-1, 1), (1, 1), (1, -1))


def _pad(grid: Array) -> Array:
    """Return a grid with one more row and column on each side, at the spacing of its outer lines."""
    for _ in range(2):
        grid = np.concatenate([[2 * grid[0] - grid[1]], grid, [2 * grid[-1] - grid[-2]]]).swapaxes(0, 1)
    return grid


def _square_levels(grey: Grey, padded: Array, step: tuple[int, int], points: Array) -> Array:
    """Return the mean grey level of one of the squares around each corner, (rows, columns)."""
    rows, columns = padded.shape[0] - 2, padded.shape[1] - 2
    corner = padded[1:-1, 1:-1]
    down = padded[1 + step[0] : 1 + step[0] + rows, 1:-1] - corner
    right = padded[1:-1, 1 + step[1] : 1 + step[1] + columns] - corner
    positions = (
        corner[..., None, :] + points[:, :1] * down[..., None, :] + points[:, 1:] * right[..., None, :]
    )
    maps = positions.reshape(rows, -1, 2).astype(np.float32)
    levels = cv2.remap(grey, maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(levels.reshape(rows, columns, -1).mean(axis=2, dtype=np.float64))


def crop_grid(grey: Grey, grid: Array, size: tuple[int, int]) -> Array:
    """Return the part of a grid with the given size; remove the outer rows of least contrast.

    Parameters
    ----------
    grey : the image, (height, width).
    grid : (rows, columns, 2) in px, at least of the given size, perhaps turned by 90 degrees.
    size : columns and rows.

    Returns
    -------
    (rows, columns, 2) in px, with rows and columns in the order of a front view, not mirrored.
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


# Columns and rows of inner corners.
Size = tuple[int, int]

_LARGE_PX = 1600
_EXHAUSTIVE = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
# First sizes for the search of a larger grid. With some sizes the detector may begin beside the board.
_SEEDS = ((7, 5), (5, 4), (4, 3), (3, 3))


class ChessboardView(NamedTuple):
    """The corners (rows, columns, 2) of a board of the wanted size; the size of the largest grid; or None."""

    corners: Array | None
    size: Size | None


class _Try(NamedTuple):
    """One call of OpenCV's detector; with CALIB_CB_LARGER in ``flags``, a larger grid is accepted."""

    whole_image: bool
    size: Size
    flags: int = 0


def find_chessboard(grey: Grey, size: Size, thorough: bool) -> ChessboardView:
    """Detect a chessboard in any surroundings.

    Parameters
    ----------
    grey : the image, (height, width).
    size : columns and rows of inner corners.
    thorough : search longer if the first search does not find the board.

    Notes
    -----
    The function also detects a board turned by 90 degrees: it has the same corners.
    """
    large = max(grey.shape) > _LARGE_PX
    # The search in a large image takes long, and later steps refine the corners at full size.
    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) if large else grey
    largest: Size | None = None
    for attempt in _tries(size, large, thorough):
        image = grey if attempt.whole_image or not large else np.asarray(small, dtype=np.uint8)
        grid = _grid(image, attempt)
        if grid is None:
            continue
        columns_rows = (grid.shape[1], grid.shape[0])
        if fits_in(size, columns_rows):
            corners = crop_grid(image, grid, size)
            return ChessboardView(corners if image is grey else 2 * corners + 0.5, columns_rows)
        largest = _larger(largest, columns_rows)
        if not fits_in(columns_rows, size):
            break  # a board of another size
    return ChessboardView(None, largest)


def fits_in(size: Size, other: Size) -> bool:
    """Return whether a grid fits into another grid, turned by 90 degrees or not."""
    return min(size) <= min(other) and max(size) <= max(other)


def find_largest_grid(grey: Grey) -> Size | None:
    """Return columns and rows of the largest grid of inner corners in an image, or None."""
    scale = min(1.0, _LARGE_PX / max(grey.shape))
    small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
    largest: Size | None = None
    for seed in _SEEDS:
        grid = _grid(np.asarray(small, dtype=np.uint8), _Try(False, seed, cv2.CALIB_CB_LARGER))
        if grid is not None:
            largest = _larger(largest, (grid.shape[1], grid.shape[0]))
    return largest


def _larger(one: Size | None, other: Size) -> Size:
    return other if one is None or other[0] * other[1] > one[0] * one[1] else one


def _tries(size: Size, large: bool, thorough: bool) -> list[_Try]:
    tries = [_Try(False, size), *([_Try(True, size)] * large)]
    if thorough:
        tries += [_Try(False, first, cv2.CALIB_CB_LARGER) for first in (size, *_SEEDS)]
        tries += [_Try(False, size, _EXHAUSTIVE)]
    return tries


def _grid(image: Grey, attempt: _Try) -> Array | None:
    """Return the real corners from one call of the detector, (rows, columns, 2), or None."""
    is_detected, corners, cells = cv2.findChessboardCornersSBWithMeta(image, attempt.size, attempt.flags)
    if not is_detected:
        return None
    rows, columns = cells.shape if attempt.flags & cv2.CALIB_CB_LARGER else attempt.size[::-1]
    return complete_grid(image, np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2))
