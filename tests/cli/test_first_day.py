"""The first day of a user: mistakes are reported at once, and names, pictures and help are clear."""

import json
import shlex
from pathlib import Path
from textwrap import dedent

import pytest
import typer.main

from ipsys_log.app.cli.app import app, panels
from ipsys_log.log.dataset import Session
from tests.conftest import Ipsys

RIG = """name = "lab"
dictionary = "DICT_4X4_100"
marker_length_m = 0.2
[[reference_points]]
name = "A"
x_m = 0.0
y_m = 0.0
[[reference_points]]
name = "B"
x_m = 2.0
y_m = 0.0
"""
SIMULATED = '[[cameras]]\nname = "red"\nsource = "sim:red"\nwidth = 320\nheight = 180\n'
OPENED = "shows the simulated lab"


@pytest.fixture
def fitted(calibration: Path) -> Path:
    """Return a log with a model of the cameras red, white and black."""
    return calibration


def write_rig(folder: Path, cameras: str) -> Path:
    path = folder / "lab.toml"
    path.write_text(RIG + cameras)
    return path


def played(lab: Path, camera: str = "red", more: str = "") -> str:
    """Return a rig camera that plays a recorded one, with intrinsics from the same log."""
    return (
        f'[[cameras]]\nname = "{camera}"\nsource = "file:{lab}?{camera}"\ncalibration = "{lab.name}"\n{more}'
    )


