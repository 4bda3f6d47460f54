"""Printed markers: where their corners are, and what is black on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from ipsys_log.geometry.lenses import project
from ipsys_log.geometry.markers import marker_corners, white_cells
from ipsys_log.geometry.poses import transform
from ipsys_log.messages import CameraCalibration

__all__ = ["Moving", "Placed", "black_cells", "print_outline", "true_corners"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A printed marker in the world.

    ``length_m`` is the side of its black square; a white margin of one cell is printed around it.
    ``world_from_marker`` is (4, 4), the marker's frame that of
    :func:`ipsys_log.geometry.markers.marker_corners`: it may lie at any angle.
    """

    id: int
    length_m: float
    world_from_marker: Array


# A print by the time in s since the time of the frame.
Moving = Callable[[float], Placed]


@cache
def black_cells(dictionary: str, marker_id: int) -> NDArray[np.bool_]:
    """Which cells of the print are black, (n + 2, n + 2) with the white margin, top row first."""
    black: NDArray[np.bool_] = np.pad(~white_cells(dictionary, marker_id), 1)
    black.flags.writeable = False
    return black


def print_outline(placed: Placed, dictionary: str, per_side: int = 8) -> Array:
    """Points around the edge of the print, white margin included, (4 per_side, 3) in world m."""
    cells = len(black_cells(dictionary, placed.id))
    corners = marker_corners(placed.length_m * cells / (cells - 2))
    step = np.linspace(0, 1, per_side, endpoint=False)[None, :, None]
    sides = corners[:, None] + step * (np.roll(corners, -1, axis=0) - corners)[:, None]
    return transform(placed.world_from_marker, sides.reshape(-1, 3))


def true_corners(lens: CameraCalibration, camera_from_world: Array, placed: Placed) -> Array:
    """Pixels of the corners of the black square, in OpenCV's order, as no detector finds them.

    Parameters
    ----------
    lens : of the camera.
    camera_from_world : (4, 4), its pose.
    placed : the marker.

    Returns
    -------
    (4, 2), in px, (0, 0) the centre of the first pixel; clockwise from the marker's own top left.
    """
    camera_from_marker = camera_from_world @ placed.world_from_marker
    return project(transform(camera_from_marker, marker_corners(placed.length_m)), lens)
