"""A session scores against imported ground truth as against that of the simulator."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import ipsys_log as ipsys_api
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.messages import TRUTH_TOPIC
from tests.conftest import Ipsys
from tests.exchange.driven_lab import OtherSystem
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session


def _moved_table(path: Path, truth: Path, system: OtherSystem) -> None:
    """Write the simulated ground truth in the clock and coordinates of another system, with its robots."""
    with ipsys_api.open(truth) as opened:
        table = opened.table("truth")
    points_m = system.points_m(table[["x_m", "y_m", "z_m"]].to_numpy())
    times_ns = table["time"].dt.tz_localize(None).to_numpy().astype("datetime64[ns]").astype(np.int64)
    moved = table[["robot"]].assign(time_ns=system.times_ns(times_ns))
    moved[["x_m", "y_m", "z_m"]] = points_m
    moved.to_csv(path, index=False)


@pytest.mark.slow
def test_imported_truth_scores_as_that_of_the_simulator(tmp_path: Path, ipsys: Ipsys) -> None:
    messages = list(
        simulate_session(build_lab(GeometricSettings(points=40, lab=LabSettings(rate_hz=20.0, drive_s=20.0))))
    )
    write_log(tmp_path / "full.mcap", messages)
    write_log(tmp_path / "lab.mcap", [one for one in messages if one.topic != TRUTH_TOPIC])
    _moved_table(
        tmp_path / "truth.csv", tmp_path / "full.mcap", OtherSystem(987_654_321, 0.8, (3.0, -4.0, 0.0))
    )
    scores = {}
    for name in ("full", "lab"):
        log = tmp_path / f"{name}.mcap"
        assert ipsys("replay", log, "--model", "poly").code == 0
        if name == "lab":
            done = ipsys("import", "truth", tmp_path / "truth.csv", "--into", log, "--json")
            assert done.code == 0, done.err
            found = json.loads(done.out)
        result = ipsys("replay", log, "--model", "poly", "--json")
        scores[name] = json.loads(result.out)["models"]["poly"]
    # The errors of the tracks change over the floor: the alignment follows their mean.
    assert found["time_offset_s"] == pytest.approx(0.987654321, abs=0.005)
    assert found["rotation_z_rad"] == pytest.approx(0.8, abs=0.005)
    assert found["translation_x_m"] == pytest.approx(3.0, abs=0.02)
    full, lab = (scores[name]["tracks"]["ate"]["2d"] for name in ("full", "lab"))
    assert full["count"] * 0.9 < lab["count"] <= full["count"] * 1.1
    # An alignment hides the constant part of the errors, so it reduces them.
    assert 0.5 * full["rmse_m"] < lab["rmse_m"] < 1.02 * full["rmse_m"]
    page = tmp_path / "lab.html"
    assert ipsys("report", tmp_path / "lab.mcap", "--model", "poly", "--html", page).code == 0
    assert "ATE RMSE" in page.read_text()
