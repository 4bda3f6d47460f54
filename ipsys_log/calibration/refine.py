"""Corners of squares from the edges that meet in them.

Around a corner there is little to see, and on a ChArUco board markers come near it. Its four edges are
long. A camera's gamma and the markers' borders shift an edge towards its white side, or its black one;
the white side changes at the corner, so that an edge is shifted to both sides alike, and goes through the
corner as before.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

__all__ = ["refine_corners"]

Array = NDArray[np.float64]
Grey = NDArray[np.uint8]

# Along an edge, in squares from the corner; the same on both sides of it.
_ALONG = np.linspace(0.12, 0.5, 9)
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
    on = np.concatenate([corner + _ALONG[:, None] * arm for arm in pair])
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
    half = len(_ALONG)
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
