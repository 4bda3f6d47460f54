"""Markers and calibration boards for print, on pages at true size with cutting marks and a ruler."""

import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline

from ipsys_log.calibration.board import Board, black_squares, board_markers
from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Rig
from ipsys_log.units import MM_PER_M
from ipsys_log.vision.markers import cell_outlines, white_cells

# White margin around a chessboard or a ChArUco board, in squares; white margin around a marker, in cells.
_BOARD_MARGIN, _MARKER_MARGIN = 0.5, 1.0
# A marker of this side fits on A4 and on Letter, and is that of the example of a rig.
_USUAL_LENGTH_M = 0.14


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

    The simulated lab draws its markers itself: those of its robots are printed to try, at most as large as A4
    can hold.

    Parameters
    ----------
    rig : rig with the dictionary, the markers and their side lengths.
    ids : ids of the dictionary to print instead of the ids of the rig.
    length_m : side length of all markers, instead of the lengths of the rig.
    """
    names = {marker.id: marker.robot for marker in rig.markers}
    names |= {marker.id: "reference" for marker in rig.reference_markers}
    if ids is None and rig.is_simulated:
        ids = [marker.id for marker in rig.markers if marker.robot]
        length_m = length_m or min(rig.marker_length_m, _USUAL_LENGTH_M)
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


MM_PER_INCH = 25.4
# Printers leave this much of the paper's edge white.
_EDGE_MM = 10.0
# Height of the foot of a page: the ruler, and the text beside it.
_FOOT_MM = 15.0
RULER_MM = 100.0
_RULER_Y_MM = _EDGE_MM + 5.0
# Height of the caption below a marker (an arrow to its front, and three lines of text). Gap between two
# prints, for the cutting marks. Smallest width of the paper of a marker.
_CAPTION_MM, _GAP_MM, _NARROWEST_MM = 8.0, 6.0, 34.0
_MARK_MM, _MARK_PT = 2.0, 0.3
_GREY = "0.35"


@dataclass(frozen=True, slots=True)
class Paper:
    """A sheet of paper in portrait orientation: its name, and its size in mm."""

    name: str
    width_mm: float
    height_mm: float

    def landscape(self) -> "Paper":
        """Return the sheet in landscape orientation."""
        return Paper(self.name, self.height_mm, self.width_mm)

    @property
    def free_mm(self) -> tuple[float, float]:
        """The width and height that are free for prints."""
        return self.width_mm - 2 * _EDGE_MM, self.height_mm - 2 * _EDGE_MM - _FOOT_MM


PAPERS = {
    "a4": Paper("A4", 210.0, 297.0),
    "letter": Paper("Letter", 215.9, 279.4),
    "a3": Paper("A3", 297.0, 420.0),
}


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A print on a page; its position is the top left of its black, in mm from the page's bottom left."""

    item: Print
    x_mm: float
    y_mm: float


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """A sheet of paper, and the prints on it."""

    paper: Paper
    placed: tuple[Placed, ...]


def choose_paper(prints: Sequence[Print], name: str | None) -> Paper:
    """Return the paper with a name; without a name, A4, or A3 if a print is too large for A4."""
    if name is not None and name.lower() not in PAPERS:
        raise IpsysError(f"--page {name}: is not known; give one of {', '.join(PAPERS)}")
    papers = [PAPERS["a4"], PAPERS["a3"]] if name is None else [PAPERS[name.lower()]]
    for paper in papers:
        large = [item for item in prints if _orientation(item, paper) is None]
        if not large:
            return paper
    raise IpsysError(_too_large(large[0], papers[-1]))


def lay_out(prints: Sequence[Print], paper: Paper) -> list[Page]:
    """Arrange prints on pages: markers in rows from the top left, each board on a separate page."""
    markers = [item for item in prints if not item.is_board]
    pages = _rows_of_markers(markers, paper)
    for board in prints:
        if board.is_board:
            oriented = _orientation(board, paper)
            assert oriented is not None
            pages.append(Page(oriented, (_in_the_middle(board, oriented),)))
    return pages


