"""When the rows of a frame are exposed, and how much each instant of a motion counts in each row.

The time of a frame is the middle of the exposure of its first row, row 0; row r is exposed
``exposure_s`` long around ``r * row_time_ns`` after it. Between the instants at which a moving print
is drawn, the picture is taken to change linearly.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ipsys_log.simulation.settings import LabSettings
from ipsys_log.units import NS_PER_S

__all__ = ["exposed", "instants", "row_shares"]

Array = NDArray[np.float64]

# How far a print may move from one instant to the next where there is no motion blur.
_STEP_PX = 0.125
# So short that nothing moves.
_SHORTEST_S = 1e-9


def exposed(first_row: int, last_row: int, settings: LabSettings) -> tuple[float, float]:
    """From when to when rows are exposed, in s after the time of the frame."""
    row_s, half_s = settings.row_time_ns / NS_PER_S, settings.exposure_s / 2
    return first_row * row_s - half_s, last_row * row_s + half_s


def instants(start_s: float, end_s: float, speed_px_s: float, settings: LabSettings) -> Array:
    """Evenly spaced times (n,) in s from start to end, near enough to draw a motion; one if it is none.

    Parameters
    ----------
    start_s, end_s : of the exposure, in s after the time of the frame.
    speed_px_s : of what moves fastest.
    settings : the length of an exposure.
    """
    # Drawing a motion in steps softens only where the blur of it begins and ends. As a share of the
    # light that grows with the square of the step and falls with the length of the blur.
    step_px = _STEP_PX * np.sqrt(1 + speed_px_s * settings.exposure_s)
    steps = int(np.ceil((end_s - start_s) * speed_px_s / step_px))
    return np.linspace(start_s, end_s, steps + 1) if steps else np.array([(start_s + end_s) / 2])


def row_shares(times_s: Array, rows: NDArray[np.int_], settings: LabSettings) -> Array:
    """By which share each instant counts in the mean over the exposure of each row.

    Parameters
    ----------
    times_s : (n,) from :func:`instants`.
    rows : (m,), 0 the first of the frame.
    settings : row time and length of an exposure.

    Returns
    -------
    (n, m); the shares of a row that is exposed between the first and the last instant add up to 1.

    Examples
    --------
    >>> lab = LabSettings(row_time_ns=500_000)
    >>> row_shares(np.array([0.0, 0.002]), np.array([0, 1, 4]), lab).round(6)
    array([[1.  , 0.75, 0.  ],
           [0.  , 0.25, 1.  ]])
    """
    if len(times_s) == 1:
        return np.ones((1, len(rows)))
    step_s = times_s[1] - times_s[0]
    exposure_s = max(settings.exposure_s, _SHORTEST_S)
    middles_s = rows * (settings.row_time_ns / NS_PER_S) - times_s[:, None]
    # An instant's weight falls to 0 at its neighbours: the integral of that hat, in steps.
    start, end = (np.clip((middles_s + side * exposure_s / 2) / step_s, -1, 1) for side in (-1, 1))
    shares: Array = (end - end * np.abs(end) / 2 - start + start * np.abs(start) / 2) * step_s / exposure_s
    return shares
