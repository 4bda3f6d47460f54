"""Columns of tables from the fields of messages: numbers, elements of matrices, optional values."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from ipsys_log.log.columns import Column

# The six different elements of a 3 x 3 covariance of x, y, z, by their index in row-major order.
_COVARIANCE = {"xx": 0, "xy": 1, "xz": 2, "yy": 4, "yz": 5, "zz": 8}
_CORNERS = [f"{axis}{corner}_px" for corner in range(4) for axis in "xy"]
_ANGLES = ("rx", "ry", "rz")

_Expand = Callable[[str, Column], dict[str, Any]]


def expand_field(name: str, column: Column) -> dict[str, Any]:
    """Return the columns of a table, by name, from a field of messages."""
    return _EXPAND.get(name, _number)(name, column)


def _number(name: str, column: Column) -> dict[str, Any]:
    name = "marker_id" if name == "id" else name
    if column.values.dtype == np.float64:
        return {name: np.where(column.missing, np.nan, column.values)}
    return {name: column.values}


def _elements(names: Sequence[str], places: Sequence[int], size: int) -> _Expand:
    """Return the function that makes a column of each element of a list of ``size`` numbers, by its name."""

    def expand(_: str, column: Column) -> dict[str, Any]:
        complete = column.values.ndim == 2 and column.values.shape[1] == size
        rows = column.values if complete else np.zeros((len(column.values), size))
        missing = column.missing | (not complete)
        return {
            name: np.where(missing, np.nan, rows[:, place]) for name, place in zip(names, places, strict=True)
        }

    return expand


def _optional_flag(name: str, column: Column) -> dict[str, Any]:
    values = column.values.astype(object)
    values[~column.missing] = column.values[~column.missing].astype(bool)
    values[column.missing] = None
    return {name: values}


def _optional_integer(name: str, column: Column) -> dict[str, Any]:
    values = column.values.astype(object)
    values[column.missing] = None
    return {name: values}


_EXPAND: dict[str, _Expand] = {
    "covariance_m2": _elements([f"cov_{axes}_m2" for axes in _COVARIANCE], [*_COVARIANCE.values()], 9),
    "velocity_m_s": _elements(["vx_m_s", "vy_m_s", "vz_m_s"], range(3), 3),
    "velocity_covariance_m2_s2": _elements(
        [f"cov_v{axes[0]}_v{axes[1]}_m2_s2" for axes in _COVARIANCE], [*_COVARIANCE.values()], 9
    ),
    "rotation_rad": _elements([f"{angle}_rad" for angle in _ANGLES], range(3), 3),
    "pose_covariance": _elements(
        [
            f"cov_{first}_{_ANGLES[column]}_{'m_rad' if row < 3 else 'rad2'}"
            for row, first in enumerate(("x", "y", "z", *_ANGLES))
            for column in range(max(row - 3, 0), 3)
        ],
        [6 * row + column for row in range(6) for column in range(max(row, 3), 6)],
        36,
    ),
    "angular_velocity_rad_s": _elements(["wx_rad_s", "wy_rad_s", "wz_rad_s"], range(3), 3),
    "corners_px": _elements(_CORNERS, range(8), 8),
    "inside": _optional_flag,
    "time_offset_ns": _optional_integer,
    "coasting_ns": _optional_integer,
    "age_ns": _optional_integer,
}
