"""Search for markers in a whole image: by squares at three scales, or as in the paper, by OpenCV alone.

The first search finds squares at a third of the size. There, the cells of a far or foreshortened marker are
too small, and a shadow or blur hides an outline. The thorough search finds squares at half and at full size,
with other thresholds. All squares are read at full size.
"""

import math
from collections.abc import Sequence
from itertools import accumulate

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Array, Grey, Marker
from ipsys_log.stages.detect.cells import (
    Candidate,
    Threshold,
    count_wrong_cells,
    find_quads,
    may_be_markers,
    read_cells,
    read_markers,
)
from ipsys_log.vision.markers import white_cells

Ids = frozenset[int] | None
Area = tuple[slice, slice]

_SHRINK = 3
# At a third of the size, the window is wider than the black border of a marker, and the shortest outline is
# that of OpenCV, a share of the longer side of the image.
_QUICK = Threshold(31, 12, 0.06, 0.0)
_SHORTEST = 0.03
# Scales of the thorough search. Blur and faint light need the wide window at half size, small cells the
# narrow one at full size (test_textured_floor_loses_no_marker).
_THOROUGH = ((2, Threshold(13, 7, 0.05, 30.0)), (1, Threshold(9, 7, 0.05, 40.0)))
_NEAR = (4, 4)
# The wide window corrects corners in glare, but does not fit into the cells of a small marker.
_WINDOWS = ((2, 2), _NEAR)
_REFINE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 10, 0.05)
# Search of leftovers: least contrast between neighbouring samples; sampling steps; masks for the contrast and
# for a square with contrast; reach of the paper around a marker, in sides; margin of an area.
_CONTRAST = 30
_FINER, _COARSER = 2, 3
_STEP_PX = _FINER * _SHRINK
_AROUND, _SQUARE = np.ones((3, 3), dtype=np.uint8), np.ones((4, 4), dtype=np.uint8)
_PAPER = 0.35
_CLEAR_PX = 24
_CLEAR = np.ones((2 * _CLEAR_PX // _STEP_PX + 1,) * 2, dtype=np.uint8)
# Share of the contrast: darker samples are the black of a marker.
_AS_BLACK = 0.1
# Rows and columns of a whole image.
WHOLE = (slice(None), slice(None))
# A mask is faster than many areas, or than areas with more than this share of the image.
_MANY, _MOST = 16, 0.12
# Bound of the thorough search in one frame, that of 1920 x 1080 px; and the common rows of two parts.
_MOST_PX, _COMMON_PX = 1920 * 1080, 128


def sample(grey: Grey) -> Grey:
    """Return the reduced image: sample k is pixel 3 k + 1."""
    return _shrink(grey, _SHRINK)


def _shrink(grey: Grey, step: int) -> Grey:
    # Single pixels are three times as fast as means of pixels, and as good if cells are wider than 3 px.
    return np.ascontiguousarray(grey[step // 2 :: step, step // 2 :: step])


def search(grey: Grey, dictionary: str, region: Area = WHOLE, ids: Ids = None) -> list[Candidate]:
    """Find markers in an image, with approximate corners.

    Parameters
    ----------
    grey : (height, width).
    dictionary : OpenCV's name, such as DICT_4X4_100.
    region : rows and columns to search.
    ids : as for :func:`~ipsys_log.stages.detect.cells.read_markers`.
    """
    part = np.ascontiguousarray(grey[region])
    return _placed(search_squares(part, dictionary, ids=ids)[0], region)


def search_squares(
    grey: Grey, dictionary: str, samples: Grey | None = None, ids: Ids = None
) -> tuple[list[Candidate], Array]:
    """Return the markers in a whole image, and the corners (n, 4, 2) of all its squares, as search()."""
    corners_px = find_squares(grey, samples)
    return read_markers(grey, corners_px, dictionary, ids), corners_px


def _placed(found: list[Candidate], region: Area) -> list[Candidate]:
    if region == WHOLE or not found:
        return found
    origin = np.array([region[1].start or 0, region[0].start or 0], dtype=np.float64)
    return [candidate._replace(corners_px=candidate.corners_px + origin) for candidate in found]


def find_squares(grey: Grey, samples: Grey | None = None) -> Array:
    """Return the corners (n, 4, 2) in px of all squares in an image, markers and others."""
    small = sample(grey) if samples is None else samples
    if not small.size:
        return np.empty((0, 4, 2))
    threshold = _QUICK._replace(shortest_px=_SHORTEST * max(small.shape))
    return _refine(grey, find_quads(small, threshold), _SHRINK, _NEAR)


def _refine(grey: Grey, quads: NDArray[np.float32], step: int, window: tuple[int, int]) -> Array:
    """Return the refined corners (n, 4, 2) of squares in an image of every ``step``-th pixel."""
    if not len(quads):
        return np.empty((0, 4, 2))
    rough = quads.reshape(-1, 1, 2) * np.float32(step) + np.float32(step // 2)
    return cv2.cornerSubPix(grey, rough, window, (-1, -1), _REFINE).reshape(-1, 4, 2).astype(np.float64)


def split(shape: tuple[int, ...], region: Area = WHOLE) -> list[Area]:
    """Return the parts of a region of an image (height, width), each small enough for one frame."""
    (top, bottom, _), (left, right, _) = (
        part.indices(size) for part, size in zip(region, shape, strict=True)
    )
    height = max(_MOST_PX // max(right - left, 1), 2 * _COMMON_PX)
    starts = range(top, max(bottom - _COMMON_PX, top + 1), height - _COMMON_PX)
    return [(slice(start, min(start + height, bottom)), slice(left, right)) for start in starts]


def take(areas: list[Area]) -> list[Area]:
    """Remove from ``areas`` and return those that one frame searches: the first, up to the bound."""
    sizes_px = [math.prod(part.stop - part.start for part in area) for area in areas]
    count = max(sum(total <= _MOST_PX for total in accumulate(sizes_px)), 1)
    taken, areas[:] = areas[:count], areas[count:]
    return taken


def search_thoroughly(
    grey: Grey,
    dictionary: str,
    region: Area = WHOLE,
    ids: Ids = None,
    mask: Grey | None = None,
    is_faint: bool = False,
) -> list[Candidate]:
    """Find markers, also small ones and those in shadow, with approximate corners.

    Parameters
    ----------
    grey, dictionary, region, ids : as for :func:`search`.
    mask : the places to search, 255 in every ``_STEP_PX``-th pixel; None: all.
    is_faint : search at half size without the mask, for markers with little contrast.
    """
    part = np.ascontiguousarray(grey[region])
    candidates = []
    for step, threshold in _THOROUGH:
        scaled = part if step == 1 else _shrink(part, step)
        if not scaled.size:
            continue
        places = None if is_faint and step > 1 else _scaled(mask, grey, region, step)
        quads = find_quads(scaled, threshold, places)
        quads = quads[may_be_markers(part, quads.astype(np.float64) * step + step // 2, dictionary)]
        for window in _WINDOWS:
            candidates += read_markers(part, _refine(part, quads, step, window), dictionary, ids)
    return _placed(candidates, region)


def _scaled(mask: Grey | None, grey: Grey, region: Area, step: int) -> Grey | None:
    """Return a mask for the region of an image of every ``step``-th pixel."""
    if mask is None:
        return None
    height, width = (-(-size // _STEP_PX) * _STEP_PX for size in grey.shape)
    whole = cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST)
    part = whole[: grey.shape[0], : grey.shape[1]][region]
    return np.ascontiguousarray(part[step // 2 :: step, step // 2 :: step])


def find_unexplained_areas(
    grey: Grey, samples: Grey, known_px: Sequence[Array], is_whole: bool = False
) -> tuple[list[Area], Grey | None]:
    """Return areas with contrast that no known marker, (4, 2) in px, explains, and a mask if it is faster.

    Lines and the edges of large objects also have contrast, but not everywhere in a square.

    Parameters
    ----------
    samples : reduced image, from :func:`sample`.
    is_whole : return the whole image and a mask.

    Returns
    -------
    Rows and columns, and 255 in the areas and their margins, in every ``_STEP_PX``-th pixel.
    """
    fine = np.ascontiguousarray(samples[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER])
    # At the fine scale, there is no contrast inside the cells of a large marker.
    coarse = np.ascontiguousarray(fine[_COARSER // 2 :: _COARSER, _COARSER // 2 :: _COARSER])
    full = np.zeros([-(-size // _STEP_PX) for size in grey.shape], dtype=np.uint8)
    if not coarse.size:
        return split(grey.shape), None
    inner, wide = _squares(fine), _squares(coarse)
    known = _spans(known_px)
    down, right = wide.shape[0] / inner.shape[0], wide.shape[1] / inner.shape[1]
    for rows, columns in known:
        # Only the coarse samples that are completely inside the known marker.
        wide[_inner(rows, down), _inner(columns, right)] = 0
    if cv2.countNonZero(wide):
        widened = cv2.resize(wide, inner.shape[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.bitwise_or(inner, widened, inner)
    for rows, columns in known:
        inner[rows, columns] = 0
    contours, _ = cv2.findContours(inner, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    boxes = [cv2.boundingRect(contour) for contour in contours]
    share = sum(math.prod(box[2:]) for box in boxes) / inner.size
    if not is_whole and len(boxes) <= _MANY and share <= _MOST:
        areas = [
            (_widened(top, height), _widened(left, width))
            for left, top, width, height in boxes
            if not _is_cut(grey, fine, left, top, left + width, top + height)
        ]
        return [part for area in areas for part in split(grey.shape, area)], None
    cv2.drawContours(full, contours, -1, 255, cv2.FILLED)
    return split(grey.shape), np.asarray(cv2.dilate(full, _CLEAR), dtype=np.uint8)


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


def _widened(first: int, count: int) -> slice:
    return slice(max(first * _STEP_PX - _CLEAR_PX, 0), (first + count) * _STEP_PX + _CLEAR_PX)


def _squares(samples: Grey) -> Grey:
    """Return a mask of the squares with contrast at all samples."""
    contrast = cv2.morphologyEx(samples, cv2.MORPH_GRADIENT, _AROUND)
    high = cv2.threshold(contrast, _CONTRAST, 1, cv2.THRESH_BINARY)[1]
    return np.asarray(cv2.morphologyEx(high, cv2.MORPH_OPEN, _SQUARE), dtype=np.uint8)


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
