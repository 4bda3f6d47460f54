"""OpenCV's detector with sub-pixel corners: the method of the paper."""

from __future__ import annotations

import cv2
import numpy as np

from ipsys_log.errors import IpsysError
from ipsys_log.images.decode import Grey
from ipsys_log.messages import Marker

__all__ = ["detect_markers", "marker_detector"]

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
    return [Marker(int(np.ravel(ids)[i]), np.asarray(refined[i], dtype=np.float64)) for i in order]
