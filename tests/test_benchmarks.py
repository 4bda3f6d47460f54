"""The benchmarks run, on next to nothing, and leave a file with the ratios first."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"


@pytest.mark.parametrize(
    "arguments",
    [
        ["detection", "--scene", "3 markers"],
        pytest.param([], marks=pytest.mark.slow),
    ],
)
def test_smoke(arguments: list[str], tmp_path: Path) -> None:
    output = tmp_path / "results.json"
    command = [sys.executable, "bench.py", "--smoke", "-o", str(output), *arguments]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.replace(str(output), "").splitlines())) <= 80
    results = json.loads(output.read_text(encoding="utf-8"))
    assert next(iter(results)) == "ratios"
    for benchmark, rows in results["ratios"].items():
        assert rows or benchmark == "live"  # which has figures only
        assert all(0 < row["min"] <= row["median"] <= row["max"] for row in rows.values()), benchmark
    pipelines = results["details"]["detection"]["3 markers"]
    assert pipelines["plain"]["markers"] > 0
    assert pipelines["plain"]["found"] > 0.8
    assert pipelines["tracking"]["found"] > 0.8


def test_corners_are_scored_against_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    detection, scenes = importlib.import_module("detection"), importlib.import_module("scenes")
    square = np.array([[0.0, 0], [50, 0], [50, 50], [0, 50]])
    there = {marker_id: square + 100 * marker_id for marker_id in range(4)}
    known = {("red", 7): scenes.Truth(there, frozenset([0, 1, 2]))}
    # 0 is 5 px off, 1 is missed, 2 is somewhere else, 3 counts for nothing, 9 is not there.
    found = [("red", 7, [(0, square + np.array([3, 4])), (2, square), (3, square + 300), (9, square)])]
    assert detection.score(found, known) == {
        "rms_px": 5.0,
        "max_px": 5.0,
        "found": 1 / 3,
        "markers": 3,
        "wrong_ids": 2,
    }
