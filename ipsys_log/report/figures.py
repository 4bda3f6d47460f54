"""Figures as bytes, equal for equal figures, and the colours and symbols of figures.

The hues are those of Okabe and Ito (2008), without their yellow, which white paper swallows.
"""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ipsys_log.plain_text import plain_text
from ipsys_log.sinks.rerun.scene import assign_colours

__all__ = [
    "GRID",
    "NOTE",
    "REST",
    "TEST",
    "ModelStyle",
    "camera_styles",
    "model_styles",
    "picture",
    "png",
    "robot_colour",
    "scale_logarithmic",
    "set_ticks",
    "shorten",
    "strip",
    "svg_uri",
]

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


_DPI = 150
_LONGEST = 24
# Without the time of writing.
_WITHOUT: dict[str, dict[str, object]] = {
    "pdf": {"metadata": {"Creator": None, "Producer": None, "CreationDate": None}},
    "jpg": {},
    "jpeg": {},
    "webp": {},
}


def png(figure: Figure, dpi: int = _DPI) -> bytes:
    """A figure as the bytes of a PNG."""
    return _saved(figure, format="png", dpi=dpi, metadata={"Software": None})


def picture(figure: Figure, path: Path, dpi: int = _DPI) -> bytes:
    """A figure as the bytes of the kind of file that a name ends in, one of ``PICTURES``."""
    kind = path.suffix.lower().removeprefix(".")
    if kind == "png":
        return png(figure, dpi)
    return _svg(figure) if kind == "svg" else _saved(figure, format=kind, dpi=dpi, **_WITHOUT[kind])


def _svg(figure: Figure) -> bytes:
    with matplotlib.rc_context({"svg.hashsalt": "ipsys", "svg.fonttype": "path"}):
        return _saved(figure, format="svg", metadata={"Date": None, "Creator": None})


def svg_uri(figure: Figure) -> str:
    """A figure as an address that holds the picture itself."""
    data = _svg(figure)
    return f"data:image/svg+xml;base64,{base64.b64encode(data).decode()}"


def _saved(figure: Figure, **how: object) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # A name in letters that the font lacks is drawn as boxes.
        warnings.filterwarnings("ignore", message="Glyph")
        figure.savefig(buffer, **how)  # type: ignore[arg-type]
    return buffer.getvalue()


def shorten(name: str) -> str:
    """A name out of a log as a picture has room for it, on one line."""
    plain = plain_text(name)
    return plain if len(plain) <= _LONGEST else f"{plain[: _LONGEST - 1]}…"


def strip(axes: Axes, grid: str = "both") -> None:
    """The look that all pictures of figures share: a light grid behind, no box around."""
    axes.grid(axis=grid, color=GRID, lw=0.7)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def scale_logarithmic(axes: Axes, axis: str, low: float, high: float) -> None:
    """A logarithmic axis whose ticks are round numbers, not powers."""
    steps = [m * 10.0**e for e in range(-4, 6) for m in (1, 2, 5)]
    axes.set(**{f"{axis}scale": "log", f"{axis}lim": (low, high)})
    set_ticks(axes, axis, [step for step in steps if low <= step <= high])


def set_ticks(axes: Axes, axis: str, values: Sequence[float]) -> None:
    """Ticks at just these values, and their numbers in plain digits."""
    along = axes.xaxis if axis == "x" else axes.yaxis
    along.set_major_locator(FixedLocator(values))
    along.set_minor_locator(NullLocator())
    along.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
