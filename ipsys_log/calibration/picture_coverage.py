"""Where in the image, and how tilted, the board was seen: what a lens rests on, and what to add."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["NEAR", "Coverage", "advice", "group_outlines", "measure_coverage"]

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
