"""The benchmarks run with minimal input, and write a file with the ratios first."""

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
