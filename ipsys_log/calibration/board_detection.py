"""Detection of a board in an image: its corners to sub-pixel accuracy, and its sharpness.

The area near a corner has little information, and on a ChArUco board markers lie close to it. So the position
of a corner comes from its four long edges. The gamma of a camera and the borders of markers shift an edge
towards its white or its black side. White changes to the other side of the edge at the corner. So both halves
of the edge have opposite shifts, and the edge still passes through the corner.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.chessboard import find_chessboard
from ipsys_log.messages import Array, Grey

# Sample positions along an edge, in squares from the corner, the same on both sides of the corner.
_ALONG_EDGE = np.linspace(0.12, 0.5, 9)
# Sample range across an edge, in squares, or in standard deviations of the blur.
_REACH = 0.1
_BLURS = 2.5
_STEP_PX = 0.5
_LEAST_REACH_PX = 1.5
_MOST_REACH_PX = 12.0
_ROUNDS = 2
# Least difference of grey levels between black and white, and least share of the usual slope of an edge.
_CONTRAST = 8.0
_FAINT = 0.3
# Largest shift of a corner by its edges, in squares. A larger shift leads to another corner.
_MOST_SHIFT = 0.15


def refine_corners(
    grey: Grey, columns: int, ids: NDArray[np.intp], pixels: Array, blur_px: float, clear: float
) -> Array:
    """Return the corners, moved to the intersections of their edges.

    Parameters
    ----------
    grey : the image, (height, width).
    columns : number of corners in a row of the board; ids count along rows.
    ids, pixels : ids (n,) and approximate positions (n, 2) in px of the corners.
    blur_px : standard deviation of the blur.
    clear : width beside an edge that shows only its two squares, in squares.

    Returns
    -------
    (n, 2) in px; a corner without visible edges does not move.
    """
    positions = pixels.copy()
    for _ in range(_ROUNDS):
        arms = _arms(columns, ids, positions)
        positions = _intersect_edges(grey, arms, positions, blur_px, clear)
    return positions


def _arms(columns: int, ids: NDArray[np.intp], pixels: Array) -> Array:
    """Return the vectors from each corner to its neighbours in its row and in its column, (n, 2, 2, 2).

    The second index is row or column, the third is before or after the corner. If one neighbour is not
    visible, the negative vector to the opposite neighbour replaces it. If both are not visible, the vectors
    are NaN.
    """
    by_id = dict(zip(ids.tolist(), pixels, strict=True))
    nothing = np.full(2, np.nan)
    arms = np.empty((len(ids), 2, 2, 2))
    for n, i in enumerate(ids.tolist()):
        left, right = by_id.get(i - 1, nothing), by_id.get(i + 1, nothing)
        if i % columns == 0:
            left = nothing
        if i % columns == columns - 1:
            right = nothing
        arms[n, 0] = left - pixels[n], right - pixels[n]
        arms[n, 1] = (
            by_id.get(i - columns, nothing) - pixels[n],
            by_id.get(i + columns, nothing) - pixels[n],
        )
    opposite = -arms[:, :, ::-1]
    return np.where(np.isnan(arms), opposite, arms)


def _intersect_edges(grey: Grey, arms: Array, pixels: Array, blur_px: float, clear: float) -> Array:
    """Return the intersections of the edges along ``arms``, (n, 2)."""
    lengths = np.linalg.norm(arms, axis=3)
    spacing = np.nanmin(lengths, axis=(1, 2), initial=np.inf)
    usable = np.isfinite(arms).all(axis=(1, 2, 3)) & (spacing * clear >= _LEAST_REACH_PX / 2)
    positions = pixels.copy()
    for n in np.flatnonzero(usable):
        reach_px = max(_REACH * spacing[n], _BLURS * blur_px)
        reach_px = float(np.clip(min(reach_px, clear * spacing[n]), _LEAST_REACH_PX, _MOST_REACH_PX))
        normals, offsets = zip(*(_offset(grey, pixels[n], pair, reach_px) for pair in arms[n]), strict=True)
        if None in offsets or abs(np.linalg.det(normals)) < 0.1:
            continue
        shift = np.linalg.solve(np.array(normals), np.array(offsets, dtype=np.float64))
        if np.linalg.norm(shift) <= max(_MOST_SHIFT * spacing[n], 0.5):
            positions[n] = pixels[n] + shift
    return positions


def _offset(grey: Grey, corner: Array, pair: Array, reach_px: float) -> tuple[Array, float | None]:
    """Return the normal (2,) of the edge along ``pair``, and its distance from the corner, if visible."""
    direction = pair[1] - pair[0]
    direction = direction / np.linalg.norm(direction)
    normal = np.array([-direction[1], direction[0]])
    points = np.concatenate([corner + _ALONG_EDGE[:, None] * arm for arm in pair])
    steps = _steps(grey, points, normal, reach_px)
    if steps is None:
        return normal, None
    beside_px, visible = steps
    t = (points - corner) @ direction
    # Lens distortion bends the edge.
    terms = np.column_stack([np.ones_like(t), t, t * t])
    return normal, _intercept(terms, beside_px + (points - corner) @ normal, visible)


def _steps(grey: Grey, on: Array, normal: Array, reach_px: float) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return the distance of the black-white step from each point (n, 2), and a mask of valid points."""
    distances = np.arange(-reach_px, reach_px + 1e-9, _STEP_PX)
    positions = (on[:, None] + distances[:, None] * normal).astype(np.float32)
    levels = cv2.remap(
        grey, positions[..., 0], positions[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    slopes = np.diff(levels.astype(np.float64), axis=1)
    # Black lies on one side of the edge along one arm, and on the other side along the other arm.
    half = len(_ALONG_EDGE)
    heights = slopes.reshape(2, half, -1).sum(axis=2).mean(axis=1)
    if heights[0] * heights[1] > 0 or np.abs(heights).min() < _CONTRAST:
        return None
    slopes = np.maximum(slopes * np.repeat(np.sign(heights), half)[:, None], 0.0)
    weights = slopes.sum(axis=1)
    visible = weights > _FAINT * np.median(weights)
    if visible.reshape(2, half).sum(axis=1).min() < half // 2:
        return None
    return (slopes @ ((distances[1:] + distances[:-1]) / 2)) / np.maximum(weights, 1e-9), visible


def _intercept(terms: Array, found: Array, seen: NDArray[np.bool_]) -> float:
    """Return the value at the corner of a curve through the visible points; outliers do not count."""
    for _ in range(2):
        solution = np.linalg.lstsq(terms[seen], found[seen], rcond=None)[0]
        errors = np.abs(terms @ solution - found)
        seen = seen & (errors <= 3 * max(float(np.median(errors[seen])) * 1.5, 0.03))
    return float(solution[0])


# Least number of corners for a pose, with additional corners to check it.
LEAST_CORNERS = 6
# Least number of detected corners: one or two corners are often other objects in the room.
_SEEN = 4
# Sample positions for the sharpness of an edge: along the edge between two corners, and largest distance
# beside the edge, in squares. The samples stay within the white border of a marker.
_ALONG = (0.3, 0.4, 0.5, 0.6, 0.7)
_BESIDE, _BESIDE_MARKERS = 0.3, 0.12
_STEP_PX, _PIXEL = 0.5, 2
# Width beside an edge without other edges, in squares; with markers, as a factor of 1 - marker_scale.
_CLEAR, _CLEAR_MARKERS = 0.3, 0.32
_LEAST_SLOPE = 0.1
# Largest distance of a board corner from the visible corners, as a multiple of their extent.
_FARTHEST = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class BoardSighting:
    """A detection of the board in the image ``name``.

    ``ids`` (n,) and ``pixels`` (n, 2) are the detected corners. ``blur_px`` is the width of the edges (a
    standard deviation). ``outline`` (4, 2) has the outer corners in px, visible or not.
    """

    name: str
    ids: NDArray[np.intp]
    pixels: Array
    blur_px: float
    outline: Array


class BoardView(NamedTuple):
    """A sighting, or None; for a chessboard also columns and rows of the largest grid of inner corners."""

    sighting: BoardSighting | None
    grid: tuple[int, int] | None = None


def find_board(name: str, grey: Grey, board: Board, thorough: bool) -> BoardSighting | None:
    """Detect the board in an image; see `view_board`."""
    return view_board(name, grey, board, thorough).sighting


def view_board(name: str, grey: Grey, board: Board, thorough: bool) -> BoardView:
    """Detect the board in an image, and the largest grid of a chessboard.

    Parameters
    ----------
    name : name of the image.
    grey : the image, (height, width).
    board : the board to search for.
    thorough : search longer a second time if the first search finds no chessboard.

    Returns
    -------
    The view, without a sighting if the board is not detected. A ChArUco board may be partly visible, a
    chessboard must be completely visible.
    """
    if board.inverted:
        grey = np.asarray(255 - grey, dtype=np.uint8)
    if board.marker_scale is not None:
        corners = _charuco(grey, board)
        return BoardView(None if corners is None else _sighting(name, grey, board, *corners))
    view = find_chessboard(grey, board.grid, thorough)
    if view.corners is None:
        return BoardView(None, view.size)
    ids = np.arange(board.columns * board.rows)
    return BoardView(_sighting(name, grey, board, ids, view.corners.reshape(-1, 2)), view.size)


def _sighting(name: str, grey: Grey, board: Board, ids: NDArray[np.intp], pixels: Array) -> BoardSighting:
    places = board.grid_positions(ids)
    if len(ids) < LEAST_CORNERS or min(len(set(column)) for column in places.T.tolist()) < 2:
        return BoardSighting(name, ids, pixels, 0.0, np.tile(pixels.mean(axis=0), (4, 1)))
    blur_px = _edge_width_px(grey, board, ids, pixels)
    clear = _CLEAR if board.marker_scale is None else _CLEAR_MARKERS * (1 - board.marker_scale)
    pixels = refine_corners(grey, board.grid[0], ids, pixels, blur_px, clear)
    return BoardSighting(name, ids, pixels, blur_px, _outline(board, ids, pixels))


def _charuco(grey: Grey, board: Board) -> tuple[NDArray[np.intp], Array] | None:
    # OpenCV before 4.6 printed boards with an even number of rows with a white square at the top left.
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
    """Return the four outer corners, (4, 2); estimate invisible corners without lens distortion."""
    columns, rows = board.grid
    ends = np.array([0, columns - 1, columns * rows - 1, columns * (rows - 1)])
    by_id = dict(zip(ids.tolist(), pixels, strict=True))
    if all(end in by_id for end in ends.tolist()):
        return np.array([by_id[end] for end in ends.tolist()])
    places, center = board.grid_positions(ids), pixels.mean(axis=0)
    homography, _ = cv2.findHomography(places, pixels)
    projected = (
        np.column_stack([board.grid_positions(ends), np.ones(4)])
        @ (np.eye(3) if homography is None else homography).T
    )
    # The homography is not valid beyond the horizon, so the distance is limited.
    reach_px = _FARTHEST * float(np.ptp(pixels, axis=0).max())
    outline = projected[:, :2] / np.maximum(projected[:, 2:], 1e-9)
    return np.asarray(np.clip(outline, center - reach_px, center + reach_px))


def _edge_width_px(grey: Grey, board: Board, ids: NDArray[np.intp], pixels: Array) -> float:
    """Return the standard deviation in px of the blur across edges, the greater one of both directions.

    The steepest slope of a step that a normal distribution blurs is its height over sqrt(2 pi) standard
    deviations. The height is the difference of black and white on the whole board. A profile near a marker is
    short, so it may not reach black or white.
    """
    (left, top), (right, bottom) = np.maximum(np.round([pixels.min(axis=0), pixels.max(axis=0)]), 0).astype(
        int
    )
    black, white = np.percentile(grey[top : bottom + 1, left : right + 1], [10, 90])
    by_id = dict(zip(ids.tolist(), pixels, strict=True))
    reach_share = _BESIDE if board.marker_scale is None else _BESIDE_MARKERS
    columns = board.grid[0]
    widths = []
    for step, other_step in ((1, columns), (columns, 1)):
        pairs = [
            (by_id[i], by_id[i + step])
            for i in by_id
            if i + step in by_id and (step > 1 or (i + 1) % columns)
        ]
        # Distances to the next parallel edge.
        spacing = [np.linalg.norm(by_id[i] - by_id[i + other_step]) for i in by_id if i + other_step in by_id]
        if pairs and spacing:
            reach_px = max(reach_share * float(np.median(spacing)), 2.0)
            widths.append((white - black) / (np.sqrt(2 * np.pi) * _slopes(grey, np.array(pairs), reach_px)))
    return max((float(np.median(values)) for values in widths), default=0.0)


def _slopes(grey: Grey, ends: Array, reach_px: float) -> Array:
    """Return the slopes of edges between corners (n, 2, 2), in levels per px, up to ``reach_px`` beside."""
    directions = ends[:, 1] - ends[:, 0]
    across = np.stack([-directions[:, 1], directions[:, 0]], axis=1) / np.linalg.norm(
        directions, axis=1, keepdims=True
    )
    offsets = np.arange(-reach_px, reach_px + 1e-9, _STEP_PX)
    start = ends[:, :1] + directions[:, None] * np.array(_ALONG)[:, None]
    positions = (start[:, :, None] + across[:, None, None] * offsets[:, None]).astype(np.float32)
    rows = positions.reshape(-1, len(offsets), 2)
    levels = cv2.remap(
        grey, rows[..., 0], rows[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    ).astype(np.float64)
    # The differences span a whole pixel: with shorter differences, noise looks steep.
    rises = np.abs(levels[:, _PIXEL:] - levels[:, :-_PIXEL]).max(axis=1) / (_PIXEL * _STEP_PX)
    return np.asarray(np.median(rises.reshape(len(ends), -1), axis=1) + _LEAST_SLOPE)
