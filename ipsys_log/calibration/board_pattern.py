"""The pattern of a calibration board: its black squares, and the markers in the others.

The layout is that of OpenCV since 4.6: the square at the top left is black for any number of rows.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board

__all__ = ["BoardMarker", "black_squares", "board_markers"]


class BoardMarker(NamedTuple):
    """A marker of a ChArUco board, and its square."""

    id: int
    row: int
    column: int


def black_squares(board: Board) -> NDArray[np.bool_]:
    """Return a mask of the black squares, (rows, columns), the top row first.

    Examples
    --------
    >>> black_squares(Board(3, 3, 0.03)).astype(int).tolist()
    [[1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1]]
    """
    columns, rows = (size + 1 for size in board.grid)
    row, column = np.indices((rows, columns))
    black: NDArray[np.bool_] = (row + column) % 2 == 0
    return black


def board_markers(board: Board) -> list[BoardMarker]:
    """Return the markers of a ChArUco board, row by row; of a chessboard none.

    Examples
    --------
    >>> board_markers(Board(3, 3, 0.03, 0.75))[:2]
    [BoardMarker(id=0, row=0, column=1), BoardMarker(id=1, row=1, column=0)]
    """
    if board.marker_scale is None:
        return []
    white = np.argwhere(~black_squares(board)).tolist()
    return [BoardMarker(number, row, column) for number, (row, column) in enumerate(white)]
