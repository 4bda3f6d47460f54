"""Figures as bytes (equal figures give equal bytes), the common style of their axes, and names of cameras."""

import base64
import io
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import ArrayLike

from ipsys_log.app.report.files import write_files
from ipsys_log.app.report.styles import GRID, shorten

_DPI = 150
# Colours from pale (small error) to dark (large error), readable with any colour vision.
ERROR_COLOURS = ListedColormap(colormaps["magma_r"](np.linspace(0.2, 0.95, 256)))
# The width of a page on a phone.
PAGE_IN = 4.7
# Options that leave out the time of writing.
_WITHOUT: dict[str, dict[str, object]] = {
    "pdf": {"metadata": {"Creator": None, "Producer": None, "CreationDate": None}},
    "jpg": {},
    "jpeg": {},
    "webp": {},
}
# A legend of more cameras covers the map, and so many colours cannot be told apart.
MOST_IN_LEGEND = 6
_WHITE = withStroke(linewidth=2.5, foreground="white")


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


def save_figure(figure: Figure, path: Path, dpi: int = 100) -> None:
    """Write a figure into a file; an existing file is replaced. The suffix gives the file format."""
    write_files(path.parent, {path.name: figure_bytes(figure, path, dpi)})


def new_figure(height_in: float) -> tuple[Figure, Axes]:
    """Return a figure as wide as a phone, with its axes."""
    figure = Figure(figsize=(PAGE_IN, height_in), layout="constrained")
    axes = figure.add_subplot()
    axes.tick_params(labelsize=8)
    return figure, axes


def add_panel(figure: Figure, left_in: float, low_in: float, width_in: float, height_in: float) -> Axes:
    """Return new axes at a place in inches from the bottom left of a figure."""
    width, height = figure.get_size_inches()
    return figure.add_axes((left_in / width, low_in / height, width_in / width, height_in / height))


def add_bar(figure: Figure, shades: ScalarMappable, axes: Axes, label: str, size: float = 9) -> Colorbar:
    """Return the colour bar below the axes of a narrow figure."""
    bar = figure.colorbar(shades, ax=axes, location="bottom", shrink=0.75, pad=0.02, extend="max", aspect=30)
    bar.set_label(label, fontsize=size)
    bar.ax.tick_params(labelsize=8)
    return bar


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


def has_legend(count: int) -> bool:
    """Return whether a legend names so many cameras; otherwise, :func:`name_cameras` does.

    Examples
    --------
    >>> has_legend(3), has_legend(24)
    (True, False)
    """
    return count <= MOST_IN_LEGEND


def legend_label(text: str, count: int) -> str | None:
    """Return the entry of a camera in the legend of ``count`` cameras; None if their legend is too large."""
    return text if has_legend(count) else None


def name_cameras(axes: Axes, places_m: Mapping[str, ArrayLike], colours: Mapping[str, str]) -> None:
    """Write the names of many cameras at their places on a floor map; few cameras have a legend.

    Parameters
    ----------
    places_m : by camera, x and y of the middle of its view.
    colours : by camera.
    """
    if has_legend(len(places_m)):
        return
    for camera, place_m in places_m.items():
        x_m, y_m = np.asarray(place_m, dtype=np.float64)[:2].tolist()
        axes.text(
            x_m, y_m, shorten(camera), color=colours[camera], fontsize=8, weight="bold", ha="center",
            va="center", zorder=7, path_effects=[_WHITE], clip_on=True,
        )  # fmt: skip
