"""The commands on the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
import typer.main

from ipsys_log import pipeline
from ipsys_log.cli.app import app
from ipsys_log.cli.setup import SETTINGS
from ipsys_log.log.writer import LogWriter
from ipsys_log.rig.file import check_rig, load_rig
from ipsys_log.runs.options import Request
from ipsys_log.simulation.settings import LabSettings
from tests.conftest import ROOT, Ipsys


def command_names(command: Any, prefix: str = "") -> Iterator[str]:
    """Yield the names of all commands, such as ``import imsel``."""
    for name, child in getattr(command, "commands", {}).items():
        if hasattr(child, "commands"):
            yield from command_names(child, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}"


COMMANDS = sorted(command_names(typer.main.get_command(app)))


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_helps_within_80_columns(
    ipsys: Ipsys, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    done = ipsys(*command.split(), "--help")
    assert done.code == 0
    assert max(len(line) for line in done.out.splitlines()) <= 80
    assert f"## `ipsys {command}`" in (ROOT / "docs/commands.md").read_text().replace("### ", "## ")


def test_the_list_of_commands_is_up_to_date(tmp_path: Path) -> None:
    fresh = tmp_path / "commands.md"
    subprocess.run([ROOT / "scripts/make-docs", str(fresh)], check=True)
    assert fresh.read_text() == (ROOT / "docs/commands.md").read_text(), "run scripts/make-docs"


def test_init_writes_a_rig_that_can_be_read(ipsys: Ipsys, tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    assert ipsys("init", path).code == 0
    rig = check_rig(load_rig(path), "lab.toml")
    # the lab of the paper (sect. 3)
    assert [(p.x_m, p.y_m) for p in rig.reference_points] == [(1.2192, 2.4384), (3.6576, 2.4384)]
    assert [camera.name for camera in rig.cameras] == ["red", "white", "black"]
    text = path.read_text()
    assert text.count("#") > 10
    again = ipsys("init", path)
    assert again.code == 1
    assert "exists already" in again.err
    assert path.read_text() == text


def test_the_defaults_of_simulate_are_those_of_the_library() -> None:
    defaults = {field.name: field.default for field in fields(LabSettings)}
    assert {name: default for name, (default, _) in SETTINGS.items()} == {n: defaults[n] for n in SETTINGS}


def test_simulate_gives_the_same_bytes_for_a_seed(ipsys: Ipsys, tmp_path: Path) -> None:
    small = {
        "width": 640,
        "height": 360,
        "stations": 4,
        "frames-per-station": 1,
        "rate-hz": 5,
        "drive-s": 0.4,
    }
    options = [word for name, value in small.items() for word in (f"--{name}", value)]
    for name, seed in (("a", 7), ("b", 7), ("c", 8)):
        assert ipsys("simulate", "-o", tmp_path / f"{name}.mcap", "--seed", seed, *options).code == 0
    a, b, c = (tmp_path / f"{name}.mcap" for name in "abc")
    assert a.read_bytes() == b.read_bytes()
    assert a.read_bytes() != c.read_bytes()


def test_info_says_what_is_in_a_log(ipsys: Ipsys, replayed_lab: Path) -> None:
    found = json.loads(ipsys("info", replayed_lab, "--json").out)
    assert found["cameras"]["red"] == {
        "images": "/cameras/red/image",
        "calibration": "/cameras/red/calibration",
        "lens": {"width": 960, "height": 540, "model": "kannala_brandt"},
    }
    images = found["channels"]["/cameras/red/image"]
    assert images["schema"] == "foxglove.CompressedImage"
    assert images["rate_hz"] == pytest.approx(5.0)
    # The markers are moved between the points, so the log has as many gaps.
    assert images["gaps"] > 5
    assert images["longest_gap_s"] == pytest.approx(3.0, abs=0.5)
    assert [run["stage"] for run in found["runs"]] == [
        "detect", "camera-frame", "fit", "evaluate", "locate", "fuse",
    ]  # fmt: skip


def test_a_log_without_messages_has_no_date(ipsys: Ipsys, tmp_path: Path) -> None:
    with LogWriter.create(tmp_path / "none.mcap"):
        pass
    shown = ipsys("info", tmp_path / "none.mcap")
    assert shown.code == 0, shown.err
    assert "no messages" in shown.out
    assert "1970" not in shown.out
    assert json.loads(ipsys("info", tmp_path / "none.mcap", "--json").out)["start"] is None


def test_info_fits_80_columns(ipsys: Ipsys, replayed_lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(replayed_lab.parent)
    for command in ("info", "runs"):
        done = ipsys(command, replayed_lab.name)
        assert max(len(line) for line in done.out.splitlines()) <= 80, done.out


def test_evaluate_fits_80_columns(ipsys: Ipsys, detected_lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Print the ground truth of a simulated lab in the terminal too."""
    monkeypatch.setenv("COLUMNS", "80")
    models = ("--model", "rigid", "--model", "poly", "--model", "rigid+poly")
    done = ipsys("evaluate", detected_lab, *models, "--details")
    assert done.code == 0, done.err
    assert max(len(line) for line in done.out.splitlines()) <= 80, done.out
    for title in (
        "Best model: ",
        "Against the ground truth: ",
        "Errors in cm, held-out points",
        "Errors in cm, cross-validated",
        "Model by the number of points per camera",
    ):
        assert title in done.out


