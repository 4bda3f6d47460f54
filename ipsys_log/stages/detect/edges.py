"""Corners from the edges of a marker: its pose is moved until the print lies on the picture.

From an approximate pose, points on all edges between black and white of the known print, the inner ones
too, are sent through the lens into the picture. Across each edge a short profile of grey levels is read, and
a blurred step is fitted to it: how far it lies beside the middle is how far the edge is off. One small turn
and shift of the marker explains all of them at once; the next pass starts from there, until nothing moves.

Where a sensor exposes row after row, each point of the print is seen where it was at its own time: the speed
along the print is one more thing that the edges tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.images.decode import Grey
from ipsys_log.messages import CameraCalibration
from ipsys_log.stages.detect.adjustment import (
    Fit,
    Guess,
    into_poses,
    known_unknowns,
    moves,
    outline,
    solve,
    whole,
)
from ipsys_log.stages.detect.prints import Prints, lay_out
from ipsys_log.stages.detect.profiles import LEAST_CONTRAST, Poses, View, measure

__all__ = ["Fit", "Guess", "fit_edges"]

Array = NDArray[np.float64]

_MOVED_FAR_PX = 1.0
_PASSES = 7
# The last step of a fit that has settled is shorter.
_SETTLED_PX = 0.12
_SHORT_PX = 8.0
# Edges that rise by less than this share from black to white are blurred by motion.
_BLURRED = 0.6
_SEEN = 0.6
_EXACT_PX = 0.05
_WRONG_CELLS = 1
# Signs of glare, a shadow or a cover: a side is displaced by this share of the edges' spread, or the black
# beside some edges is lighter than beside the others, by that share of the contrast. A few edges
# may be: a neighbouring white cell reaches as far where cells are small.
_SIDE_OFF, _LIGHTER = 0.85, 0.35
_WIDE_SPREAD_PX, _SIDE_OFF_WIDE = 0.12, 0.6
_LEAST_SPREAD_PX, _FEW, _SMALL_PX = 0.03, 3, 4.0
# Or the edges are spread by more px. If motion blurs them, or seems to, sides are displaced by shares of the
# blur's width, and the surroundings of an edge mix with it.
_SPREAD_PX, _LIGHTER_BLURRED = 0.3, 0.6


def fit_edges(
    grey: Grey,
    guesses: Sequence[Guess],
    dictionary: str,
    lens: CameraCalibration,
    edge_offset_px: float | None = None,
    row_time_s: float = 0.0,
    blur_px: float | None = None,
) -> list[Fit | None]:
    """Fit marker poses to a picture.

    Parameters
    ----------
    grey : (height, width).
    guesses : markers and their approximate poses, to some pixels.
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : of the camera.
    edge_offset_px : offset of edges into the black; None: estimated with each marker.
    row_time_s : between the exposures of two rows. Poses are valid for the exposure of the row of the marker
        centre.
    blur_px : of edges in pictures of this camera; None: estimated from these.

    Returns
    -------
    For each guess the fit, or None if there is no such marker: the fit does not converge, edges are missing,
    a corner lies outside of the picture, or the cells do not match this id.
    """
    possible = into_poses(guesses).possible() if guesses else np.ones(0, dtype=bool)
    if not possible.all():
        some = [guess for guess, ok in zip(guesses, possible, strict=True) if ok]
        found = iter(fit_edges(grey, some, dictionary, lens, edge_offset_px, row_time_s, blur_px))
        return [next(found) if ok else None for ok in possible]
    if not guesses:
        return []
    view = View(grey, lens, lay_out(dictionary, tuple(guess.id for guess in guesses)), row_time_s, blur_px)
    settled, (corners_px, slopes, levels) = _settle_all(view, guesses, edge_offset_px)
    colours = _bright_and_dark(view.prints, levels)
    good = settled.good & whole(corners_px, grey) & _same_cells(view.prints, levels, colours)
    uneven = _uneven(view.prints, settled, colours)
    covariances_px2 = slopes @ settled.covariances @ slopes.transpose(0, 2, 1)
    return [
        Fit(
            Guess(guess.id, settled.poses.rotations[n], settled.poses.centres[n], None, settled.blurred[n]),
            corners_px[n],
            covariances_px2[n],
            float(settled.edge_offsets_px[n]),
            float(settled.spreads_px[n]),
            float(settled.blurs_px[n]),
            bool(uneven[n]),
        )
        if good[n]
        else None
        for n, guess in enumerate(guesses)
    ]


class _Settled(NamedTuple):
    """Fitted poses; ``covariances`` (m, 6, 6) of the twists in print coordinates; ``ends`` (m, s, 2), levels
    at both ends of the profiles; ``cells_px`` (m,), least width of a cell; ``sides_off_px`` (m,), largest
    displacement of a side."""

    poses: Poses
    edge_offsets_px: Array
    covariances: Array
    good: NDArray[np.bool_]
    heights: Array
    cells_px: Array
    blurred: NDArray[np.bool_]
    spreads_px: Array
    blurs_px: Array
    ends: Array
    sides_off_px: Array

    def where(self, good: NDArray[np.bool_], other: _Settled) -> _Settled:
        """Return the good ones of these fits, and others instead of the rest."""
        if not good.any():
            return other
        chosen = [
            np.where(good.reshape(-1, *[1] * (one.ndim - 1)), one, two)
            for one, two in zip(self[1:], other[1:], strict=True)
        ]
        return _Settled(self.poses.where(good, other.poses), *chosen)


def _settle_all(
    view: View, guesses: Sequence[Guess], edge_offset_px: float | None
) -> tuple[_Settled, tuple[Array, Array, Array]]:
    """Fit markers until they converge, again if edges are blurred; return them with their outlines."""
    settled = _settle(view, guesses, edge_offset_px, np.array([guess.blurred for guess in guesses]))
    seen = outline(view, settled.poses)
    more = _blurred(view.prints, settled.heights, seen[2]) & ~settled.blurred
    if more.any():
        sharp = settled.blurred
        settled = _settle(view, guesses, edge_offset_px, sharp | more)
        if (more.any(axis=1) & settled.good).any():
            settled = _sharpened(view, guesses, edge_offset_px, sharp, settled)
        seen = outline(view, settled.poses)
    return settled, seen


def _sharpened(
    view: View,
    guesses: Sequence[Guess],
    edge_offset_px: float | None,
    blurred: NDArray[np.bool_],
    settled: _Settled,
) -> _Settled:
    """Return the fits; sharp ones if only ``blurred`` axes (m, 2) stay blurred in a fit from their poses.

    If a guess is far off, sharp edges seem to be blurred.
    """
    poses = settled.poses
    nearer = [
        guess._replace(rotation=poses.rotations[n], centre=poses.centres[n])
        for n, guess in enumerate(guesses)
    ]
    sharp = _settle(view, nearer, edge_offset_px, blurred)
    more = _blurred(view.prints, sharp.heights, outline(view, sharp.poses)[2]) & ~blurred
    seemed = (settled.blurred & ~blurred).any(axis=1)
    return sharp.where(seemed & settled.good & sharp.good & ~more.any(axis=1), settled)


def _settle(
    view: View, guesses: Sequence[Guess], edge_offset_px: float | None, blurred: NDArray[np.bool_]
) -> _Settled:
    """Move markers until they converge; ``blurred`` (m, 2) marks the axes across which edges are blurred."""
    poses = into_poses(guesses)
    # Unknown are a twist, the edge offset and, where rows take time, the speed along the print.
    unknowns = 9 if view.row_time_s else 7
    known, hold = known_unknowns(guesses, edge_offset_px)
    known, hold, motions = known[:, :unknowns], hold[:, :unknowns], known[:, 7:]
    wide = blurred
    doubt: Array | float = 1.0
    for _ in range(_PASSES):
        seen = measure(view, poses, motions, wide)
        rows = moves(view.prints, poses.camera(), seen.slopes, seen.late, unknowns)
        # Edges were looked for where they are at the speed known so far.
        off_px = seen.off_px
        if view.row_time_s:
            off_px = off_px + (motions[:, None, :2] @ rows[:, 7:])[:, 0]
        weights = seen.certainty / doubt
        normal, found = solve(rows, weights, off_px, known, hold)
        left_px = off_px - (found[:, None] @ rows)[:, 0]
        # Steps are what the twist moves, and what the speed does that was not known before.
        moved_px = np.abs(seen.off_px - left_px + found[:, 6:7] * view.prints.polarity).max(axis=1)
        # A step of many pixels was read off another edge.
        short = np.minimum(1.0, _SHORT_PX / np.maximum(moved_px, _SHORT_PX))
        moved = poses.moved(found[:, :6] * short[:, None])
        # What is no marker may run away, behind the camera even: it stays, and never settles.
        possible = moved.possible()
        if possible.all():
            poses = moved
        else:
            poses, moved_px = moved.where(possible, poses), np.where(possible, moved_px, np.inf)
        if view.row_time_s:
            motions = np.concatenate([found[:, 7:], motions[:, 2:]], axis=1)
        spread_px = np.sqrt((weights * left_px**2).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-9))
        if (moved_px < _SETTLED_PX).all():
            break
        wide = blurred | (moved_px > _MOVED_FAR_PX)[:, None]
        # What still lies beside the others, beyond twice their spread, counts for less.
        doubt = np.maximum(1.0, np.abs(left_px) / (_EXACT_PX + 2 * spread_px)[:, None])
    count = weights.sum(axis=1)
    variances_px2 = spread_px**2 * count / np.maximum(count - unknowns, 1.0)
    covariances: Array = np.linalg.inv(normal)[:, :6, :6] * variances_px2[:, None, None]
    enough = (seen.certainty > 0).sum(axis=1) > _SEEN * np.abs(view.prints.polarity).sum(axis=1)
    good = enough & (moved_px < _SETTLED_PX)
    sided = (left_px * view.prints.polarity * (seen.certainty > 0))[:, None] @ view.prints.by_side
    return _Settled(
        poses,
        found[:, 6],
        covariances,
        good,
        seen.heights(view.prints),
        seen.slopes.min(axis=1) / view.prints.cells,
        blurred,
        spread_px,
        seen.blurs_px,
        seen.ends(),
        np.abs(sided[:, 0]).max(axis=1),
    )


def _blurred(prints: Prints, heights: Array, levels: Array) -> NDArray[np.bool_]:
    """Across which axes edges rise by less than from black cells to white ones, (m, 2)."""
    bright, dark = _bright_and_dark(prints, levels)
    rises = (heights[:, None] @ prints.by_axis)[:, 0]
    return np.asarray(rises < _BLURRED * (bright - dark)[:, None])


def _bright_and_dark(prints: Prints, levels: Array) -> tuple[Array, Array]:
    """Mean grey levels of the cells that are white, and of those that are black, (m,) each."""
    bright, dark = (levels[:, None] @ prints.by_colour)[:, 0].T
    return bright, dark


def _same_cells(prints: Prints, levels: Array, colours: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Return whether cells have the right colours, (m,), from their grey levels (m, c)."""
    bright, dark = colours
    wrong = np.count_nonzero((levels > ((bright + dark) / 2)[:, None]) != prints.white, axis=1)
    return np.asarray((wrong <= _WRONG_CELLS) & (bright - dark > LEAST_CONTRAST))


def _uneven(prints: Prints, settled: _Settled, colours: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Return the markers (m,) with edges that glare, a shadow or a cover may have moved."""
    black = np.where(prints.polarity > 0, settled.ends[..., 0], settled.ends[..., 1])
    black[prints.polarity == 0] = -np.inf
    black.sort(axis=1)
    bright, dark = colours
    lighter = black[:, -_FEW] - black[:, black.shape[1] // 2]
    lighter /= np.maximum(bright - dark, LEAST_CONTRAST)
    spreads_px = settled.spreads_px
    off = settled.sides_off_px / np.maximum(spreads_px, _LEAST_SPREAD_PX)
    sharp = (lighter > _LIGHTER) & (settled.cells_px > _SMALL_PX)
    sharp |= (off > _SIDE_OFF) | (spreads_px > _SPREAD_PX)
    sharp |= (off > _SIDE_OFF_WIDE) & (spreads_px > _WIDE_SPREAD_PX)
    moving = (lighter > _LIGHTER_BLURRED) | (spreads_px > _SPREAD_PX)
    return np.asarray(np.where(settled.blurred.any(axis=1), moving, sharp))
