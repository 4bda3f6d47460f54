"""The benchmarks run with minimal input, and write a file with the ratios first."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"
# Benchmarks of seconds, and a kind of measurement each; ./scripts/bench --smoke runs all of them.
QUICK = ("detection", "log_write", "log_read", "table", "node_clock", "answers", "track_cost")


@pytest.mark.slow
def test_benchmark_smoke_run_writes_its_ratios(tmp_path: Path) -> None:
    """The command imports all benchmarks, and runs those of seconds."""
    output = tmp_path / "results.json"
    command = [sys.executable, "bench.py", "--smoke", "-o", str(output), "--scene", "3 markers", *QUICK]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.replace(str(output), "").splitlines())) <= 80
    results = json.loads(output.read_text(encoding="utf-8"))
    assert next(iter(results)) == "ratios"
    for benchmark, rows in results["ratios"].items():
        assert rows or benchmark == "node_clock"
        assert all(0 < row["min"] <= row["median"] <= row["max"] for row in rows.values()), benchmark
    pipelines = results["details"]["detection"]["3 markers"]
    assert pipelines["plain"]["markers"] > 0
    assert pipelines["plain"]["found"] > 0.8
    assert pipelines["tracking"]["found"] > 0.8


@pytest.mark.slow
def test_coverage_of_joint_covariances_is_measured(tmp_path: Path) -> None:
    output = tmp_path / "results.json"
    command = [sys.executable, "joint.py", "--coverage", "--smoke", "--lab-scene", "16 points"]
    done = subprocess.run(
        [*command, "-o", str(output)], cwd=BENCHMARKS, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.replace(str(output), "").splitlines())) <= 80
    (labs,) = json.loads(output.read_text(encoding="utf-8"))["details"]["joint"].values()
    assert [set(lab) for lab in labs] == [{"seed", "grid", "points", "drive", "clocks_s", "sources"}]
    # The tape dominates: its readings and its scale.
    assert 0.6 < labs[0]["sources"]["tape"] + labs[0]["sources"]["tape scale"] < 1
    for place in ("grid", "points", "drive"):
        assert 0 <= labs[0][place]["inside_68"] <= labs[0][place]["inside_95"] <= 1
        assert 0 < labs[0][place]["nees"] < 10


@pytest.mark.slow
def test_coverage_of_tracks_is_measured(tmp_path: Path) -> None:
    output = tmp_path / "results.json"
    command = [sys.executable, "tracks.py", "--track-coverage", "--smoke", "-o", str(output)]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.replace(str(output), "").splitlines())) <= 80
    ((lab,),) = json.loads(output.read_text(encoding="utf-8"))["details"]["tracks"].values()
    assert {"single positions", "fuse, at capture", "fuse, coasting", "smooth, half-way"} < set(lab)
    assert abs(lab["fuse, at capture"]["nees"] - lab["single positions"]["nees"]) < 0.3


@pytest.mark.slow
def test_drift_benchmark_finds_a_large_knock() -> None:
    command = [sys.executable, "drift.py", "--labs", "1", "--logs", "3", "--sizes-mm", "5"]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "3 undisturbed logs: 0 false alarms"
    assert "1 of 1" in lines[-1]
    assert max(map(len, lines)) <= 80