CAMERAS = ("red", "white", "black")


def test_runs_list_their_inputs(ipsys: Ipsys, replayed_lab: Path) -> None:
    runs = {run["stage"]: run for run in json.loads(ipsys("runs", replayed_lab, "--json").out)["rows"]}
    assert runs["detect"]["parameters"] == {
        "corners": "edges",
        "reset_s": "30",
        "detect": "3",
        "edges": "2",
    }
    assert {row["topic"] for row in runs["detect"]["inputs"]} == {
        "/rig",
        *(f"/cameras/{camera}/{what}" for camera in CAMERAS for what in ("image", "calibration")),
    }
    assert all(row["hash"] and row["messages"] for row in runs["detect"]["inputs"])
    assert runs["locate"]["input_runs"] == ["edges", "poly"]
    assert {"numpy", "opencv-python-headless", "blas", "python"} <= set(runs["fit"]["fingerprint"])


def print_of(program: str) -> str:
    """Return what a Python program of this package prints."""
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout.strip()


def test_help_imports_no_heavy_library() -> None:
    """The help and the shell completion appear at once."""
    program = (
        "import sys, ipsys_log.cli.app; print(sorted({'numpy', 'cv2', 'rerun', 'mcap'} & sys.modules.keys()))"
    )
    assert print_of(program) == "[]"


def test_pipeline_imports_no_library_that_only_models_need() -> None:
    """A command without a model, such as record, starts in less than half the time without scikit-learn."""
    program = (
        "import sys, ipsys_log.pipeline, ipsys_log.restore, ipsys_log.runs.verify\n"
        "unwanted = {'sklearn', 'scipy', 'pandas', 'matplotlib', 'fsspec', 'aiohttp'}\n"
        "print(sorted(unwanted & sys.modules.keys()))"
    )
    assert print_of(program) == "[]"


def test_replay_that_is_done_imports_no_library_of_models(lab: Path) -> None:
    """A command that finds everything up to date answers at once."""
    pipeline.replay([lab], Request(models=("poly",)), "fit")
    program = (
        "import sys; from pathlib import Path; from ipsys_log import pipeline\n"
        "from ipsys_log.runs.options import Request\n"
        f"(*_, fit) = pipeline.replay([Path({str(lab)!r})], Request(models=('poly',)), 'fit')\n"
        "print(fit.fresh, sorted({'sklearn', 'pandas', 'matplotlib'} & sys.modules.keys()))"
    )
    assert print_of(program) == "False []"
