"""The joint model as stages of replay, in sessions without images whose ground truth is known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.log.dataset import Session
from ipsys_log.messages import Markers, Message, Run, Tracks
from ipsys_log.messages.channels import MODEL
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


def errors_m(log: Path, run: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the errors on the floor of the tracks of a run, at the instants of the ground truth."""
    with Session([log]) as session:
        truth = {t.timestamp: t for t in session.payloads(["/truth/tracks"])}
        offsets = [
            np.hypot(track.x_m - true.x_m, track.y_m - true.y_m)
            for tracks in session.payloads([f"/runs/{run}/tracks"])
            for true in (truth[tracks.timestamp].tracks if tracks.timestamp in truth else ())
            for track in tracks.tracks
            if track.id == true.id and track.inside
        ]
    assert len(offsets) > 100
    return np.array(offsets)


def test_joint_model_halves_the_error_of_rayplane(ipsys: Ipsys, log: Path) -> None:
    done = ipsys("replay", log, "--model", "joint", "--model", "rayplane", "--json")
    assert done.code == 0, done.err
    models = json.loads(done.out)["models"]
    truth = {name: model["pooled"]["truth"]["2d"]["mean_cm"] for name, model in models.items()}
    assert truth["joint"] < 0.6 * truth["rayplane"]
    assert errors_m(log, "joint").mean() < 0.6 * errors_m(log, "rayplane").mean()
    assert errors_m(log, "joint").mean() < 0.0015


def test_replay_of_the_joint_model_gives_the_same_bytes(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    copies = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for copy in copies:
        assert ipsys("replay", log, "--model", "joint", "-o", copy).code == 0
    assert copies[0].read_bytes() == copies[1].read_bytes()
    verified = ipsys("verify", log, copies[0])
    assert verified.code == 0, verified.out + verified.err


def test_drive_after_the_points_determines_the_lenses(ipsys: Ipsys, tmp_path: Path) -> None:
    points = list(simulate_session(lab(6, 0.0, intrinsics="nominal")))
    drive = [m for m in hour_later(simulate_session(lab(0, 40.0, intrinsics="nominal"))) if m.camera]
    sigmas = []
    for name, messages in {"points": points, "both": [*points, *drive]}.items():
        log = tmp_path / f"{name}.mcap"
        write_log(log, [m for m in messages if m in points or "/markers" in m.topic])
        done = ipsys("fit", log, "--model", "joint")
        assert done.code == 0, done.err
        with Session([log]) as session:
            (model,) = session.payloads(session.topics(MODEL, "joint"))
        arrays = [{p.name: p.values.reshape(p.shape) for p in camera.parameters} for camera in model.cameras]
        # The first row of the intrinsics is the focal length.
        sigmas.append(max(float(np.linalg.norm(array["modes"][6])) for array in arrays))
    assert sigmas[1] < 0.3 * sigmas[0]


def test_log_with_camera_points_only_is_refused(ipsys: Ipsys, tmp_path: Path, data: Path) -> None:
    log = tmp_path / "paper.mcap"
    imported = ipsys("import", "imsel", data / "imsel", "-o", log)
    assert imported.code == 0, imported.err
    before = log.read_bytes()
    done = ipsys("fit", log, "--model", "joint")
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "joint is fitted to the corners of markers, but the log has only camera points" in done.err
    assert log.read_bytes() == before
