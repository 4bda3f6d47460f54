"""Squares in an image and their cells: all squares are read at once, and compared with a table of markers."""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, Grey
from ipsys_log.stages.detect.uneven_light import (
    CELL_SAMPLES,
    compare_pattern,
    count_contradictions,
    has_clear_cells,
)
from ipsys_log.vision.decode import levels_at
from ipsys_log.vision.markers import white_cells

# Least side of a square as a share of the length of its outline, as in OpenCV's detector.
_LEAST_SIDE = 0.05
_BORDER_PX = 1
# Largest share of light cells in the black border; share of the wrong cells inside it that a dictionary can
# correct; and a number of wrong cells, border included, that is always allowed.
_LIGHT_BORDER, _CORRECTED, _MISREAD = 0.35, 0.6, 3
_LIGHT_ROUGH_BORDER = 0.6
# Squares of one id whose corners are nearer together are one marker, as a share of the outline.
_SAME = 0.125


class Candidate(NamedTuple):
    """A marker and its approximate corners, (4, 2) in px."""

    id: int
    corners_px: Array


class Threshold(NamedTuple):
    """Pixels that are darker than the mean of a window, by a number of grey levels, are black.

    ``rounded`` is the largest distance of an outline from its square, and ``shortest_px`` the least length of
    an outline.
    """

    window_px: int
    darker: int
    rounded: float
    shortest_px: float


def find_quads(grey: Grey, threshold: Threshold, mask: Grey | None = None) -> NDArray[np.float32]:
    """Return the corners (n, 4, 2) of the dark squares in an image, in px, clockwise, the longest first.

    The rules and the corners are those of OpenCV's detector.

    Parameters
    ----------
    mask : (height, width), 255 where squares are searched.
    """
    black = cv2.adaptiveThreshold(
        grey, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, threshold.window_px, threshold.darker
    )
    if mask is not None:
        cv2.bitwise_and(black, mask, black)
    lengths, quads = [], []
    for contour in cv2.findContours(black, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)[0]:
        length = len(contour)
        if length < threshold.shortest_px:
            continue
        quad = cv2.approxPolyDP(contour, threshold.rounded * length, True)
        if len(quad) == 4:
            lengths.append(length)
            quads.append(quad)
    if not quads:
        return np.empty((0, 4, 2), dtype=np.float32)
    corners_px = np.array(quads, dtype=np.float32).reshape(-1, 4, 2)
    sides = np.roll(corners_px, -1, axis=1) - corners_px
    turns = sides[..., 0] * np.roll(sides[..., 1], -1, axis=1) - sides[..., 1] * np.roll(
        sides[..., 0], -1, axis=1
    )
    long = (sides**2).sum(axis=2).min(axis=1) >= (_LEAST_SIDE * np.array(lengths)) ** 2
    convex = (turns > 0).all(axis=1) | (turns < 0).all(axis=1)
    last = np.array(grey.shape[::-1]) - 1 - _BORDER_PX
    inside = ((corners_px >= _BORDER_PX) & (corners_px <= last)).all(axis=(1, 2))
    anticlockwise = turns[:, 0] < 0
    corners_px[anticlockwise] = corners_px[anticlockwise][:, [0, 3, 2, 1]]
    chosen = np.flatnonzero(long & convex & inside)
    return corners_px[chosen[np.argsort(-np.array(lengths)[chosen], kind="stable")]]


def may_be_markers(grey: Grey, corners_px: Array, dictionary: str) -> NDArray[np.bool_]:
    """Return a mask of the squares (n, 4, 2) with a border that is mostly dark, by rough corners."""
    if not len(corners_px):
        return np.zeros(0, dtype=bool)
    cells = len(white_cells(dictionary, 0))
    levels = read_cells(grey, corners_px, cells)
    light = levels > (levels.min(axis=1) + levels.max(axis=1))[:, None] / 2
    return np.asarray(light[:, _border(cells)].mean(axis=1) <= _LIGHT_ROUGH_BORDER)


def read_markers(
    grey: Grey, corners_px: Array, dictionary: str, ids: frozenset[int] | None = None
) -> list[Candidate]:
    """Return the markers among the squares (n, 4, 2), by their cells: of duplicates, the first.

    Parameters
    ----------
    ids : the ids in use. Markers of other ids must have clear cells. None: all ids are in use.
    """
    if not len(corners_px):
        return []
    words = _words(dictionary)
    levels = read_cells(grey, corners_px, round(words.shape[1] ** 0.5))
    # In glare, the middle of the range is no threshold, but the middle of two means is one.
    middle = (levels.min(axis=1) + levels.max(axis=1))[:, None] / 2
    light = levels > middle
    counts = np.count_nonzero(light, axis=1)[:, None]
    bright = (levels * light).sum(axis=1, keepdims=True) / np.maximum(counts, 1)
    dark = (levels * ~light).sum(axis=1, keepdims=True) / np.maximum(light.shape[1] - counts, 1)
    correctable = _correctable(dictionary)
    reads = [_compare(one, words, correctable) for one in (light, levels > (bright + dark) / 2)]
    candidates: list[Candidate] = []
    for n in np.flatnonzero(np.isfinite(reads[0].wrong) | np.isfinite(reads[1].wrong)).tolist():
        for read in sorted(reads, key=lambda read: float(read.wrong[n])):
            marker_id, turns = divmod(int(read.best[n]), 4)
            candidate = Candidate(marker_id, np.roll(corners_px[n], -turns, axis=0).astype(np.float64))
            is_known = ids is None or marker_id in ids
            is_read = read.wrong[n] < (np.inf if is_known else 1)
            if is_read and _is_marker(grey, candidate, dictionary, is_known):
                if not any(_is_same(candidate, other) for other in candidates):
                    candidates.append(candidate)
                break
    return candidates


