"""Wrong or interrupted commands name the next step and the kept data."""

import json
import os
import pty
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ipsys_log.app.cli.signals import Interrupted, note_kept, say_kept
from ipsys_log.capture.simulation.lab import simulate
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CameraCalibration, CameraPoints, Markers, Message, Positions
from ipsys_log.messages.channels import RIG
from ipsys_log.tools.differences import Extent, explain_no_overlap
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.test_bad_input import refused
from tests.waiting import wait_until

LIMIT_S = 240.0
PAPER_LAB = ROOT / "sample_logs" / "paper_lab.mcap"


def test_view_saved_under_another_ending_is_refused(ipsys: Ipsys, lab: Path) -> None:
    line = refused(ipsys, lab, "view", lab, "--save", lab.with_name("out.txt"))
    assert "--save" in line
    assert "use out.rrd" in line
    assert "there is no folder" in refused(ipsys, lab, "view", lab, "--save", lab.with_name("no") / "out.rrd")


def test_view_saves_a_picture_of_the_tracks(ipsys: Ipsys, replayed_log: Path, tmp_path: Path) -> None:
    assert ipsys("view", replayed_log, "-o", tmp_path / "with.svg").code == 0
    assert ipsys("view", PAPER_LAB, "-o", tmp_path / "without.svg").code == 0
    lines = [(tmp_path / name).read_text().count("line2d") for name in ("with.svg", "without.svg")]
    assert lines[0] > lines[1]
    assert "has no run 'x'" in refused(
        ipsys, replayed_log, "view", replayed_log, "--run", "x", "-o", tmp_path / "x.png"
    )


@pytest.mark.parametrize("command", [("images",), ("imsel",), ("videos",)])
def test_import_of_a_log_names_what_to_run(ipsys: Ipsys, lab: Path, command: tuple[str]) -> None:
    # a log by its bytes, with any file name
    log = Path(shutil.copy(lab, lab.with_name("recorded.bin")))
    source = f"red={log}" if command == ("videos",) else log
    line = refused(ipsys, lab, "import", *command, source, "-o", lab.with_name("new.mcap"))
    assert f"{log}: is already a log and needs no import" in line
    assert f"ipsys replay {log}" in line


def with_lens(lab: Path, model: str) -> Path:
    """Return a log with another distortion model of the red camera."""

    def change(message: Message) -> Message:
        if isinstance(message.payload, CameraCalibration) and message.camera == "red":
            return replace(message, payload=replace(message.payload, distortion_model=model))
        return message

    return rewrite(lab, change)


@pytest.mark.parametrize("command", ["detect", "replay"])
def test_unknown_distortion_model_names_the_way_out(ipsys: Ipsys, lab: Path, command: str) -> None:
    log = with_lens(lab, "fisheye62")
    line = refused(ipsys, log, command, log)
    assert "/cameras/red/calibration: distortion model 'fisheye62' is not known" in line
    assert "kannala_brandt, plumb_bob, rational_polynomial" in line
    assert "ipsys calibrate" in line
    assert "--calibration red=red.yaml" in line
    # The proposed command works.
    assert ipsys("detect", log, "--calibration", f"red={lens_file(lab)}").code == 0


def lens_file(lab: Path) -> Path:
    path = lab.with_name("red.yaml")
    with Session([lab]) as session:
        lens = session.payloads(["/cameras/red/calibration"])[0]
    path.write_text(
        f"image_width: {lens.width}\nimage_height: {lens.height}\ndistortion_model: equidistant\n"
        f"camera_matrix: {{rows: 3, cols: 3, data: {lens.K.ravel().tolist()}}}\n"
        f"distortion_coefficients: {{rows: 1, cols: 4, data: {lens.D.tolist()}}}\n"
    )
    return path


