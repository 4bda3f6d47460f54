"""Search for markers in a whole image: by squares in a reduced image, or as in the paper, by OpenCV alone.

OpenCV's detector finds squares at a third of the size, with one threshold window instead of three. There,
the cells of a far or foreshortened marker are too small for identification. All squares that are not
identified as markers are therefore read again at full size.
"""

from collections.abc import Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Grey, Marker
from ipsys_log.stages.detect.uneven_light import CELL_SAMPLES, count_contradictions
from ipsys_log.vision.decode import levels_at
from ipsys_log.vision.markers import white_cells

_SHRINK = 3
# Window of the threshold at that scale. It is wider than the black border of a marker.
_WINDOW_PX = 31
_DARKER = 12
_ROUNDED = 0.06
_BORDER_PX = 1
_NEAR = (4, 4)
_REFINE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10, 0.05)
_MISREAD = 3
# Search of leftovers: least contrast between neighbouring samples; sampling steps; masks for the contrast and
# for a square with contrast; reach of the paper around a marker, in sides; margin of an area. The last two
# are limits: a share of the image, and a number of areas. Above them, one search of the whole image is
# faster.
_CONTRAST = 30
_FINER, _COARSER = 2, 3
_STEP_PX = _FINER * _SHRINK
_AROUND, _SQUARE = np.ones((3, 3), dtype=np.uint8), np.ones((4, 4), dtype=np.uint8)
_PAPER = 0.35
_CLEAR_PX = 24
_MOST, _MANY = 0.4, 40
# Share of the contrast: darker samples are the black of a marker.
_AS_BLACK = 0.1
# Rows and columns of a whole image.
WHOLE = (slice(None), slice(None))


class Candidate(NamedTuple):
    """A marker and its approximate corners, (4, 2) in px."""

    id: int
    corners_px: Array


