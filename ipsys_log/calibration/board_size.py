"""Estimates of the size of a board, and hints for images that show another board than the stated one."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import find_board
from ipsys_log.calibration.chessboard import find_largest_grid, fits_in
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Grey

# Squares in a row of the tried boards, and the largest number of rows.
_COLUMNS, _MOST_ROWS = range(3, 25), 25
# Least number of markers to find the row length; least share of the markers of an image at their positions.
_LEAST_MARKERS, _AT_PLACE = 6, 0.75
# Largest distance of a marker from its position, in squares: lens distortion bends the board.
_NEAR = 0.3


class CharucoSize(NamedTuple):
    """Columns and rows of squares, and the number of images with so many columns."""

    columns: int
    rows: int
    image_count: int


def estimate_charuco_size(images: Sequence[Grey], dictionary: str) -> CharucoSize | None:
    """Return the size of the board that explains most markers; None if there is none.

    With the right number of columns, the markers of an image lie in a plane, each at the position of its id.
    The highest id gives the last row, so rows outside of the images are not counted.

    Parameters
    ----------
    images : grey images, not inverted.
    dictionary : name of the marker dictionary in OpenCV.
    """
    number = getattr(cv2.aruco, dictionary)
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(number))
    rows_by_columns: dict[int, list[int]] = {}
    for grey in images:
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
    """Return the columns and rows for which most markers of an image are at their positions."""
    best: tuple[int, int] | None = None
    most = max(_LEAST_MARKERS, _AT_PLACE * len(ids)) - 0.5
    for columns in _COLUMNS:
        # OpenCV before 4.6 printed boards with an even number of rows with a white square at the top left.
        for first in (1, 0):
            positions = _marker_positions(columns, first)
            known = ids < len(positions)
            if known.sum() <= most or len({int(y) for y in positions[ids[known]][:, 1]}) < 2:
                continue
            near = _share_at_positions(positions[ids[known]], centres[known])
            if near.sum() > most:
                most = float(near.sum())
                best = columns, int(positions[ids[known]][near, 1].max()) + 1
    return best


def _share_at_positions(positions: Array, centres: Array) -> NDArray[np.bool_]:
    """Return a mask of the markers at their positions in a plane, (n,); all False if there is no plane."""
    result: Any = cv2.findHomography(centres, positions, cv2.RANSAC, _NEAR)
    homography, near = result
    return np.zeros(len(positions), np.bool_) if homography is None else np.ravel(near).astype(np.bool_)


@cache
def _marker_positions(columns: int, first: int) -> Array:
    """Return column and row of the square of each id, (n, 2); ``first`` is the first column with a marker."""
    return np.array(
        [(x, y) for y in range(_MOST_ROWS) for x in range(columns) if (x + y) % 2 == first], dtype=np.float64
    )


# Columns and rows of inner corners.
Size = tuple[int, int]

# One dictionary of each kind: smaller dictionaries are the beginning of a larger one.
_DICTIONARIES = (
    "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
)  # fmt: skip
# A grid belongs to a board if most images show it, or at least this share and two or more images.
_MOST, _SUPPORT, _LEAST_SUPPORT = 0.5, 0.2, 2
# The size from the user is refused if more than this share of the images contradicts it.
_CONTRADICTED = 0.5
_FORCE = "if the size is right, give --force"


def describe_other_board(
    images: Sequence[Grey],
    board: Board,
    trying: Callable[[int, int], None],
    sizes: Sequence[Size | None] = (),
) -> str:
    """Return the end of an error text: the board in the images, or advice for a check.

    Parameters
    ----------
    images : the images to examine.
    board : the board that no image shows.
    trying : called with the number of other kinds of board tried so far, and their total: the search is slow.
    sizes : size of the largest chessboard in each image, if it is known.
    """
    if any(size is not None for size in sizes) and (answer := _name_size(sizes, board, board)):
        return answer
    if board.marker_scale is not None and (mirrored := _mirrored(images, board)):
        return mirrored
    searches = list(_searches(images, board))
    for number, search in enumerate(searches):
        trying(number, len(searches))
        if answer := search():
            return answer
    if board.marker_scale is None:
        return (
            "; give the number of inner corners, which is one less than the squares in each direction, and "
            "show the whole board, with a white margin"
        )
    return "; give columns x rows of its squares, and the --dictionary of its markers"


def check_chessboard_size(sizes: Sequence[Size | None], board: Board, source: str) -> None:
    """Check that most images do not show a larger chessboard than the given board.

    Parameters
    ----------
    sizes : size of the largest grid in each image.
    board : a chessboard.
    source : source of the images, for messages.
    """
    larger = _largest_board([size for size in sizes if size is None or _exceeds(size, board.grid)])
    total = sum(size is not None for size in sizes)
    count = sum(size is not None and _exceeds(size, board.grid) for size in sizes)
    if larger is None or count <= _CONTRADICTED * total:
        return
    larger_board = _sized(board, larger)
    shown = sum(_same(size, larger) for size in sizes)
    raise IpsysError(
        f"{source}: {board} is only a part of the board: {shown} of {total} pictures show {larger_board}; "
        f"give --board {larger_board.columns}x{larger_board.rows}; {_FORCE}"
    )


def check_charuco_size(images: Sequence[Grey], board: Board, source: str) -> None:
    """Check that the markers have the positions of a ChArUco board of the given size."""
    size = estimate_charuco_size([_as_printed(grey, board) for grey in images], board.dictionary)
    if size is None or size.image_count <= _CONTRADICTED * len(images):
        return
    if size.columns == board.columns and size.rows <= board.rows:
        return
    rows = max(size.rows, board.rows) if size.columns == board.columns else size.rows
    raise IpsysError(
        f"{source}: {size.image_count} of {len(images)} checked pictures show the markers of "
        f"{replace(board, columns=size.columns, rows=rows)} or a larger board, not of {board.columns} x "
        f"{board.rows}; give --board charuco:{size.columns}x{rows}; {_FORCE}"
    )


def _mirrored(images: Sequence[Grey], board: Board) -> str:
    mirrored = [np.ascontiguousarray(grey[:, ::-1]) for grey in images]
    seen = sum(find_board("", grey, board, thorough=False) is not None for grey in mirrored)
    if not seen:
        return ""
    return (
        f"; but it is mirrored in {seen} of {len(images)} checked pictures: some webcam programs mirror "
        "images; turn this off, and take the pictures again"
    )


def _searches(images: Sequence[Grey], board: Board) -> Iterator[Callable[[], str]]:
    """Yield the searches for other boards, the likely boards first."""
    inverted = replace(board, inverted=not board.inverted)
    chessboards = [partial(_other_chessboard, images, kind, board) for kind in (board, inverted)]
    markers = [
        partial(_other_charuco, images, replace(kind, dictionary=name), board)
        for name in dict.fromkeys((board.dictionary, *_DICTIONARIES))
        for kind in (board, inverted)
    ]
    yield from [*chessboards, *markers] if board.marker_scale is None else [*markers, *chessboards]


def _other_chessboard(images: Sequence[Grey], kind: Board, board: Board) -> str:
    return _name_size([find_largest_grid(_as_printed(grey, kind)) for grey in images], kind, board)


def _name_size(sizes: Sequence[Size | None], kind: Board, board: Board) -> str:
    """Return the text on a chessboard that the images show instead of the given board, or ""."""
    size = _largest_board(sizes)
    if size is None:
        return ""
    seen_board = _sized(replace(kind, marker_scale=None), size)
    if seen_board == board:
        return ""
    seen_count = sum(_same(shown, size) for shown in sizes)
    option = f"--board {seen_board.columns}x{seen_board.rows}"
    turn = f" and {_inversion(board)}" if kind.inverted != board.inverted else ""
    return f"; but {seen_board} is in {seen_count} of {len(sizes)} checked pictures: give {option}{turn}"


def _other_charuco(images: Sequence[Grey], kind: Board, board: Board) -> str:
    size = estimate_charuco_size([_as_printed(grey, kind) for grey in images], kind.dictionary)
    if size is None:
        return ""
    scale = board.marker_scale if board.marker_scale is not None else 0.75
    seen_board = replace(kind, columns=size.columns, rows=size.rows, marker_scale=scale)
    options = [f"--board charuco:{seen_board.columns}x{seen_board.rows}"]
    options = [] if board.marker_scale and seen_board.grid == board.grid else options
    options += [f"--dictionary {kind.dictionary}"] if kind.dictionary != board.dictionary else []
    options += [_inversion(board)] if kind.inverted != board.inverted else []
    if not options:
        return ""
    options_text = " and ".join(options)
    return (
        f"; but {seen_board} is in {size.image_count} of {len(images)} checked pictures: give {options_text}"
    )


def _largest_board(sizes: Sequence[Size | None]) -> Size | None:
    """Return the largest grid that enough images show; some images show only parts of a board."""
    counts = Counter((max(size), min(size)) for size in sizes if size is not None)
    for size, count in counts.most_common(1):
        if count > _MOST * counts.total():
            return size
    least = max(_LEAST_SUPPORT, _SUPPORT * counts.total())
    often = [size for size, count in counts.items() if count >= least]
    return max(often or counts, key=lambda size: size[0] * size[1], default=None)


def _sized(board: Board, size: Size) -> Board:
    """Return the board with another size; its longer direction stays the same."""
    columns, rows = (max(size), min(size)) if board.columns >= board.rows else (min(size), max(size))
    return replace(board, columns=columns, rows=rows)


def _exceeds(size: Size, other: Size) -> bool:
    return fits_in(other, size) and not _same(size, other)


def _same(size: Size | None, other: Size) -> bool:
    return size is not None and sorted(size) == sorted(other)


def _as_printed(grey: Grey, board: Board) -> Grey:
    return np.asarray(255 - grey, dtype=np.uint8) if board.inverted else grey


def _inversion(board: Board) -> str:
    return "it without --inverted" if board.inverted else "--inverted"