# Use this camera beside another one that reports if it is opened.
FAULTS = {
    "source": (
        '[[cameras]]\nname = "white"\nsource = "carrier_pigeon:7"\n',
        "has an unknown type; use one of http:",
    ),
    "device": (
        '[[cameras]]\nname = "white"\nsource = "usb:/dev/none"\n',
        "device '/dev/none' does not exist",
    ),
    "lens": (
        '[[cameras]]\nname = "white"\nsource = "sim:white"\ncalibration = "none.yaml"\n',
        "none.yaml: does not exist",
    ),
}
COMMANDS = {
    "record": ("record", "-o", "new.mcap", "--seconds", "1"),
    "measure": ("record", "-o", "new.mcap", "--seconds", "1", "--measure"),
    "live": ("live", "-o", "new.mcap", "--seconds", "1", "--model-from", "FITTED"),
    "align": ("align", "--seconds", "1"),
    "calibrate": ("calibrate", "--board", "6x4", "--seconds", "1"),
}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_bad_source_or_calibration_is_reported_first(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fitted: Path, command: str, fault: str
) -> None:
    cameras, said = FAULTS[fault]
    rig = write_rig(tmp_path, SIMULATED + cameras)
    monkeypatch.chdir(tmp_path)
    if (command, fault) == ("calibrate", "lens"):
        pytest.skip("it is about to make that file")
    given = [str(fitted) if part == "FITTED" else part for part in COMMANDS[command]]
    done = ipsys(*given, "--rig", rig)
    assert done.code == 1
    assert said in done.err
    assert OPENED not in done.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab.toml"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("record", "-o", "old.mcap"), "old.mcap: exists already"),
        (("record", "-o", "old"), "old.mcap: exists already"),
        (("record", "-o", "none/a.mcap"), "there is no folder none"),
        (("record", "-o", "/proc/a.mcap"), "cannot write into /proc"),
        (("record", "-o", "."), "is a folder"),
        (("record", "-o", "a.mcap", "--detect", "--corners", "best"), "best"),
        (("record", "-o", "a.mcap", "--model-from", "old.mcap"), "has no effect without --measure"),
        (("record", "-o", "a.mcap", "--points-only"), "--points-only: has no effect without --measure"),
        (("record", "-o", "a.mcap", "--measure", "--model-from", "none.mcap"), "none.mcap"),
        (("record", "-o", "a.mcap", "--measure", "--host", "192.0.2.1"), "cannot listen on this address"),
        (("live", "-o", "a.mcap", "--model-from", "none.mcap"), "none.mcap"),
        (("live", "-o", "a.mcap", "--model-from", "FITTED", "--model", "best"), "has no fitted model best"),
        (("live", "-o", "a.mcap"), "no fitted model is given"),
        (("live", "-o", "old.mcap", "--model-from", "FITTED"), "old.mcap: exists already"),
        (("align", "-o", "old.mcap"), "old.mcap: exists already"),
        (("align", "--plot", "none/a.png"), "there is no folder none"),
        (("align", "--corners", "best"), "best"),
        (("calibrate", "--board", "6x4", "-o", "old.yaml"), "old.yaml: exists already"),
        (("calibrate", "--board", "6x4", "-o", "/proc"), "cannot write into /proc"),
        (("calibrate", "--board", "6x4", "--plot", "a.doc"), "use a name that ends in .png"),
    ],
)
def test_impossible_request_is_reported_before_cameras_open(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fitted: Path,
    arguments: tuple[str, ...], said: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    for name in ("old.mcap", "old.yaml"):
        (tmp_path / name).write_bytes(b"years of work")
    given = [str(fitted) if part == "FITTED" else part for part in arguments]
    done = ipsys(*given, "--rig", write_rig(tmp_path, SIMULATED), "--seconds", "1")
    assert done.code == 1
    assert done.err.startswith("ipsys: ") or arguments[2] == "old"
    assert said in done.err
    assert OPENED not in done.err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["lab.toml", "old.mcap", "old.yaml"]
    assert (tmp_path / "old.mcap").read_bytes() == b"years of work"


def test_portrait_image_gives_a_remark(ipsys: Ipsys, tmp_path: Path) -> None:
    for width, height, said in ((180, 320, True), (320, 180, False)):
        size = f"width = {width}\nheight = {height}"
        rig = write_rig(tmp_path, f'[[cameras]]\nname = "red"\nsource = "http://127.0.0.1:9/"\n{size}')
        done = ipsys("record", "--rig", rig, "-o", tmp_path / "none" / "a.mcap")
        assert (
            "camera red: 180 x 320 px is upright: check that width and height are not exchanged" in done.err
        ) == said


def test_model_of_other_cameras_is_refused_before_cameras_open(
    ipsys: Ipsys, tmp_path: Path, fitted: Path
) -> None:
    rig = write_rig(tmp_path, SIMULATED.replace('"red"', '"blue"'))
    for command in (("live",), ("record", "--measure")):
        given = ("-o", tmp_path / "a.mcap", "--rig", rig, "--model-from", fitted, "--seconds", "1")
        done = ipsys(*command, *given)
        assert done.code == 1
        assert "is for the cameras black, red, white, but the rig has only blue" in done.err
        assert OPENED not in done.err


def test_calibration_is_read_from_a_log(ipsys: Ipsys, tmp_path: Path, lab: Path) -> None:
    """Select by camera name; a log with a single camera needs no name."""
    rig = write_rig(tmp_path, played(lab))
    one = ("record", "--rig", rig, "--seconds", "0.5", "-o")
    assert ipsys(*one, tmp_path / "red.mcap").code == 0
    other = write_rig(tmp_path, played(lab, "white").replace(f'"{lab.name}"', '"red.mcap"'))
    assert ipsys("record", "--rig", other, "--seconds", "0.5", "-o", tmp_path / "white.mcap").code == 0
    given = ("--calibration", f"white={tmp_path / 'red.mcap'}")
    done = ipsys("record", "--rig", other, "--seconds", "0.5", "-o", tmp_path / "again.mcap", *given)
    assert done.code == 0, done.err
    with Session([lab]) as session:
        meant = session.payloads([session.calibrations["red"]])[-1]
    for name, camera in (("red", "red"), ("white", "white"), ("again", "white")):
        with Session([tmp_path / f"{name}.mcap"]) as session:
            held = session.payloads([session.calibrations[camera]])[-1]
        assert (held.D.tolist(), held.K.tolist(), held.width) == (meant.D.tolist(), meant.K.tolist(), 960)
    stranger = write_rig(tmp_path, played(lab).replace('name = "red"', 'name = "green"'))
    done = ipsys("record", "--rig", stranger, "-o", tmp_path / "green.mcap")
    assert "has no calibration of camera green, only of black, red, white" in done.err


def test_file_name_gets_a_missing_suffix_and_a_message(
    ipsys: Ipsys, tmp_path: Path, lab: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = ipsys("record", "--rig", write_rig(tmp_path, played(lab)), "--seconds", "0.5", "-o", "monday")
    assert "-o monday: the log gets the name monday.mcap" in done.err
    assert "monday.mcap written" in done.out
    done = ipsys("detect", "monday.mcap", "-o", "results.v2")
    assert "the log gets the name results.v2.mcap" in done.err
    assert ipsys("info", "monday.mcap", "results.v2.mcap").code == 0
    assert not (tmp_path / "monday").exists()


@pytest.mark.slow
def test_live_align_names_the_kept_log(ipsys: Ipsys, tmp_path: Path, lab: Path) -> None:
    rig = write_rig(tmp_path, played(lab))
    done = ipsys("align", "--rig", rig, "--seconds", "1")
    assert done.code == 0, done.err
    assert "no frames or results are kept" in done.err
    assert "now.mcap" not in done.out + done.err
    kept = tmp_path / "kept.mcap"
    done = ipsys("align", "--rig", rig, "--seconds", "1", "-o", kept)
    assert f"results are in {kept}" in done.err
    with Session([kept]) as session:
        assert list(session.images) == ["red"]
        assert {run.stage for run in session.runs()} == {"detect", "camera-frame"}


def test_unknown_marker_is_shown_with_the_next_step(ipsys: Ipsys, tmp_path: Path, lab: Path) -> None:
    with Session([lab]) as session:
        (rig,) = session.payloads(["/rig"])
    known = sorted(marker.id for marker in rig.markers)[1:]
    markers = "".join(f"[[markers]]\nid = {n}\n" for n in known)
    rig_file = write_rig(tmp_path, markers + played(lab))
    done = ipsys("record", "--rig", rig_file, "--seconds", "2.5", "-o", tmp_path / "a.mcap")
    assert "camera red: marker 0 is seen, but not in the rig; to track it, add" in done.out
    assert "add [[markers]] with id = 0 to lab.toml" in done.out
    assert f"marker {known[0]} is seen" not in done.out


def test_a_camera_without_a_lens_is_recorded_and_named(ipsys: Ipsys, tmp_path: Path, lab: Path) -> None:
    bare = played(lab).replace("calibration =", "# calibration =")
    done = ipsys("record", "--rig", write_rig(tmp_path, bare), "--seconds", "0.5", "-o", tmp_path / "a.mcap")
    assert done.code == 0, done.err
    assert "camera red has no calibration, but a replay needs one" in done.err
    lensed = write_rig(tmp_path, played(lab))
    done = ipsys("record", "--rig", lensed, "--seconds", "0.5", "-o", tmp_path / "b.mcap")
    assert "has no calibration" not in done.err


@pytest.mark.parametrize(
    "arguments", [("replay",), ("plan",), ("align",), ("latency",), ("calibrate", "--board", "6x4")]
)
def test_figure_without_a_valid_suffix_is_refused_first(
    ipsys: Ipsys, lab: Path, arguments: tuple[str, ...]
) -> None:
    before = lab.read_bytes()
    # With several figures, a name without a suffix is a folder.
    for name in ("floor.doc",) if arguments == ("replay",) else ("floor.doc", "floor"):
        done = ipsys(*arguments, lab, "--plot", lab.parent / name)
        assert done.code == 1
        assert "is not a figure file; use a name that ends in .png, .pdf, .svg" in done.err
    assert lab.read_bytes() == before
    assert not (lab.parent / "floor").exists()


# Ten replays, two for each kind of file.
@pytest.mark.slow
def test_a_picture_is_what_its_name_says(ipsys: Ipsys, detected_lab: Path) -> None:
    begins = {"png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml", "jpg": b"\xff\xd8", "webp": b"RIFF"}
    for kind, magic in begins.items():
        drawn = [detected_lab.parent / f"{number}.{kind}" for number in (1, 2)]
        for path in drawn:
            done = ipsys("replay", detected_lab, "--model", "rigid", "--plot", path)
            assert done.code == 0, done.err
        assert drawn[0].read_bytes().startswith(magic)
        assert drawn[0].read_bytes() == drawn[1].read_bytes()


def test_info_has_one_line_per_channel_and_no_event_rates(
    ipsys: Ipsys, tmp_path: Path, detected_lab: Path, fitted: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log has three runs, and the window has 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(tmp_path)
    for model in ("poly", "rigid"):
        ipsys("replay", detected_lab.name, "--model", model)
    rows = ipsys("info", detected_lab.name).out.splitlines()
    assert max(map(len, [*rows, *ipsys("info", "--runs", detected_lab.name).out.splitlines()])) <= 80
    assert [row.strip() for row in rows if row.startswith("/runs/")] == [
        "/runs/edges/",
        "/runs/poly/",
        "/runs/rigid/",
    ]
    for name in ("annotations", "camera_points", "markers"):
        assert sum(row.startswith(f"  cameras/black/{name} ") for row in rows) == 1
    found = json.loads(ipsys("info", detected_lab.name, "--json").out)
    rates = {topic: row["rate_hz"] for topic, row in found["channels"].items()}
    assert rates["/cameras/red/image"] == pytest.approx(5.0)
    # Three cameras with two frames at each point: at most 5 steps in 0.22 s. A frame has no new tracks if
    # other cameras have seen all its robots at the same instant.
    assert 15 < rates["/runs/poly/tracks"] <= 22.5
    for topic in ("/measurements", "/rig", "/cameras/red/calibration", "/runs/poly/record"):
        assert rates[topic] is None
    assert found["cameras"]["red"]["lens"]["width"] == 960


def test_the_help_lists_the_commands_in_the_order_of_a_first_day(ipsys: Ipsys) -> None:
    out = ipsys("--help").out
    panel = out[out.index("First day, in this order") : out.index("Results")]
    listed = [line.split()[1] for line in panel.splitlines()[1:] if line[2:3].isalpha()]
    assert tuple(listed) == panels()["First day, in this order"]


COMMAND_NAMES = [name for names in panels().values() for name in names if name != "batch"]


@pytest.mark.parametrize("command", COMMAND_NAMES)
def test_the_examples_of_the_help_are_commands(ipsys: Ipsys, command: str) -> None:
    program = typer.main.get_group(app)
    lines = dedent(str(program.commands[command].epilog).partition("\n\n")[2]).splitlines()
    assert lines
    for line in lines:
        assert len(line) <= 76
        ipsys_, name, *arguments = shlex.split(line, comments=True)
        assert (ipsys_, name) == ("ipsys", command)
        parsed = program.commands[name]
        parsed.make_context(name, arguments)
    assert lines[0] in ipsys(command, "--help").out
