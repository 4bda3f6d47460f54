"""``ipsys drift``: simulated logs of weeks, bad input, and the mended model."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from ipsys_log.api import python_api as api
from ipsys_log.calibration.joint.locate import locate_markers
from ipsys_log.calibration.joint.payload import restore_joint
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Floor, Message, Model
from ipsys_log.messages.channels import MODEL
from ipsys_log.messages.rig_file import rig_toml
from ipsys_log.statistics.floor_cameras import floor_grid, shift_floor_map
from ipsys_log.vision.poses import PosedCamera
from tests.conftest import Ipsys
from tests.geometric.floor_error import compute_errors, grid_nodes
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session
from tests.geometric.weeks import (
    Knock,
    WeekSettings,
    knock_camera,
    reference_rig,
    simulate_week,
    week_start_ns,
)

Array = NDArray[np.float64]

KNOCK = Knock("white", 5, (0.0010, 0.0020, 0.0003), (0.001, 0.0, 0.0))
WEEKS = WeekSettings(duration_s=3.0, knocks=(KNOCK,))


def lab(drive_s: float = 0.0) -> GeometricLab:
    own = LabSettings(seed=3, rate_hz=10.0, drive_s=drive_s, markers=2)
    return build_lab(GeometricSettings(lab=own, points=30))


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the log of a session with calibration points; its model is fitted by the test that needs it."""
    path = tmp_path_factory.mktemp("drift") / "calibration.mcap"
    write_log(path, simulate_session(lab(5.0)))
    return path


