"""Calibration boards: their kinds, their patterns, and the positions of their corners.

The layout follows OpenCV 4.6 and later: the square at the top left is black for any number of rows.
"""

import re
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError

_FORM = re.compile(r"(?P<kind>charuco:|chessboard:)?(?P<columns>\d{1,3})[x×](?P<rows>\d{1,3})")
_MOST = 100


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board with a pattern of squares.

    Attributes
    ----------
    columns, rows : numbers of inner corners of a chessboard, or of squares of a ChArUco board.
    square_m : side of a square in m. It scales the positions of the board, not the intrinsics.
    marker_scale : side of the markers of a ChArUco board, in squares; None for a chessboard without markers.
    dictionary : name of the marker dictionary in OpenCV.
    inverted : whether black and white are exchanged.
    """

    columns: int
    rows: int
    square_m: float
    marker_scale: float | None = None
    dictionary: str = "DICT_4X4_50"
    inverted: bool = False

    def __str__(self) -> str:
        if self.marker_scale is None:
            return f"a chessboard of {self.columns} x {self.rows} inner corners"
        first = f"a{'n inverted' if self.inverted else ''} ChArUco board"
        return f"{first} of {self.columns} x {self.rows} squares, {self.dictionary}"

    @property
    def grid(self) -> tuple[int, int]:
        """The numbers of inner corners from left to right, and from top to bottom."""
        difference = 0 if self.marker_scale is None else 1
        return self.columns - difference, self.rows - difference

    def grid_positions(self, ids: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the column and the row of each corner, (n, 2)."""
        return np.column_stack([ids % self.grid[0], ids // self.grid[0]]).astype(np.float64)

    def points_m(self, ids: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the corners on the board, (n, 3) in m: x along rows, y down columns, 0 at the center."""
        center = (np.array(self.grid) - 1) / 2
        return np.column_stack([(self.grid_positions(ids) - center) * self.square_m, np.zeros(len(ids))])


def parse_board(text: str, square_m: float, marker_scale: float, dictionary: str, inverted: bool) -> Board:
    """Return the board for a text such as ``6x4`` or ``charuco:4x5``.

    Examples
    --------
    >>> parse_board("6x4", 0.03, 0.75, "DICT_4X4_50", False).grid
    (6, 4)
    >>> parse_board("charuco:4x5", 0.03, 0.75, "DICT_4X4_50", False).grid
    (3, 4)
    """
    match = _FORM.fullmatch(text.strip().lower())
    if match is None:
        raise IpsysError(
            f"--board {text}: is not a board; write the inner corners of a chessboard as 6x4, or the squares "
            "of a ChArUco board as charuco:4x5"
        )
    columns, rows = int(match["columns"]), int(match["rows"])
    charuco = match["kind"] == "charuco:"
    least = 3
    if not (least <= columns <= _MOST and least <= rows <= _MOST):
        unit = "squares" if charuco else "inner corners"
        raise IpsysError(
            f"--board {text}: has a wrong size; a board has {least} to {_MOST} {unit} in each direction"
        )
    if not 1e-4 <= square_m <= 10:
        raise IpsysError(
            f"--square {square_m:g}: is not a length; give the side of a square in metres, such as 0.03"
        )
    if not charuco:
        return Board(columns, rows, square_m, inverted=inverted)
    if not 0.1 <= marker_scale <= 0.95:
        raise IpsysError(
            f"--marker-scale {marker_scale:g}: is not between 0 and 1; give the side of a marker as a "
            "fraction of the side of a square, such as 0.75"
        )
    board = Board(columns, rows, square_m, marker_scale, dictionary.upper(), inverted)
    _check_dictionary(board)
    return board


def _check_dictionary(board: Board) -> None:
    number = getattr(cv2.aruco, board.dictionary, None)
    if not board.dictionary.startswith("DICT_") or not isinstance(number, int):
        raise IpsysError(
            f"--dictionary {board.dictionary}: is unknown to OpenCV; give one such as DICT_4X4_50"
        )
    markers = board.columns * board.rows // 2
    known = len(cv2.aruco.getPredefinedDictionary(number).bytesList)
    if markers > known:
        raise IpsysError(
            f"--dictionary {board.dictionary}: has {known} markers, but the board has {markers}; give a "
            "larger dictionary"
        )


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
    """Return the markers of a ChArUco board, row by row; a chessboard has none.

    Examples
    --------
    >>> board_markers(Board(3, 3, 0.03, 0.75))[:2]
    [BoardMarker(id=0, row=0, column=1), BoardMarker(id=1, row=1, column=0)]
    """
    if board.marker_scale is None:
        return []
    white = np.argwhere(~black_squares(board)).tolist()
    return [BoardMarker(number, row, column) for number, (row, column) in enumerate(white)]
