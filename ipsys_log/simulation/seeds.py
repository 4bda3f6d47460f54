"""One stream of random numbers per purpose, so that a change to one leaves the others as they are."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

__all__ = ["Purpose", "stream"]


class Purpose(IntEnum):
    """What random numbers are drawn for. The numbers are part of what a seed means: only add."""

    CAMERA = 1
    FLOOR = 2
    PLACES = 3
    TAPE = 4
    SPLIT = 5
    DRIVE = 6
    NOISE_FIELD = 7
    FRAME = 8
    BOARD = 9
    LYING = 10


def stream(seed: int, purpose: Purpose, *which: int) -> np.random.Generator:
    """The random numbers for a purpose, and for one camera or frame of it."""
    return np.random.default_rng([seed, int(purpose), *which])
