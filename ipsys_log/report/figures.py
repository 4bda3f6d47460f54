"""Figures as bytes (equal figures give equal bytes), and the colours and symbols of figures.

The hues are those of Okabe and Ito (2008). Their yellow is left out: it is hard to see on white paper.
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
    "figure_bytes",
    "model_styles",
    "png",
    "robot_colour",
    "scale_logarithmic",
    "set_ticks",
    "shorten",
    "style_axes",
    "svg_data_uri",
]

# A camera with the name of a colour gets a similar colour that is easy to see.
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
    colours = assign_colours(cameras, _NAMED, _COLOURS)
    return {camera: (colours[camera], _SHAPES[n % len(_SHAPES)]) for n, camera in enumerate(sorted(colours))}


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


_DPI = 150
_LONGEST = 24
# Options that leave out the time of writing.
_WITHOUT: dict[str, dict[str, object]] = {
    "pdf": {"metadata": {"Creator": None, "Producer": None, "CreationDate": None}},
    "jpg": {},
    "jpeg": {},
    "webp": {},
}


def png(figure: Figure, dpi: int = _DPI) -> bytes:
    """Return a figure as the bytes of a PNG file."""
    return _saved(figure, format="png", dpi=dpi, metadata={"Software": None})


def figure_bytes(figure: Figure, path: Path, dpi: int = _DPI) -> bytes:
    """Return a figure as the bytes of a file; the suffix of ``path`` gives the format, see ``PICTURES``."""
    kind = path.suffix.lower().removeprefix(".")
    if kind == "png":
        return png(figure, dpi)
    return _svg(figure) if kind == "svg" else _saved(figure, format=kind, dpi=dpi, **_WITHOUT[kind])


def _svg(figure: Figure) -> bytes:
    with matplotlib.rc_context({"svg.hashsalt": "ipsys", "svg.fonttype": "path"}):
        return _saved(figure, format="svg", metadata={"Date": None, "Creator": None})


def svg_data_uri(figure: Figure) -> str:
    """Return a figure as a data URI, which holds the figure itself."""
    data = _svg(figure)
    return f"data:image/svg+xml;base64,{base64.b64encode(data).decode()}"


def _saved(figure: Figure, **how: object) -> bytes:
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        # Letters that the font lacks are drawn as boxes, without a warning.
        warnings.filterwarnings("ignore", message="Glyph")
        figure.savefig(buffer, **how)  # type: ignore[arg-type]
    return buffer.getvalue()


def shorten(name: str) -> str:
    """Shorten a name from a log to one line that fits into a figure."""
    plain = plain_text(name)
    return plain if len(plain) <= _LONGEST else f"{plain[: _LONGEST - 1]}…"


def style_axes(axes: Axes, grid: str = "both") -> None:
    """Set the common style of plots: a light grid behind the data, and no box."""
    axes.grid(axis=grid, color=GRID, lw=0.7)  # type: ignore[arg-type]
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def scale_logarithmic(axes: Axes, axis: str, low: float, high: float) -> None:
    """Make an axis logarithmic, with round numbers as ticks instead of powers of ten."""
    steps = [m * 10.0**e for e in range(-4, 6) for m in (1, 2, 5)]
    axes.set(**{f"{axis}scale": "log", f"{axis}lim": (low, high)})
    set_ticks(axes, axis, [step for step in steps if low <= step <= high])


def set_ticks(axes: Axes, axis: str, values: Sequence[float]) -> None:
    """Set the ticks of an axis to the given values, with labels in plain digits."""
    target = axes.xaxis if axis == "x" else axes.yaxis
    target.set_major_locator(FixedLocator(values))
    target.set_minor_locator(NullLocator())
    target.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