def sample(grey: Grey) -> Grey:
    """Return the reduced image: sample k is pixel 3 k + 1."""
    # Single pixels are three times as fast as means of pixels, and as good if cells are wider than 3 px.
    return np.ascontiguousarray(grey[_SHRINK // 2 :: _SHRINK, _SHRINK // 2 :: _SHRINK])


def search(grey: Grey, dictionary: str, region: tuple[slice, slice] = WHOLE) -> list[Candidate]:
    """Find markers in an image, with approximate corners.

    Parameters
    ----------
    grey : (height, width).
    dictionary : OpenCV's name, such as DICT_4X4_100.
    region : rows and columns to search.
    """
    part = np.ascontiguousarray(grey[region])
    return _placed(search_squares(part, dictionary)[0], region)


def search_squares(grey: Grey, dictionary: str, samples: Grey | None = None) -> tuple[list[Candidate], Array]:
    """Return the markers in a whole image, and the corners (n, 4, 2) of all its squares, as search()."""
    small = sample(grey) if samples is None else samples
    corners_px, ids = _read_squares(grey, small, dictionary)
    others = _read(grey, corners_px[len(ids) :], dictionary)
    return _candidates(corners_px[: len(ids)], ids) + others, corners_px


def _placed(found: list[Candidate], region: tuple[slice, slice]) -> list[Candidate]:
    if region == WHOLE or not found:
        return found
    origin = np.array([region[1].start or 0, region[0].start or 0], dtype=np.float64)
    return [candidate._replace(corners_px=candidate.corners_px + origin) for candidate in found]


def find_squares(grey: Grey, dictionary: str) -> Array:
    """Return the corners (n, 4, 2) in px of all squares in an image, markers and others."""
    return _read_squares(grey, sample(grey), dictionary)[0]


def _read_squares(grey: Grey, small: Grey, dictionary: str) -> tuple[Array, list[int]]:
    """Return the corners (n, 4, 2) of squares, and the ids of the first of them, which are markers."""
    if not small.size:
        return np.empty((0, 4, 2)), []
    marker_corners, ids, rejected = _quick_detector(dictionary).detectMarkers(small)
    squares = [*marker_corners, *rejected]
    if not squares:
        return np.empty((0, 4, 2)), []
    rough = np.concatenate(squares).reshape(-1, 1, 2) * np.float32(_SHRINK) + np.float32(_SHRINK // 2)
    corners_px = cv2.cornerSubPix(grey, rough, _NEAR, (-1, -1), _REFINE).reshape(-1, 4, 2).astype(np.float64)
    # OpenCV 5 returns ids of shape (n,), OpenCV 4 returns ids of shape (n, 1), or None.
    return corners_px, [] if ids is None else [int(n) for n in np.ravel(ids)]


def search_thoroughly(grey: Grey, dictionary: str, region: tuple[slice, slice] = WHOLE) -> list[Candidate]:
    """Find markers, also those in shadow, with the default settings of OpenCV's detector, at full size."""
    marker_corners, ids, _ = _full_detector(dictionary).detectMarkers(np.ascontiguousarray(grey[region]))
    return _placed(_candidates(marker_corners, ids), region)


def search_unexplained_areas(
    grey: Grey, dictionary: str, samples: Grey, known_px: Sequence[Array]
) -> list[Candidate]:
    """Search thoroughly in areas with contrast that no known marker, (4, 2) in px, explains.

    Parameters
    ----------
    samples : reduced image, from :func:`sample`.
    """
    candidates = []
    for region in _contrasts(grey, samples, known_px):
        candidates += search_thoroughly(grey, dictionary, region)
    return candidates


def _contrasts(grey: Grey, samples: Grey, known_px: Sequence[Array]) -> list[tuple[slice, slice]]:
    """Return rows and columns of areas with the contrast of a marker, without known markers.

    Lines and the edges of large objects also have contrast, but not everywhere in a square.
    """
    fine = np.ascontiguousarray(samples[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER])
    # At the fine scale, there is no contrast inside the cells of a large marker.
    coarse = np.ascontiguousarray(fine[_COARSER // 2 :: _COARSER, _COARSER // 2 :: _COARSER])
    if not coarse.size:
        return [WHOLE]
    full, wide = _squares(fine), _squares(coarse)
    known = _spans(known_px)
    down, right = wide.shape[0] / full.shape[0], wide.shape[1] / full.shape[1]
    for rows, columns in known:
        # Only the coarse samples that are completely inside the known marker.
        wide[_inner(rows, down), _inner(columns, right)] = 0
    if cv2.countNonZero(wide):
        widened = cv2.resize(wide, full.shape[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.bitwise_or(full, widened, full)
    for rows, columns in known:
        full[rows, columns] = 0
    if not cv2.countNonZero(full):
        return []
    contours, _ = cv2.findContours(full, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    boxes = [cv2.boundingRect(contour) for contour in contours]
    if sum(width * height for *_, width, height in boxes) > _MOST * full.size or len(boxes) > _MANY:
        return [WHOLE]
    return [
        (_widened(top, height), _widened(left, width))
        for left, top, width, height in boxes
        if not _is_cut(grey, fine, left, top, left + width, top + height)
    ]


def _spans(known_px: Sequence[Array]) -> list[tuple[slice, slice]]:
    """Return rows and columns of the samples that show known markers, their paper included."""
    if not len(known_px):
        return []
    known = np.asarray(known_px)
    low, high = known.min(axis=1), known.max(axis=1)
    around = _PAPER * (high - low) + _COARSER * _STEP_PX
    spans = np.concatenate([np.maximum(low - around, 0), high + around + _STEP_PX], axis=1) / _STEP_PX
    return [
        (slice(top, bottom), slice(left, right)) for left, top, right, bottom in spans.astype(int).tolist()
    ]


def _inner(span: slice, scale: float) -> slice:
    return slice(int(span.start * scale) + 1, int(span.stop * scale))


def _is_cut(grey: Grey, fine: Grey, left: int, top: int, right: int, bottom: int) -> bool:
    """Return whether the image border cuts off a marker in a box of samples.

    The black of such a marker touches the border. A whole marker has its white margin around it, or at least
    the floor.
    """
    height, width = fine.shape
    rows = slice(top * _STEP_PX, bottom * _STEP_PX)
    columns = slice(left * _STEP_PX, right * _STEP_PX)
    lines = [grey[0, columns]] * (top == 0) + [grey[-1, columns]] * (bottom == height)
    lines += [grey[rows, 0]] * (left == 0) + [grey[rows, -1]] * (right == width)
    if not lines:
        return False
    box = fine[top:bottom, left:right]
    darkest, brightest = int(box.min()), int(box.max())
    return min(int(line.min()) for line in lines) < darkest + _AS_BLACK * (brightest - darkest)


def _squares(samples: Grey) -> Grey:
    """Return a mask of the squares with contrast at all samples."""
    contrast = cv2.morphologyEx(samples, cv2.MORPH_GRADIENT, _AROUND)
    high = cv2.threshold(contrast, _CONTRAST, 1, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.morphologyEx(high, cv2.MORPH_OPEN, _SQUARE), dtype=np.uint8)


def _widened(first: int, count: int) -> slice:
    return slice(max(first * _STEP_PX - _CLEAR_PX, 0), (first + count) * _STEP_PX + _CLEAR_PX)


def _candidates(found: Iterable[Any], ids: Any) -> list[Candidate]:
    numbers = [] if ids is None else np.ravel(ids).tolist()
    return [
        Candidate(n, np.asarray(square, dtype=np.float64).reshape(4, 2))
        for n, square in zip(numbers, found, strict=True)
    ]


def _known(dictionary: str) -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))


@cache
def _quick_detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = _WINDOW_PX
    parameters.adaptiveThreshConstant = _DARKER
    parameters.polygonalApproxAccuracyRate = _ROUNDED
    parameters.minDistanceToBorder = _BORDER_PX
    return cv2.aruco.ArucoDetector(_known(dictionary), parameters)


@cache
def _full_detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    parameters = cv2.aruco.DetectorParameters()
    parameters.minDistanceToBorder = _BORDER_PX
    # Bits are read from 8 px per cell instead of 4: this finds more small and tilted markers.
    parameters.perspectiveRemovePixelPerCell = 8
    return cv2.aruco.ArucoDetector(_known(dictionary), parameters)


def _read(grey: Grey, corners: Array, dictionary: str) -> list[Candidate]:
    """Return the markers among the squares (n, 4, 2), by their cells."""
    if not len(corners):
        return []
    words = _words(dictionary)
    levels = read_cells(grey, corners, round(words.shape[1] ** 0.5))
    middle = levels.min(axis=1) / 2 + levels.max(axis=1) / 2
    signs = np.where(levels > middle[:, None], np.float32(1), np.float32(-1))
    # Number of cells that differ, (squares, ids * turns).
    differ = (words.shape[1] - signs @ words.T) / 2
    best = differ.argmin(axis=1)
    candidates = []
    for n in np.flatnonzero(differ.min(axis=1) <= _MISREAD).tolist():
        marker_id, turns = divmod(int(best[n]), 4)
        candidates.append(Candidate(marker_id, np.roll(corners[n], -turns, axis=0)))
    return candidates


def count_wrong_cells(grey: Grey, marker_id: int, corners_px: Array, dictionary: str) -> int:
    """Return the number of cells in a square (4, 2) that clearly have another colour than those of an id."""
    cells = len(white_cells(dictionary, marker_id))
    samples = [read_cells(grey, corners_px[None], cells, *aside)[0] for aside in CELL_SAMPLES.tolist()]
    return count_contradictions(np.array(samples), dictionary, marker_id)


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
def _words(dictionary: str) -> NDArray[np.float32]:
    """Return the cells of all markers of a dictionary, (ids * 4, cells), border included.

    They are 1 for white and -1 for black, turned by 0 to 3 quarters.
    """
    images = [white_cells(dictionary, n) for n in range(len(_known(dictionary).bytesList))]
    # If the marker's top left is corner k of a square, the square shows the marker turned k quarters
    # clockwise.
    turned = [np.rot90(image, -turn).ravel() for image in images for turn in range(4)]
    return np.where(turned, np.float32(1), np.float32(-1))


# OpenCV corrects wrong cells, up to three of 6x6, and a third of the border. More than one is another print.
_WRONG_CELLS = 1
# Distance outside a marker, in cells, that is black only in a border wider than one cell; darker than this
# share of the contrast is black.
_OUTSIDE, _BLACK = 0.2, 0.25
_SUBPIXEL = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.001)


def marker_detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    """Return OpenCV's detector for a dictionary such as DICT_4X4_100.

    Raises
    ------
    IpsysError
        OpenCV has no dictionary of that name.
    """
    index = getattr(cv2.aruco, dictionary, None) if dictionary.startswith("DICT_") else None
    if not isinstance(index, int):
        raise IpsysError(
            f"the marker dictionary {dictionary!r} of the rig is unknown to OpenCV; use one such as "
            "DICT_4X4_100"
        )
    parameters = cv2.aruco.DetectorParameters()
    # Bits are read from 8 px per cell instead of 4: this finds more small and tilted markers.
    parameters.perspectiveRemovePixelPerCell = 8
    return cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(index), parameters)


def detect_markers(grey: Grey, dictionary: str) -> list[Marker]:
    """Return all markers of a dictionary in an image, sorted by id; an id can occur twice.

    Parameters
    ----------
    grey : (height, width)
    dictionary : OpenCV's name, such as DICT_4X4_100.

    Returns
    -------
    list of :class:`Marker`, with corners refined to sub-pixels with a window of 3 (the authors' setting).
    """
    corners, ids, _ = marker_detector(dictionary).detectMarkers(grey)
    if ids is None or len(ids) == 0:
        return []
    flat = np.concatenate(corners, axis=1).reshape(-1, 1, 2).astype(np.float32)
    refined = cv2.cornerSubPix(grey, flat, (3, 3), (-1, -1), _SUBPIXEL).reshape(-1, 4, 2)
    # OpenCV 5 returns ids of shape (n,), OpenCV 4 returns ids of shape (n, 1).
    order = np.argsort(np.ravel(ids), kind="stable")
    markers = [Marker(int(np.ravel(ids)[i]), np.asarray(refined[i], dtype=np.float64)) for i in order]
    return [marker for marker in markers if _is_print(grey, marker, dictionary)]


def _is_print(grey: Grey, marker: Marker, dictionary: str) -> bool:
    """Return whether the cells have the colours of the id, and the border ends at the corners."""
    if count_wrong_cells(grey, marker.id, marker.corners_px, dictionary) > _WRONG_CELLS:
        return False
    white = white_cells(dictionary, marker.id)
    cells = len(white)
    middle_px = marker.corners_px.mean(axis=0)
    # The outer cells of a larger square are outside the marker.
    larger_px = middle_px + (marker.corners_px - middle_px) * (cells + 2 * _OUTSIDE) / (cells - 1)
    levels, around = (
        read_cells(grey, px[None], cells).reshape(cells, cells) for px in (marker.corners_px, larger_px)
    )
    around[1:-1, 1:-1] = np.nan
    dark, light = np.median(levels[~white]), np.median(levels[white])
    return bool(np.nanmedian(around) > dark + _BLACK * (light - dark))
