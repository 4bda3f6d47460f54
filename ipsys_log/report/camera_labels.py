"""Names of cameras on floor maps: in a legend, or at their places if there are too many cameras for one."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from numpy.typing import ArrayLike

from ipsys_log.report.styles import shorten

# A legend of more cameras covers the map, and so many colours cannot be told apart.
MOST_IN_LEGEND = 6
_WHITE = withStroke(linewidth=2.5, foreground="white")


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
