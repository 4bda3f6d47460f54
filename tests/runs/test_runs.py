"""Runs: names of stage results, reused only if they are complete."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ipsys_log
from ipsys_log.engine.output import append_messages, write_log, write_messages
from ipsys_log.engine.request import Request
from ipsys_log.live_runs import pipeline
from ipsys_log.log.contents import run_of_topic
from ipsys_log.log.dataset import Session
from ipsys_log.log.writer import LogWriter
from ipsys_log.messages import CameraCalibration, Measurement, Message, Run, Tracks
from ipsys_log.messages.channels import CAMERA_POINTS, MARKERS, MEASUREMENTS, MODEL, RIG, RUN_EVENTS
from ipsys_log.messages.rig_file import load_rig
from tests.changed_logs import rewrite
from tests.conftest import ROOT, Ipsys
from tests.shared_files import make_once

PAPER = ROOT / "sample_logs" / "paper_lab.mcap"


@pytest.fixture
def paper(tmp_path: Path) -> Path:
    """Write the paper's layout without frames: its markers are in run ``edges``."""
    return Path(shutil.copy(PAPER, tmp_path / "paper.mcap"))


@pytest.fixture(scope="session")
def replayed_paper(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same with all stages, to be copied before it is changed."""

    def write(folder: Path) -> None:
        shutil.copy(PAPER, folder / "paper.mcap")
        pipeline.replay([folder / "paper.mcap"], Request(models=("poly",)))

    return make_once(tmp_path_factory, "paper", write) / "paper.mcap"


@pytest.fixture
def replayed(replayed_paper: Path, tmp_path: Path) -> Path:
    """A copy of the paper's layout with all stages."""
    return Path(shutil.copy(replayed_paper, tmp_path / "paper.mcap"))


def runs_of(ipsys: Ipsys, *arguments: object) -> dict[str, tuple[str, bool]]:
    done = ipsys(*arguments, "--json")
    assert done.code == 0, done.err
    return {row["stage"]: (row["run"], row["new"]) for row in json.loads(done.out)["stages"]}


def without(log: Path, drop: Callable[[Message], bool]) -> Path:
    return rewrite(log, lambda message: None if drop(message) else message, name="less.mcap")


def change(log: Path, edit: Callable[[Any], Any]) -> Path:
    return rewrite(log, lambda m: replace(m, payload=edit(m.payload)), name="other.mcap")


def robots(folder: Path, log: Path, prefix: str) -> Path:
    """Write a rig file that differs from the log's only in the names of the robots."""
    with Session([log]) as session:
        rig = session.payloads(session.topics(RIG))[0]
    text = f'name = "a"\ndictionary = "{rig.dictionary}"\nmarker_length_m = {rig.marker_length_m}\n'
    # Camera points depend on the heights, too: they are compared with the sizes of the markers.
    text += f"marker_height_m = {rig.marker_height_m}\n" if rig.marker_height_m is not None else ""
    for p in rig.reference_points:
        text += f'[[reference_points]]\nname = "{p.name}"\nx_m = {p.x_m}\ny_m = {p.y_m}\n'
    for marker in rig.markers:
        text += f'[[markers]]\nid = {marker.id}\nrobot = "{prefix}_{marker.id}"\n'
    path = folder / f"{prefix}.toml"
    path.write_text(text)
    return path


def test_copied_models_are_used_without_measurements(ipsys: Ipsys, paper: Path, tmp_path: Path) -> None:
    calibration = tmp_path / "calibration.mcap"
    bare = without(paper, lambda message: isinstance(message.payload, Measurement))
    ipsys("replay", paper, "--model", "rigid", "-o", calibration)
    first = runs_of(ipsys, "replay", bare, "--model-from", calibration, "--model", "rigid")
    assert first["fuse"] == ("rigid", True)
    found = runs_of(ipsys, "replay", bare)
    assert {found[stage] for stage in ("locate", "fuse")} == {("rigid", False)}
    # A withdrawn measurement is none.
    with Session([paper]) as session, Session([bare]) as other:
        entered: Measurement = session.payloads(["/measurements"])[0]
        time_ns = other.end_ns + 1
    typed = [entered, Measurement(entered.timestamp, "w1", withdraws=entered.id)]
    append_messages(
        bare, [Message("/measurements", time_ns + n, time_ns, one) for n, one in enumerate(typed)]
    )
    assert runs_of(ipsys, "replay", bare)["fuse"] == ("rigid", False)


def test_newest_run_is_found_again(ipsys: Ipsys, replayed: Path) -> None:
    made = runs_of(ipsys, "replay", replayed, "--run", "again")
    assert made["fit"] == made["fuse"] == ("again", True)
    found = runs_of(ipsys, "replay", replayed)
    assert {found[stage] for stage in ("fit", "evaluate", "locate", "fuse")} == {("again", False)}


def test_run_of_last_log_is_newest_whatever_its_number(ipsys: Ipsys, paper: Path, tmp_path: Path) -> None:
    """With two results of one recording, that of the last log counts."""
    low, high = tmp_path / "low.mcap", tmp_path / "high.mcap"
    ipsys("camera-frame", paper)
    assert runs_of(ipsys, "replay", paper, "-o", low, "--run", "low", "--model", "poly")["fuse"] == (
        "low",
        True,
    )
    assert runs_of(ipsys, "replay", paper, low, "-o", high, "--run", "high")["fuse"] == ("high", True)
    assert runs_of(ipsys, "replay", paper, low, high)["fuse"] == ("high", False)
    assert runs_of(ipsys, "replay", paper, high, low)["fuse"] == ("low", False)


@pytest.mark.slow
def test_run_contains_only_consistent_results(ipsys: Ipsys, replayed: Path, tmp_path: Path) -> None:
    renamed = runs_of(ipsys, "replay", replayed, "--rig", robots(tmp_path, replayed, "ada"))
    # Other robots change only fuse, which gets a new run ...
    assert renamed["locate"] == ("poly", False)
    assert renamed["fuse"] == ("poly_2", True)
    # ... without the results of a new model.
    fewer = runs_of(ipsys, "replay", replayed, "--model", "rigid", "--rig", robots(tmp_path, replayed, "ada"))
    assert {fewer[stage] for stage in ("fit", "evaluate", "locate", "fuse")} == {("rigid", True)}
    with Session([replayed]) as session:
        end_ns = session.end_ns
        first = session.payloads(["/measurements"])[0]
        withdrawal = replace(first, timestamp=end_ns, id="w", withdraws=first.id, splits=())
    with LogWriter.append(replayed) as writer:
        write_messages(writer, [Message("/measurements", end_ns + 1, end_ns, withdrawal)])
    again = runs_of(ipsys, "replay", replayed, "--model", "poly")
    assert {again[stage] for stage in ("fit", "evaluate", "locate", "fuse")} == {("poly_3", True)}


def test_topics_without_a_record_are_ignored(ipsys: Ipsys, replayed: Path) -> None:
    log = without(replayed, lambda m: isinstance(m.payload, Run) and m.payload.stage in ("fit", "locate"))
    with Session([log]) as session:
        topics = [t for r in session.readers for t in r.channels if run_of_topic(t) == "poly"]
        before = {t: session.count(t) for t in topics if not t.endswith("/record")}
    made = runs_of(ipsys, "replay", log, "--model", "poly")
    assert {made[stage] for stage in ("fit", "evaluate", "locate", "fuse")} == {("poly_2", True)}
    with Session([log]) as session:
        assert {t: session.count(t) for t in before} == before


def test_a_run_that_lost_a_channel_is_not_complete(ipsys: Ipsys, replayed: Path) -> None:
    log = without(replayed, lambda m: m.topic == "/runs/poly/cameras/red/positions")
    made = runs_of(ipsys, "replay", log, "--model", "poly")
    assert made["evaluate"] == ("poly", False)
    assert made["locate"] == ("poly_2", True)
    assert made["fuse"] == ("poly_2", True)


def test_a_named_run_takes_the_shared_detection(ipsys: Ipsys, lab: Path) -> None:
    ipsys("detect", lab)
    made = runs_of(ipsys, "camera-frame", lab, "--run", "again")
    assert made == {"detect": ("edges", False), "camera-frame": ("again", True)}
    # The next request gets the first correct run, and computes nothing again.
    before = lab.read_bytes()
    assert "nothing to do" in ipsys("camera-frame", lab).err
    assert lab.read_bytes() == before


def test_one_run_name_for_several_models_is_refused_first(ipsys: Ipsys, paper: Path) -> None:
    before = paper.read_bytes()
    done = ipsys("evaluate", paper, "--run", "x")
    assert done.code == 1
    assert "the command fits" in done.err
    assert paper.read_bytes() == before


def test_seed_changes_only_the_folds_of_labelled_points(ipsys: Ipsys, replayed: Path) -> None:
    made = runs_of(ipsys, "replay", replayed, "--seed", 5)
    assert {stage for stage, (_, new) in made.items() if new} == {"evaluate"}
    assert all(not new for _, new in runs_of(ipsys, "replay", replayed, "--seed", 5).values())
    # The output has the new evaluation, once, with the tracks that are still correct.
    done = ipsys("replay", replayed, "--seed", 5, "--details")
    assert done.out.count("(tracks)") == 1
    # The summary has one row, and so has each table of the details.
    assert sum(line.split()[:1] == ["red"] for line in done.out.splitlines()) == 1 + 4


def test_model_is_identified_by_content_not_by_file(ipsys: Ipsys, replayed: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copy(replayed, tmp_path / "copy.mcap"))
    drive = without(replayed, lambda m: m.topic.startswith("/runs/poly") or m.topic == "/measurements")
    assert runs_of(ipsys, "replay", drive, "--model-from", replayed)["fit"] == ("poly", True)
    assert runs_of(ipsys, "replay", drive, "--model-from", copy)["fit"] == ("poly", False)
    done = ipsys("replay", drive, "--model-from", drive)
    assert done.code == 1
    assert "is the same log" in done.err


def test_a_camera_that_the_model_does_not_know_is_named(ipsys: Ipsys, paper: Path, tmp_path: Path) -> None:
    two = without(paper, lambda m: m.camera == "red")
    with Session([paper]) as session:
        record = next(run for run in session.runs() if run.stage == "detect")
    kept = tuple(o for o in record.outputs if "/red/" not in o.topic)
    two = change(two, lambda p: replace(p, outputs=kept) if isinstance(p, Run) else p)
    assert ipsys("replay", two, "--model", "poly").code == 0
    done = ipsys("replay", paper, "--model-from", two)
    assert done.code == 0
    assert "camera red has no model" in done.err


def test_model_contains_its_calibration_points(ipsys: Ipsys, paper: Path, tmp_path: Path) -> None:
    plain = change(paper, lambda p: replace(p, splits=()) if hasattr(p, "splits") else p)
    fitted = tmp_path / "fitted.mcap"
    assert ipsys("fit", plain, "-o", fitted, "--model", "poly").code == 0
    done = ipsys("evaluate", plain, "--model-from", fitted, "--json")
    assert done.code == 0, done.err
    counts = {c: e["3d"]["count"] for c, e in json.loads(done.out)["models"]["poly"]["cameras"].items()}
    with Session([plain]) as session:
        total = len(session.payloads(["/measurements"]))
    # A fifth of the points was held out by fit; only these count.
    assert sum(counts.values()) < 0.5 * total


def test_files_in_another_order_are_the_same_channels(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    with Session([lab]) as session:
        topics = [topic for reader in session.readers for topic in reader.channels]
        middle = (session.start_ns + session.end_ns) // 2
        parts = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
        write_log(parts[0], session.messages(topics, None, middle))
        write_log(parts[1], session.messages(topics, middle, None))
    derived = tmp_path / "derived.mcap"
    assert ipsys("detect", *parts, "-o", derived).code == 0
    assert runs_of(ipsys, "detect", *parts[::-1], derived) == {"detect": ("edges", False)}


def test_later_rig_does_not_change_earlier_measurements(ipsys: Ipsys, replayed: Path) -> None:
    with Session([replayed]) as session:
        rig, end_ns = session.payloads(["/rig"])[0], session.end_ns
        old = session.payloads(session.topics(MODEL, "poly"))[0]
    moved = replace(rig, reference_points=tuple(replace(p, x_m=p.x_m + 0.1) for p in rig.reference_points))
    with LogWriter.append(replayed) as writer:
        write_messages(writer, [Message("/rig", end_ns + 1, end_ns + 1, moved)])
    assert ipsys("replay", replayed).code == 0
    with Session([replayed]) as session:
        new = session.payloads(session.topics(MODEL, "poly_2"))[0]
    for one, other in zip(old.cameras, new.cameras, strict=True):
        for p, q in zip(one.parameters, other.parameters, strict=True):
            np.testing.assert_array_equal(p.values, q.values)


def test_a_marker_beyond_the_lens_is_left_out_and_named(ipsys: Ipsys, paper: Path) -> None:
    def bent(payload: Any) -> Any:
        # The lens model folds back: far from the centre, a pixel has no ray.
        if isinstance(payload, CameraCalibration) and payload.frame_id == "red":
            return replace(payload, D=np.array([-0.22, 0.0, 0.0, 0.0]))
        return payload

    log = change(paper, bent)
    done = ipsys("camera-frame", log)
    assert done.code == 0, done.err
    assert "outside lens" in done.err
    with Session([log]) as session:
        points = [p for m in session.payloads(session.topics(CAMERA_POINTS, "edges")) for p in m.points]
        events = session.payloads(session.topics(RUN_EVENTS, "edges"))
    assert {event.camera for event in events} == {"red"}
    assert all(np.isfinite([p.x_m, p.y_m, p.z_m]).all() and abs(p.z_m) < 10 for p in points)


def test_a_model_and_its_evaluation_speak_of_the_last_input(ipsys: Ipsys, replayed_lab: Path) -> None:
    with Session([replayed_lab]) as session:
        inputs = list(session.messages([*session.topics(CAMERA_POINTS, "edges"), "/measurements", "/rig"]))
        (model,) = session.messages(session.topics(MODEL, "poly"))
    assert (model.log_time_ns, model.publish_time_ns) == (inputs[-1].log_time_ns, inputs[-1].publish_time_ns)
    assert model.payload.timestamp == model.publish_time_ns


def test_points_that_no_camera_saw_are_named(ipsys: Ipsys, paper: Path) -> None:
    def late(payload: Any) -> Any:
        if getattr(payload, "id", "") == "s003":
            return replace(payload, still=None, timestamp=payload.timestamp + 10**15)
        return payload

    done = ipsys("fit", change(paper, late), "--model", "poly")
    assert "calibration points have no stationary interval in any camera: s003" in done.err


def test_the_truth_is_compared_only_where_it_is_known(ipsys: Ipsys, paper: Path) -> None:
    with Session([paper]) as session:
        middle = (session.start_ns + session.end_ns) // 2
    log = without(paper, lambda m: isinstance(m.payload, Tracks) and m.log_time_ns < middle)
    cameras = json.loads(ipsys("replay", log, "--model", "poly", "--json").out)["models"]["poly"]["cameras"]
    for errors in cameras.values():
        assert "truth" not in errors or errors["truth"]["3d"]["count"] < errors["3d"]["count"]
        assert "truth" not in errors or errors["truth"]["3d"]["mean_m"] < 0.02


def test_rig_of_a_log_can_be_exported_edited_and_used(ipsys: Ipsys, replayed: Path, tmp_path: Path) -> None:
    path = tmp_path / "mended.toml"
    assert ipsys("init", path, "--from", replayed).code == 0
    assert all(not new for _, new in runs_of(ipsys, "replay", replayed, "--rig", path).values())
    path.write_text(path.read_text().replace("marker_length_m = 0.2", "marker_length_m = 0.19"))
    assert runs_of(ipsys, "replay", replayed, "--rig", path)["camera-frame"] == ("edges_2", True)
    assert "0.19 m" in ipsys("runs", replayed).out
    runs = json.loads(ipsys("runs", replayed, "--json").out)["rows"]
    lengths = [run["rig"]["marker_length_m"] for run in runs if run["rig"]]
    assert lengths == [0.19]


def test_exported_rig_has_the_edge_offset(ipsys: Ipsys, tmp_path: Path) -> None:
    lab, path = tmp_path / "lab.mcap", tmp_path / "lab.toml"
    size = ("--width", 960, "--height", 540, "--stations", 9, "--drive-s", 0.5)
    assert ipsys("simulate", "-o", lab, *size, "--gamma", 2.2, "--markers", 6).code == 0
    assert "inside the black" in ipsys("detect", lab).err
    assert ipsys("init", path, "--from", lab).code == 0
    offsets_px = [camera.edge_offset_px for camera in load_rig(path).cameras]
    assert offsets_px == pytest.approx([0.42] * 3, abs=0.1)
    # With the option, every marker has the same length.
    assert ipsys("detect", lab, "--rig", path).code == 0
    with Session([lab]) as session:
        (topic,) = session.topics(MARKERS, "edges_2")[:1]
        found = {m.edge_offset_px for p in session.payloads([topic]) for m in p.markers}
    assert len(found) <= 1 or np.ptp(list(found)) < 1e-3


def test_stage_without_model_continues_the_newest_run(ipsys: Ipsys, replayed: Path, tmp_path: Path) -> None:
    """The log already has a run of the default model."""
    settings = ("--model", "rigid", "--seed", 3, "--run", "monday")
    rig = robots(tmp_path, replayed, "bus")
    assert runs_of(ipsys, "replay", replayed, *settings, "--rig", rig)["fuse"] == ("monday", True)
    for stage in ("locate", "fuse"):
        assert runs_of(ipsys, stage, replayed)[stage] == ("monday", False)
    smoothed = runs_of(ipsys, "smooth", replayed)
    assert smoothed["smooth"] == ("monday", True)
    assert [stage for stage, (_, is_new) in smoothed.items() if is_new] == ["smooth"]
    with Session([replayed]) as session:
        first = session.payloads(["/runs/monday/smoothed_tracks"])[0]
    with ipsys_log.open(replayed) as log:
        track = log.track_at(first.tracks[0].robot, [first.timestamp])
        assert track.robot.startswith("bus")
        assert (track.run, track.channel) == ("monday", "smoothed_tracks")
    # An evaluation of all models selects none.
    assert ipsys("evaluate", replayed, "--model", "kriging", "--model", "rayplane").code == 0
    assert runs_of(ipsys, "smooth", replayed)["smooth"] == ("monday", False)
    # One model is fitted and evaluated before it is applied.
    assert ipsys("fit", replayed, "--model", "kriging-regression").code == 0
    assert runs_of(ipsys, "locate", replayed)["locate"] == ("kriging_regression", True)
    # A setting of the user counts.
    assert runs_of(ipsys, "smooth", replayed, "--model", "poly")["smooth"] == ("poly", True)


def test_stage_without_model_continues_a_run_of_a_copied_model(
    ipsys: Ipsys, replayed: Path, tmp_path: Path
) -> None:
    """The log has measurements, but the user selected a model of another log."""
    other = tmp_path / "other.mcap"
    shutil.copy(PAPER, other)
    assert ipsys("fit", other, "--model", "rigid").code == 0
    assert runs_of(ipsys, "replay", replayed, "--model-from", other)["fuse"] == ("rigid", True)
    smoothed = runs_of(ipsys, "smooth", replayed)
    assert [run for run, is_new in smoothed.values() if is_new] == ["rigid"]


def test_newest_run_that_is_out_of_date_is_repeated_as_it_was(
    ipsys: Ipsys, replayed: Path, tmp_path: Path
) -> None:
    assert runs_of(ipsys, "replay", replayed, "--model", "rigid", "--seed", 3)["fuse"] == ("rigid", True)
    with Session([replayed]) as session:
        *_, last = session.messages(session.topics(MEASUREMENTS))
    withdrawal = replace(last.payload, id="w", withdraws=last.payload.id, splits=())
    append_messages(replayed, [replace(last, payload=withdrawal)])
    smoothed = runs_of(ipsys, "smooth", replayed)
    assert smoothed["smooth"] == ("rigid_2", True)
