"""Detection of a chessboard in a picture: its corners, and the largest grid of corners."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.chessboard_grid import complete_grid, crop_grid

__all__ = ["ChessboardView", "find_chessboard", "find_largest_grid", "fits_in"]

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]
# Columns and rows of inner corners.
Size = tuple[int, int]

_LARGE_PX = 1600
_EXHAUSTIVE = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
# A larger grid that begins with one of these: the detector may begin beside the board with some of them.
_SEEDS = ((7, 5), (5, 4), (4, 3), (3, 3))


class ChessboardView(NamedTuple):
    """Corners (rows, columns, 2) of a board of the wanted size, and the size of the largest grid; or None."""

    corners: Array | None
    size: Size | None


class _Try(NamedTuple):
    """One call of OpenCV's detector; ``flags`` with CALIB_CB_LARGER accept a larger grid."""

    whole_picture: bool
    size: Size
    flags: int = 0


def find_chessboard(grey: Grey, size: Size, thorough: bool) -> ChessboardView:
    """Detect a chessboard in any surroundings.

    Parameters
    ----------
    grey : (height, width).
    size : columns and rows of inner corners.
    thorough : search longer if the board is not found at once.

    Notes
    -----
    A board turned by 90 degrees is found, too: it has the same corners.
    """
    large = max(grey.shape) > _LARGE_PX
    # A large picture takes long; corners are refined at full size anyway.
    small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) if large else grey
    largest: Size | None = None
    for attempt in _tries(size, large, thorough):
        picture = grey if attempt.whole_picture or not large else np.asarray(small, dtype=np.uint8)
        grid = _grid(picture, attempt)
        if grid is None:
            continue
        columns_rows = (grid.shape[1], grid.shape[0])
        if fits_in(size, columns_rows):
            corners = crop_grid(picture, grid, size)
            return ChessboardView(corners if picture is grey else 2 * corners + 0.5, columns_rows)
        largest = _larger(largest, columns_rows)
        if not fits_in(columns_rows, size):
            break  # a board of another size
    return ChessboardView(None, largest)


def fits_in(size: Size, other: Size) -> bool:
    """Return whether a grid fits into another one, turned by 90 degrees or not."""
    return min(size) <= min(other) and max(size) <= max(other)


def find_largest_grid(grey: Grey) -> Size | None:
    """Return columns and rows of the largest grid of inner corners in a picture, or None."""
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


def _grid(picture: Grey, attempt: _Try) -> Array | None:
    """Return the real corners found from one call, (rows, columns, 2)."""
    seen, corners, cells = cv2.findChessboardCornersSBWithMeta(picture, attempt.size, attempt.flags)
    if not seen:
        return None
    rows, columns = cells.shape if attempt.flags & cv2.CALIB_CB_LARGER else attempt.size[::-1]
    return complete_grid(picture, np.asarray(corners, dtype=np.float64).reshape(rows, columns, 2))
