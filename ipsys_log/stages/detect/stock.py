"""OpenCV's detector with sub-pixel corners: the method of the paper."""

from __future__ import annotations

import cv2
import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.messages import Marker
from ipsys_log.messages.arrays import Grey
from ipsys_log.stages.detect.search import count_wrong_cells, read_cells
from ipsys_log.vision.markers import white_cells

# OpenCV corrects wrong cells, up to three of 6x6, and a third of the border. More than one is another print.
_WRONG_CELLS = 1
# Distance outside a marker, in cells, that is black only in a border wider than one cell; darker than this
# share of the contrast is black.
_OUTSIDE, _BLACK = 0.2, 0.25
_REFINE = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 40, 0.001)


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
    refined = cv2.cornerSubPix(grey, flat, (3, 3), (-1, -1), _REFINE).reshape(-1, 4, 2)
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
