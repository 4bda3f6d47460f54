"""The commands on the command line."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer.main

from ipsys_log.app.cli.app import app, present_words
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages.rig_file import check_rig, load_rig
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


# Old forms of commands, which work for one release, with the present ones.
OLD_FORMS = [
    ("runs a.mcap --json", "info --runs a.mcap --json"),
    ("du a.mcap b.mcap", "info --sizes a.mcap b.mcap"),
    ("latency a.mcap --plot a.png", "info --latency a.mcap --plot a.png"),
    ("diff a.mcap b.mcap --run poly", "verify --compare a.mcap b.mcap --run poly"),
    ("diff a.mcap --run poly --run best", "verify --compare a.mcap --run poly --run best"),
    ("evaluate a.mcap --plots figures", "evaluate a.mcap --plot figures"),
    ("replay a.mcap --plots=figures", "replay a.mcap --plot=figures"),
    ("compact a.mcap --dry-run", "cut --compact a.mcap --dry-run"),
    ("detect a.mcap --corners stock", "replay --until detect a.mcap --corners stock"),
    ("camera-frame a.mcap", "replay --until camera-frame a.mcap"),
    ("fit a.mcap --model best", "replay --until fit a.mcap --model best"),
    ("locate a.mcap", "replay --until locate a.mcap"),
    ("fuse a.mcap", "replay --until fuse a.mcap"),
    ("smooth a.mcap", "replay --until smooth a.mcap"),
    ("import imsel data -o a.mcap", "import --as imsel data -o a.mcap"),
    ("import images -o a.mcap data", "import --as images -o a.mcap data"),
    ("import videos red=a.mp4 -o a.mcap", "import --as videos red=a.mp4 -o a.mcap"),
    ("import ros a.bag -o a.mcap", "import --as ros a.bag -o a.mcap"),
    ("import truth a.csv --into a.mcap", "import --as truth a.csv --into a.mcap"),
    ("import detections a.csv --into a.mcap", "import --as detections a.csv --into a.mcap"),
    ("import pairs a.csv -o a.mcap", "import --as pairs a.csv -o a.mcap"),
    (
        "measure --rig lab.toml --output a.mcap --json",
        "record --measure --points-only --rig lab.toml --output a.mcap --json",
    ),
    ("simulate -o a.mcap --seed 3 --drive-s=4", "simulate -o a.mcap --seed 3 --set drive_s=4"),
    ("simulate --width 960 -o a.mcap", "simulate --set width=960 -o a.mcap"),
]


@pytest.mark.parametrize(("old", "present"), OLD_FORMS, ids=[old.split()[0] for old, _ in OLD_FORMS])
def test_old_form_is_a_present_command(old: str, present: str) -> None:
    assert present_words(old.split()) == present.split() == present_words(present.split())
    name, *words = present.split()
    typer.main.get_group(app).commands[name].make_context(name, words)


def test_old_and_present_name_give_the_same_result(ipsys: Ipsys, replayed_lab: Path) -> None:
    old, present = ipsys("runs", replayed_lab, "--json"), ipsys("info", replayed_lab, "--runs", "--json")
    assert old == present
    both = json.loads(ipsys("info", replayed_lab, "--runs", "--sizes", "--json").out)
    assert both["runs"] == json.loads(present.out)["rows"]
    assert both["sizes"] == json.loads(ipsys("du", replayed_lab, "--json").out)["rows"]


def test_folder_with_the_name_of_a_kind_is_a_source(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("images").mkdir()
    words = ["import", "images", "-o", "a.mcap"]
    assert present_words(words) == words


def test_first_help_screen_has_few_commands_and_lists_the_others(ipsys: Ipsys) -> None:
    first, _, more = ipsys("--help").out.partition("More commands")
    names = set(typer.main.get_group(app).commands)
    described = {
        line.split()[1] for line in first.splitlines() if line.startswith("│ ") and line[2].isalpha()
    }
    assert described <= names
    assert len(described) <= 18
    lines = re.findall(r"^ +[A-Z][a-z ]+: ([a-z, -]+)$", more.split("The help of")[0], re.MULTILINE)
    listed = {name.strip() for line in lines for name in line.split(",")}
    assert described | listed == names


def test_simulate_reads_settings_from_a_file(ipsys: Ipsys, tmp_path: Path) -> None:
    small = "width = 640\nheight = 360\nstations = 4\nframes_per_station = 1\nrate_hz = 5\ndrive_s = 0.4\n"
    (tmp_path / "small.toml").write_text(small)
    logs = [tmp_path / f"{name}.mcap" for name in "abc"]
    for log, seed in zip(logs, (7, 7, 8), strict=True):
        done = ipsys("simulate", "-o", log, "--seed", seed, "--settings", tmp_path / "small.toml")
        assert done.code == 0, done.err
    same, again, other = (log.read_bytes() for log in logs)
    assert same == again != other


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ("bright=3", "there is no setting 'bright'; use one of seed, width"),
        ("width=wide", "is not TOML"),
        ("width=1.5", "width is 1.5; give a value such as 1920"),
        ("width=10", "simulator setting width is 10"),
    ],
)
def test_wrong_setting_is_refused(ipsys: Ipsys, tmp_path: Path, change: str, text: str) -> None:
    done = ipsys("simulate", "-o", tmp_path / "a.mcap", "--set", change)
    assert done.code == 1
    assert text in done.err


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


CAMERAS = ("red", "white", "black")


def test_runs_list_their_inputs(ipsys: Ipsys, replayed_lab: Path) -> None:
    runs = {run["stage"]: run for run in json.loads(ipsys("runs", replayed_lab, "--json").out)["rows"]}
    assert runs["detect"]["parameters"] == {"corners": "edges", "reset_s": "30", "detect": "3", "edges": "3"}
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
        "import sys, ipsys_log.app.cli.app; "
        "print(sorted({'numpy', 'cv2', 'rerun', 'mcap'} & sys.modules.keys()))"
    )
    assert print_of(program) == "[]"


def test_pipeline_imports_no_library_that_only_models_need() -> None:
    """A command that fits no model, such as record or live, starts in half the time without scikit-learn."""
    program = (
        "import sys, ipsys_log.live_runs.pipeline, ipsys_log.live_runs.restore, ipsys_log.tools.verify\n"
        "from ipsys_log.models.table import restore\n"
        "restore('poly', {'centre': [0] * 3, 'scale': [1] * 3, 'coefficients': [[0] * 3] * 10})\n"
        "unwanted = {'sklearn', 'scipy', 'pandas', 'matplotlib', 'fsspec', 'aiohttp'}\n"
        "print(sorted(unwanted & sys.modules.keys()))"
    )
    assert print_of(program) == "[]"
