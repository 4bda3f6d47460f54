"""Markers in uneven light: edges that glare, a shadow or a cover disturbs, and the colours of cells.

A profile far to both sides shows the approximate position of an edge. A near profile shows the exact
position. The shape of a near profile shows if the edge is undisturbed. Glare that begins at the edge, or
saturates the white, causes another shape.

Under glare or half in a shadow, no single threshold separates black from white. Neighbouring cells still
differ if the print changes its colour between them, and hardly differ if it does not.
"""

from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array
from ipsys_log.stages.detect.prints import BLURS_PX, LEAST_CONTRAST, Prints
from ipsys_log.vision.markers import white_cells

# Cells differ if their levels differ by this share of the print's contrast.
_DIFFERENT = 0.25
_AGREES, _CLEARLY, _ALIKE = 0.5, 0.1, 0.3
# A cell has the level of the print's black or white within this share of the contrast, at its middle and
# around it. With 0.2 and 0.35, glare counts as white (test_edges_in_uneven_light_are_exact_at_full_size).
_AS_PRINTED, _AS_PRINTED_AROUND = 0.15, 0.3
# Width in cells of the window whose darkest and brightest cells decide a colour. In windows with less than
# this share of the marker's contrast, all cells have one colour. Sigma in cells of the levels around a cell.
_WINDOW_CELLS, _PLAIN, _NEAR_CELLS = 5, 0.4, 1.5
# Positions of the samples of a cell, in cells from its middle.
CELL_SAMPLES = np.array([[0.0, 0.0], [0.25, 0.25], [-0.25, 0.25], [-0.25, -0.25], [0.25, -0.25]])


