"""The joint model as stages of replay, in sessions without images whose ground truth is known."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ipsys_log.api import python_api as api
from ipsys_log.api.python_api import load_model
from ipsys_log.capture.simulation.settings import LabSettings
from ipsys_log.engine.graph import stages_until
from ipsys_log.engine.model_checks import compare_labs
from ipsys_log.engine.model_choice import choose_models, newest_model
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.errors import FitError, IpsysError
from ipsys_log.live_runs.survey.checks import check_entry
from ipsys_log.live_runs.survey.entry import TypedEntry, parse_entry
from ipsys_log.live_runs.survey.from_log import open_finished_log
from ipsys_log.live_runs.survey.scene import observe_marker
from ipsys_log.log.dataset import Session
from ipsys_log.messages import (
    TRUTH_TOPIC,
    CameraCalibration,
    Markers,
    Measurement,
    Message,
    Model,
    Run,
    Tracks,
)
from ipsys_log.messages.channels import EVALUATION, MARKERS, MEASUREMENTS_TOPIC, MODEL, POSITIONS, RIG
from ipsys_log.models.locate_corners import FittedCornerModel
from ipsys_log.models.table import MODELS
from ipsys_log.statistics.joint_evaluation import JOINT_SUBSETS
from tests.changed_logs import rewrite
from tests.conftest import Ipsys
from tests.geometric.lab import GeometricLab, GeometricSettings, build_lab
from tests.geometric.session import simulate_session

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
    write_log(path, simulate_session(lab(20, 8.0, held_out_points=8)))
    return path


@pytest.fixture
def log(calibration: Path, tmp_path: Path) -> Path:
    path = tmp_path / "lab.mcap"
    path.write_bytes(calibration.read_bytes())
    return path


@pytest.fixture(scope="module")
def fitted_log(calibration: Path) -> Path:
    path = calibration.with_name("fitted.mcap")
    path.write_bytes(calibration.read_bytes())
    api.replay(path, models=["joint"], until="fit")
    return path


@pytest.fixture
def fitted(fitted_log: Path, tmp_path: Path) -> Path:
    path = tmp_path / "lab.mcap"
    path.write_bytes(fitted_log.read_bytes())
    return path


@pytest.fixture(scope="module")
def replayed(calibration: Path) -> Path:
    """Return a log with all results of two models; tests do not change it."""
    path = calibration.with_name("replayed.mcap")
    path.write_bytes(calibration.read_bytes())
    api.replay(path, models=["joint", "rayplane"])
    return path


def replay(ipsys: Ipsys, *arguments: object) -> dict[str, Any]:
    """Return the models in the JSON of a replay."""
    done = ipsys("replay", *arguments, "--json")
    assert done.code == 0, done.err
    models: dict[str, Any] = json.loads(done.out)["models"]
    return models


@pytest.mark.slow
def test_joint_model_halves_the_error_of_rayplane(ipsys: Ipsys, replayed: Path) -> None:
    models = replay(ipsys, replayed, "--model", "joint", "--model", "rayplane")
    truth = {name: model["pooled"]["truth"]["2d"]["mean_m"] for name, model in models.items()}
    tracks = {name: model["tracks"]["truth"]["2d"]["mean_m"] for name, model in models.items()}
    assert truth["joint"] < 0.6 * truth["rayplane"]
    assert tracks["joint"] < 0.6 * tracks["rayplane"]
    assert tracks["joint"] < 0.0015
    with Session([replayed]) as session:
        (evaluation,) = session.payloads(session.topics(EVALUATION, "joint"))
    curve = {(point.camera, point.pairs): point for point in evaluation.learning}
    cameras = {camera for camera, _ in curve}
    assert len(cameras) == 3
    for camera in cameras:
        # With a drive, five points are nearly enough; the tape is most of the error.
        few = curve[camera, 5]
        assert few.subsets == JOINT_SUBSETS
        assert few.mean_2d_m < 0.02


@pytest.mark.slow
def test_results_of_the_joint_model_are_verified(ipsys: Ipsys, replayed: Path) -> None:
    """The model, its evaluation and all later results are computed again, to the same bytes."""
    verified = ipsys("verify", replayed)
    assert verified.code == 0, verified.out + verified.err
    for channel in ("model", "evaluation", "tracks"):
        assert f"joint/{channel} " in verified.out


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
    errors_m = [
        replay(ipsys, both, "--model", "joint", *more)["joint"]["tracks"]["truth"]["2d"]["mean_m"]
        for more in (before, [])
    ]
    assert errors_m[1] < 0.5 * errors_m[0]


def test_log_with_camera_points_only_is_refused(ipsys: Ipsys, tmp_path: Path, data: Path) -> None:
    log = tmp_path / "paper.mcap"
    imported = ipsys("import", "imsel", data / "imsel", "-o", log)
    assert imported.code == 0, imported.err
    before = log.read_bytes()
    done = ipsys("fit", log, "--model", "joint")
    assert (done.code, done.err.count("\n")) == (1, 1)
    assert "joint is fitted to the corners of markers, but the log has only camera points" in done.err
    assert log.read_bytes() == before


def test_loaded_joint_model_gives_the_positions_of_locate(ipsys: Ipsys, fitted: Path) -> None:
    assert ipsys("locate", fitted, "--model", "joint").code == 0
    model = load_model(fitted, "joint")
    assert isinstance(model, FittedCornerModel)
    with Session([fitted]) as session:
        rig = session.payloads(session.topics(RIG))[-1]
        located = {
            (m.camera, m.log_time_ns): m.payload.positions
            for m in session.messages(session.topics(POSITIONS, "joint"))
        }
        # A marker on a robot is at the height of the rig, other than one at a calibration point.
        seen, positions = next(
            (m, positions)
            for m in session.messages(session.topics(MARKERS, "geometric"))
            if (positions := located[m.camera, m.log_time_ns])
            and all(p.inside and abs(p.z_m - rig.height_of(p.id)) < 0.005 for p in positions)
        )
    markers = seen.payload.markers
    corners_px = np.array([marker.corners_px for marker in markers])
    covariances_px2 = np.array([marker.covariance_px2 for marker in markers])
    heights_m = [rig.height_of(marker.id) for marker in markers]
    found = model.locate(str(seen.camera), corners_px, rig.marker_length_m, heights_m, covariances_px2)
    assert [p.id for p in positions] == [marker.id for marker in markers]
    expected_m = np.array([(p.x_m, p.y_m, p.z_m) for p in positions])
    assert np.abs(found.points_m - expected_m).max() < 1e-9
    assert np.abs(found.headings_rad - [p.heading_rad for p in positions]).max() < 1e-9
    level = model.predict(str(seen.camera), corners_px, rig.marker_length_m, heights_m)
    free = model.predict(str(seen.camera), corners_px, rig.marker_length_m)
    assert np.abs(level - expected_m).max() < 0.002
    assert np.abs(free - expected_m)[:, :2].max() < 0.01
    with pytest.raises(IpsysError, match="has no camera 'blue'"):
        model.predict("blue", corners_px, 0.2)
    with pytest.raises(IpsysError, match=r"corners_px has the shape \(3,\)"):
        model.predict(str(seen.camera), np.zeros(3), 0.2)
    with pytest.raises(IpsysError, match="heights_m has the shape"):
        model.predict(str(seen.camera), corners_px, 0.2, np.zeros(len(markers) + 7))


@pytest.mark.slow
def test_logs_with_runs_of_one_name_are_fitted_together(ipsys: Ipsys, fitted: Path, tmp_path: Path) -> None:
    """A drive of another hour has runs of the same names; the fit uses the sightings of both."""
    drive, alone, both = (tmp_path / name for name in ("drive.mcap", "alone.mcap", "both.mcap"))
    later = [m for m in hour_later(simulate_session(lab(4, 8.0))) if m.topic != MEASUREMENTS_TOPIC]
    write_log(drive, later)
    assert ipsys("fit", fitted, "--model", "joint", "-o", alone).code == 0
    done = ipsys("fit", fitted, drive, "--model", "joint", "-o", both)
    assert done.code == 0, done.err
    with Session([fitted, drive, both]) as session:
        record = next(run for run in reversed(session.runs()) if run.stage == "fit")
        counts = {read.topic: read.messages for read in record.inputs if "/markers" in read.topic}
        assert counts
        for topic, count in counts.items():
            assert count == sum(r.channels[topic].message_count for r in session.readers[:2])
    other = tmp_path / "other.mcap"
    changed = [
        replace(m, payload=replace(m.payload, parameters={"format": "other"}))
        if isinstance(m.payload, Run)
        else m
        for m in hour_later(simulate_session(lab(4, 8.0)))
    ]
    write_log(other, [m for m in changed if m.topic != MEASUREMENTS_TOPIC])
    refused = ipsys("fit", fitted, other, "--model", "joint")
    assert (refused.code, refused.err.count("\n")) == (1, 1)
    assert "run geometric has other parameters of import in" in refused.err
    same_time = tmp_path / "same_time.mcap"
    same_time.write_bytes(fitted.read_bytes())
    refused = ipsys("fit", fitted, same_time, "--model", "joint")
    assert (refused.code, refused.err.count("\n")) == (1, 1)
    assert "at the same time" in refused.err
    assert "leave one of them out" in refused.err


@pytest.mark.slow
def test_wrong_tape_reading_is_an_outlier_of_joint(ipsys: Ipsys, tmp_path: Path) -> None:
    """A drive shows a wrong reading among few points, where other models cannot search."""

    def wrong(message: Message) -> Message:
        payload = message.payload
        if not isinstance(payload, Measurement) or payload.id != "s004":
            return message
        first, second = payload.distances
        longer = replace(first, distance_m=first.distance_m + 0.1)
        return replace(message, payload=replace(payload, distances=(longer, second)))

    log = tmp_path / "wrong.mcap"
    write_log(log, map(wrong, simulate_session(lab(12, 10.0))))
    done = ipsys("evaluate", log, "--model", "joint", "--json")
    assert done.code == 0, done.err
    (model,) = json.loads(done.out)["models"].values()
    (suspect,) = model["suspects"]
    assert (suspect["measurement"], suspect["kind"]) == ("s004", "distance")
    assert "distance to A" in suspect["text"]
    assert 0.05 < np.linalg.norm(suspect["residual_m"]) < 0.25
    assert "Outliers: measure 1 point again" in ipsys("evaluate", log, "--model", "joint").out


def test_models_are_the_best_that_a_log_allows(calibration: Path, tmp_path: Path) -> None:
    points_only = tmp_path / "points.mcap"
    with Session([calibration]) as session:
        topics = [t for reader in session.readers for t in reader.channels if "/markers" not in t]
        write_log(points_only, (m for m in session.messages(topics) if not isinstance(m.payload, Run)))
        (rig,) = session.payloads(session.topics(RIG))
    evaluate, fuse = (stages_until(name)[-1] for name in ("evaluate", None))
    assert choose_models(Request(), [calibration], evaluate).models == (*MODELS, "joint")
    assert choose_models(Request(), [points_only], evaluate).models == tuple(MODELS)
    no_height = replace(rig, marker_height_m=None)
    said = {
        (calibration, None): ("joint", "model joint: the log has markers and their heights"),
        (points_only, None): ("best", "joint needs images or markers"),
        (calibration, no_height): ("best", "joint needs marker_height_m of marker 0 in the rig"),
    }
    for (log, given), (model, reason) in said.items():
        choice = choose_models(Request(rig=given), [log], fuse)
        assert choice.models == (model,)
        assert reason in choice.reason


def test_model_is_of_the_lenses_that_it_was_fitted_with(log: Path, fitted_log: Path) -> None:
    """The log has other intrinsics than its model: they were replaced, or ``joint`` has estimated them."""

    def widen(message: Message) -> Message:
        if not isinstance(message.payload, CameraCalibration):
            return message
        wide = message.payload.K * np.array([[0.9, 1, 1], [1, 0.9, 1], [1, 1, 1]])
        return replace(message, payload=replace(message.payload, K=wide))

    with Session([fitted_log]) as session:
        lenses = {camera: session.payloads([topic])[-1] for camera, topic in session.calibrations.items()}
        (model,) = session.payloads(session.topics(MODEL, "joint"))
    other = rewrite(log, widen, name="other.mcap")
    with pytest.raises(IpsysError, match="this is a model of other cameras"):
        compare_labs(other, [], None, lenses)
    assert compare_labs(other, [model], None, lenses) == []
    api.replay(other, model="rayplane", until="fit", calibrations=lenses)
    assert compare_labs(other, [], None, lenses) == []


def test_newest_run_of_the_user_is_continued(ipsys: Ipsys, fitted: Path) -> None:
    """Later evaluations of all models do not select one."""
    assert ipsys("replay", fitted, "--model", "rigid", "--seed", 3).code == 0
    assert ipsys("evaluate", fitted, "--model", "rayplane", "--model", "best").code == 0
    done = ipsys("replay", fitted)
    assert "model rigid: that of the newest run" in done.err
    assert "nothing to do" in done.err
    with Session([fitted]) as session:
        assert newest_model(session) == "rigid"


def test_default_joint_model_that_cannot_be_fitted_is_replaced(
    ipsys: Ipsys, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_arguments: object) -> Model:
        raise FitError("camera red: no overlap")

    monkeypatch.setattr("ipsys_log.engine.model_choice.MODELS", ("rigid",))
    monkeypatch.setattr("ipsys_log.statistics.joint_evaluation.fit_joint_model", fail)
    for command, runs in (("replay", {"best"}), ("evaluate", {"best", "rigid"})):
        done = ipsys(command, log)
        assert done.code == 0, done.err
        assert "joint is left out: camera red: no overlap" in done.err
        with Session([log]) as session:
            assert {run.run for run in session.runs()} - {"geometric"} == runs
    named = ipsys("evaluate", log, "--model", "joint")
    assert (named.code, named.err.count("\n")) == (1, 1)


@pytest.mark.slow
def test_marker_without_a_height_gets_its_full_pose(ipsys: Ipsys, fitted: Path, tmp_path: Path) -> None:
    rig, located = tmp_path / "lab.toml", tmp_path / "located.mcap"
    assert ipsys("init", rig, "--from", fitted).code == 0
    rig.write_text(rig.read_text().replace("marker_height_m = 0.1\n", ""))
    drive = tmp_path / "drive.mcap"
    write_log(drive, simulate_session(lab(4, 10.0)))
    before = drive.read_bytes()
    options = ("--model", "joint", "--model-from", fitted, "--rig", rig, "-o", located)
    tracks = replay(ipsys, drive, *options)["joint"]["tracks"]["truth"]
    assert drive.read_bytes() == before
    assert tracks["2d"]["mean_m"] < 0.004
    assert tracks["3d"]["mean_m"] < 0.015
    with Session([drive, located]) as session:
        positions = [p for one in session.payloads(session.topics(POSITIONS, "joint")) for p in one.positions]
    heights_m = np.array([p.z_m for p in positions])
    sigmas_m = np.sqrt([p.covariance_m2[2, 2] for p in positions if p.covariance_m2 is not None])
    assert abs(float(np.median(heights_m)) - 0.1) < 0.005
    # The covariance has an error of the print of 0.1 %, 2 mm from a camera at 2.1 m. These prints are exact.
    assert 0.0018 < float(np.median(sigmas_m)) < 0.0025
    assert float(np.median(np.abs(heights_m - 0.1) / sigmas_m)) / 0.6745 < 2
    assert np.mean([bool(p.inside) for p in positions]) > 0.99


def test_points_are_measured_beside_a_joint_model(ipsys: Ipsys, log: Path) -> None:
    """The joint model cannot predict from camera points: a point is checked without it, and saved."""
    assert ipsys("fit", log, "--model", "joint").code == 0
    with open_finished_log(log, Request()) as scene:
        assert scene.model is not None
        assert scene.model.name == "joint"
        interval = scene.intervals[0]
        sight = observe_marker(scene.views(0), interval.marker_id)
        assert sight.points_m
        typed = TypedEntry(str(interval.marker_id), {"A": "250", "B": "250"}, "left", "10")
        checked = check_entry(*parse_entry(typed, scene.rig), scene.rig, sight, (), scene.model)
        assert checked.measurement is not None, checked.faults
        before = len(scene.history())
        scene.add([checked.measurement])
        assert len(scene.history()) == before + 1