def draw_pages(pages: Sequence[Page]) -> bytes:
    """Draw pages as a PDF; equal pages give equal bytes."""
    buffer = io.BytesIO()
    metadata: dict[str, object] = {"Creator": None, "Producer": None, "CreationDate": None}
    with PdfPages(buffer, metadata=metadata) as pdf:
        for page in pages:
            figure, axes = _blank(page.paper)
            _draw_ruler(axes)
            for placed in page.placed:
                _draw_black(axes, placed)
                if placed.item.is_board:
                    text = "\n".join(placed.item.lines)
                    _write(axes, _EDGE_MM + RULER_MM + 8, _EDGE_MM + 5.5, text, 7.0)
                else:
                    _draw_marker_text(axes, placed)
                    _draw_cutting_marks(axes, placed)
            pdf.savefig(figure)
    return buffer.getvalue()


def _size_mm(item: Print) -> tuple[float, float]:
    """Return width and height of the paper for a print; the edge of the page counts as margin of a board."""
    if item.is_board:
        spare_mm = max(item.margin_mm - _EDGE_MM, 0.0)
        return item.width_mm + 2 * spare_mm, item.height_mm + spare_mm + item.margin_mm
    width_mm = item.width_mm + 2 * item.margin_mm
    return max(width_mm, _NARROWEST_MM), item.height_mm + 2 * item.margin_mm + _CAPTION_MM


def _orientation(item: Print, paper: Paper) -> Paper | None:
    """Return the paper in portrait, or in landscape if a board needs it; None if the print does not fit."""
    width_mm, height_mm = _size_mm(item)
    for oriented in (paper, paper.landscape()) if item.is_board else (paper,):
        free_mm = oriented.free_mm
        if width_mm <= free_mm[0] + 1e-6 and height_mm <= free_mm[1] + 1e-6:
            return oriented
    return None


def _too_large(item: Print, paper: Paper) -> str:
    width_mm, height_mm = _size_mm(item)
    size = f"{width_mm:.0f} x {height_mm:.0f} mm"
    text = f"{item.name} needs {size} with its white margin, too much for {paper.name}"
    if item.is_board:
        return f"{text}; make its squares smaller, with --square, or use larger paper"
    largest_mm = np.floor(paper.free_mm[0] / (1 + 2 * item.margin_mm / item.width_mm))
    text += f", which holds markers of up to {largest_mm:.0f} mm: --length {largest_mm / 1000:g}"
    return text if paper is PAPERS["a3"] else f"{text}; or use larger paper: --page a3"


def _rows_of_markers(markers: Sequence[Print], paper: Paper) -> list[Page]:
    free_mm = paper.free_mm
    pages: list[list[Placed]] = []
    x_mm = y_mm = row_mm = 0.0
    for marker in markers:
        width_mm, height_mm = _size_mm(marker)
        if x_mm + width_mm > free_mm[0] + 1e-6:
            x_mm, y_mm, row_mm = 0.0, y_mm + row_mm + _GAP_MM, 0.0
        if not pages or y_mm + height_mm > free_mm[1] + 1e-6:
            pages.append([])
            x_mm = y_mm = row_mm = 0.0
        left_mm = _EDGE_MM + x_mm + (width_mm - marker.width_mm) / 2
        top_mm = paper.height_mm - _EDGE_MM - y_mm - marker.margin_mm
        pages[-1].append(Placed(marker, left_mm, top_mm))
        x_mm, row_mm = x_mm + width_mm + _GAP_MM, max(row_mm, height_mm)
    return [Page(paper, tuple(placed)) for placed in pages]


def _in_the_middle(board: Print, paper: Paper) -> Placed:
    below_mm = _EDGE_MM + _FOOT_MM + board.margin_mm
    above_mm = max(_EDGE_MM, board.margin_mm)
    spare_mm = paper.height_mm - below_mm - above_mm - board.height_mm
    top_mm = below_mm + spare_mm / 2 + board.height_mm
    return Placed(board, (paper.width_mm - board.width_mm) / 2, top_mm)