class Agreement(NamedTuple):
    """The share of neighbouring cells that agree with a marker, minus the share of those that contradict it.

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
    # Equal signs agree, opposite signs contradict. An invisible step counts for none of the two.
    agreements = words @ signs + (words == 0) @ np.where(signs == 0, 1.0, -1.0)
    agreements /= len(signs)
    own = float(agreements[4 * marker_id])
    agreements[4 * marker_id] = -1.0
    return Agreement(own, float(agreements.max()))


def count_contradictions(samples: Array, dictionary: str, marker_id: int) -> int:
    """Return the number of cells that clearly have the opposite colour of those of a marker.

    Such a cell has everywhere the level of the black or the white around it, and so have the cells beside it.
    Otherwise it may be covered, in glare or at the border of a shadow, and says nothing about the print.

    Parameters
    ----------
    samples : (5, c), grey levels of the cells, black border included, row after row: at the middle of a cell,
        and around it.
    dictionary, marker_id : as for :func:`compare_pattern`.
    """
    white = white_cells(dictionary, marker_id).ravel()
    seen_white, off = _compare_levels(samples, white)
    if (seen_white == white).all():
        return 0
    cells = round(len(white) ** 0.5)
    odd = (off[0] > _AS_PRINTED).reshape(cells, cells).astype(np.uint8)
    beside = cv2.dilate(odd, np.ones((3, 3), dtype=np.uint8)).ravel() > 0
    clear = ~beside & (off[1:].max(axis=0) < _AS_PRINTED_AROUND)
    return int(np.count_nonzero(clear & (seen_white != white)))


def has_clear_cells(samples: Array, dictionary: str, marker_id: int) -> bool:
    """Return whether all cells clearly have the colours of a marker, in even light.

    The parameters are those of :func:`count_contradictions`.
    """
    white = white_cells(dictionary, marker_id).ravel()
    seen_white, off = _compare_levels(samples, white)
    is_clear = off[0].max() < _AS_PRINTED and off[1:].max() < _AS_PRINTED_AROUND
    return bool(is_clear and (seen_white == white).all())


def _compare_levels(samples: Array, white: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], Array]:
    """Return the cells (c,) that look white, and the distances (5, c) of samples from the level of the print.

    The unit of distances is the contrast of the print around the cell.
    """
    levels = samples[0]
    cells = round(len(levels) ** 0.5)
    middle, contrast = _between(levels, cells)
    if contrast < LEAST_CONTRAST:
        return white, np.full(samples.shape, np.inf)
    seen_white = levels > middle
    near = _nearness(cells)
    light, dark = (
        near @ (levels * right) / np.maximum(near @ right, 1e-9)
        for right in (white & seen_white, ~white & ~seen_white)
    )
    return seen_white, np.abs((samples - dark) / np.maximum(light - dark, LEAST_CONTRAST) - seen_white)


def _between(levels: Array, cells: int) -> tuple[Array, float]:
    """Return for each cell (c,) the level between the black and the white around it, and the contrast."""
    square = levels.reshape(cells, cells).astype(np.float32)
    window = np.ones((_WINDOW_CELLS, _WINDOW_CELLS), dtype=np.uint8)
    low, high = cv2.erode(square, window).ravel(), cv2.dilate(square, window).ravel()
    contrast = float(levels.max() - levels.min())
    is_plain = high - low < _PLAIN * contrast
    middle = np.where(is_plain, (levels.max() + levels.min()) / 2, (low + high) / 2)
    return np.asarray(middle, dtype=np.float64), contrast


@cache
def _nearness(cells: int) -> Array:
    """Return the weights (c, c) of cells in the levels around each cell. Far cells count if no others do."""
    row, column = np.divmod(np.arange(cells * cells), cells)
    squared = (row[:, None] - row) ** 2 + (column[:, None] - column) ** 2
    return np.asarray(np.exp(-squared / (2 * _NEAR_CELLS**2)) + 1e-3)


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


TAPS = np.linspace(-1, 1, 13)
# Share of the median height: a lower rise is no edge of the print.
_WEAK, _WEAK_ROUGH = 0.3, 0.25
# RMS of a profile about its step, relative to the step height, and relative to its median over all edges.
_MISSHAPEN, _MISSHAPEN_SURELY, _ODD = 0.02, 0.12, 3.0
# An edge farther out in its profile is cut off.
_CENTRAL = 0.6
# Shorter profiles cannot distinguish a slope of the light from a step.
_LONG_PX = 2.5


class Steps(NamedTuple):
    """Displacements of edges, (m, s) in px, and which of them are clear, (m, s)."""

    off_px: Array
    clear: NDArray[np.bool_]


def masked_median(values: Array, mask: NDArray[np.bool_]) -> Array:
    """Return the medians, (m, 1), of the masked values (m, s); 0.0 if there are none."""
    count = np.count_nonzero(mask, axis=1)
    ordered = np.sort(np.where(mask, values, np.inf), axis=1)
    median = np.take_along_axis(ordered, np.maximum(count - 1, 0)[:, None] // 2, axis=1)
    return np.where(count[:, None] > 0, median, 0.0)


def rough_steps(prints: Prints, profiles: Array, reach_px: float) -> Steps:
    """Return the steepest rises of profiles (m, s, t) that reach far to both sides."""
    rises = np.maximum((profiles[..., 2:] - profiles[..., :-2]) * prints.polarity[..., None], 0.0)
    steepest = rises.argmax(axis=2)[..., None]
    height = np.take_along_axis(rises, steepest, axis=2)[..., 0]
    around = rises * (np.abs(np.arange(rises.shape[2]) - steepest) <= 1)
    off_px = (around @ TAPS[1:-1]) / np.maximum(around.sum(axis=2), 1e-6) * reach_px
    real = prints.polarity != 0
    least = np.maximum(_WEAK_ROUGH * masked_median(height, real), LEAST_CONTRAST)
    return Steps(off_px, real & (height > least))


def exact_steps(prints: Prints, profiles: Array, reach_px: float, blur_px: float) -> Steps:
    """Return the positions of a blurred step in profiles (m, s, t), with a gradient of the light."""
    steps, inverse = _shapes(reach_px, blur_px)
    fitted = profiles @ inverse.T
    misshapen = np.sqrt(np.square(profiles - fitted @ steps.T).mean(axis=2))
    height = fitted[..., 1] * prints.polarity
    real = (prints.polarity != 0) & (height > LEAST_CONTRAST)
    real &= height > _WEAK * masked_median(height, real)
    misshapen = np.divide(misshapen, height, out=np.ones_like(height), where=real)
    off_px = np.divide(fitted[..., 2], fitted[..., 1], out=np.zeros_like(height), where=real)
    real &= (np.abs(off_px) < _CENTRAL * reach_px) & (misshapen < _MISSHAPEN_SURELY)
    usual = masked_median(misshapen, real)
    return Steps(off_px, real & (misshapen < np.maximum(_ODD * usual, _MISSHAPEN)))


def usual_blur(prints: Prints, profiles: Array, reach_px: float) -> float:
    """Return the blur of the edges of one marker in px, from profiles (s, t) across them."""
    rising = profiles * prints.polarity[0][:, None]
    heights = rising[:, -1] - rising[:, 0]
    real = heights > LEAST_CONTRAST
    real &= heights > 0.5 * masked_median(heights[None], real[None])[0]
    if not real.any():
        return float(BLURS_PX[len(BLURS_PX) // 5])
    shapes = (rising[real] - rising[real].mean(axis=1)[:, None]) / heights[real][:, None]
    left = _residues(reach_px) @ np.median(shapes, axis=0)
    return float(BLURS_PX[int(np.square(left).sum(axis=1).argmin())])


@cache
def _residues(reach_px: float) -> Array:
    """Return the matrices of the residuals of a profile about the best step of each blur, (blurs, t, t)."""
    shapes = [_shapes(reach_px, blur_px) for blur_px in BLURS_PX.tolist()]
    return np.array([np.eye(len(TAPS)) - steps @ inverse for steps, inverse in shapes])


@cache
def _shapes(reach_px: float, blur_px: float) -> tuple[Array, Array]:
    """Return foot, height, shift and slope of a blurred step as profiles, (t, 3 or 4), and their inverse."""
    from scipy.special import ndtr  # late: commands that detect nothing start 0.2 s earlier

    x = reach_px * TAPS / blur_px
    bell = np.exp(-(x**2) / 2) / (np.sqrt(2 * np.pi) * blur_px)
    columns = [np.ones_like(x), ndtr(x), -bell]
    if reach_px >= _LONG_PX:
        columns.append(TAPS)
    steps = np.column_stack(columns)
    return steps, np.linalg.pinv(steps)