def rig_file(lab: Path, *cameras: str) -> Path:
    """Return the rig of a log, with these cameras."""
    path = lab.with_name("lab.toml")
    path.unlink(missing_ok=True)
    text = ['name = "lab"', 'dictionary = "DICT_4X4_100"', "marker_length_m = 0.2"]
    with Session([lab]) as session:
        for point in session.payloads(session.topics(RIG))[0].reference_points:
            text += [
                "[[reference_points]]",
                f'name = "{point.name}"',
                f"x_m = {point.x_m}",
                f"y_m = {point.y_m}",
            ]
    text += [line for name in cameras for line in ("[[cameras]]", f'name = "{name}"')]
    path.write_text("\n".join(text) + "\n")
    return path


def test_rig_of_other_cameras_is_refused(ipsys: Ipsys, lab: Path) -> None:
    rig = rig_file(lab, "left", "right")
    for command in (("detect", lab), ("measure", lab, "--places")):
        line = refused(ipsys, lab, *command, "--rig", rig)
        assert "describes the cameras left, right, but the images are from black, red, white" in line
        assert "rename its cameras, or remove its [[cameras]]" in line


def test_rig_of_some_cameras_is_a_remark(ipsys: Ipsys, lab: Path) -> None:
    done = ipsys("detect", lab, "--rig", rig_file(lab, "red", "white"))
    assert done.code == 0, done.err
    assert "does not describe camera black; defaults are used" in " ".join(done.err.split())
    done = ipsys("detect", lab, "--rig", rig_file(lab), "--run", "bare")
    assert done.code == 0, done.err
    assert "describe" not in done.err


