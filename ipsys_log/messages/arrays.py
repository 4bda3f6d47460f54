"""Types of arrays; docstrings give the shapes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.intp]
Times = NDArray[np.int64]
Grey = NDArray[np.uint8]
