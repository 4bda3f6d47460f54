"""A hall of the simulated lab: cameras in a grid above a large floor."""

from __future__ import annotations

import re
from string import ascii_lowercase
from typing import Any

from ipsys_log.errors import IpsysError
from ipsys_log.simulation.settings import LabSettings

_MOST = 12
# The cameras of a hall are higher than those of the lab, so that fields of view overlap on all sides.
_MOUNT_HEIGHT_M = 5.0


def parse_grid(text: str) -> tuple[int, int]:
    """Return the columns and rows of a grid of cameras from text such as ``6x4``.

    Raises
    ------
    IpsysError
        The text is not a grid, or the grid is too large.

    Examples
    --------
    >>> parse_grid("6x4")
    (6, 4)
    """
    match = re.fullmatch(r"([0-9]{1,6})x([0-9]{1,6})", text)
    if match is None:
        raise IpsysError(f"--cameras {text!r} is not a grid; give columns x rows, such as 6x4")
    columns, rows = int(match[1]), int(match[2])
    if not (1 <= columns <= _MOST and 1 <= rows <= _MOST):
        raise IpsysError(f"--cameras {text}: give 1 to {_MOST} columns and 1 to {_MOST} rows, such as 6x4")
    return columns, rows


def grid_names(columns: int, rows: int) -> tuple[str, ...]:
    """Return the names of the cameras, column after column: a letter for the column, a number for the row.

    Examples
    --------
    >>> grid_names(2, 3)
    ('a1', 'a2', 'a3', 'b1', 'b2', 'b3')
    """
    return tuple(f"{letter}{row + 1}" for letter in ascii_lowercase[:columns] for row in range(rows))


def hall_settings(columns: int, rows: int, **settings: Any) -> LabSettings:
    """Return the settings of a hall; ``settings`` are other settings of the lab.

    Raises
    ------
    IpsysError
        A value is impossible for a lab.

    Examples
    --------
    >>> hall = hall_settings(6, 4, markers=12)
    >>> len(hall.cameras), [round(size_m, 2) for size_m in hall.floor_m], hall.mount_height_m
    (24, [20.0, 15.0], 5.0)
    """
    settings = {"mount_height_m": _MOUNT_HEIGHT_M, **settings}
    return LabSettings(cameras=grid_names(columns, rows), grid=(columns, rows), **settings)
