"""Colours and symbols of cameras, models and robots, and short names.

The hues are those of Okabe and Ito (2008). Their yellow is left out: it is hard to see on white paper.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

from ipsys_log.plain_text import plain_text
from ipsys_log.sinks.colours import assign_colours

_LONGEST = 24
# A camera with the name of a colour gets a similar colour that is easy to see.
_NAMED = {"red": "#D55E00", "white": "#8C8C8C", "black": "#000000", "blue": "#0072B2", "green": "#009E73"}
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#8C8C8C")
_SHAPES = "osD^vP*X"
_ROBOTS = ("#56B4E9", "#E69F00", "#CC79A7", "#009E73", "#0072B2", "#9467BD")
_LINES = ("-", "--", ":", "-.")
_MODELS = {
    "rigid": ("#0072B2", "o"),
    "poly": ("#D55E00", "s"),
    "ann": ("#CC79A7", "D"),
    "kriging": ("#009E73", "^"),
    "kriging-regression": ("#56B4E9", "v"),
    "rayplane": ("#E69F00", "P"),
    "best": ("#000000", "X"),
    "joint": ("#882255", "*"),
}

# Lightness, in OKLab, of colours that are visible on white paper.
_ON_PAPER = (0.35, 0.75)

# Colours for the less important parts of a figure.
REST = "#B5B5B5"
GRID = "#E6E6E6"
NOTE = "#505050"
# Colour of held-out points; the points of the fit are black.
TEST = "#D7191C"


class ModelStyle(NamedTuple):
    """The style of a model in a figure.

    A hybrid model has the colour of its second model, a dashed ``line`` and larger, hollow marks. So both
    models stay visible if they are the same function.
    """

    colour: str
    line: str
    marker: dict[str, Any]


def camera_styles(cameras: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Return colour and marker shape of each camera, independent of the order of the names."""
    named = {name: to_rgb(colour) for name, colour in _NAMED.items()}
    colours = assign_colours(cameras, named, [to_rgb(colour) for colour in _COLOURS], _ON_PAPER)
    return {
        camera: ("#{:02X}{:02X}{:02X}".format(*colours[camera]), _SHAPES[n % len(_SHAPES)])
        for n, camera in enumerate(sorted(colours))
    }


def to_rgb(colour: str) -> tuple[int, int, int]:
    """Return red, green and blue of a colour, 0 to 255.

    Examples
    --------
    >>> to_rgb("#0072B2")
    (0, 114, 178)
    """
    red, green, blue = bytes.fromhex(colour[1:])
    return red, green, blue


def model_styles(models: Iterable[str]) -> dict[str, ModelStyle]:
    """Return colour, shape and line of each model, the same in every figure and for every set of models."""
    styles = {}
    for model in models:
        first, plus, second = model.partition("+")
        colour, shape = _MODELS.get(second or first, (_COLOURS[-1], "h"))
        marker = {"marker": shape, "ms": 8.5 if plus else 5.5, "mfc": "none" if plus else colour, "mew": 1.2}
        styles[model] = ModelStyle(colour, "--" if plus else "-", marker)
    return styles


def robot_colour(number: int) -> str:
    """Return the colour of a robot by its number, from 0."""
    return _ROBOTS[number % len(_ROBOTS)]


def robot_line(number: int) -> str:
    """Return the line style of a robot by its number, from 0; robots of one colour have different styles."""
    return _LINES[number // len(_ROBOTS) % len(_LINES)]


def shorten(name: str) -> str:
    """Shorten a name from a log to one line that fits into a figure."""
    plain = plain_text(name)
    return plain if len(plain) <= _LONGEST else f"{plain[: _LONGEST - 1]}…"
