"""Colours and shapes of cameras and robots on white paper, apart for any colour vision.

The hues are those of Okabe and Ito (2008), without their yellow, which white paper swallows.
"""

from __future__ import annotations

from collections.abc import Iterable

from ipsys_log.sinks.palette import assign_colours

__all__ = ["REST", "camera_styles", "robot_colour"]

# A camera that has the name of a colour gets one that is like it and can be seen.
_NAMED = {"red": "#D55E00", "white": "#8C8C8C", "black": "#000000", "blue": "#0072B2", "green": "#009E73"}
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#8C8C8C")
_SHAPES = "osD^vP*X"
_ROBOTS = ("#56B4E9", "#E69F00", "#CC79A7", "#009E73", "#0072B2", "#9467BD")

# What is not the matter of a picture, but belongs to it.
REST = "#B5B5B5"


def camera_styles(cameras: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker shape for each camera, whatever the order of the names."""
    colours = assign_colours(cameras, _NAMED, _COLOURS)
    return {camera: (colours[camera], _SHAPES[n % len(_SHAPES)]) for n, camera in enumerate(sorted(colours))}


def robot_colour(number: int) -> str:
    """The colour of the first, second ... robot."""
    return _ROBOTS[number % len(_ROBOTS)]
