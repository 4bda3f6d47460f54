"""Figures as bytes (equal figures give equal bytes), and the common style of their axes."""

from __future__ import annotations

import base64
import io
import warnings
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from ipsys_log.report.styles import GRID

_DPI = 150
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