def _blank(paper: Paper) -> tuple[Figure, Axes]:
    """Return an empty page with data coordinates in mm from its bottom left."""
    figure = Figure(figsize=(paper.width_mm / MM_PER_INCH, paper.height_mm / MM_PER_INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_xlim(0, paper.width_mm)
    axes.set_ylim(0, paper.height_mm)
    axes.set_axis_off()
    return figure, axes


def _draw_black(axes: Axes, placed: Placed) -> None:
    """Draw all black parts as one path, so that no part is drawn twice."""
    loops = [np.vstack([polygon, polygon[:1]]) for polygon in placed.item.polygons]
    codes = [
        code
        for loop in loops
        for code in (Outline.MOVETO, *[Outline.LINETO] * (len(loop) - 2), Outline.CLOSEPOLY)
    ]
    points_mm = np.vstack(loops) * [1, -1] + [placed.x_mm, placed.y_mm]
    axes.add_patch(PathPatch(Outline(points_mm, codes), facecolor="black", linewidth=0))


def _draw_marker_text(axes: Axes, placed: Placed) -> None:
    """Draw the caption below the margin of a marker, with an arrow to the front of the marker."""
    marker = placed.item
    width_mm = _size_mm(marker)[0]
    left_mm = placed.x_mm + marker.width_mm / 2 - width_mm / 2 + 1.5
    bottom_mm = placed.y_mm - marker.height_mm - marker.margin_mm - _CAPTION_MM + 1.5
    arrow = np.array([[0.9, 0], [0.9, 3], [0, 3], [1.5, 5.5], [3, 3], [2.1, 3], [2.1, 0]])
    axes.add_patch(
        PathPatch(Outline(arrow + np.array([left_mm, bottom_mm]), closed=False), facecolor=_GREY, linewidth=0)
    )
    size_pt = 5.0 if width_mm < 60 else 8.0
    text = "\n".join(("front: this way up" if width_mm >= 60 else "front", *marker.lines))
    _write(axes, left_mm + 4.5, bottom_mm + 2.75, text, size_pt)


def _write(axes: Axes, x_mm: float, y_mm: float, text: str, size_pt: float) -> None:
    axes.text(x_mm, y_mm, text, fontsize=size_pt, color=_GREY, va="center", linespacing=1.1, parse_math=False)


def _draw_cutting_marks(axes: Axes, placed: Placed) -> None:
    """Draw a small angle outside of each corner of the paper of a marker."""
    marker = placed.item
    width_mm, height_mm = _size_mm(marker)
    left_mm = placed.x_mm + marker.width_mm / 2 - width_mm / 2
    top_mm = placed.y_mm + marker.margin_mm
    for x_mm, right in ((left_mm, -1), (left_mm + width_mm, 1)):
        for y_mm, up in ((top_mm, 1), (top_mm - height_mm, -1)):
            for dx, dy in ((right, 0), (0, up)):
                ends = [x_mm + dx * 0.5, x_mm + dx * _MARK_MM], [y_mm + dy * 0.5, y_mm + dy * _MARK_MM]
                axes.plot(*ends, color=_GREY, linewidth=_MARK_PT, solid_capstyle="butt")


def _draw_ruler(axes: Axes) -> None:
    """Draw a ruler of 10 cm at the bottom left, with a tick for each mm."""
    for number in range(int(RULER_MM) + 1):
        length_mm = 5.0 if number % 10 == 0 else 3.5 if number % 5 == 0 else 2.0
        x_mm = _EDGE_MM + number
        axes.plot(
            [x_mm, x_mm],
            [_RULER_Y_MM, _RULER_Y_MM + length_mm],
            color="black",
            linewidth=0.35,
            solid_capstyle="butt",
        )
        if number % 10 == 0:
            axes.text(x_mm, _RULER_Y_MM - 0.8, str(number // 10), fontsize=6, ha="center", va="top")
    ends_mm = [_EDGE_MM, _EDGE_MM + RULER_MM]
    axes.plot(ends_mm, [_RULER_Y_MM] * 2, color="black", linewidth=0.35, solid_capstyle="butt")
    text = "Print at 100 % (actual size). Check the scale: it must be 10 cm long."
    _write(axes, _EDGE_MM, _EDGE_MM + 0.4, text, 6.0)
