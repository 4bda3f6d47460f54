"""Inputs and outputs of unit variance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["spread"]


def spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of each column, (d,) of (n, d); 1 where a column does not vary.

    Examples
    --------
    >>> spread(np.array([[0.0, 5.0], [2.0, 5.0]])).tolist()
    [1.0, 1.0]
    """
    deviation = values.std(axis=0)
    # Rounding leaves a trace of variance in a column of equal numbers.
    level = deviation <= 1e-12 * np.abs(values).max(axis=0)
    return np.where(level, 1.0, deviation)