@pytest.fixture(scope="module")
def weeks(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder, own = tmp_path_factory.mktemp("weeks"), lab()
    paths = [folder / f"week{number}.mcap" for number in range(1, 7)]
    for number, path in enumerate(paths, 1):
        write_log(path, simulate_week(own, WEEKS, number))
    return paths


@pytest.fixture(scope="module")
def fitted(calibration: Path) -> Path:
    api.replay(calibration, models=["joint", "best"], until="fit")
    return calibration


def drift(ipsys: Ipsys, *arguments: object) -> dict[str, Any]:
    done = ipsys("drift", *arguments, "--json")
    assert done.code == 0, done.err
    result: dict[str, Any] = json.loads(done.out)
    return result


def true_shift_m() -> float:
    own = next(camera for camera in lab().cameras if camera.name == KNOCK.camera)
    camera = PosedCamera.at_pose(own.name, own.lens, own.camera_from_world)
    motion = np.array([*KNOCK.turn_rad, *KNOCK.shift_m])
    shifts_m = shift_floor_map(camera, floor_grid(camera, Floor(4.88, 4.88)), motion)
    return float(np.linalg.norm(shifts_m, axis=1).mean())


@pytest.mark.parametrize("order", [1, -1])
def test_knocked_camera_week_and_size_are_found(
    ipsys: Ipsys, weeks: list[Path], fitted: Path, order: int
) -> None:
    found = drift(ipsys, *weeks[::order], "--model-from", fitted)
    (move,) = found["moves"]
    assert (move["camera"], move["before"]["log"], move["after"]["log"]) == (
        "white",
        "week4.mcap",
        "week5.mcap",
    )
    assert move["before"]["time_ns"] < week_start_ns(5) < move["after"]["time_ns"]
    assert move["low_m"] < true_shift_m() < move["high_m"]
    assert np.abs(np.array(move["turn_rad"]) - KNOCK.turn_rad).max() < 4 * max(move["turn_sigma_rad"])
    assert {state["camera"] for state in found["states"] if state["moved"]} == {"white"}


def test_text_and_figure_name_the_camera(
    ipsys: Ipsys, weeks: list[Path], fitted: Path, tmp_path: Path
) -> None:
    done = ipsys("drift", *weeks, "--model-from", fitted, "--plot", tmp_path / "drift.png")
    assert done.code == 0, done.err
    assert "Camera white moved between" in done.out
    assert (tmp_path / "drift.png").stat().st_size > 10_000
    folder = tmp_path / "other"
    folder.mkdir()
    copy = folder / weeks[0].name
    copy.write_bytes(weeks[3].read_bytes())
    still = ipsys("drift", *weeks[:2], copy, "--model-from", fitted)
    assert "No camera has moved" in still.out


def test_mended_model_is_as_good_as_before_the_knock(
    ipsys: Ipsys, weeks: list[Path], fitted: Path, tmp_path: Path
) -> None:
    log = tmp_path / "week6.mcap"
    log.write_bytes(weeks[-1].read_bytes())
    found = drift(ipsys, *weeks[:5], log, "--model-from", fitted, "--fix")
    assert found["mended_run"] == "joint_mended"
    before, after = (_errors_mm(path) for path in (fitted, log))
    assert before > 4.0
    assert after < before / 4
    runs = json.loads(ipsys("runs", log, "--json").out)["rows"]
    (row,) = [row for row in runs if row["run"] == "joint_mended"]
    assert row["state"] == "not repeatable"
    assert row["parameters"]["mended"] == "white"
    replayed = ipsys("replay", log, "--model", "joint")
    assert replayed.code == 0, replayed.err
    again = drift(ipsys, *weeks[:5], log, "--model-from", fitted)
    assert [move["camera"] for move in again["moves"]] == ["white"]
    assert drift(ipsys, log)["model"]["topic"] == "/runs/joint_mended/model"


def _errors_mm(log: Path) -> float:
    """Return the mean error over the floor of the knocked camera, located with the newest joint model."""
    own = knock_camera(lab().camera(KNOCK.camera), KNOCK)
    with Session([log]) as session:
        topics = [t for run in ("joint", "joint_mended") for t in session.topics(MODEL, run)]
        model: Model = session.payloads([topics[-1]])[-1]
    joint = restore_joint(model)[KNOCK.camera]
    nodes = grid_nodes(
        own.lens,
        own.camera_from_world,
        lambda poses, side_m: lab().place(poses).corners_m(side_m),
        (4.88, 4.88),
        0.1,
        0.2,
    )

    def locate(
        camera: str, corners_px: Array, heights_m: Array, covariances_px2: Array | None = None
    ) -> tuple[Array, None]:
        assert (camera, covariances_px2) == (KNOCK.camera, None)
        covariances = np.tile(1e-4 * np.eye(8), (len(corners_px), 1, 1))
        sides_m = np.full(len(corners_px), 0.2)
        return locate_markers(joint, corners_px, covariances, heights_m, sides_m).points_m, None

    (errors,) = compute_errors([nodes], locate)
    return 1000 * float(np.nanmean(np.linalg.norm(errors.errors_m, axis=1)))


def test_best_model_finds_the_move_and_cannot_be_mended(
    ipsys: Ipsys, weeks: list[Path], calibration: Path, fitted: Path, tmp_path: Path
) -> None:
    only = tmp_path / "best.mcap"
    with Session([calibration]) as session:
        topics = [t for reader in session.readers for t in reader.channels if "joint" not in t]
        write_log(only, session.messages(topics))
    found = drift(ipsys, *weeks, "--model-from", only)
    assert found["model"]["name"] == "best"
    assert [move["camera"] for move in found["moves"]] == ["white"]
    done = ipsys("drift", *weeks, "--model-from", only, "--fix")
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "no camera poses to correct" in done.err


def test_bad_input_is_one_line(
    ipsys: Ipsys, weeks: list[Path], fitted: Path, calibration: Path, tmp_path: Path
) -> None:
    def error(*arguments: object) -> str:
        done = ipsys("drift", *arguments)
        assert (done.code, done.err.count("\n")) == (1, 1), done.err
        return done.err

    assert ipsys("drift", calibration).code == 0  # the joint model and robots show moves, too
    plain = tmp_path / "plain.mcap"
    with Session([weeks[1]]) as session:
        (rig,) = session.payloads(["/rig"])
        start_ns = session.start_ns
    write_log(plain, [Message("/rig", start_ns, start_ns, replace(rig, reference_markers=()))])
    assert "add [[reference_markers]]" in error(plain)
    assert "no fitted model" in error(*weeks[:2])
    own = lab()
    other = tmp_path / "other.mcap"
    two = replace(own.settings.lab, cameras=("left", "right"), seed=8)
    write_log(other, simulate_week(build_lab(GeometricSettings(lab=two, points=3)), WEEKS, 2))
    assert "compare only logs of one lab" in error(weeks[0], other, "--model-from", fitted)
    bare = tmp_path / "bare.mcap"
    with Session([weeks[1]]) as session:
        write_log(bare, session.messages(["/rig"]))
    assert "has no detected markers; to detect them: ipsys replay" in error(weeks[0], bare)
    hidden = tmp_path / "hidden.mcap"
    write_log(hidden, simulate_week(own, replace(WEEKS, references=((2.4, 20.0, 0.0, 0.0, 0.0),)), 1))
    assert "no camera sees a reference marker" in error(hidden, weeks[2], "--model-from", fitted)


def test_rig_file_gives_reference_markers_to_old_logs(
    ipsys: Ipsys, weeks: list[Path], fitted: Path, tmp_path: Path
) -> None:
    old, rig = tmp_path / "old.mcap", tmp_path / "lab.toml"
    plain = replace(reference_rig(lab(), WEEKS), reference_markers=())
    with Session([weeks[0]]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        write_log(
            old, (replace(m, payload=plain) if m.topic == "/rig" else m for m in session.messages(topics))
        )
    rig.write_text(rig_toml(reference_rig(lab(), WEEKS)))
    assert "reference_markers" in ipsys("drift", old, weeks[4]).err
    found = drift(ipsys, old, weeks[4], "--model-from", fitted, "--rig", rig)
    assert [move["camera"] for move in found["moves"]] == ["white"]


def test_one_log_gets_a_remark(ipsys: Ipsys, weeks: list[Path], fitted: Path) -> None:
    done = ipsys("drift", weeks[0], "--model-from", fitted)
    assert done.code == 0
    assert "one log shows only moves during its recording" in done.err


@pytest.mark.slow
def test_hundred_undisturbed_logs_have_no_alarm(ipsys: Ipsys, fitted: Path, tmp_path: Path) -> None:
    own, still = lab(), WeekSettings(duration_s=2.0)
    paths = [tmp_path / f"week{number:03d}.mcap" for number in range(1, 101)]
    for number, path in enumerate(paths, 1):
        write_log(path, simulate_week(own, still, number))
    found = drift(ipsys, *paths, "--model-from", fitted)
    assert (found["moves"], found["marker_moves"]) == ([], [])
    assert not any(state["moved"] for state in found["states"])
