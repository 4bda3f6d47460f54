"""What pictures show where the board that was asked for is not in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from ipsys_log.calibration.boards import Board
from ipsys_log.calibration.sighting import Grey, find_board
from ipsys_log.errors import IpsysError

__all__ = ["check_whole", "hint"]

# One dictionary of each kind: the smaller ones are its beginning.
_DICTIONARIES = (
    "DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_36h11",
)  # fmt: skip


def hint(pictures: Sequence[Grey], board: Board, trying: Callable[[int, int], None]) -> str:
    """The end of a sentence that says which other board is seen, or what to look after.

    Parameters
    ----------
    pictures : to look at.
    board : that is not in them.
    trying : called with the other boards tried so far, and all of them: it takes a while.
    """
    if board.marker_scale is not None:
        mirrored = [np.ascontiguousarray(grey[:, ::-1]) for grey in pictures]
        seen = sum(find_board("", grey, board, thorough=False) is not None for grey in mirrored)
        if seen:
            return (
                f"; but in a mirror it is, in {seen} of {len(pictures)} tried: the pictures are mirrored, as "
                "webcam programs do; turn that off, and take them again"
            )
    others = list(_others(board))
    for number, (other, option) in enumerate(others):
        trying(number, len(others))
        seen = sum(find_board("", grey, other, thorough=False) is not None for grey in pictures)
        if seen:
            return f"; but {other} is seen in {seen} of {len(pictures)} tried: give {option}"
    if board.marker_scale is None:
        return (
            "; give the inner corners, one less than the squares in each direction, and see that the whole "
            "board is in the picture, with a white margin"
        )
    return "; give columns x rows of its squares, and the --dictionary that its markers are of"


def check_whole(pictures: Sequence[Grey], board: Board, where: str) -> None:
    """See that a chessboard is not a part of a larger one: whichever part is found, changes.

    Raises
    ------
    IpsysError
        Naming the larger one.
    """
    for more in ((1, 1), (1, 0), (0, 1)) if board.marker_scale is None else ():
        larger = replace(board, columns=board.columns + more[0], rows=board.rows + more[1])
        seen = sum(find_board("", grey, larger, thorough=False) is not None for grey in pictures)
        if 2 * seen > len(pictures):
            raise IpsysError(
                f"{where}: {board} is seen, and it is a part of {larger}: "
                f"give --board {larger.columns}x{larger.rows}"
            )


def _others(board: Board) -> Iterator[tuple[Board, str]]:
    columns, rows = board.columns, board.rows
    if board.marker_scale is None:
        for dc, dr in ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1)):
            if min(columns + dc, rows + dr) >= 3:
                other = replace(board, columns=columns + dc, rows=rows + dr)
                yield other, f"--board {other.columns}x{other.rows}"
        yield replace(board, inverted=not board.inverted), _inversion(board)
        return
    turned = replace(board, columns=rows, rows=columns)
    option = f"--board charuco:{rows}x{columns}"
    inverted = _inversion(board)
    for change, said in ((board, ""), (turned, option)):
        for dictionary in dict.fromkeys((board.dictionary, *_DICTIONARIES)):
            named = f"--dictionary {dictionary}" if dictionary != board.dictionary else ""
            for turn, how in ((board.inverted, ""), (not board.inverted, inverted)):
                other = replace(change, dictionary=dictionary, inverted=turn)
                if other != board:
                    yield other, " and ".join(word for word in (said, named, how) if word)
    # With as many inner corners, or as many squares: a part of the larger one would be seen, too.
    for less in (0, 1):
        if min(columns, rows) - less >= 3:
            plain = replace(board, columns=columns - less, rows=rows - less, marker_scale=None)
            yield plain, f"--board {plain.columns}x{plain.rows}"


def _inversion(board: Board) -> str:
    return "it without --inverted" if board.inverted else "--inverted"
