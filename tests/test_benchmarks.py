"""The benchmarks run with minimal input, and write a file with the ratios first."""

from __future__ import annotations

import importlib
import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parent.parent / "benchmarks"
# Benchmarks without ratios.
FIGURES_ONLY = (
    "contradictions",
    "dashboard",
    "hall",
    "hall_nodes",
    "live",
    "node_clock",
    "remote",
    "robot_run",
    "streams",
)


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ["detection", "--scene", "3 markers"],
        pytest.param([], marks=pytest.mark.slow),
    ],
)
def test_benchmark_smoke_run_writes_its_ratios(arguments: list[str], tmp_path: Path) -> None:
    output = tmp_path / "results.json"
    command = [sys.executable, "bench.py", "--smoke", "-o", str(output), *arguments]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert max(map(len, done.stdout.replace(str(output), "").splitlines())) <= 80
    results = json.loads(output.read_text(encoding="utf-8"))
    assert next(iter(results)) == "ratios"
    for benchmark, rows in results["ratios"].items():
        assert rows or benchmark in FIGURES_ONLY
        assert all(0 < row["min"] <= row["median"] <= row["max"] for row in rows.values()), benchmark
    pipelines = results["details"]["detection"]["3 markers"]
    assert pipelines["plain"]["markers"] > 0
    assert pipelines["plain"]["found"] > 0.8
    assert pipelines["tracking"]["found"] > 0.8


