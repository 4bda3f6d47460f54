"""The drift of cameras in a catalogue, compared with the simulated knock."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from ipsys_log.api import python_api as api
from ipsys_log.api.catalogue import Baseline, update_catalogue
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from tests.geometric.lab import GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.geometric.weeks import Knock, WeekSettings, simulate_week

WEEKS = WeekSettings(duration_s=3.0, knocks=(Knock("white", 3, (0.0010, 0.0020, 0.0003)),))


def settings(drive_s: float) -> GeometricSettings:
    return GeometricSettings(lab=LabSettings(seed=3, rate_hz=10.0, drive_s=drive_s, markers=2), points=30)


@pytest.mark.slow
def test_camera_that_was_knocked_has_moved_in_later_logs(tmp_path: Path) -> None:
    model, folder = tmp_path / "model.mcap", tmp_path / "weeks"
    write_log(model, simulate_session(build_lab(settings(5.0))))
    api.replay(model, models=("best",), until="fit")
    folder.mkdir()
    for week in (1, 2, 3, 4):
        write_log(folder / f"week{week}.mcap", simulate_week(build_lab(settings(0.0)), WEEKS, week))
    target, baseline = tmp_path / "catalogue.parquet", Baseline(folder / "week1.mcap", model)
    assert update_catalogue(folder, target, baseline).read == 4
    rows = pd.read_parquet(target).set_index("log")
    for week in (1, 2, 3, 4):
        row: Any = rows.loc[f"week{week}.mcap"]
        assert pd.isna(row["drift_error"])
        moved = {camera["camera"] for camera in row["drift"] if camera["moved"]}
        assert moved == ({"white"} if week >= 3 else set())
    assert update_catalogue(folder, target, baseline).read == 0
    # Without its baseline, a catalogue has no drift.
    assert update_catalogue(folder, target).read == 4
    assert pd.read_parquet(target)["drift"].isna().all()
