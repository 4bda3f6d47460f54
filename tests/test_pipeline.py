"""Replay: missing and outdated results are computed and appended, and no others."""

import json
import random
import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ipsys_log.engine.execute import run_stage
from ipsys_log.engine.output import write_log
from ipsys_log.engine.request import Request
from ipsys_log.engine.stream import in_threads, run
from ipsys_log.errors import LogError
from ipsys_log.live_runs.pipeline import replay
from ipsys_log.log.codec import encode
from ipsys_log.log.dataset import Session
from ipsys_log.messages import CompressedImage, Markers, Measurement, Message, Positions, Rig
from ipsys_log.messages.channels import CAMERA_POINTS, IMAGES, MARKERS, MODEL, POSITIONS, TRACKS
from ipsys_log.messages.rig_file import load_rig
from ipsys_log.statistics.calibration_points import active_measurements
from tests.conftest import ROOT, Ipsys, data_section
from tests.wiring import wired

RIG_TOML = """
name = "simulated"
dictionary = "DICT_4X4_100"
marker_length_m = {length}
marker_height_m = 0.1
marker_height_sigma_m = 0.0001
[[reference_points]]
name = "A"
x_m = 1.2192
y_m = 2.4384
[[reference_points]]
name = "B"
x_m = 3.6576
y_m = 2.4384
"""


def stages_of(ipsys: Ipsys, *arguments: object) -> dict[str, tuple[str, bool]]:
    done = ipsys(*arguments, "--json")
    assert done.code == 0, done.err
    return {row["stage"]: (row["run"], row["new"]) for row in json.loads(done.out)["stages"]}


def write_rig(path: Path, lab: Path, length_m: float) -> Path:
    """Write the lab's rig as a file, with another marker length."""
    with Session([lab]) as session:
        held = session.payloads(["/rig"])[0]
    robots = "".join(f'[[markers]]\nid = {m.id}\nrobot = "{m.robot}"\n' for m in held.markers)
    path.write_text(RIG_TOML.format(length=length_m) + robots)
    return path


def frames(count: int) -> Iterator[Message]:
    yield Message("/rig", 0, 0, Rig("lab", "DICT_4X4_100", 0.2))
    for number in range(1, count):
        camera = ("red", "white", "black")[number % 3]
        yield Message(
            f"/cameras/{camera}/image", number, number, CompressedImage(number, camera, b"", ""), camera
        )


def test_run_yields_results_after_their_inputs() -> None:
    def seen(message: Message) -> Iterator[Any]:
        yield Markers(message.publish_time_ns, (), 1, 1)

    def located(message: Message) -> Iterator[Any]:
        yield Positions(message.publish_time_ns, ())

    stages = [
        wired("a", (IMAGES,), (MARKERS,), seen),
        wired("b", (MARKERS,), (POSITIONS,), located, {MARKERS: "a"}),
    ]
    made = list(run(frames(3), stages))
    assert [message.topic for message in made] == [
        "/rig",
        "/cameras/white/image",
        "/runs/a/cameras/white/markers",
        "/runs/b/cameras/white/positions",
        "/cameras/black/image",
        "/runs/a/cameras/black/markers",
        "/runs/b/cameras/black/positions",
    ]
    assert [message.log_time_ns for message in made] == [0, 1, 1, 1, 2, 2, 2]


def test_threads_change_the_speed_and_not_the_order() -> None:
    uneven = random.Random(0)
    last: dict[str | None, int] = {}

    def slow(message: Message) -> Iterator[Any]:
        time.sleep(uneven.random() * 0.003)
        # The stage gets a camera's messages in order.
        assert last.get(message.camera, -1) < message.log_time_ns
        last[message.camera] = message.log_time_ns
        yield Markers(message.publish_time_ns, (), 1, 1)

    stage = wired("a", (IMAGES,), (MARKERS,), slow)
    plain = [(m.topic, m.log_time_ns) for m in run(frames(60), [stage])]
    last.clear()
    threaded = [(m.topic, m.log_time_ns) for m in run(frames(60), [stage], in_threads)]
    assert threaded == plain


