"""Figures to bytes, the same for the same figure: no time of writing, no random names inside."""

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

from ipsys_log.plain_text import plain_text
from ipsys_log.report.palette import GRID

__all__ = ["picture", "png", "scale_logarithmic", "set_ticks", "shorten", "strip", "svg_uri"]

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
