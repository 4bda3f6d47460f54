"""Markers and calibration boards for printing: their black polygons, and their size on paper."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ipsys_log.calibration.board import Board, black_squares, board_markers
from ipsys_log.messages import Array, Rig
from ipsys_log.units import MM_PER_M
from ipsys_log.vision.markers import cell_outlines, white_cells

# White margin around a chessboard or a ChArUco board, in squares; white margin around a marker, in cells.
_BOARD_MARGIN, _MARKER_MARGIN = 0.5, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Print:
    """A marker or a board at true size. Lengths are in mm.

    Attributes
    ----------
    name : name in error messages.
    polygons : the black parts, each (n, 2): x to the right and y down, from the top left of the black.
    width_mm, height_mm : size of the black.
    margin_mm : white margin around the black.
    lines : lines of text beside the print.
    is_board : True for a board, which has a separate page.
    """

    name: str
    polygons: tuple[Array, ...]
    width_mm: float
    height_mm: float
    margin_mm: float
    lines: tuple[str, ...]
    is_board: bool = False


def marker_print(dictionary: str, marker_id: int, length_m: float, robot: str | None = None) -> Print:
    """Return the print of a marker whose black square has a side of ``length_m``."""
    black = ~white_cells(dictionary, marker_id)
    side_mm = length_m * MM_PER_M
    cell_mm = side_mm / len(black)
    polygons = tuple(polygon * cell_mm for polygon in cell_outlines(black))
    title = f"id {marker_id}" if robot is None else f"id {marker_id}, {robot}"
    lines = (title, f"{dictionary}, {side_mm:g} mm")
    return Print(f"marker {marker_id}", polygons, side_mm, side_mm, _MARKER_MARGIN * cell_mm, lines)


def rig_prints(rig: Rig, ids: Sequence[int] | None = None, length_m: float | None = None) -> list[Print]:
    """Return the prints of the markers of a rig, or of some ids, each with its own side length.

    Parameters
    ----------
    rig : rig with the dictionary, the markers and their side lengths.
    ids : ids of the dictionary to print instead of the ids of the rig.
    length_m : side length of all markers, instead of the lengths of the rig.
    """
    names = {marker.id: marker.robot for marker in rig.markers}
    names |= {marker.id: "reference" for marker in rig.reference_markers}
    prints = []
    for marker_id in list(names) if ids is None else ids:
        side_m = length_m or rig.length_of(marker_id)
        prints.append(marker_print(rig.dictionary, marker_id, side_m, names.get(marker_id)))
    return prints


def board_print(board: Board, text: str) -> Print:
    """Return the print of a calibration board; ``text`` is its name for ``ipsys calibrate --board``.

    The layout is the same as in ``ipsys calibrate`` and in OpenCV since 4.6.
    """
    square_mm = board.square_m * MM_PER_M
    squares = black_squares(board)
    rows, columns = squares.shape
    polygons = [polygon * square_mm for polygon in cell_outlines(squares)]
    options = f"--board {text} --square {board.square_m:g}"
    if board.marker_scale is not None:
        options += f" --marker-scale {board.marker_scale:g} --dictionary {board.dictionary}"
    for marker in board_markers(board):
        black = ~white_cells(board.dictionary, marker.id)
        cell_mm = square_mm * (board.marker_scale or 1.0) / len(black)
        gap_mm = (square_mm - cell_mm * len(black)) / 2
        corner_mm = np.array([marker.column, marker.row]) * square_mm + gap_mm
        polygons += [polygon * cell_mm + corner_mm for polygon in cell_outlines(black)]
    lines = (*_wrapped(f"{board}; square side {square_mm:g} mm"), *_wrapped(f"ipsys calibrate {options}"))
    size = (columns * square_mm, rows * square_mm)
    return Print(f"the board {text}", tuple(polygons), *size, _BOARD_MARGIN * square_mm, lines, True)


def _wrapped(text: str) -> list[str]:
    """Wrap a text into lines that fit beside the ruler."""
    return textwrap.wrap(text, 54, break_long_words=False, break_on_hyphens=False)