def changed(lab: Path, name: str, change: Callable[[Message], Message | None]) -> Path:
    path = lab.with_name(name)
    with Session([lab]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        messages = [change(message) for message in session.messages(topics)]
    write_log(path, sorted((m for m in messages if m is not None), key=lambda m: m.log_time_ns))
    return path


def only_camera(camera: str) -> Callable[[Message], Message | None]:
    return lambda m: m if m.camera in (None, camera) else None


def shifted(ns: int) -> Callable[[Message], Message | None]:
    return lambda m: replace(m, log_time_ns=m.log_time_ns + ns, publish_time_ns=m.publish_time_ns + ns)


def other_ids(message: Message) -> Message:
    payload = message.payload
    if isinstance(payload, Markers):
        payload = replace(payload, markers=tuple(replace(one, id=one.id + 50) for one in payload.markers))
    elif isinstance(payload, CameraPoints):
        payload = replace(payload, points=tuple(replace(one, id=one.id + 50) for one in payload.points))
    elif isinstance(payload, Positions):
        payload = replace(payload, positions=tuple(replace(one, id=one.id + 50) for one in payload.positions))
    return replace(message, payload=payload)


@pytest.fixture
def detected(tmp_path: Path) -> Path:
    """Return the markers of the sample log."""
    return Path(shutil.copy(PAPER_LAB, tmp_path / "lab.mcap"))


@pytest.mark.parametrize(
    ("first", "second", "why"),
    [
        (
            only_camera("red"),
            only_camera("black"),
            "no camera in common: the first has red, the second black",
        ),
        (
            shifted(0),
            shifted(3600 * 10**9),
            "the time ranges do not overlap: the first has 2023-11-14 22:13:2",
        ),
        (shifted(0), shifted(1_000_000), "The nearest differ by 0.001000 s"),
        (shifted(0), other_ids, "no marker id in common: the first has 0, 1, 2"),
    ],
)
def test_diff_without_common_frames_gives_the_reason(
    ipsys: Ipsys,
    detected: Path,
    first: Callable[[Message], Message | None],
    second: Callable[[Message], Message | None],
    why: str,
) -> None:
    logs = changed(detected, "first.mcap", first), changed(detected, "second.mcap", second)
    done = ipsys("diff", *logs)
    assert done.code == 1
    assert why in " ".join(done.out.split())
    assert why in json.loads(ipsys("diff", *logs, "--json").out)["nothing_in_common"]


def test_diff_of_runs_without_frames_says_which_side(ipsys: Ipsys, detected: Path) -> None:
    bare = changed(detected, "bare.mcap", lambda m: None if isinstance(m.payload, Markers) else m)
    done = ipsys("diff", detected, bare)
    assert done.code == 1
    assert "the second has no markers, camera points, positions or tracks" in " ".join(done.out.split())


def test_adjacent_extents_give_no_explanation() -> None:
    times_ns = np.array([1, 5, 9])
    one = Extent(frozenset({"red"}), times_ns, frozenset({1, 2}))
    assert explain_no_overlap(one, replace(one, ids=frozenset({2, 3}))) is None
    assert explain_no_overlap(*[replace(one, times_ns=times_ns[:0])] * 2) is None
    apart = explain_no_overlap(one, replace(one, times_ns=np.array([7])))
    assert apart is not None
    assert "differ by 0.000000 s" in apart


def interrupted_when(command: list[object], ready: Callable[[], bool]) -> tuple[int, str]:
    """Run a command on a terminal, and interrupt it at a given output; return exit code and last lines."""
    main, side = pty.openpty()
    program = subprocess.Popen(
        [sys.executable, "-m", "ipsys_log", *map(str, command)],
        stderr=subprocess.PIPE,
        stdout=side,
        text=True,
    )
    try:
        wait_until(lambda: ready() or program.poll() is not None, "the command has reached its output")
    finally:
        program.send_signal(signal.SIGINT)
    _, err = program.communicate(timeout=LIMIT_S)
    os.close(main)
    os.close(side)
    return program.returncode, err


def test_simulate_interrupted_says_that_nothing_was_written(tmp_path: Path) -> None:
    log = tmp_path / "lab.mcap"
    code, err = interrupted_when(
        ["simulate", "-o", log, "--width", 640, "--height", 360, "--drive-s", 300],
        lambda: bool(list(tmp_path.iterdir())),
    )
    assert code == 130
    assert f"ipsys: interrupted; {log} was not written" in err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_evaluate_interrupted_names_the_runs_that_are_complete(detected: Path) -> None:
    def has_a_fit() -> bool:
        with Session([detected]) as session:
            return any(run.stage == "fit" for run in session.runs())

    code, err = interrupted_when(["evaluate", detected], has_a_fit)
    assert code == 130
    assert f"ipsys: interrupted; complete in {detected}: " in err
    assert "rigid (fit" in err
    assert "To continue, repeat the command" in err


@pytest.mark.parametrize("files", [(), ("red.yaml", "white.yaml")])
def test_calibrate_interrupted_names_the_files_written(
    ipsys: Ipsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: tuple[str, ...]
) -> None:
    def interrupt(*_: object, **__: object) -> None:
        for name in files:
            note_kept(name)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("ipsys_log.calibration.images.find_sources", interrupt)
    done = ipsys("calibrate", tmp_path, "--board", "6x4")
    assert done.code == 130
    said = f"written: {', '.join(files)}" if files else "no file was written"
    assert done.err == f"ipsys: interrupted; {said}\n"


def test_kept_results_of_one_command_are_not_of_the_next(ipsys: Ipsys, tmp_path: Path) -> None:
    note_kept("other.yaml")
    with (
        pytest.raises(Interrupted, match="interrupted; nothing"),
        say_kept(lambda kept: "".join(kept) or "nothing"),
    ):
        raise Interrupted(130, "")


def test_simulate_shows_its_progress() -> None:
    told: list[tuple[str, int, int]] = []
    lab = LabSettings(width=320, height=180, stations=2, frames_per_station=2, drive_s=0.1, markers=2)
    messages = list(simulate(lab, lambda *step: told.append(step)))
    frames = sum(message.topic.endswith("/image") for message in messages)
    assert [step for step in told if step[0] == "views"] == [("views", n, 3) for n in range(4)]
    done = [count for stage, count, total in told if stage == "simulate" and total == frames]
    assert done[0] == 0
    assert done[-1] == frames
    assert done == sorted(done)
    assert len(done) == frames // 3 + 1
