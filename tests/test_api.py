"""The Python API: the log contents for programs, and tables that equal the decoded messages."""

import shutil
import subprocess
import sys
from dataclasses import replace
from datetime import UTC, datetime
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import ipsys_log as ipsys
from ipsys_log import IpsysError
from ipsys_log.engine.output import write_log
from ipsys_log.exchange.data_frames import TABLES
from ipsys_log.log.dataset import Session
from ipsys_log.messages import Message, Model, Position, Positions, RigCamera, Track, Tracks
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, POSITIONS, TRACKS, Channel
from ipsys_log.messages.rig_file import rig_toml
from tests.conftest import ROOT
from tests.live_recordings import lenses

RUNS = ("poly", "rigid")


@pytest.fixture(scope="module")
def replayed(detected_log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = Path(shutil.copy(detected_log, tmp_path_factory.mktemp("api") / "lab.mcap"))
    ipsys.replay(path, models=RUNS, until="smooth")
    return path


def test_every_public_name_is_there() -> None:
    for name in ipsys.__all__:
        assert getattr(ipsys, name) is not None
    with pytest.raises(AttributeError):
        ipsys.nothing  # noqa: B018


@pytest.fixture(scope="module")
def api_objects(replayed: Path) -> dict[str, Any]:
    """Return an object of each public class, with as much content as a large lab gives it."""
    result = ipsys.replay(replayed, models=["poly"])
    log, player = ipsys.open(replayed), ipsys.play(replayed)
    score = ipsys.Score(
        model="poly", scheme="held_out", against="tape", dimensions="3d", points=150,
        mean_mm=1.23456789, median_mm=1.23456789, p95_mm=1.23456789, rmse_mm=1.23456789,
    )  # fmt: skip
    compared, many = ipsys.ScoreComparison(score, score), np.zeros((9000, 2))
    finding = ipsys.LogFinding("time", "remark", "the times decrease", "record again", "/runs/a/tracks", 5, 7)
    track = Track("robot_0", 0, 1.0, 2.0, 0.2, 0.5, np.eye(3), ("red", "white"), True)
    seen, lens = tuple((f"{n}.jpg", 0.2) for n in range(400)), replace(next(iter(lenses(replayed).values())))
    calibration: Any = ipsys.CalibrationResult
    objects = [
        calibration("red", lens, ("fx",), many, many, True, many, many, 0.2, 0.1, 400, 400, *[seen] * 4, 0,
                    many, ("move the board",), many, many),
        ipsys.Comparison("/runs/poly/tracks", 5, 5, 5, 5),
        ipsys.Export(replayed, 5, ("poly",)),
        ipsys.Failure("red", "no image shows the board", True),
        ipsys.FittedCornerModel(Model(0, "joint", ())),
        ipsys.load_model(replayed, "poly"),
        type(log.channels)(log.channels * 9),
        ipsys.LiveTracks("poly", 5, (track,) * 100),
        log,
        ipsys.LogCheck(replayed, (finding,) * 500),
        finding,
        result.evaluations["poly"],
        result.outcomes[0],
        player,
        result,
        log.track_at("robot_0", log.table("tracks")["time"]),
        score,
        compared,
        ipsys.ScoreResult("dataset", (score,) * 99, (compared,) * 99, (score,) * 9),
        ipsys.Tracker(lambda _: []),
        next(log.messages("images")),
    ]  # fmt: skip
    return {type(one).__name__: one for one in objects}


@pytest.mark.parametrize(
    "name", [name for name in ipsys.__all__ if isinstance(getattr(ipsys, name), type)] + ["Message"]
)
def test_object_prints_in_20_lines(api_objects: dict[str, Any], name: str) -> None:
    if name == "IpsysError":
        return
    lines = repr(api_objects[name]).splitlines()
    assert 0 < sum(1 + len(line) // 80 for line in lines) <= 20


def test_tracker_keeps_few_tracks_of_a_loop_that_pauses() -> None:
    from ipsys_log.live_runs.player import Tracker

    tracker = Tracker(lambda _: [])
    tracks = [Message("/runs/poly/tracks", n, n, Tracks(n, ())) for n in range(1000)]
    for message in tracks:
        tracker.send(message)
    assert tracker.dropped == 900
    assert next(iter(tracker)).time_ns == 999
    assert tracker.dropped == 999


def test_import_is_light() -> None:
    program = (
        "import sys, ipsys_log; print(sorted({'numpy', 'cv2', 'sklearn', 'pandas'} & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True, timeout=120
    )
    assert done.stdout.strip() == "[]"


def test_log_lists_cameras_runs_and_channels(replayed: Path) -> None:
    with ipsys.open(replayed) as log:
        assert [row[0] for row in log.cameras] == ["black", "red", "white"]
        assert {(row[0], row[1], row[2]) for row in log.runs} >= {
            ("edges", "detect", "current"),
            ("poly", "fuse", "current"),
            ("rigid", "fuse", "current"),
        }
        channels = {(row[0], row[1]) for row in log.channels}
        assert {("rig", None), ("images", None), ("markers", "edges"), ("tracks", "poly")} <= channels
        assert repr(log.cameras).splitlines()[0].split() == ["camera", "images", "calibrated"]
        assert "<td>edges</td>" in log.runs._repr_html_()


def test_text_in_html_is_escaped() -> None:
    from ipsys_log.api.opened_log import Listing, _RunRow

    listing = Listing([_RunRow("<script>", "detect", "current", ())])
    assert "<script>" not in listing._repr_html_()


@pytest.mark.parametrize(
    ("name", "channel", "run"),
    [
        ("markers", MARKERS, "edges"),
        ("camera_points", CAMERA_POINTS, "edges"),
        ("positions", POSITIONS, "poly"),
        ("tracks", TRACKS, "poly"),
    ],
)
def test_table_equals_the_decoded_messages(replayed: Path, name: str, channel: Channel, run: str) -> None:
    with ipsys.open(replayed) as log, Session([replayed]) as session:
        table = log.table(name, run=run)
        rows = [
            (message, item)
            for message in session.messages(session.topics(channel, run))
            for item in getattr(message.payload, {"camera_points": "points"}.get(name, name))
        ]
    assert len(table) == len(rows) > 0
    for (_, row), (message, item) in zip(table.iterrows(), rows, strict=True):
        assert row["time"].value == message.publish_time_ns
        assert row["log_time_ns"] == message.log_time_ns
        assert row["marker_id"] == item.id
        if name == "tracks":
            assert (row["robot"], row["cameras"]) == (item.robot, item.cameras)
        else:
            assert row["camera"] == message.camera
        if name == "markers":
            assert [
                row[f"{axis}{n}_px"] for n in range(4) for axis in "xy"
            ] == item.corners_px.ravel().tolist()
            continue
        assert (row["x_m"], row["y_m"], row["z_m"]) == (item.x_m, item.y_m, item.z_m)
        covariance = item.covariance_m2
        if covariance is None:
            assert isnan(row["cov_xx_m2"])
        else:
            assert (row["cov_xy_m2"], row["cov_zz_m2"]) == (covariance[0, 1], covariance[2, 2])
        if name in ("positions", "tracks"):
            assert (pd.isna(row["inside"]) and item.inside is None) or row["inside"] == item.inside


def test_missing_values_are_nan_or_na(tmp_path: Path) -> None:
    from ipsys_log.engine.output import write_log
    from ipsys_log.messages import Rig

    path = tmp_path / "x.mcap"
    tracks = Tracks(
        5, (Track("a", 0, 0.0, 1.0, 2.0), Track("b", 1, 0.0, 0.0, 0.0, 0.5, np.eye(3), ("red",), False))
    )
    positions = Positions(5, (Position(0, 1.0, 2.0, 3.0),))
    messages = [
        Message("/rig", 1, 1, Rig("lab", "DICT_4X4_100", 0.2)),
        Message("/runs/poly/cameras/red/positions", 5, 5, positions, "red"),
        Message("/runs/poly/tracks", 5, 5, tracks),
        Message("/runs/poly/tracks", 6, 6, Tracks(6, ())),
    ]
    write_log(path, messages)
    with ipsys.open(path) as log:
        table = log.table("tracks", run="poly")
        assert table["x_m"].tolist() == [0.0, 0.0]
        assert np.isnan(table["heading_rad"][0])
        assert np.isnan(table["cov_xx_m2"][0])
        assert table["cov_xx_m2"][1] == 1.0
        assert table["inside"].isna().tolist() == [True, False]
        assert table["cameras"].tolist() == [(), ("red",)]
        positions_table = log.table("positions", run="poly")
        assert np.isnan(positions_table["cov_zz_m2"][0])
        assert positions_table["time_offset_ns"].isna().all()


@pytest.mark.parametrize("name", ["tracks", "smoothed_tracks", "truth"])
def test_segment_of_a_table_is_an_unbroken_track(
    replayed: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ipsys_log.exchange.data_frames._BATCH", 7)  # a track goes on in the next part
    with ipsys.open(replayed) as log:
        rows: Any = log.table(name).itertuples()
    last: dict[tuple[str, int], Any] = {}
    begun = set()
    for row in rows:
        before = last.get(key := (row.robot, row.marker_id))
        gap_ns = None if before is None else row.time.value - before.time.value
        if gap_ns is None or gap_ns > getattr(row, "age_ns", 1_000_000_000):
            assert row.segment not in begun
            begun.add(row.segment)
        else:
            assert before is not None
            assert row.segment == before.segment
        last[key] = row
    assert len(begun) > len(last) > 1


def test_several_runs_add_a_column(replayed: Path) -> None:
    with ipsys.open(replayed) as log:
        both = log.table("tracks", run=RUNS)
        single = [log.table("tracks", run=run) for run in RUNS]
    assert both["run"].tolist() == [
        run for run, table in zip(RUNS, single, strict=True) for _ in range(len(table))
    ]
    assert "run" not in single[0]


def test_every_table_of_a_log_can_be_read(replayed: Path) -> None:
    with ipsys.open(replayed) as log:
        for name in {*TABLES} - {"estimate"}:
            table = log.table(name)
            assert str(table["time"].dtype) == "datetime64[ns, UTC]"
            assert (len(table) > 0) == (name not in ("latency", "events", "commands"))


def test_times_bound_a_table(replayed: Path) -> None:
    with ipsys.open(replayed) as log:
        whole = log.table("tracks", run="poly")
        middle_ns = int(whole["log_time_ns"].median())
        before, after = (
            log.table("tracks", run="poly", end=middle_ns),
            log.table("tracks", run="poly", start=middle_ns),
        )
        assert len(before) + len(after) == len(whole)
        assert after["log_time_ns"].min() >= middle_ns > before["log_time_ns"].max()
        moment = datetime.fromtimestamp(middle_ns // 1_000_000_000, UTC)
        messages = list(log.messages("tracks", run="poly", start=moment))
        assert all(message.log_time_ns >= middle_ns // 1_000_000_000 * 1_000_000_000 for message in messages)
        with pytest.raises(IpsysError, match="has no time zone"):
            log.table("tracks", start=datetime(2026, 1, 1))


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"name": "trax"}, "table 'trax' is not known"),
        ({"name": "tracks", "run": "nobody"}, "run nobody has no tracks"),
        ({"name": "events", "run": "poly"}, "is recorded and belongs to no run"),
    ],
)
def test_wrong_names_are_one_line(replayed: Path, given: dict[str, Any], text: str) -> None:
    with ipsys.open(replayed) as log, pytest.raises(IpsysError, match=text):
        log.table(**given)


@pytest.mark.slow
def test_replay_returns_evaluations(lab_log: Path, tmp_path: Path) -> None:
    path = Path(shutil.copy(lab_log, tmp_path / "lab.mcap"))
    result = ipsys.replay(path, models=["poly"])
    frame = result.evaluations["poly"].to_frame()
    assert {"held_out", "cross_validation"} >= set(frame["scheme"]) > set()
    assert (frame["mean_m"] > 0).all()
    assert not any(outcome.fresh for outcome in ipsys.replay(path, models=["poly"]).outcomes)
    assert all(comparison.equal for comparison in ipsys.verify(path))


def test_model_predicts_the_positions_of_its_log(replayed: Path) -> None:
    model = ipsys.load_model(replayed, "poly")
    assert isinstance(model, ipsys.FittedModel)
    with ipsys.open(replayed) as log:
        points = log.table("camera_points", run="edges").query("camera == 'red'")
        positions = log.table("positions", run="poly").query("camera == 'red'")
    predicted = model.predict("red", points[["x_m", "y_m", "z_m"]].to_numpy())
    assert predicted == pytest.approx(positions[["x_m", "y_m", "z_m"]].to_numpy(), abs=1e-12)
    with pytest.raises(IpsysError, match="has no camera"):
        model.predict("green", [[0.0, 0.0, 1.0]])
    with pytest.raises(IpsysError, match="shape"):
        model.predict("red", [0.0, 0.0, 1.0])


def test_calibrate_without_images_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(IpsysError):
        list(ipsys.calibrate(tmp_path / "nothing", board="6x4"))


def rig_of_log(log: Path, folder: Path) -> Path:
    """Write a rig file whose cameras play the images of a log; return its path."""
    with Session([log]) as session:
        (rig,) = session.payloads(["/rig"])
    cameras = tuple(RigCamera(name, source=f"file:{log}?{name}") for name in ("red", "white", "black"))
    lab = folder / "lab.toml"
    lab.write_text(rig_toml(replace(rig, cameras=cameras)))
    return lab


def test_live_tracks_and_records(lab_log: Path, replayed: Path, tmp_path: Path) -> None:
    lab, target = rig_of_log(lab_log, tmp_path), tmp_path / "live.mcap"
    calibrations = lenses(lab_log)
    with ipsys.live(
        lab, record=target, model_from=replayed, models=RUNS, calibrations=calibrations
    ) as tracker:
        seen = next(tracks for tracks in tracker if tracks.tracks)
        assert seen.run in RUNS
    assert {(outcome.stage, outcome.run) for outcome in tracker.outcomes} >= {
        ("detect", "edges"),
        ("fuse", "poly"),
        ("fuse", "rigid"),
    }
    with ipsys.open(target) as log:
        assert len(log.table("tracks", run="poly")) > 0
    assert all(comparison.equal for comparison in ipsys.verify(target))
    again = ipsys.live(lab, record=target, model_from=replayed, calibrations=calibrations)
    with pytest.raises(IpsysError, match="exists already"), again:
        pass


def test_live_without_record_tracks_and_writes_nothing(lab_log: Path, replayed: Path, tmp_path: Path) -> None:
    lab = rig_of_log(lab_log, tmp_path)
    with ipsys.live(lab, model_from=replayed, model="rigid", calibrations=lenses(lab_log)) as tracker:
        assert next(tracks for tracks in tracker if tracks.tracks).run == "rigid"
    assert ("fuse", "rigid") in {(outcome.stage, outcome.run) for outcome in tracker.outcomes}
    assert [path.name for path in tmp_path.iterdir()] == ["lab.toml"]


def test_live_says_what_is_wrong_on_entering(tmp_path: Path, replayed: Path) -> None:
    with (
        pytest.raises(IpsysError, match=r"lab\.toml"),
        ipsys.live(tmp_path / "lab.toml", record=tmp_path / "x.mcap", model_from=replayed),
    ):
        pass
    assert not (tmp_path / "x.mcap").exists()
    with pytest.raises(IpsysError, match="model_from"), ipsys.live(rig_of_log(replayed, tmp_path)):
        pass


def test_names_of_models_and_runs_select_the_same(replayed: Path) -> None:
    with ipsys.open(replayed) as log, pytest.raises(IpsysError, match="run rigid_poly has no tracks"):
        log.table("tracks", run="rigid+poly")
    assert ipsys.replay(replayed, model="poly", until="fit").outcomes[-1].run == "poly"
    with pytest.raises(IpsysError, match=r"has no fitted model bst \(it has: rigid, poly\)$"):
        ipsys.load_model(replayed, "bst")


def test_tables_without_pandas_are_one_line(replayed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    result = ipsys.replay(replayed, models=["poly"])
    monkeypatch.setitem(sys.modules, "pandas", None)
    with ipsys.open(replayed) as log, pytest.raises(IpsysError, match="need pandas"):
        log.table("tracks")
    with pytest.raises(IpsysError, match="need pandas"):
        result.evaluations["poly"].to_frame()


def test_table_of_an_impossible_time_is_one_line(tmp_path: Path) -> None:
    from ipsys_log.log.codec import encode, schema_data
    from ipsys_log.log.contents import Schema
    from ipsys_log.log.writer import LogWriter

    path, name = tmp_path / "x.mcap", "ipsys.v1.Tracks"
    with LogWriter.create(path) as writer:
        writer.add_channel("/runs/poly/tracks", Schema(name, "protobuf", schema_data(name)))
        writer.write("/runs/poly/tracks", 2**63 + 1, 5, encode(Tracks(5, ())))
    with ipsys.open(path) as log, pytest.raises(IpsysError, match="later than the year 2262"):
        log.table("tracks", run="poly")


def test_table_of_a_small_log_with_many_parts_is_refused(tmp_path: Path) -> None:
    log = tmp_path / "many.mcap"
    tracks = Tracks(1, (Track("a", 1, 0.0, 0.0, 0.0),) * 70_000)
    write_log(log, [Message("/truth/tracks", 1, 1, tracks)])
    assert log.stat().st_size < 70_000
    with (
        ipsys.open(log) as opened,
        pytest.raises(ipsys.IpsysError, match="more parts than a log of this size"),
    ):
        opened.table("truth")
