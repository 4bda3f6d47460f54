"""The size of a ChArUco board from the ids and positions of its markers in pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["CharucoSize", "estimate_charuco_size"]

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Squares in a row of the tried boards, and the largest number of rows.
_COLUMNS, _MOST_ROWS = range(3, 25), 25
# Least number of markers to tell the length of a row; least share of a picture's markers at their place.
_LEAST_MARKERS, _AT_PLACE = 6, 0.75
# Largest distance of a marker from its place, in squares: lens distortion bends the board.
_NEAR = 0.3


class CharucoSize(NamedTuple):
    """Columns and rows of squares, and the number of pictures with so many columns."""

    columns: int
    rows: int
    pictures: int


def estimate_charuco_size(pictures: Sequence[Grey], dictionary: str) -> CharucoSize | None:
    """Return the size of the board that explains most markers; None if there is none.

    The number of columns is the one for which the markers of a picture lie in a plane, each at the place of
    its id. The last row is that of the highest id, so rows outside of the pictures are not counted.

    Parameters
    ----------
    pictures : grey, not inverted.
    dictionary : by OpenCV's name.
    """
    number = getattr(cv2.aruco, dictionary)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    rows_by_columns: dict[int, list[int]] = {}
    for grey in pictures:
        corners, ids, _ = detector.detectMarkers(grey)
        if ids is None or len(ids) < _LEAST_MARKERS:
            continue
        centres = np.array([np.asarray(corner).reshape(4, 2).mean(axis=0) for corner in corners])
        size = _size_of(np.ravel(ids), centres)
        if size is not None:
            rows_by_columns.setdefault(size[0], []).append(size[1])
    if not rows_by_columns:
        return None
    columns, rows = max(rows_by_columns.items(), key=lambda item: len(item[1]))
    # One misread marker must not add rows.
    often = [row for row, count in Counter(rows).items() if count > 1 or len(rows) == 1] or rows
    return CharucoSize(columns, max(often), len(rows))


def _size_of(ids: NDArray[np.intp], centres: Array) -> tuple[int, int] | None:
    """Return the columns and rows for which most markers of a picture are at their places."""
    best: tuple[int, int] | None = None
    most = max(_LEAST_MARKERS, _AT_PLACE * len(ids)) - 0.5
    for columns in _COLUMNS:
        # OpenCV before 4.6 printed boards of an even number of rows with a white square first.
        for first in (1, 0):
            places = _marker_places(columns, first)
            known = ids < len(places)
            if known.sum() <= most or len({int(y) for y in places[ids[known]][:, 1]}) < 2:
                continue
            near = _at_place(places[ids[known]], centres[known])
            if near.sum() > most:
                most = float(near.sum())
                best = columns, int(places[ids[known]][near, 1].max()) + 1
    return best


def _at_place(places: Array, centres: Array) -> NDArray[np.bool_]:
    """Return a mask of the markers at their places in a plane, (n,); all False if there is no such plane."""
    result: Any = cv2.findHomography(centres, places, cv2.RANSAC, _NEAR)
    homography, near = result
    return np.zeros(len(places), np.bool_) if homography is None else np.ravel(near).astype(np.bool_)


@cache
def _marker_places(columns: int, first: int) -> Array:
    """Return column and row of the square of each id, (n, 2); ``first`` is the first column with a marker."""
    return np.array(
        [(x, y) for y in range(_MOST_ROWS) for x in range(columns) if (x + y) % 2 == first], dtype=np.float64
    )
