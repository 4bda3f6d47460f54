"""Colours and shapes of cameras, robots and models on white paper, apart for any colour vision.

The hues are those of Okabe and Ito (2008), without their yellow, which white paper swallows.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

from ipsys_log.sinks.rerun.palette import assign_colours

__all__ = ["GRID", "NOTE", "REST", "TEST", "ModelStyle", "camera_styles", "model_styles", "robot_colour"]

# A camera that has the name of a colour gets one that is like it and can be seen.
_NAMED = {"red": "#D55E00", "white": "#8C8C8C", "black": "#000000", "blue": "#0072B2", "green": "#009E73"}
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#8C8C8C")
_SHAPES = "osD^vP*X"
_ROBOTS = ("#56B4E9", "#E69F00", "#CC79A7", "#009E73", "#0072B2", "#9467BD")
_MODELS = {
    "rigid": ("#0072B2", "o"),
    "poly": ("#D55E00", "s"),
    "ann": ("#CC79A7", "D"),
    "kriging": ("#009E73", "^"),
    "kriging-regression": ("#56B4E9", "v"),
    "rayplane": ("#E69F00", "P"),
    "best": ("#000000", "X"),
}

# What is not the matter of a picture, but belongs to it.
REST = "#B5B5B5"
GRID = "#E6E6E6"
NOTE = "#505050"
# Places that no model was fitted on, beside black ones that it was fitted on.
TEST = "#D7191C"


class ModelStyle(NamedTuple):
    """A hybrid has the colour of its second model, a dashed ``line`` and hollow, larger marks: where both
    are the same function, both are seen."""

    colour: str
    line: str
    marker: dict[str, Any]


def camera_styles(cameras: Iterable[str]) -> dict[str, tuple[str, str]]:
    """Colour and marker shape for each camera, whatever the order of the names."""
    colours = assign_colours(cameras, _NAMED, _COLOURS)
    return {camera: (colours[camera], _SHAPES[n % len(_SHAPES)]) for n, camera in enumerate(sorted(colours))}


def model_styles(models: Iterable[str]) -> dict[str, ModelStyle]:
    """Colour, shape and line of each model, the same in every picture and for every choice of models."""
    styles = {}
    for model in models:
        first, plus, second = model.partition("+")
        colour, shape = _MODELS.get(second or first, (_COLOURS[-1], "h"))
        marker = {"marker": shape, "ms": 8.5 if plus else 5.5, "mfc": "none" if plus else colour, "mew": 1.2}
        styles[model] = ModelStyle(colour, "--" if plus else "-", marker)
    return styles


def robot_colour(number: int) -> str:
    """The colour of the first, second ... robot."""
    return _ROBOTS[number % len(_ROBOTS)]
