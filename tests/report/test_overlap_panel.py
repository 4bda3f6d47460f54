"""The panel of the report on the disagreement of cameras: its rows and its figures."""

from __future__ import annotations

import base64

import numpy as np
import pytest

from ipsys_log.app.report.html_figures import overlap_pictures
from ipsys_log.app.report.html_sections import overlap_tables
from ipsys_log.messages import Floor, Rig
from ipsys_log.statistics.disagreement import CameraPositions, PairDisagreement, compare_cameras
from ipsys_log.units import NS_PER_S


def pairs(
    sigma_m: float | None, cameras: tuple[str, str] = ("red", "white"), apart_m: float = 0.005
) -> list[PairDisagreement]:
    """Return two cameras that differ in x, with a stated standard deviation."""
    times_ns = np.arange(200) * NS_PER_S // 30
    points_m = np.column_stack([1 + times_ns / NS_PER_S * 0.3, np.full(200, 2.0)])
    covariances = np.broadcast_to((np.nan if sigma_m is None else sigma_m**2) * np.eye(2), (200, 2, 2))
    ids = np.zeros(200, dtype=np.int64)
    return compare_cameras(
        [
            CameraPositions(cameras[0], ids, times_ns, points_m + np.array([apart_m, 0.0]), covariances),
            CameraPositions(cameras[1], ids, times_ns, points_m, covariances),
        ]
    )


@pytest.mark.parametrize(
    ("sigma_m", "within", "verdict"),
    [(0.005, "100 %", "consistent"), (0.001, "0 %", "larger than the covariances explain"), (None, "-", "-")],
)
def test_row_says_whether_covariances_explain_it(sigma_m: float | None, within: str, verdict: str) -> None:
    table = overlap_tables(pairs(sigma_m))["table"]
    assert table is not None
    (row,) = table.cells
    assert row == ["red and white", "199", "5.0", "5.0", within, verdict]


@pytest.mark.parametrize("rig", [None, Rig("lab", "DICT_4X4_100", 0.2, floor=Floor(4.88, 4.88))])
def test_panel_has_a_map_and_a_time_course(rig: Rig | None) -> None:
    shown = overlap_pictures(pairs(0.005), rig)
    assert ["over the floor" in one["caption"] for one in shown] == [True, False]
    for one in shown:
        assert b"</svg>" in base64.b64decode(one["uri"].partition(",")[2])
    assert shown == overlap_pictures(pairs(0.005), rig)


def test_page_shows_the_pairs_that_differ_most_and_folds_all() -> None:
    many = [pair for n in range(12) for pair in pairs(0.005, ("a", f"b{n}"), n / 1000)]
    tables = overlap_tables(many)
    assert tables["table"] is not None
    assert tables["all"] is not None
    assert [row[0] for row in tables["table"].cells] == [f"a and b{n}" for n in range(11, 1, -1)]
    assert [row[0] for row in tables["all"].cells] == [f"a and b{n}" for n in range(12)]
    assert overlap_tables(many[:3])["all"] is None