# Four calibrations of a lab.
@pytest.mark.slow
def test_accuracy_of_calibrations_is_measured(tmp_path: Path) -> None:
    output, picture = tmp_path / "results.json", tmp_path / "floor.png"
    command = [sys.executable, "bench.py", "joint", "--smoke", "--models", "rayplane,best"]
    done = subprocess.run(
        [*command, "-o", str(output), "--picture", str(picture)],
        cwd=BENCHMARKS,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.replace(str(output), "").replace(str(picture), "").splitlines()
    assert max(map(len, lines)) <= 80
    results = json.loads(output.read_text(encoding="utf-8"))
    assert 0 < results["ratios"]["joint"]["75 points: best / rayplane"]["median"] < 3
    (lab,) = results["details"]["joint"]["75 points"]["rayplane"]
    assert 0 < lab["aligned_mean_mm"] < lab["mean_mm"] < lab["p95_mm"] < 10
    # A robot that stands still moves by less than the errors of the calibration.
    assert 0 < lab["standing_mm"] < 0.05
    assert set(lab["coverage"]) == {"grid", "points", "drive"}
    assert picture.read_bytes().startswith(b"\x89PNG")


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


def test_table_of_coverage_has_means_over_labs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    coverage_table = importlib.import_module("joint_coverage").coverage_table
    labs = []
    for inside, error_s in ((0.5, 0.0003), (0.7, -0.0004)):
        shares = {"inside_68": inside, "inside_95": inside, "nees": inside}
        clocks_s = [(error_s, 0.0005)]
        places = {"grid": shares, "points": shares, "drive": shares}
        labs.append({**places, "clocks_s": clocks_s, "sources": {"tape": inside}})
    lines = coverage_table("made up", labs).splitlines()
    assert lines[0] == "made up, 2 labs"
    assert lines[2].split() == ["grid", "60.0", "±", "10.0", "60.0", "±", "10.0", "0.60", "±", "0.10"]
    assert lines[-2] == "  sources: tape 60 %"
    # The ratio is that of sqrt((0.6^2 + 0.8^2) / 2).
    assert lines[-1] == "  clocks: RMS error 0.354 ms, stated 0.500 ms, ratio 0.71"


def test_coverage_of_tracks_is_compared_with_that_of_single_positions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    table = importlib.import_module("track_coverage").coverage_table
    labs = []
    for nees in (0.5, 1.5):  # the errors of a lab share its calibration
        single = {"inside_68": 0.6, "inside_95": 0.9, "nees": nees}
        labs.append({"single positions": single, "fuse": {**single, "nees": nees + 0.25}})
    lines = table("made up", labs).splitlines()
    assert lines[0] == "made up, 2 labs"
    assert " ".join(lines[2].split()) == "single positions 60.0 ± 0.0 90.0 ± 0.0 1.00 ± 0.50"
    assert " ".join(lines[3].split()) == "fuse 60.0 ± 0.0 90.0 ± 0.0 1.25 ± 0.50 0.250 ± 0.000"


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


def test_corners_are_scored_against_the_truth(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(BENCHMARKS)
    detection, scenes = importlib.import_module("detection"), importlib.import_module("scenes")
    square = np.array([[0.0, 0], [50, 0], [50, 50], [0, 50]])
    there = {marker_id: square + 100 * marker_id for marker_id in range(4)}
    known = {("red", 7): scenes.Truth(there, frozenset([0, 1, 2]))}
    # 0 has an error of 5 px, 1 is missed, 2 is at a wrong position, 3 is ignored, 9 does not exist.
    found = [("red", 7, [(0, square + np.array([3, 4])), (2, square), (3, square + 300), (9, square)])]
    assert detection.score(found, known) == {
        "rms_px": 5.0,
        "max_px": 5.0,
        "found": 1 / 3,
        "markers": 3,
        "wrong_ids": 2,
    }


# In place of ffmpeg: one camera stream is late and one never comes.
_LATE = """#!/bin/sh
case "$*" in
*/white) echo "no camera here" >&2; exit 3 ;;
*/red) sleep 2 ;;
esac
exec {ffmpeg} "$@"
"""


def put_in_path(program: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace ffmpeg by a script."""
    script = folder / "ffmpeg"
    script.write_text(program)
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")


@pytest.mark.slow
def test_live_reports_what_it_measured_without_a_stream(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ffmpeg = shutil.which("ffmpeg")
    if ffmpeg is None:
        pytest.skip("no ffmpeg")
    put_in_path(_LATE.format(ffmpeg=ffmpeg), tmp_path, monkeypatch)
    output = tmp_path / "results.json"
    command = [sys.executable, "bench.py", "live", "--smoke", "-o", str(output)]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert "live: record: white never came: ffmpeg ended with 3: no camera here" in done.stdout, done.stderr
    assert "Traceback" not in done.stderr
    results = json.loads(output.read_text(encoding="utf-8"))
    # The late stream is measured like the others.
    assert set(results["details"]["live"]["record"]["cameras"]) == {"red", "black"}
    assert all(frames > 30 for frames, _, _ in results["details"]["live"]["record"]["cameras"].values())
    assert results["figures"]["live"]["live, 2 cameras: of one core"]["median"] > 0
    assert done.returncode == 1


@pytest.fixture
def streams(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(BENCHMARKS)
    return importlib.import_module("stream_server")


# A script that listens like ffmpeg after a while; the stream black never comes, white ends at once.
_LISTENER = """#!{python}
import socket, sys, time
from urllib.parse import urlsplit
address = urlsplit(sys.argv[-1])
if address.path == "/white":
    sys.exit("no camera here")
with socket.socket() as server:
    if address.path != "/black":
        time.sleep(0.2 if address.path == "/red" else 0)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        server.bind((address.hostname, address.port))
        server.listen()
    time.sleep(600)
"""


def test_streams_are_waited_for_and_the_missing_named(
    streams: Any, lab_log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_in_path(_LISTENER.format(python=sys.executable), tmp_path, monkeypatch)
    loops = {name: tmp_path / name for name in ("red", "white")}
    with streams.serve(lab_log, loops, 3, tmp_path, 60.0) as served:
        assert served.cameras == ["red", "red_2"]
        assert served.missing == {"white": "ffmpeg ended with 1: no camera here"}
        rig = served.rig.read_text()
        assert [name for name in ("red", "white", "red_2") if f'name = "{name}"' in rig] == served.cameras
        port = int(rig.partition("127.0.0.1:")[2].partition("/")[0])
        socket.create_connection(("127.0.0.1", port), timeout=10).close()
    with streams.serve(lab_log, {"black": tmp_path / "black"}, 1, tmp_path, 0.2) as served:
        assert served.missing == {"black": "ffmpeg did not listen in time"}


def test_live_keeps_what_it_measured_before_a_failure(
    streams: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = importlib.import_module("live")
    results = importlib.import_module("results")
    report, counts = results.Report("live"), []

    class Fake:
        cameras, missing, rig = ("red",), dict[str, str](), tmp_path / "lab.toml"

        def __init__(self, *arguments: Any) -> None:
            counts.append(arguments[2])

        def __enter__(self) -> Fake:
            return self

        def __exit__(self, *_: object) -> None: ...

    def run(arguments: list[object]) -> float:
        if counts[-1] == 9:
            raise live._FailedError("ipsys record ended with 1: camera red_7: refuses the connection")
        return 1.0

    monkeypatch.setattr(live, "serve", Fake)
    monkeypatch.setattr(live, "_run", run)
    monkeypatch.setattr(live, "_rates", lambda log, cameras: {"red": (300, 30.0, 1000)})
    monkeypatch.setattr(live, "_events", lambda log, kind: 0)
    options = type("Options", (), {"wait_seconds": 1.0, "many_seconds": 1.0})
    live._many(tmp_path, {}, tmp_path, options, report)
    assert counts == [6, 9]
    assert [row.values for row in report.rows] == [(6,)]
    assert report.remarks == ["9 cameras: ipsys record ended with 1: camera red_7: refuses the connection"]
    assert report.failed


@pytest.mark.slow
def test_drift_benchmark_finds_a_large_knock() -> None:
    command = [sys.executable, "drift.py", "--labs", "1", "--logs", "3", "--sizes-mm", "5"]
    done = subprocess.run(command, cwd=BENCHMARKS, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0] == "3 undisturbed logs: 0 false alarms"
    assert "1 of 1" in lines[-1]
    assert max(map(len, lines)) <= 80


def test_cameras_are_covered_at_other_times_in_each_lab(monkeypatch: pytest.MonkeyPatch) -> None:
    """With equal times, the first robot would be unseen in the same bends in all labs."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    find_gaps = importlib.import_module("track_errors").find_gaps
    frames = [SimpleNamespace(publish_time_ns=n * 10**9) for n in (0, 20)]

    def gaps_of(seed: int) -> np.ndarray:
        lab = SimpleNamespace(settings=SimpleNamespace(lab=SimpleNamespace(seed=seed)))
        drive = SimpleNamespace(positions=frames, truth=SimpleNamespace(lab=lab))
        return np.array(find_gaps(drive)) / 1e9

    gaps_s = np.array([gaps_of(seed) for seed in range(100)])
    assert gaps_s.shape == (100, 6, 2)
    np.testing.assert_array_equal(gaps_s[0], gaps_of(0))
    np.testing.assert_allclose(gaps_s[:, :, 1] - gaps_s[:, :, 0], 0.6)
    assert (gaps_s[:, 1:, 0] - gaps_s[:, :-1, 1]).min() > 1.1
    assert gaps_s[:, :, 0].std(axis=0).min() > 0.25
    assert gaps_s.max() < 20
