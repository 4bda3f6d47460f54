"""The joint model as stages of replay, in sessions without images whose ground truth is known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.api import load_model
from ipsys_log.errors import IpsysError
from ipsys_log.log.dataset import Session
from ipsys_log.messages import TRUTH_TOPIC, Markers, Message, Run, Tracks
from ipsys_log.messages.channels import POSITIONS
from ipsys_log.runs.output import write_log
from ipsys_log.simulation.geometric_lab import GeometricLab, GeometricSettings, build_lab
from ipsys_log.simulation.geometric_session import simulate_session
from ipsys_log.simulation.settings import LabSettings
from tests.conftest import Ipsys

HOUR_NS = 3_600_000_000_000


def lab(points: int, drive_s: float, **settings: Any) -> GeometricLab:
    own = LabSettings(seed=3, rate_hz=10.0, drive_s=drive_s, markers=2)
    return build_lab(GeometricSettings(lab=own, points=points, **settings))


def hour_later(messages: Iterator[Message]) -> Iterator[Message]:
    for message in messages:
        payload = message.payload
        if isinstance(payload, Markers | Tracks | Run):
            payload = replace(payload, timestamp=payload.timestamp + HOUR_NS)
        yield replace(
            message,
            payload=payload,
            log_time_ns=message.log_time_ns + HOUR_NS,
            publish_time_ns=message.publish_time_ns + HOUR_NS,
        )


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("joint") / "calibration.mcap"
    write_log(path, simulate_session(lab(30, 10.0, held_out_points=10)))
    return path


@pytest.fixture
def log(calibration: Path, tmp_path: Path) -> Path:
    path = tmp_path / "lab.mcap"
    path.write_bytes(calibration.read_bytes())
    return path


def replay(ipsys: Ipsys, *arguments: object) -> dict[str, Any]:
    """Return the models in the JSON of a replay."""
    done = ipsys("replay", *arguments, "--json")
    assert done.code == 0, done.err
    models: dict[str, Any] = json.loads(done.out)["models"]
    return models


def test_joint_model_halves_the_error_of_rayplane(ipsys: Ipsys, log: Path) -> None:
    models = replay(ipsys, log, "--model", "joint", "--model", "rayplane")
    truth = {name: model["pooled"]["truth"]["2d"]["mean_cm"] for name, model in models.items()}
    tracks = {name: model["tracks"]["truth"]["2d"]["mean_cm"] for name, model in models.items()}
    assert truth["joint"] < 0.6 * truth["rayplane"]
    assert tracks["joint"] < 0.6 * tracks["rayplane"]
    assert tracks["joint"] < 0.15


def test_replay_of_the_joint_model_gives_the_same_bytes(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    copies = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for copy in copies:
        assert ipsys("replay", log, "--model", "joint", "-o", copy).code == 0
    assert copies[0].read_bytes() == copies[1].read_bytes()
    verified = ipsys("verify", log, copies[0])
    assert verified.code == 0, verified.out + verified.err


@pytest.mark.slow
def test_drive_after_the_points_halves_the_error(ipsys: Ipsys, tmp_path: Path) -> None:
    points, both = tmp_path / "points.mcap", tmp_path / "both.mcap"
    measured = list(simulate_session(lab(6, 0.0)))
    drive = [
        m
        for m in hour_later(simulate_session(lab(0, 40.0)))
        if "/markers" in m.topic or m.topic == TRUTH_TOPIC
    ]
    write_log(points, measured)
    write_log(both, [*measured, *drive])
    assert ipsys("fit", points, "--model", "joint").code == 0
    before = ["-o", tmp_path / "before.mcap", "--model-from", points]
    errors_cm = [
        replay(ipsys, both, "--model", "joint", *more)["joint"]["tracks"]["truth"]["2d"]["mean_cm"]
        for more in (before, [])
    ]
    assert errors_cm[1] < 0.5 * errors_cm[0]


def test_log_with_camera_points_only_is_refused(ipsys: Ipsys, tmp_path: Path, data: Path) -> None:
    log = tmp_path / "paper.mcap"
    imported = ipsys("import", "imsel", data / "imsel", "-o", log)
    assert imported.code == 0, imported.err
    before = log.read_bytes()
    done = ipsys("fit", log, "--model", "joint")
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "joint is fitted to the corners of markers, but the log has only camera points" in done.err
    assert log.read_bytes() == before


def test_joint_model_for_camera_points_is_refused_in_one_line(ipsys: Ipsys, log: Path) -> None:
    assert ipsys("fit", log, "--model", "joint").code == 0
    done = ipsys("plan", log, "--model", "joint")
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "cannot be used with camera points" in done.err
    with pytest.raises(IpsysError, match="cannot be used with camera points"):
        load_model(log, "joint")


def test_marker_without_a_height_gets_its_full_pose(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    rig, located = tmp_path / "lab.toml", tmp_path / "located.mcap"
    assert ipsys("fit", log, "--model", "joint").code == 0
    assert ipsys("init", rig, "--from", log).code == 0
    rig.write_text(rig.read_text().replace("marker_height_m = 0.1\n", ""))
    drive = tmp_path / "drive.mcap"
    write_log(drive, simulate_session(lab(4, 10.0)))
    before = drive.read_bytes()
    options = ("--model", "joint", "--model-from", log, "--rig", rig, "-o", located)
    tracks = replay(ipsys, drive, *options)["joint"]["tracks"]["truth"]
    assert drive.read_bytes() == before
    assert tracks["2d"]["mean_cm"] < 0.4
    assert tracks["3d"]["mean_cm"] < 1.5
    with Session([drive, located]) as session:
        positions = [p for one in session.payloads(session.topics(POSITIONS, "joint")) for p in one.positions]
    heights_m = np.array([p.z_m for p in positions])
    sigmas_m = np.sqrt([p.covariance_m2[2, 2] for p in positions if p.covariance_m2 is not None])
    assert abs(float(np.median(heights_m)) - 0.1) < 0.005
    # The covariance of a full pose is true: heights differ from 0.1 m by as much as it says.
    assert 0.5 < float(np.median(np.abs(heights_m - 0.1) / sigmas_m)) / 0.6745 < 2
    assert np.mean([bool(p.inside) for p in positions]) > 0.99


def test_joint_results_with_another_rig_are_verified(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    rig = tmp_path / "lab.toml"
    assert ipsys("init", rig, "--from", log).code == 0
    rig.write_text(rig.read_text().replace("tape_sigma_m = 0.003", "tape_sigma_m = 0.009"))
    rig.write_text(rig.read_text().replace("marker_height_m = 0.1\n", "marker_height_m = 0.11\n"))
    assert "0.11" in rig.read_text()
    assert ipsys("replay", log, "--model", "joint", "--rig", rig).code == 0
    verified = ipsys("verify", log)
    assert verified.code == 0, verified.out + verified.err
