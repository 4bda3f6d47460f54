"""Colours of cameras, robots and calibration points, for any viewer.

The first hues are from Okabe and Ito (2008); some are lighter for a dark background. A hall has more cameras
than these hues: each further colour is the one with the greatest perceived distance from all colours before.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

RGB = tuple[int, int, int]

# Lightness, in OKLab, of colours that are visible on a dark background.
_ON_DARK = (0.6, 0.88)
# Steps of red, green and blue between the candidates of further colours.
_STEP = 15

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
# From linear sRGB to the responses of cones, and from their cube roots to OKLab.
_CONES = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LAB = np.array(
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
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
    cameras: Iterable[str], named: Mapping[str, RGB], rest: Sequence[RGB], lightness: tuple[float, float]
) -> dict[str, RGB]:
    """Assign a colour to each camera, independent of the order of the names. No two cameras have the same.

    A camera that is named after a colour in ``named`` gets this colour; the others get the ``rest``, and
    then further colours of a ``lightness``.
    """
    cameras = sorted(set(cameras))
    colours = {camera: named[camera] for camera in cameras if camera in named}
    others = [camera for camera in cameras if camera not in named]
    free = [colour for colour in rest if colour not in colours.values()][: len(others)]
    free += more_colours((*colours.values(), *free), len(others) - len(free), lightness)
    return colours | dict(zip(others, free, strict=True))


def camera_colours(cameras: Iterable[str]) -> dict[str, RGB]:
    """Return colours for cameras on a dark background."""
    return assign_colours(cameras, _NAMED, _REST, _ON_DARK)


def robot_colour(number: int) -> RGB:
    """Return the colour of the first, second ... robot on a dark background."""
    if number < len(_ROBOTS):
        return _ROBOTS[number]
    return more_colours(_ROBOTS, number + 1 - len(_ROBOTS), _ON_DARK)[-1]


@cache
def more_colours(known: tuple[RGB, ...], count: int, lightness: tuple[float, float]) -> tuple[RGB, ...]:
    """Return further colours; each has the greatest distance from all colours before it.

    Parameters
    ----------
    known : the colours before.
    count : the number of colours, at most 1000.
    lightness : the range of their lightness in OKLab, 0 to 1.

    References
    ----------
    M. Petroff, Accessible color sequences for data visualization, 2021, for the rule of greatest distances.
    B. Ottosson, A perceptual color space for image processing, 2020, for OKLab.

    Examples
    --------
    >>> more_colours(((0, 0, 0), (255, 255, 255)), 1, (0.6, 0.9))
    ((195, 0, 240),)
    """
    levels = np.arange(0, 256, _STEP)
    candidates = np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)
    places = oklab(candidates)
    suitable = (places[:, 0] >= lightness[0]) & (places[:, 0] <= lightness[1])
    candidates, places = candidates[suitable], places[suitable]
    apart = np.full(len(places), np.inf)
    for place in oklab(np.array(known).reshape(-1, 3)):
        apart = np.minimum(apart, np.linalg.norm(places - place, axis=1))
    chosen: list[RGB] = []
    for _ in range(count):
        best = int(apart.argmax())
        red, green, blue = candidates[best].tolist()
        chosen.append((red, green, blue))
        apart = np.minimum(apart, np.linalg.norm(places - places[best], axis=1))
    return tuple(chosen)


def oklab(colours: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return colours (n, 3) of sRGB, 0 to 255, in OKLab, in which distances are those that people see."""
    share = np.asarray(colours) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.cbrt(linear @ _CONES.T) @ _LAB.T)
