"""Selection of the images for a calibration: sharp ones that differ and cover the image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ipsys_log.calibration.board import Board
from ipsys_log.calibration.board_detection import LEAST_CORNERS, Sighting

__all__ = [
    "MOST_PICTURES",
    "NEAR",
    "Chosen",
    "Coverage",
    "Dropped",
    "advice",
    "choose",
    "group_outlines",
    "measure_coverage",
]

Array = NDArray[np.float64]

_CELLS = (8, 6)
# A strip along each side of the image, as a share of it, is where distortion shows most.
_STRIP = 0.15
_ENOUGH_SHARE = 0.6
_ENOUGH_TILT = np.radians(25)
_ENOUGH_TILTED = 3
_ENOUGH_PLACES = 10
# Boards nearer to one another than this share of the image's diagonal show the same.
NEAR = 0.03


@dataclass(frozen=True, slots=True)
class Coverage:
    """Of all corners used: the ``share`` of the image (in 8 x 6 cells) that has any; sides of the image
    near which there is none; how many boards are ``tilted`` by 25 degrees or more; how many ``places`` of the
    board differ by 3 % of the image; and the greatest angle from the optical axis, or None."""

    share: float
    empty_sides: tuple[str, ...]
    tilted: int
    places: int
    widest_rad: float | None = None


def measure_coverage(
    pixels: Array,
    size_px: tuple[int, int],
    outlines: Array,
    normals: Array | None = None,
    points_m: Array | None = None,
) -> Coverage:
    """Where the board was seen.

    Parameters
    ----------
    pixels : (n, 2), all corners.
    size_px : width and height.
    outlines : (f, 4, 2) in px, of the boards.
    normals : (f, 3), of the boards in the frame of the camera, where known.
    points_m : (n, 3), the corners in the frame of the camera, where known.
    """
    size = np.array(size_px, dtype=np.float64)
    relative = (pixels + 0.5) / size
    cells = np.clip((relative * _CELLS).astype(int), 0, np.array(_CELLS) - 1)
    share = len({tuple(cell) for cell in cells.tolist()}) / (_CELLS[0] * _CELLS[1])
    sides = {
        "left": relative[:, 0] < _STRIP,
        "right": relative[:, 0] > 1 - _STRIP,
        "upper": relative[:, 1] < _STRIP,
        "lower": relative[:, 1] > 1 - _STRIP,
    }
    empty = tuple(name for name, near in sides.items() if not near.any())
    tilted = len(outlines)
    if normals is not None:
        tilted = int((np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)) >= _ENOUGH_TILT).sum())
    places = int(group_outlines(outlines, NEAR * float(np.hypot(*size))).max()) + 1
    widest = None
    if points_m is not None:
        widest = float(np.arctan2(np.hypot(points_m[:, 0], points_m[:, 1]), points_m[:, 2]).max())
    return Coverage(share, empty, tilted, places, widest)


def group_outlines(outlines: Array, near_px: float) -> NDArray[np.intp]:
    """The group of each outline (f, 4, 2): that of the nearest first one of a group, or its own."""
    groups: list[int] = []
    leaders: list[Array] = []
    for outline in outlines:
        distances = [float(np.linalg.norm(outline - other, axis=1).mean()) for other in leaders]
        nearest = int(np.argmin(distances)) if distances else 0
        if not distances or not distances[nearest] < near_px:
            nearest = len(leaders)
            leaders.append(outline)
        groups.append(nearest)
    return np.array(groups)


def advice(coverage: Coverage) -> list[str]:
    """What to add to the pictures, in words; nothing where they are good."""
    lines = []
    if coverage.empty_sides:
        *most, last = coverage.empty_sides
        sides = f"{', '.join(most)} and {last} edges" if most else f"{last} edge"
        lines.append(f"no board near the {sides} of the image: hold it there too")
    elif coverage.share < _ENOUGH_SHARE:
        lines.append(f"the board covered {coverage.share:.0%} of the image: move it all over the view")
    if coverage.places < _ENOUGH_PLACES:
        places = "place that differs" if coverage.places == 1 else "places that differ"
        lines.append(f"the board was held at {coverage.places} {places}: move it more")
    if coverage.tilted < _ENOUGH_TILTED:
        lines.append(
            f"tilted by 25 degrees or more in {coverage.tilted} pictures: tilt the board to all sides, "
            "for the focal length is told from that"
        )
    return lines


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
