"""Corners from the edges of a marker: least squares of its pose until the print matches the image.

The fit starts from an approximate pose. It projects points on all edges between black and white of the known
print, the inner edges too, into the image, with the lens distortion. It reads a short profile of grey levels
across each edge and fits a blurred step to it. The distance of the step from the middle of the profile is
the displacement of the edge. One small rotation and translation of the marker explains all displacements at
once. The next pass starts from the new pose, until the pose converges.

A rolling shutter exposes row after row, so the image shows each point of the print at a different time. The
edges then also determine the speed along the print.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.messages import Array, CameraCalibration, Grey
from ipsys_log.stages.detect.adjustment import (
    Guess,
    MarkerFit,
    edge_derivatives,
    inside_image,
    outline,
    poses_of,
    prior,
    sample_cells,
    solve,
)
from ipsys_log.stages.detect.prints import LEAST_CONTRAST, MarkerView, Poses, Prints, build_prints, measure
from ipsys_log.stages.detect.uneven_light import count_contradictions

_MOVED_FAR_PX = 1.0
_PASSES = 7
# A fit has converged if its last step is shorter.
_SETTLED_PX = 0.12
_SHORT_PX = 8.0
# Motion blurs edges that rise by less than this share of the step from black to white.
_BLURRED = 0.6
# Least share of visible edges: of all, and of those between cells. Prints with smaller cells, such as those
# of another dictionary, show a third of the latter at most (test_prints_of_another_kind_are_named).
_SEEN, _SEEN_INSIDE = 0.6, 0.5
_EXACT_PX = 0.05
_WRONG_CELLS = 1
# Signs of glare, a shadow or a cover. First sign: a side is displaced by _SIDE_OFF times the edges' spread.
# Second sign: the black beside some edges is lighter than beside the others, by _LIGHTER times the contrast.
# A few edges may have lighter black, because a neighbouring white cell reaches them if cells are small.
_SIDE_OFF, _LIGHTER = 0.85, 0.35
_WIDE_SPREAD_PX, _SIDE_OFF_WIDE = 0.12, 0.6
_LEAST_SPREAD_PX, _FEW, _SMALL_PX = 0.03, 3, 4.0
# Third sign: the spread of the edges is larger than _SPREAD_PX. If motion blurs edges, or seems to blur
# them, sides are displaced by shares of the blur's width. The surroundings of an edge then mix with it.
_SPREAD_PX, _LIGHTER_BLURRED = 0.3, 0.6


def fit_edges(
    grey: Grey,
    guesses: Sequence[Guess],
    dictionary: str,
    lens: CameraCalibration,
    edge_offset_px: float | None = None,
    row_time_s: float = 0.0,
    blur_px: float | None = None,
) -> list[MarkerFit | None]:
    """Fit marker poses to an image.

    Parameters
    ----------
    grey : (height, width).
    guesses : markers and their approximate poses, with errors of a few pixels.
    dictionary : OpenCV's name, such as DICT_4X4_100.
    lens : intrinsics of the camera.
    edge_offset_px : offset of edges into the black; None: estimated with each marker.
    row_time_s : time between the exposures of two rows. Poses are valid for the exposure of the row of the
        marker centre.
    blur_px : blur of edges in images of this camera; None: estimated from this image.

    Returns
    -------
    The fit of each guess, or None if the image does not show the marker. It is None if the fit does not
    converge, edges are missing, a corner is outside the image, or the cells do not match this id.
    """
    possible = poses_of(guesses).is_visible() if guesses else np.ones(0, dtype=bool)
    if not possible.all():
        some = [guess for guess, ok in zip(guesses, possible, strict=True) if ok]
        fits = iter(fit_edges(grey, some, dictionary, lens, edge_offset_px, row_time_s, blur_px))
        return [next(fits) if ok else None for ok in possible]
    if not guesses:
        return []
    view = MarkerView(
        grey, lens, build_prints(dictionary, tuple(guess.id for guess in guesses)), row_time_s, blur_px
    )
    settled, (corners_px, slopes, levels) = _settle_all(view, guesses, edge_offset_px)
    colours = _bright_and_dark(view.prints, levels)
    wrong = _count_wrong(view.prints, levels, colours)
    good = settled.good & inside_image(corners_px, grey) & (wrong <= _WRONG_CELLS)
    for n in np.flatnonzero(good & (wrong > 0)).tolist():
        pose = Guess(guesses[n].id, settled.poses.rotations[n], settled.poses.centres[n])
        good[n] = not count_contradictions(sample_cells(view, pose), dictionary, pose.id)
    uneven = _uneven(view.prints, settled, colours)
    covariances_px2 = slopes @ settled.covariances @ slopes.transpose(0, 2, 1)
    return [
        MarkerFit(
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
    """Fitted poses with their residuals.

    ``covariances`` (m, 6, 6) are those of the twists in print coordinates. ``ends`` (m, s, 2) are levels at
    both ends of the profiles. ``cells_px`` (m,) is the least width of a cell, and ``sides_off_px`` (m,) the
    largest displacement of a side.
    """

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
        """Return these fits where they are good, and the other fits elsewhere."""
        if not good.any():
            return other
        chosen = [
            np.where(good.reshape(-1, *[1] * (own.ndim - 1)), own, others)
            for own, others in zip(self[1:], other[1:], strict=True)
        ]
        return _Settled(self.poses.select(good, other.poses), *chosen)


def _settle_all(
    view: MarkerView, guesses: Sequence[Guess], edge_offset_px: float | None
) -> tuple[_Settled, tuple[Array, Array, Array]]:
    """Fit markers until they converge; repeat the fit if edges are blurred; return fits and outlines."""
    settled = _settle(view, guesses, edge_offset_px, np.array([guess.blurred for guess in guesses]))
    outlines = outline(view, settled.poses)
    more = _blurred(view.prints, settled.heights, outlines[2]) & ~settled.blurred
    if more.any():
        sharp = settled.blurred
        settled = _settle(view, guesses, edge_offset_px, sharp | more)
        if (more.any(axis=1) & settled.good).any():
            settled = _sharpened(view, guesses, edge_offset_px, sharp, settled)
        outlines = outline(view, settled.poses)
    return settled, outlines


def _sharpened(
    view: MarkerView,
    guesses: Sequence[Guess],
    edge_offset_px: float | None,
    blurred: NDArray[np.bool_],
    settled: _Settled,
) -> _Settled:
    """Return the fits, or sharp fits if only ``blurred`` axes (m, 2) stay blurred in a fit from their poses.

    If a guess has a large error, sharp edges seem to be blurred.
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
    view: MarkerView, guesses: Sequence[Guess], edge_offset_px: float | None, blurred: NDArray[np.bool_]
) -> _Settled:
    """Move markers until they converge; ``blurred`` (m, 2) marks the axes across which edges are blurred."""
    poses = poses_of(guesses)
    # The unknowns are a twist, the edge offset and, with a rolling shutter, the speed along the print.
    unknowns = 9 if view.row_time_s else 7
    known, hold = prior(guesses, edge_offset_px)
    known, hold, motions = known[:, :unknowns], hold[:, :unknowns], known[:, 7:]
    wide = blurred
    doubt: Array | float = 1.0
    for _ in range(_PASSES):
        seen = measure(view, poses, motions, wide)
        rows = edge_derivatives(view.prints, poses.camera_positions(), seen.slopes, seen.late, unknowns)
        # The edges were measured at the positions that follow from the speed known so far.
        off_px = seen.off_px
        if view.row_time_s:
            off_px = off_px + (motions[:, None, :2] @ rows[:, 7:])[:, 0]
        weights = seen.certainty / doubt
        normal, solution = solve(rows, weights, off_px, known, hold)
        left_px = off_px - (solution[:, None] @ rows)[:, 0]
        # A step is the motion by the twist plus the motion by the change of the speed.
        moved_px = np.abs(seen.off_px - left_px + solution[:, 6:7] * view.prints.polarity).max(axis=1)
        # A step of many pixels comes from another edge.
        short = np.minimum(1.0, _SHORT_PX / np.maximum(moved_px, _SHORT_PX))
        moved = poses.move(solution[:, :6] * short[:, None])
        # The pose of a false marker can diverge, even to a pose behind the camera. It then keeps its last
        # possible pose and never converges.
        possible = moved.is_visible()
        if possible.all():
            poses = moved
        else:
            poses, moved_px = moved.select(possible, poses), np.where(possible, moved_px, np.inf)
        if view.row_time_s:
            motions = np.concatenate([solution[:, 7:], motions[:, 2:]], axis=1)
        spread_px = np.sqrt((weights * left_px**2).sum(axis=1) / np.maximum(weights.sum(axis=1), 1e-9))
        if (moved_px < _SETTLED_PX).all():
            break
        wide = blurred | (moved_px > _MOVED_FAR_PX)[:, None]
        # Edges with residuals above twice the spread get less weight.
        doubt = np.maximum(1.0, np.abs(left_px) / (_EXACT_PX + 2 * spread_px)[:, None])
    count = weights.sum(axis=1)
    variances_px2 = spread_px**2 * count / np.maximum(count - unknowns, 1.0)
    covariances: Array = np.linalg.inv(normal)[:, :6, :6] * variances_px2[:, None, None]
    enough = (seen.certainty > 0).sum(axis=1) > _SEEN * np.abs(view.prints.polarity).sum(axis=1)
    inside = ((seen.certainty > 0)[:, None] @ view.prints.inner)[:, 0, 0] > _SEEN_INSIDE
    good = enough & inside & (moved_px < _SETTLED_PX)
    sided = (left_px * view.prints.polarity * (seen.certainty > 0))[:, None] @ view.prints.by_side
    return _Settled(
        poses,
        solution[:, 6],
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
    """Return the axes (m, 2) across which edges rise by less than the step from black to white cells."""
    bright, dark = _bright_and_dark(prints, levels)
    rises = (heights[:, None] @ prints.by_axis)[:, 0]
    return np.asarray(rises < _BLURRED * (bright - dark)[:, None])


def _bright_and_dark(prints: Prints, levels: Array) -> tuple[Array, Array]:
    """Return the mean grey levels of the white cells and of the black cells, (m,) each."""
    bright, dark = (levels[:, None] @ prints.by_colour)[:, 0].T
    return bright, dark


def _count_wrong(prints: Prints, levels: Array, colours: tuple[Array, Array]) -> NDArray[np.int_]:
    """Return the number (m,) of cells with the wrong colour, from grey levels (m, c)."""
    bright, dark = colours
    wrong = (levels > ((bright + dark) / 2)[:, None]) != prints.white
    no_print = bright - dark <= LEAST_CONTRAST
    return np.asarray(np.count_nonzero(wrong, axis=1) + wrong.shape[1] * no_print)


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
