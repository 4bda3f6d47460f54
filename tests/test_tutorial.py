"""The notebooks run completely."""

import json
import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

from tests.conftest import ROOT

DOCS = ROOT / "docs"


def run_notebook(name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the cells of a notebook; return its variables."""
    mpl.use("agg")
    monkeypatch.chdir(DOCS)
    notebook = json.loads((DOCS / name).read_text())
    names: dict[str, Any] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    return names


def test_tutorial_runs_and_draws(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    names = run_notebook("tutorial.ipynb", monkeypatch)
    assert "mean error on the floor" in capsys.readouterr().out
    assert names["error_m"].mean() < 0.05
    assert Path(names["folder"], "tracks.png").stat().st_size > 10_000


@pytest.mark.slow
def test_notebook_of_foreign_truth_finds_its_clock(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The other system is 1.25 s ahead; its alignment cannot increase the errors on the floor by much."""
    names = run_notebook("foreign-truth.ipynb", monkeypatch)
    printed = " ".join(capsys.readouterr().out.split())
    offsets_s = [float(text) for text in re.findall(r"Time offset: ([-\d.]+) s", printed)]
    assert offsets_s == pytest.approx([-1.25, 3.7], abs=0.005)
    assert "Pivot, from the marker to the body: x -15.0" in printed
    assert re.search(r"its lengths are (0\.9\d|1\.0) % longer than those of the tracks", printed)
    floor_m = [
        table[table["metric"] == "ATE 2D"]["rmse_m"].to_numpy() for table in (names["known"], names["errors"])
    ]
    assert len(floor_m[0]) == len(floor_m[1]) > 0
    assert (floor_m[1] < floor_m[0] + 0.005).all()
    for picture in ("ate.png", "odometry.png"):
        assert Path(names["folder"], picture).stat().st_size > 5_000


@pytest.mark.slow
def test_notebook_of_own_model_repeats_the_scores(monkeypatch: pytest.MonkeyPatch) -> None:
    names = run_notebook("own-model.ipynb", monkeypatch)
    assert names["result"].as_stated
    rows = names["crossed"]
    means_mm = rows[rows["against"] == "tape"].set_index("model")["mean_mm"]
    assert set(means_mm.index) == {"rigid", "poly", "ridge"}
    # The penalty is small, so the quadratic model has about the error of the polynomial.
    assert means_mm["ridge"] == pytest.approx(means_mm["poly"], rel=0.3)