def _is_marker(grey: Grey, candidate: Candidate, dictionary: str, is_known: bool) -> bool:
    """Return whether the cells of a square can be those of its id, or are clearly so if the id is unknown."""
    marker_id, corners_px = candidate
    cells = len(white_cells(dictionary, marker_id))
    levels = read_cells(grey, corners_px[None], cells)[0]
    if not compare_pattern(levels, dictionary, marker_id).likely:
        return False
    samples = _sample_cells(grey, corners_px, cells)
    if not is_known:
        return has_clear_cells(samples, dictionary, marker_id)
    return not count_contradictions(samples, dictionary, marker_id)


class _Reading(NamedTuple):
    """The best words (n,) of squares, and the number of wrong cells (n,), infinite if too many are wrong."""

    best: NDArray[np.int_]
    wrong: Array


def _compare(light: NDArray[np.bool_], words: NDArray[np.float32], correctable: int) -> _Reading:
    """Compare the light cells (n, cells) of squares with those of markers."""
    border = _border(round(words.shape[1] ** 0.5))
    wrong, best = np.full(len(light), np.inf), np.zeros(len(light), dtype=np.int_)
    light_border = np.count_nonzero(light[:, border], axis=1)
    possible = np.flatnonzero(light_border <= _LIGHT_BORDER * np.count_nonzero(border))
    # Number of cells that differ, (squares, ids * turns).
    differ = (words.shape[1] - np.where(light[possible], np.float32(1), np.float32(-1)) @ words.T) / 2
    best[possible] = differ.argmin(axis=1)
    least = differ.min(axis=1)
    is_read = (least <= _MISREAD) | (least - light_border[possible] <= correctable)
    wrong[possible] = np.where(is_read, least, np.inf)
    return _Reading(best, wrong)


def _is_same(one: Candidate, other: Candidate) -> bool:
    if one.id != other.id:
        return False
    length_px = np.abs(other.corners_px - np.roll(other.corners_px, 1, axis=0)).sum()
    return bool(np.abs(one.corners_px - other.corners_px).sum(axis=1).mean() < _SAME * length_px)


def count_wrong_cells(grey: Grey, marker_id: int, corners_px: Array, dictionary: str) -> int:
    """Return the number of cells in a square (4, 2) that clearly have another colour than those of an id."""
    samples = _sample_cells(grey, corners_px, len(white_cells(dictionary, marker_id)))
    return count_contradictions(samples, dictionary, marker_id)


def _sample_cells(grey: Grey, corners_px: Array, cells: int) -> Array:
    """Return the levels of the cells of a square (4, 2), as for :func:`count_contradictions`."""
    samples = [read_cells(grey, corners_px[None], cells, *aside)[0] for aside in CELL_SAMPLES.tolist()]
    return np.array(samples)


def read_cells(grey: Grey, corners_px: Array, cells: int, right: float = 0.0, down: float = 0.0) -> Array:
    """Return the grey levels (n, cells * cells) of squares (n, 4, 2): at the middles of their cells.

    Parameters
    ----------
    cells : number of cells along a side, border included.
    right, down : distance from the middles, in cells.
    """
    positions = _positions(cells, right, down)
    x, y = (np.ascontiguousarray(corners_px[..., axis] @ positions.T, dtype=np.float32) for axis in (0, 1))
    return levels_at(grey, x, y)


@cache
def _positions(cells: int, right: float, down: float) -> Array:
    """Return the weights (cells * cells, 4) of the corners of a square at the points of its cells.

    Perspective and lens distortion bend a square of this size only a little, so linear interpolation between
    the corners is sufficient.
    """
    steps = np.arange(cells) + 0.5
    x, y = (axis.ravel() / cells for axis in np.meshgrid(steps + right, steps + down))
    return np.stack([(1 - x) * (1 - y), x * (1 - y), x * y, (1 - x) * y], axis=1)


@cache
def _correctable(dictionary: str) -> int:
    """Return the number of wrong cells inside the border that OpenCV's detector corrects."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    return int(_CORRECTED * known.maxCorrectionBits)


@cache
def _border(cells: int) -> NDArray[np.bool_]:
    """Return a mask (cells * cells,) of the border of a marker."""
    return np.pad(np.zeros((cells - 2, cells - 2), dtype=bool), 1, constant_values=True).ravel()


@cache
def _words(dictionary: str) -> NDArray[np.float32]:
    """Return the cells of all markers of a dictionary, (ids * 4, cells), border included.

    They are 1 for white and -1 for black, turned by 0 to 3 quarters.
    """
    count = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)
    images = [white_cells(dictionary, n) for n in range(count)]
    # If the marker's top left is corner k of a square, the square shows the marker turned k quarters
    # clockwise.
    turned = [np.rot90(image, -turn).ravel() for image in images for turn in range(4)]
    return np.where(turned, np.float32(1), np.float32(-1))
