"""Pictures of sizes that nobody asked for."""

from __future__ import annotations

import numpy as np
import pytest

from ipsys_log.stages.detect.search import search, search_thoroughly


@pytest.mark.parametrize("shape", [(1, 1), (1, 2), (2000, 1), (1, 2000), (2, 2), (3, 3), (4, 2)])
def test_a_tiny_picture_has_no_markers(shape: tuple[int, int]) -> None:
    grey = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
    assert search(grey, "DICT_4X4_100") == []
    assert search_thoroughly(grey, "DICT_4X4_100") == []
