"""JSON of the commands: SI units, one key with one meaning; and the keys of format 1, for one release."""

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

FORMAT = 2

# Units of format 1: the SI unit of the key today, and the factor.
_UNITS = {
    "cm": ("m", 100.0),
    "mm": ("m", 1000.0),
    "deg": ("rad", math.degrees(1)),
    "ms": ("s", 1e3),
    "us": ("s", 1e6),
}
_STATISTICS = ("mean", "rmse", "min", "max", "std", "median", "p95", "mean_low", "mean_high")
_REMAINING = ("remaining", "remaining_low", "remaining_high", "mean_with_excluded", "bias", "residual")
_EVALUATION = (*(f"{name}_cm" for name in (*_STATISTICS, *_REMAINING, "lowest_mean")), "n")
# The keys of format 1 that have another unit or name today, by command; None stands for the stages.
_OLD_KEYS: dict[str | None, tuple[str, ...]] = {
    None: _EVALUATION,
    "align": (
        *("level_below_cm", "above_cm", "spread_cm", "spread_after_cm", "tilt_deg", "tilt_sigma_deg"),
        *("look_further_right_deg", "look_further_down_deg"),
    ),
    "calibrate-lab": (
        *("goal_mm", "mean_mm", "p95_mm", "mean_after_mm", "error_mm", "clock_ms", "row_time_us"),
    ),
    "drive": ("seconds",),
    "measure": ("seconds",),
    "plan": ("mean_before_cm", "mean_after_cm"),
    "score": ("mean_mm", "median_mm", "p95_mm", "rmse_mm", "tolerance_mm", "difference_mm"),
}
_RENAMED = {"n": "count", "seconds": "duration_s"}


def plain(value: Any) -> Any:
    """Return a value as plain data: a class becomes its fields, bytes their number; None is left out.

    Examples
    --------
    >>> plain({"low_m": np.array([0.0, 1.0]), "high_m": None})
    {'low_m': [0.0, 1.0]}
    """
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    elif hasattr(value, "_asdict"):
        value = value._asdict()
    elif isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(part) for key, part in value.items() if part is not None}
    if isinstance(value, list | tuple):
        return [plain(part) for part in value]
    if isinstance(value, bytes | bytearray | memoryview):
        return {"bytes": len(value)}
    is_number = not isinstance(value, float) or math.isfinite(value)
    return value if is_number else None


def document(result: Any) -> dict[str, Any]:
    """Return the result of a command with its format; the rows of a list are in ``rows``."""
    return {"format": FORMAT, **(result if isinstance(result, dict) else {"rows": result})}


def old_document(result: Any, command: str | None) -> Any:
    """Return the result of a command, which is in SI units, with the keys of format 1."""
    is_evaluation = isinstance(result, dict) and "stages" in result
    old = _OLD_KEYS.get(None if is_evaluation else command, ())
    return _renamed(result, dict(map(_today, old)))


def _today(old_key: str) -> tuple[str, tuple[str, float]]:
    """Return the key of today, with the old key and its factor."""
    name, _, unit = old_key.rpartition("_")
    if unit in _UNITS:
        return f"{name}_{_UNITS[unit][0]}", (old_key, _UNITS[unit][1])
    return _RENAMED[old_key], (old_key, 1)


def _renamed(value: Any, keys: Mapping[str, tuple[str, float]]) -> Any:
    if isinstance(value, list):
        return [_renamed(part, keys) for part in value]
    if not isinstance(value, dict):
        return value
    parts = {}
    for key, part in value.items():
        old_key, factor = keys.get(key, (key, 1))
        parts[old_key] = _renamed(part, keys) if factor == 1 else _scaled(part, factor)
    return parts


def _scaled(value: Any, factor: float) -> Any:
    if value is None:
        return None
    return [part * factor for part in value] if isinstance(value, list) else value * factor
