"""The panel of the report on the disagreement of cameras: its rows and its figures."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from ipsys_log.analysis.disagreement import CameraPositions, PairDisagreement, compare_cameras
from ipsys_log.messages import Floor, Rig
from ipsys_log.report.html_sections import overlap_rows
from ipsys_log.report.overlap_figure import overlap_pictures
from ipsys_log.units import NS_PER_S


def pairs(sigma_m: float | None) -> list[PairDisagreement]:
    """Return two cameras that differ by 5 mm in x, with a stated standard deviation."""
    times_ns = np.arange(200) * NS_PER_S // 30
    points_m = np.column_stack([1 + times_ns / NS_PER_S * 0.3, np.full(200, 2.0)])
    covariances = np.broadcast_to((np.nan if sigma_m is None else sigma_m**2) * np.eye(2), (200, 2, 2))
    ids = np.zeros(200, dtype=np.int64)
    return compare_cameras(
        [
            CameraPositions("red", ids, times_ns, points_m + np.array([0.005, 0.0]), covariances),
            CameraPositions("white", ids, times_ns, points_m, covariances),
        ]
    )


@pytest.mark.parametrize(
    ("sigma_m", "within", "verdict"),
    [(0.005, "100 %", "consistent"), (0.001, "0 %", "larger than the covariances explain"), (None, "–", "–")],
)
def test_row_says_whether_covariances_explain_it(sigma_m: float | None, within: str, verdict: str) -> None:
    (row,) = overlap_rows(pairs(sigma_m))
    assert (row["cameras"], row["median"], row["p95"]) == ("red and white", "5.0", "5.0")
    assert (row["within"], row["verdict"]) == (within, verdict)


@pytest.mark.parametrize("rig", [None, Rig("lab", "DICT_4X4_100", 0.2, floor=Floor(4.88, 4.88))])
def test_panel_has_a_map_and_a_time_course(rig: Rig | None) -> None:
    shown = overlap_pictures(pairs(0.005), rig)
    assert ["over the floor" in one["caption"] for one in shown] == [True, False]
    for one in shown:
        assert b"</svg>" in base64.b64decode(one["uri"].partition(",")[2])
    assert shown == overlap_pictures(pairs(0.005), rig)
