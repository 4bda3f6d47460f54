"""Detection of a board in an image: its corners to sub-pixel accuracy, and its sharpness.

Around a corner there is little to see, and on a ChArUco board markers come near it. Its four edges are
long. A camera's gamma and the markers' borders shift an edge towards its white side, or its black one;
the white side changes at the corner, so that an edge is shifted to both sides alike, and goes through the
corner as before.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.chessboard import find_chessboard

__all__ = ["LEAST_CORNERS", "Grey", "Sighting", "View", "find_board", "refine_corners", "view_board"]

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Along an edge, in squares from the corner; the same on both sides of it.
_ALONG_EDGE = np.linspace(0.12, 0.5, 9)
# Across it, in squares, or in widths of the blur.
_REACH = 0.1
_BLURS = 2.5
_STEP_PX = 0.5
_LEAST_REACH_PX = 1.5
_MOST_REACH_PX = 12.0
_ROUNDS = 2
# Levels by which black and white differ at least, and the share of the usual slope that an edge has.
_CONTRAST = 8.0
_FAINT = 0.3
# A corner that edges put farther away is not that corner.
_MOST_SHIFT = 0.15


def refine_corners(
    grey: Grey, columns: int, ids: NDArray[np.intp], pixels: Array, blur_px: float, clear: float
) -> Array:
    """Corners moved to where the edges cross.

    Parameters
    ----------
    grey : (height, width).
    columns : corners in a row of the board; ids count along rows.
    ids, pixels : (n,), and (n, 2) about where they are.
    blur_px : standard deviation of the blur.
    clear : how far beside an edge nothing but its two squares is seen, in squares.

    Returns
    -------
    (n, 2) in px; as they were where edges cannot be seen.
    """
    moved = pixels.copy()
    for _ in range(_ROUNDS):
        arms = _arms(columns, ids, moved)
        moved = _crossed(grey, arms, moved, blur_px, clear)
    return moved


def _arms(columns: int, ids: NDArray[np.intp], pixels: Array) -> Array:
    """From each corner half way to what is next to it in its row, and in its column: (n, 2, 2, 2), the
    second index before or after. Where nothing is seen on one side, what is opposite counts; else NaN."""
    at = dict(zip(ids.tolist(), pixels, strict=True))
    nothing = np.full(2, np.nan)
    arms = np.empty((len(ids), 2, 2, 2))
    for n, i in enumerate(ids.tolist()):
        left, right = at.get(i - 1, nothing), at.get(i + 1, nothing)
        if i % columns == 0:
            left = nothing
        if i % columns == columns - 1:
            right = nothing
        arms[n, 0] = left - pixels[n], right - pixels[n]
        arms[n, 1] = at.get(i - columns, nothing) - pixels[n], at.get(i + columns, nothing) - pixels[n]
    opposite = -arms[:, :, ::-1]
    return np.where(np.isnan(arms), opposite, arms)


def _crossed(grey: Grey, arms: Array, pixels: Array, blur_px: float, clear: float) -> Array:
    """Where the edges along ``arms`` cross, (n, 2)."""
    lengths = np.linalg.norm(arms, axis=3)
    spacing = np.nanmin(lengths, axis=(1, 2), initial=np.inf)
    usable = np.isfinite(arms).all(axis=(1, 2, 3)) & (spacing * clear >= _LEAST_REACH_PX / 2)
    moved = pixels.copy()
    for n in np.flatnonzero(usable):
        reach_px = max(_REACH * spacing[n], _BLURS * blur_px)
        reach_px = float(np.clip(min(reach_px, clear * spacing[n]), _LEAST_REACH_PX, _MOST_REACH_PX))
        normals, offsets = zip(*(_offset(grey, pixels[n], pair, reach_px) for pair in arms[n]), strict=True)
        if None in offsets or abs(np.linalg.det(normals)) < 0.1:
            continue
        shift = np.linalg.solve(np.array(normals), np.array(offsets, dtype=np.float64))
        if np.linalg.norm(shift) <= max(_MOST_SHIFT * spacing[n], 0.5):
            moved[n] = pixels[n] + shift
    return moved


def _offset(grey: Grey, corner: Array, pair: Array, reach_px: float) -> tuple[Array, float | None]:
    """How far an edge that runs along ``pair`` passes beside the corner, along its normal (2,)."""
    along = pair[1] - pair[0]
    along = along / np.linalg.norm(along)
    normal = np.array([-along[1], along[0]])
    on = np.concatenate([corner + _ALONG_EDGE[:, None] * arm for arm in pair])
    found = _steps(grey, on, normal, reach_px)
    if found is None:
        return normal, None
    beside_px, seen = found
    t = (on - corner) @ along
    # A lens bends the edge.
    terms = np.column_stack([np.ones_like(t), t, t * t])
    return normal, _intercept(terms, beside_px + (on - corner) @ normal, seen)


def _steps(grey: Grey, on: Array, normal: Array, reach_px: float) -> tuple[Array, NDArray[np.bool_]] | None:
    """How far beside each point (n, 2) the step between black and white is, and where there is one."""
    beside = np.arange(-reach_px, reach_px + 1e-9, _STEP_PX)
    at = (on[:, None] + beside[:, None] * normal).astype(np.float32)
    levels = cv2.remap(grey, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    slopes = np.diff(levels.astype(np.float64), axis=1)
    # Black lies on one side along one arm, on the other side along the other.
    half = len(_ALONG_EDGE)
    heights = slopes.reshape(2, half, -1).sum(axis=2).mean(axis=1)
    if heights[0] * heights[1] > 0 or np.abs(heights).min() < _CONTRAST:
        return None
    slopes = np.maximum(slopes * np.repeat(np.sign(heights), half)[:, None], 0.0)
    weights = slopes.sum(axis=1)
    seen = weights > _FAINT * np.median(weights)
    if seen.reshape(2, half).sum(axis=1).min() < half // 2:
        return None
    return (slopes @ ((beside[1:] + beside[:-1]) / 2)) / np.maximum(weights, 1e-9), seen


def _intercept(terms: Array, found: Array, seen: NDArray[np.bool_]) -> float:
    """Where the curve through what was seen is at the corner; points far from it do not count."""
    for _ in range(2):
        solution = np.linalg.lstsq(terms[seen], found[seen], rcond=None)[0]
        missed = np.abs(terms @ solution - found)
        seen = seen & (missed <= 3 * max(float(np.median(missed[seen])) * 1.5, 0.03))
    return float(solution[0])


# What a pose can be told from, with something left to check it.
LEAST_CORNERS = 6
# One or two corners are as often something else in the room.
_SEEN = 4
# Where along an edge between two corners its sharpness is read, and how far beside it, in squares: within the
# white around a marker.
_ALONG = (0.3, 0.4, 0.5, 0.6, 0.7)
_BESIDE, _BESIDE_MARKERS = 0.3, 0.12
_STEP_PX, _PIXEL = 0.5, 2
# How far beside an edge nothing else is seen, in squares; of the white between it and a marker, a part.
_CLEAR, _CLEAR_MARKERS = 0.3, 0.32
_LEAST_SLOPE = 0.1
# No corner of the board is farther from those seen than so many times what they span.
_FARTHEST = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """The board in a picture called ``name``: ids (n,) and pixels (n, 2) of its corners, width of its edges
    in px (a standard deviation), and its outline (4, 2) in px, seen or not."""

    name: str
    ids: NDArray[np.intp]
    pixels: Array
    blur_px: float
    outline: Array


class View(NamedTuple):
    """A sighting, or None; for a chessboard also columns and rows of the largest grid of inner corners."""

    sighting: Sighting | None
    grid: tuple[int, int] | None = None


def find_board(name: str, grey: Grey, board: Board, thorough: bool) -> Sighting | None:
    """Detect the board in a picture; see `view_board`."""
    return view_board(name, grey, board, thorough).sighting


def view_board(name: str, grey: Grey, board: Board, thorough: bool) -> View:
    """Detect the board in a picture, and the largest grid of a chessboard.

    Parameters
    ----------
    name : of the picture.
    grey : (height, width).
    board : to search for.
    thorough : search a second time, longer, if a chessboard is not found at once.

    Returns
    -------
    The view, without a sighting if the board is not found. A ChArUco board may be partly visible, a
    chessboard must be completely visible.
    """
    if board.inverted:
        grey = np.asarray(255 - grey, dtype=np.uint8)
    if board.marker_scale is not None:
        corners = _charuco(grey, board)
        return View(None if corners is None else _sighting(name, grey, board, *corners))
    view = find_chessboard(grey, board.grid, thorough)
    if view.corners is None:
        return View(None, view.size)
    ids = np.arange(board.columns * board.rows)
    return View(_sighting(name, grey, board, ids, view.corners.reshape(-1, 2)), view.size)


def _sighting(name: str, grey: Grey, board: Board, ids: NDArray[np.intp], pixels: Array) -> Sighting:
    places = board.places(ids)
    if len(ids) < LEAST_CORNERS or min(len(set(column)) for column in places.T.tolist()) < 2:
        return Sighting(name, ids, pixels, 0.0, np.tile(pixels.mean(axis=0), (4, 1)))
    blur_px = _edge_width_px(grey, board, ids, pixels)
    clear = _CLEAR if board.marker_scale is None else _CLEAR_MARKERS * (1 - board.marker_scale)
    pixels = refine_corners(grey, board.grid[0], ids, pixels, blur_px, clear)
    return Sighting(name, ids, pixels, blur_px, _outline(board, ids, pixels))


def _charuco(grey: Grey, board: Board) -> tuple[NDArray[np.intp], Array] | None:
    # OpenCV before 4.6 printed boards of an even number of rows with a white square first.
    for legacy in (False, True) if board.rows % 2 == 0 else (False,):
        corners, ids, _, _ = _charuco_detector(board, legacy).detectBoard(grey)
        if ids is not None and len(ids) >= _SEEN:
            return np.asarray(ids, dtype=np.intp).ravel(), np.asarray(corners, dtype=np.float64).reshape(
                -1, 2
            )
    return None


@lru_cache(maxsize=32)
def _charuco_detector(board: Board, legacy: bool) -> cv2.aruco.CharucoDetector:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    side_m = board.square_m * (board.marker_scale or 0.0)
    printed = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, side_m, dictionary)
    printed.setLegacyPattern(legacy)
    return cv2.aruco.CharucoDetector(printed)


def _outline(board: Board, ids: NDArray[np.intp], pixels: Array) -> Array:
    """The four outer corners, (4, 2); those not seen about where they would be without distortion."""
    columns, rows = board.grid
    ends = np.array([0, columns - 1, columns * rows - 1, columns * (rows - 1)])
    at = dict(zip(ids.tolist(), pixels, strict=True))
    if all(end in at for end in ends.tolist()):
        return np.array([at[end] for end in ends.tolist()])
    places, middle = board.places(ids), pixels.mean(axis=0)
    found, _ = cv2.findHomography(places, pixels)
    carried = np.column_stack([board.places(ends), np.ones(4)]) @ (np.eye(3) if found is None else found).T
    # Beyond the horizon there is nothing.
    reach_px = _FARTHEST * float(np.ptp(pixels, axis=0).max())
    outline = carried[:, :2] / np.maximum(carried[:, 2:], 1e-9)
    return np.asarray(np.clip(outline, middle - reach_px, middle + reach_px))


def _edge_width_px(grey: Grey, board: Board, ids: NDArray[np.intp], pixels: Array) -> float:
    """The standard deviation of the blur across the edges of squares, the greater one of both directions.

    A step from black to white, blurred by a normal distribution, is steepest by its height over
    sqrt(2 pi) standard deviations. Its height is that of black and white on the board, for a profile that a
    marker cuts short may reach neither.
    """
    (left, top), (right, bottom) = np.maximum(np.round([pixels.min(axis=0), pixels.max(axis=0)]), 0).astype(
        int
    )
    black, white = np.percentile(grey[top : bottom + 1, left : right + 1], [10, 90])
    at = dict(zip(ids.tolist(), pixels, strict=True))
    beside = _BESIDE if board.marker_scale is None else _BESIDE_MARKERS
    columns = board.grid[0]
    widths = []
    for step, other in ((1, columns), (columns, 1)):
        pairs = [(at[i], at[i + step]) for i in at if i + step in at and (step > 1 or (i + 1) % columns)]
        # How far it is to the next edge beside.
        spacing = [np.linalg.norm(at[i] - at[i + other]) for i in at if i + other in at]
        if pairs and spacing:
            reach_px = max(beside * float(np.median(spacing)), 2.0)
            widths.append((white - black) / (np.sqrt(2 * np.pi) * _slopes(grey, np.array(pairs), reach_px)))
    return max((float(np.median(found)) for found in widths), default=0.0)


def _slopes(grey: Grey, ends: Array, reach_px: float) -> Array:
    """Return the slopes of edges between corners (n, 2, 2), in levels per px, up to ``reach_px`` aside."""
    along = ends[:, 1] - ends[:, 0]
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
    offsets = np.arange(-reach_px, reach_px + 1e-9, _STEP_PX)
    start = ends[:, :1] + along[:, None] * np.array(_ALONG)[:, None]
    at = (start[:, :, None] + across[:, None, None] * offsets[:, None]).astype(np.float32)
    rows = at.reshape(-1, len(offsets), 2)
    levels = cv2.remap(
        grey, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float64)
    # Over a whole pixel, or noise would look steep.
    rises = np.abs(levels[:, _PIXEL:] - levels[:, :-_PIXEL]).max(axis=1) / (_PIXEL * _STEP_PX)
    return np.asarray(np.median(rises.reshape(len(ends), -1), axis=1) + _LEAST_SLOPE)