def test_stage_across_cameras_gets_messages_in_order() -> None:
    order: list[int] = []

    def across(message: Message) -> Iterator[Any]:
        time.sleep(0.002 if message.camera == "white" else 0)
        order.append(message.log_time_ns)
        yield Markers(message.publish_time_ns, (), 1, 1)

    list(run(frames(30), [wired("a", (IMAGES,), (MARKERS,), across, per_camera=False)], in_threads))
    assert order == sorted(order)


def test_failed_thread_raises_and_stops_the_others() -> None:
    def failing(message: Message) -> Iterator[Any]:
        if message.log_time_ns == 20:
            raise ValueError("a bug")
        yield Markers(message.publish_time_ns, (), 1, 1)

    threads = cv2.getNumThreads()
    with pytest.raises(ValueError, match="a bug"):
        list(run(frames(60), [wired("a", (IMAGES,), (MARKERS,), failing)], in_threads))
    assert cv2.getNumThreads() == threads


def test_each_result_is_computed_once(ipsys: Ipsys, lab: Path) -> None:
    recorded = data_section(lab)
    first = stages_of(ipsys, "replay", lab, "--model", "poly")
    assert first == {
        "detect": ("edges", True),
        "camera-frame": ("edges", True),
        "fit": ("poly", True),
        "evaluate": ("poly", True),
        "locate": ("poly", True),
        "fuse": ("poly", True),
    }
    after = lab.read_bytes()
    assert after.startswith(recorded)
    second = stages_of(ipsys, "replay", lab, "--model", "poly")
    assert all(not new for _, new in second.values())
    assert "nothing to do" in ipsys("replay", lab, "--model", "poly").err
    assert lab.read_bytes() == after


