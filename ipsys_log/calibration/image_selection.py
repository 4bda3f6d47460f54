"""Which pictures a lens is fitted to: sharp ones, that differ, and not more than are needed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import LEAST_CORNERS, Sighting

__all__ = ["MOST_PICTURES", "Chosen", "Dropped", "choose"]

MOST_PICTURES = 50
# Edges so much wider than those of the sharp half are blurred, if they are as wide as this.
_BLURRED = 2.2
_BLURRED_PX = 1.8
# A board that moved less than this share of the image's diagonal shows nothing new.
_SAME = 0.0005


class Dropped(NamedTuple):
    """A picture that is not used, and why."""

    name: str
    reason: str


class Chosen(NamedTuple):
    """Pictures to fit to, those that are bad, and those that are good but show nothing new."""

    used: list[Sighting]
    bad: list[Dropped]
    spare: list[Dropped]


def choose(sightings: Sequence[Sighting], board: Board, size_px: tuple[int, int]) -> Chosen:
    """Choose among the pictures in which the board was seen.

    Where there are more than are needed, each next one is that whose board lies farthest from all boards
    chosen so far, blurred ones counting for less: outlines that are far apart differ in place, size,
    turn or tilt.

    Parameters
    ----------
    sightings : in the order of the pictures.
    board, size_px : what was seen, and width and height of the pictures.
    """
    bad, good = [], []
    usual_px = _usual_blur_px(sightings)
    for sighting in sightings:
        reason = _fault(sighting, board, usual_px)
        if reason is None:
            good.append(sighting)
        else:
            bad.append(Dropped(sighting.name, reason))
    if not good:
        return Chosen([], bad, [])
    order, spare = _spread(good, usual_px, _SAME * float(np.hypot(*size_px)))
    return Chosen([good[n] for n in sorted(order)], bad, spare)


def _usual_blur_px(sightings: Sequence[Sighting]) -> float:
    widths = [s.blur_px for s in sightings if s.blur_px > 0]
    return float(np.quantile(widths, 0.25)) if widths else 0.0


def _fault(sighting: Sighting, board: Board, usual_px: float) -> str | None:
    count = len(sighting.ids)
    if count < LEAST_CORNERS or min(len(set(line)) for line in board.places(sighting.ids).T.tolist()) < 2:
        return f"only {count} corners are seen" if count < LEAST_CORNERS else "its corners lie on one line"
    if usual_px and sighting.blur_px > max(_BLURRED * usual_px, _BLURRED_PX):
        return f"blurred: edges are {sighting.blur_px:.1f} px wide, in the sharp pictures {usual_px:.1f}"
    return None


def _spread(good: Sequence[Sighting], usual_px: float, same_px: float) -> tuple[list[int], list[Dropped]]:
    """Numbers of the pictures to use, and the others with what they are like."""
    outlines = np.stack([s.outline for s in good])
    sharp = np.array([min(1.0, usual_px / s.blur_px) if s.blur_px > 0 else 1.0 for s in good])
    order = [int(np.argmax(sharp * [len(s.ids) for s in good]))]
    nearest = np.full(len(good), order[0])
    distances = _distances_px(outlines, outlines[order[0]])
    while len(order) < min(len(good), MOST_PICTURES):
        farthest = int(np.argmax(distances * sharp))
        if distances[farthest] <= same_px:
            break
        order.append(farthest)
        anew = _distances_px(outlines, outlines[farthest])
        nearest[anew < distances] = farthest
        distances = np.minimum(distances, anew)
    used = set(order)
    spare = [
        Dropped(s.name, f"shows the board nearly as {good[nearest[n]].name} does")
        for n, s in enumerate(good)
        if n not in used
    ]
    return order, spare


def _distances_px(outlines: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean distance of the four corners of each outline (n, 4, 2) from those of another."""
    return np.asarray(np.linalg.norm(outlines - other, axis=2).mean(axis=1))
