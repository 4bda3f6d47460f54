"""The leaderboard: all models on all datasets in one table."""

import importlib
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ipsys_log as ipsys_api
from ipsys_log.tools.publish.packing import pack
from tests.conftest import ROOT, Ipsys
from tests.publish.packs import change_scores, write_card
from tests.test_benchmarks import BENCHMARKS

OWN = """
from ipsys_log.models.closed_form import PolynomialRegression as Estimator
"""


@pytest.fixture
def board(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("leaderboard")


def test_rows_are_ordered_by_their_mean_rank(board: Any) -> None:
    datasets = {
        "a": {"rigid": (30.0, True), "poly": (20.0, True), "best": (10.0, True)},
        "b": {"rigid": (3.0, True), "poly": (1.0, False)},
        "c": {"rigid": (1.0, True), "poly": (2.0, True)},
    }
    rows = board.leaderboard(datasets)
    assert rows == [
        ("poly", "1.7", "20.00", "≠1.00", "2.00"),
        ("rigid", "2.0", "30.00", "3.00", "1.00"),
        ("best", "1.0", "10.00", "-", "-"),
    ]
    head = ("model", "mean rank", *datasets)
    assert board.table_lines(head, rows, True)[:3] == [
        "| model | mean rank | a | b | c |",
        "| --- | ---: | ---: | ---: | ---: |",
        "| poly | 1.7 | 20.00 | ≠1.00 | 2.00 |",
    ]
    assert board.table_lines(head, rows, False)[:2] == [
        "model  mean rank      a      b     c",
        "poly         1.7  20.00  ≠1.00  2.00",
    ]


# Two datasets are scored twice.
@pytest.mark.slow
def test_leaderboard_scores_packs_again(packed: Path, dataset: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN)
    change_scores(dataset, lambda table: table["scores"][0].update(mean_mm=1.0))
    done = subprocess.run(
        [
            sys.executable,
            "leaderboard.py",
            packed / "dataset.zip",
            dataset,
            "--own",
            f"{tmp_path}/mine.py:Estimator",
        ],
        cwd=BENCHMARKS,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in done.stdout.splitlines()]
    assert lines[0] == ["model", "mean", "rank", "dataset", "dataset_2"]
    errors = {line[0]: line[2:] for line in lines[1:4]}
    assert errors["poly"] == errors["mine.py:Estimator"]
    assert [cell.startswith("≠") for cell in errors["rigid"]] == [False, True]
    assert lines[-1] == ["≠", "does", "not", "come", "out", "as", "stated"]


@pytest.mark.slow
def test_leaderboard_scores_estimates_of_drives(board: Any, tmp_path: Path, ipsys: Ipsys) -> None:
    log = Path(shutil.copy(ROOT / "sample_logs" / "drive_lab.mcap", tmp_path))
    ipsys_api.replay(log, model="rigid")
    with ipsys_api.open(log) as opened:
        tracks = opened.table("tracks")
    ada = tracks[tracks["robot"] == "robot_0"][["time", "x_m", "y_m", "z_m", "heading_rad"]]
    for name, noise_m in (("slam", 0.01), ("wheels", 0.05)):
        noisy = ada.assign(x_m=ada["x_m"] + np.random.default_rng(0).normal(0, noise_m, len(ada)))
        (tmp_path / name).mkdir()
        noisy.to_csv(tmp_path / name / "monday.csv", index=False)
    assert ipsys("compare", log, tmp_path / "slam" / "monday.csv", "--robot", "robot_0").code == 0
    pack([log], tmp_path / "monday", write_card(tmp_path / "card.toml"), models=("rigid",))
    folders = [tmp_path / "slam", tmp_path / "wheels"]
    scores = board.estimate_scores(str(tmp_path / "monday"), "monday", folders)
    assert scores["monday"][0] == pytest.approx(10, rel=0.1)
    assert scores["slam"][0] == pytest.approx(10, rel=0.1)
    assert scores["wheels"][0] == pytest.approx(50, rel=0.1)