@pytest.mark.slow
def test_replay_in_place_equals_replay_into_a_new_log(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    beside, before = tmp_path / "derived.mcap", lab.read_bytes()
    assert ipsys("replay", lab, "-o", beside, "--model", "poly").code == 0
    assert lab.read_bytes() == before
    assert ipsys("replay", lab, "--model", "poly").code == 0
    with Session([lab]) as one, Session([beside]) as other:
        topics = {t for reader in other.readers for t in reader.channels}
        assert topics
        assert [(m.topic, m.log_time_ns, encode(m.payload)) for m in one.messages(topics)] == [
            (m.topic, m.log_time_ns, encode(m.payload)) for m in other.messages(topics)
        ]
    # Together, the two logs are one complete log.
    lab.write_bytes(before)
    assert all(not new for _, new in stages_of(ipsys, "replay", lab, beside).values())


@pytest.mark.slow
def test_corrected_marker_length_makes_a_new_run(ipsys: Ipsys, replayed_lab: Path, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "lab.toml", replayed_lab, 0.18)
    stages = stages_of(ipsys, "replay", replayed_lab, "--rig", rig)
    # The length changes the camera points, not the corners.
    assert stages["detect"] == ("edges", False)
    assert stages["camera-frame"] == ("edges_2", True)
    assert stages["fit"] == ("poly_2", True)
    with Session([replayed_lab]) as session:
        old, new = (
            [p.z_m for m in session.payloads(session.topics(CAMERA_POINTS, run)) for p in m.points]
            for run in ("edges", "edges_2")
        )
    np.testing.assert_allclose(np.array(new) / np.array(old), 0.9, rtol=1e-12)
    # Both runs exist, and each is found again.
    assert all(not new for _, new in stages_of(ipsys, "replay", replayed_lab).values())
    assert all(not new for _, new in stages_of(ipsys, "replay", replayed_lab, "--rig", rig).values())


def test_equal_rig_changes_nothing(ipsys: Ipsys, replayed_lab: Path, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "lab.toml", replayed_lab, 0.20)
    assert load_rig(rig).name == "simulated"
    assert all(not new for _, new in stages_of(ipsys, "replay", replayed_lab, "--rig", rig).values())


def write_lens(path: Path, log: Path, scale: float) -> Path:
    """Write the calibration of the camera red with a scaled focal length."""
    with Session([log]) as session:
        lens = session.payloads(["/cameras/red/calibration"])[0]
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", lens.K * np.array([[scale, 1, 1], [1, scale, 1], [1, 1, 1]]))
    storage.write("distortion_coefficients", lens.D.reshape(-1, 1))
    storage.write("image_width", lens.width)
    storage.write("image_height", lens.height)
    storage.release()
    return path


@pytest.mark.slow
def test_a_lens_calibrated_later_is_a_new_run(ipsys: Ipsys, detected_lab: Path, tmp_path: Path) -> None:
    log = detected_lab
    for scale, fresh in ((1.01, True), (1.0, False)):
        lens = f"red={write_lens(tmp_path / 'red.yaml', log, scale)}"
        stages = stages_of(ipsys, "camera-frame", log, "--calibration", lens)
        # Edge fits need intrinsics.
        assert (stages["detect"][1], stages["camera-frame"][1]) == (fresh, fresh)
    runs = json.loads(ipsys("runs", log, "--json").out)["rows"]
    assert [run["overrides"] for run in runs if run["run"] == "edges_2"] == [["lens red"]] * 2


def test_another_lens_is_tested_by_stock_corners_too(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    stock = ("camera-frame", lab, "--corners", "stock")
    assert ipsys(*stock).code == 0
    lens = f"red={write_lens(tmp_path / 'red.yaml', lab, 1.01)}"
    stages = stages_of(ipsys, *stock, "--calibration", lens)
    assert stages["detect"] == stages["camera-frame"] == ("stock_2", True)


def test_a_model_of_another_log_is_applied_and_copied_in(
    ipsys: Ipsys, replayed_lab: Path, tmp_path: Path
) -> None:
    drive = tmp_path / "drive.mcap"
    with Session([replayed_lab]) as session:
        kept = ["/rig", *session.images.values(), *session.calibrations.values()]
        write_log(drive, session.messages(kept))
        original = session.payloads(session.topics(MODEL, "poly"))[0]
    done = ipsys("replay", drive)  # the log has no own measurements
    assert done.code == 1
    assert f"enter some with 'ipsys measure {drive}', or apply a model of another log" in done.err
    stages = stages_of(ipsys, "replay", drive, "--model-from", replayed_lab)
    assert stages["fit"] == ("poly", True)
    assert "evaluate" not in stages
    replayed_lab.unlink()  # the log needs no other file
    with Session([drive]) as session:
        assert encode(session.payloads(session.topics(MODEL, "poly"))[0]) == encode(original)
        assert session.payloads(session.topics(TRACKS, "poly"))


@pytest.mark.parametrize("camera", ["red", "black"])
def test_one_camera_alone(ipsys: Ipsys, lab: Path, tmp_path: Path, camera: str) -> None:
    alone = tmp_path / "alone.mcap"
    with Session([lab]) as session:
        topics = ["/rig", "/measurements", f"/cameras/{camera}/image", f"/cameras/{camera}/calibration"]
        write_log(alone, session.messages(topics))
    done = ipsys("replay", alone, "--model", "poly", "--json")
    assert done.code == 0, done.err
    assert list(json.loads(done.out)["models"]["poly"]["cameras"]) == [camera]
    with Session([alone]) as session:
        tracks = session.payloads(session.topics(TRACKS, "poly"))
    # Predicted poses have no camera.
    assert {track.cameras for message in tracks for track in message.tracks} - {()} == {(camera,)}


def test_new_measurements_make_the_model_out_of_date(ipsys: Ipsys, replayed_lab: Path) -> None:
    from ipsys_log.engine.output import write_messages
    from ipsys_log.log.writer import LogWriter
    from ipsys_log.messages import Measurement

    with Session([replayed_lab]) as session:
        withdrawn = next(m for m in session.payloads(["/measurements"]) if "train" in m.splits)
        end_ns = session.end_ns
    withdrawal = Measurement(end_ns, "w1", withdraws=withdrawn.id)
    with LogWriter.append(replayed_lab) as writer:
        write_messages(writer, [Message("/measurements", end_ns + 1, end_ns, withdrawal)])
    stages = stages_of(ipsys, "replay", replayed_lab)
    assert stages["camera-frame"] == ("edges", False)
    assert stages["fit"] == ("poly_2", True)
    with Session([replayed_lab]) as session:
        old, new = (session.payloads(session.topics(MODEL, run))[0] for run in ("poly", "poly_2"))
    used = [{pair.measurement for camera in model.cameras for pair in camera.pairs} for model in (old, new)]
    assert used[0] - used[1] == {withdrawn.id}


def test_equal_point_names_of_two_logs_stay_different_points(tmp_path: Path) -> None:
    def log(name: str, *places: Measurement) -> Path:
        path = tmp_path / name
        write_log(path, (Message("/measurements", one.timestamp, one.timestamp, one) for one in places))
        return path

    monday = log("monday.mcap", Measurement(10, "p001", marker_id=3), Measurement(20, "p002", marker_id=3))
    tuesday = log(
        "tuesday.mcap",
        Measurement(110, "p001", marker_id=4),
        Measurement(120, "p001_withdrawn", withdraws="p001"),
        Measurement(130, "p002", marker_id=5),
    )
    for logs in ([monday, tuesday], [tuesday, monday]):
        with Session(logs) as session:
            places = active_measurements(session.payloads(["/measurements"]))
        assert [(one.id, one.marker_id) for one in places] == [("p001", 3), ("p002", 3), ("p002_2", 5)]


def test_a_run_may_be_named(ipsys: Ipsys, detected_lab: Path) -> None:
    stages = stages_of(ipsys, "replay", detected_lab, "--run", "monday", "--model", "poly")
    assert stages["detect"] == ("edges", False)
    assert stages["fit"] == stages["fuse"] == ("monday", True)
    again = ipsys("replay", detected_lab, "--run", "monday", "--model", "rigid")
    assert again.code == 1
    assert "monday already has the stage fit" in again.err


def test_an_unlabelled_log_is_split_by_a_recorded_seed(ipsys: Ipsys, lab: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain.mcap"

    def unlabelled() -> Iterator[Message]:
        with Session([lab]) as session:
            for message in session.messages(
                ["/rig", "/measurements", *session.images.values(), *session.calibrations.values()]
            ):
                labelled = message.topic == "/measurements"
                yield replace(message, payload=replace(message.payload, splits=())) if labelled else message

    write_log(plain, unlabelled())
    held_out: dict[int, list[Any]] = {}
    for seed in (0, 1, 0):
        done = ipsys("evaluate", plain, "--model", "rigid", "--seed", seed, "--json")
        assert done.code == 0, done.err
        held_out.setdefault(seed, []).append(json.loads(done.out)["models"]["rigid"]["cameras"])
    assert held_out[0][0] == held_out[0][1]
    assert held_out[0][0] != held_out[1][0]
    runs = json.loads(ipsys("runs", plain, "--json").out)["rows"]
    assert {run["parameters"]["seed"] for run in runs if run["stage"] == "fit"} == {"0", "1"}


def test_errors_against_the_truth_and_against_the_tape(ipsys: Ipsys, detected_lab: Path) -> None:
    model = json.loads(ipsys("replay", detected_lab, "--model", "rigid", "--json").out)["models"]["rigid"]
    for errors in model["cameras"].values():
        assert 0 < errors["truth"]["3d"]["mean_m"] < 0.04
        assert 0 < errors["3d"]["mean_m"] < 0.04
        assert errors["truth"] != {key: errors[key] for key in ("3d", "2d")}
    assert 0 < model["tracks"]["truth"]["3d"]["mean_m"] < 0.04


def test_log_that_is_replaced_between_stages_gets_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The next stage would find no input in the new file, and append an empty run to it."""
    paper = ROOT / "sample_logs" / "paper_lab.mcap"
    log = Path(shutil.copy(paper, tmp_path / "paper.mcap"))

    def run_and_replace(*arguments: Any) -> Any:
        outcome = run_stage(*arguments)
        Path(shutil.copy(paper, tmp_path / "new.mcap")).rename(log)
        return outcome

    monkeypatch.setattr("ipsys_log.engine.replay.run_stage", run_and_replace)
    with pytest.raises(LogError, match=r"another program has replaced the log .* is missing\)"):
        replay([log], Request(models=("rigid",)), "evaluate")
    assert log.read_bytes() == paper.read_bytes()
