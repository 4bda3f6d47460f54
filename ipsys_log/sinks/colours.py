"""Colours of cameras, robots and calibration points, for any viewer.

The hues are from Okabe and Ito (2008); some are lighter for a dark background.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

__all__ = [
    "KIND_COLOURS",
    "MARKER_COLOUR",
    "TRUTH_COLOUR",
    "assign_colours",
    "camera_colours",
    "robot_colour",
]

RGB = tuple[int, int, int]
Colour = TypeVar("Colour")

MARKER_COLOUR: RGB = (40, 230, 90)
TRUTH_COLOUR: RGB = (190, 190, 190)
KIND_COLOURS: dict[str, RGB] = {
    "training": (130, 130, 130),
    "test": (240, 228, 66),
    "measured": (130, 130, 130),
}

# A camera that is named after a colour gets this colour, in a visible shade.
_NAMED: dict[str, RGB] = {
    "red": (235, 95, 60),
    "white": (240, 240, 240),
    "black": (110, 110, 120),
    "blue": (70, 150, 235),
    "green": (0, 180, 130),
    "yellow": (240, 228, 66),
}
_REST: tuple[RGB, ...] = (
    (70, 150, 235),
    (230, 159, 0),
    (0, 180, 130),
    (204, 121, 167),
    (235, 95, 60),
    (86, 200, 233),
)
_ROBOTS: tuple[RGB, ...] = (
    (86, 200, 233),
    (230, 159, 0),
    (0, 190, 140),
    (230, 130, 190),
    (150, 150, 255),
    (170, 215, 60),
    (240, 110, 80),
)


def assign_colours(
    cameras: Iterable[str], named: Mapping[str, Colour], rest: Sequence[Colour]
) -> dict[str, Colour]:
    """Assign a colour to each camera, independent of the order of the names.

    A camera that is named after a colour in ``named`` gets this colour; the others share the ``rest``.
    """
    cameras = sorted(set(cameras))
    colours = {camera: named[camera] for camera in cameras if camera in named}
    free = [colour for colour in rest if colour not in colours.values()] or list(rest)
    for number, camera in enumerate(camera for camera in cameras if camera not in named):
        colours[camera] = free[number % len(free)]
    return colours


def camera_colours(cameras: Iterable[str]) -> dict[str, RGB]:
    """Return colours for cameras on a dark background."""
    return assign_colours(cameras, _NAMED, _REST)


def robot_colour(number: int) -> RGB:
    """Return the colour of the first, second ... robot; the eighth robot has the colour of the first."""
    return _ROBOTS[number % len(_ROBOTS)]
