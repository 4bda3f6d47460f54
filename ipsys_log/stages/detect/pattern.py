"""Agreement of grey levels with the cells of a marker where light is uneven.

Under glare or half in a shadow, no single threshold separates black from white. Neighbouring cells still
differ if the print changes its colour between them, and hardly differ if it does not.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.markers import white_cells
from ipsys_log.stages.detect.profiles import LEAST_CONTRAST

__all__ = ["Agreement", "compare_pattern"]

Array = NDArray[np.float64]

# Cells differ if their levels differ by this share of the print's contrast.
_DIFFERENT = 0.25
_AGREES, _CLEARLY, _ALIKE = 0.5, 0.1, 0.3


class Agreement(NamedTuple):
    """The share of neighbouring cells that agree with a marker, minus that of those that contradict it.

    ``own`` is the share for the tested marker, ``next`` the greatest for any other or any turned one.
    """

    own: float
    next: float

    @property
    def clear(self) -> bool:
        """Return whether the cells match this marker and no other."""
        return self.own >= _AGREES and self.own >= self.next + _CLEARLY

    @property
    def possible(self) -> bool:
        """Return whether the cells may match this marker, near its pose."""
        return self.own >= _ALIKE

    @property
    def likely(self) -> bool:
        """Return whether the cells look like those of this marker rather than of another."""
        return self.possible and self.own > self.next


def compare_pattern(levels: Array, dictionary: str, marker_id: int) -> Agreement:
    """Return the agreement of grey levels with the cells of a marker.

    Parameters
    ----------
    levels : (c,), grey levels of the cells, black border included, row after row.
    dictionary : OpenCV's name, such as DICT_4X4_100.
    """
    words = _steps(dictionary)
    cells = round(len(levels) ** 0.5)
    rises = _neighbours(levels.reshape(1, cells, cells))[0]
    expected = words[4 * marker_id]
    contrast = float(np.median((rises * expected)[expected != 0]))
    if contrast < LEAST_CONTRAST:
        return Agreement(0.0, 0.0)
    signs = np.sign(rises) * (np.abs(rises) > _DIFFERENT * contrast)
    # Equal signs agree, opposite signs contradict; an invisible step counts for neither.
    agreements = words @ signs + (words == 0) @ np.where(signs == 0, 1.0, -1.0)
    agreements /= len(signs)
    own = float(agreements[4 * marker_id])
    agreements[4 * marker_id] = -1.0
    return Agreement(own, float(agreements.max()))


def _neighbours(cells: Array) -> Array:
    """Return the differences of cells (m, n, n) to those on their right and below: (m, 2 n (n - 1))."""
    right, down = np.diff(cells, axis=2), np.diff(cells, axis=1)
    return np.concatenate([right.reshape(len(cells), -1), down.reshape(len(cells), -1)], axis=1)


@cache
def _steps(dictionary: str) -> Array:
    """Return the signs of steps between neighbouring cells, (4 ids, p): each marker turned four times."""
    count = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary)).bytesList)
    prints = [np.rot90(white_cells(dictionary, n), turn) for n in range(count) for turn in range(4)]
    return _neighbours(np.array(prints, dtype=np.float64))
