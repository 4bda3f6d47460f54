"""``ipsys calibrate-lab --body`` and ``--board``: cameras on walls, and four webcams."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ipsys_log.calibration.joint.payload import restore_joint
from ipsys_log.engine.output import write_log
from ipsys_log.log.dataset import Session
from ipsys_log.messages import RigMarker
from ipsys_log.messages.channels import MODEL, POSITIONS
from tests.conftest import Ipsys
from tests.joint.carried_wand import CarriedWand, carry_wand, wand_messages

# The videos start at this row of the table of their times.
EPOCH_S = 1_700_000_000


@pytest.fixture(scope="module")
def wand() -> CarriedWand:
    return carry_wand(5, count=2, duration_s=10.0)


@pytest.fixture
def log(wand: CarriedWand, tmp_path: Path) -> Path:
    write_log(tmp_path / "carry.mcap", wand_messages(wand))
    return tmp_path / "carry.mcap"


def test_carried_body_gives_a_model_that_locates_it(ipsys: Ipsys, wand: CarriedWand, log: Path) -> None:
    done = ipsys("calibrate-lab", log, "--body", "wand")
    assert done.code == 0, done.err
    assert max(map(len, done.out.splitlines())) <= 80
    assert "Coordinates: those of wand at rest" in done.out
    with Session([log]) as session:
        models = restore_joint(session.payloads([MODEL.topic_of("joint")])[-1])
    for name, camera in wand.camera_from_world.items():
        assert models[name].origin_m == pytest.approx(-camera[:3, :3].T @ camera[:3, 3], abs=0.01)
    replayed = ipsys("replay", log, "--model", "joint")
    assert replayed.code == 0, replayed.err
    with Session([log]) as session:
        last = list(session.messages(session.topics(POSITIONS, "joint")))[-20:]
    # The body lies at the origin.
    places_m = [[one.x_m, one.y_m, one.z_m] for message in last for one in message.payload.positions]
    assert np.median(places_m, axis=0) == pytest.approx(np.zeros(3), abs=0.003)
    assert ipsys("verify", log).code == 0


def test_lab_without_rest_and_points_has_no_certain_coordinates(
    ipsys: Ipsys, wand: CarriedWand, tmp_path: Path
) -> None:
    moving = {camera: own[:150] for camera, own in wand.markers.items()}
    write_log(tmp_path / "a.mcap", wand_messages(replace(wand, markers=moving)))
    found = json.loads(ipsys("calibrate-lab", tmp_path / "a.mcap", "--body", "wand", "--json").out)
    assert found["rest"] is None
    assert "those of camera c0" in found["remarks"][0]
    with Session([tmp_path / "a.mcap"]) as session:
        models = restore_joint(session.payloads([MODEL.topic_of("joint")])[-1])
    assert not any(model.is_certain for model in models.values())


def test_wrong_markers_of_a_carried_body_are_named(ipsys: Ipsys, wand: CarriedWand, tmp_path: Path) -> None:
    def spoil(marker: RigMarker) -> RigMarker:
        if marker.id == 2:
            x_m, y_m, z_m = marker.xyz_m
            return replace(marker, xyz_m=(x_m + 0.003, y_m, z_m))
        return replace(marker, xyz_m=(), rpy_rad=()) if marker.id == 4 else marker

    rig = replace(wand.rig, markers=tuple(map(spoil, wand.rig.markers)))
    write_log(tmp_path / "a.mcap", wand_messages(replace(wand, rig=rig)))
    found = json.loads(ipsys("calibrate-lab", tmp_path / "a.mcap", "--body", "wand", "--json").out)
    unknown, contradiction = found["remarks"]
    assert unknown == "marker 4 of wand has no pose in the rig: it is not used"
    assert contradiction.startswith("marker 2 of wand contradicts the others, by ")
    for camera in found["cameras"]:
        true = wand.camera_from_world[camera["camera"]]
        assert camera["origin_m"] == pytest.approx(-true[:3, :3].T @ true[:3, 3], abs=0.01)


def test_two_markers_that_contradict_each_other_widen_the_covariance(
    ipsys: Ipsys, wand: CarriedWand, tmp_path: Path
) -> None:
    ids, sigmas_m = (0, 1), []
    for shift_m in (0.0, 0.004):
        markers = tuple(
            replace(one, xyz_m=(one.xyz_m[0] + shift_m, *one.xyz_m[1:])) if one.id == 1 else one
            for one in wand.rig.markers
            if one.id in ids or one.robot is None
        )
        log = tmp_path / f"{shift_m}.mcap"
        write_log(log, wand_messages(replace(wand, rig=replace(wand.rig, markers=markers))))
        found = json.loads(ipsys("calibrate-lab", log, "--body", "wand", "--json").out)
        named = any("the corners contradict the shape of wand" in remark for remark in found["remarks"])
        assert named == (shift_m > 0)
        with Session([log]) as session:
            models = restore_joint(session.payloads([MODEL.topic_of("joint")])[-1])
        assert all(model.is_certain != named for model in models.values())
        sigmas_m.append(found["cameras"][1]["origin_sigmas_m"])
        true = wand.camera_from_world["c1"]
        errors_m = np.abs(found["cameras"][1]["origin_m"] + true[:3, :3].T @ true[:3, 3])
        assert (errors_m < 3 * np.array(sigmas_m[-1])).all()
    assert min(np.divide(*reversed(sigmas_m))) > 1.5


def test_prints_that_contradict_measured_points_are_named(ipsys: Ipsys, tmp_path: Path) -> None:
    wand = carry_wand(7, count=2, duration_s=8.0, taped=True)
    markers = tuple(replace(one, length_m=1.01 * (one.length_m or 0.12)) for one in wand.rig.markers)
    markers = tuple(
        replace(one, xyz_m=tuple(1.01 * length for length in one.xyz_m)) if one.xyz_m else one
        for one in markers
    )
    write_log(tmp_path / "a.mcap", wand_messages(replace(wand, rig=replace(wand.rig, markers=markers))))
    found = json.loads(ipsys("calibrate-lab", tmp_path / "a.mcap", "--body", "wand", "--json").out)
    assert any("the measured points are 1.0 % nearer together" in remark for remark in found["remarks"])
    for camera in found["cameras"]:
        true = wand.camera_from_world[camera["camera"]]
        errors_m = np.abs(camera["origin_m"] + true[:3, :3].T @ true[:3, 3])
        assert (errors_m < 3 * np.array(camera["origin_sigmas_m"]) + 0.002).all()


def test_bad_input_of_a_carried_lab_is_one_line(ipsys: Ipsys, log: Path, tmp_path: Path) -> None:
    before = log.read_bytes()
    for words, text in (
        (("--body", "ada"), "ada: is no body of the rig, which has wand"),
        (("--body", "wand", "--board", "6x4"), "--board cannot be used with --body"),
        (("--body", "wand", "--plot", tmp_path / "a.png"), "--plot cannot be used with --body"),
        (("--board", "6", "--square", "0.03"), "--board 6: is not a board"),
        (("--board", "6x4"), "--board: add --square, the side of a square in m"),
        (("--board", "6x4", "--square", "0.03"), "has no frames of a board"),
    ):
        done = ipsys("calibrate-lab", log, *words)
        assert done.code == 1
        assert text in " ".join(done.err.split())
        assert len(done.err.strip().splitlines()) <= 3
    assert log.read_bytes() == before


@pytest.mark.slow
def test_board_in_the_hand_calibrates_webcams(ipsys: Ipsys, data: Path, tmp_path: Path) -> None:
    """Two webcams without any calibration: extrinsics, intrinsics, clocks and the squares of the board."""
    rows = ["file,time"]
    table = (data / "charuco_videos" / "timestamps.csv").read_text(encoding="utf-8").splitlines()[1:]
    for number in (0, 3):
        times = sorted(
            (int(frame), float(time))
            for _, camera, frame, time in (row.split(",") for row in table)
            if camera == str(number)
        )
        folder = tmp_path / "images" / f"cam_{number}"
        folder.mkdir(parents=True)
        video = cv2.VideoCapture(str(data / "charuco_videos" / f"cam_{number}.mp4"))
        for index, (_, time_s) in enumerate(times):
            assert cv2.imwrite(
                str(folder / f"{index:04d}.jpg"), video.read()[1], [cv2.IMWRITE_JPEG_QUALITY, 98]
            )
            rows.append(f"cam_{number}/{index:04d}.jpg,{EPOCH_S + time_s:.7f}")
    (tmp_path / "times.csv").write_text("\n".join(rows), encoding="utf-8")
    log = tmp_path / "board.mcap"
    imported = ipsys("import", tmp_path / "images", "-o", log, "--times", tmp_path / "times.csv")
    assert imported.code == 0, imported.err
    board = ("--board", "charuco:4x5", "--square", "0.054", "--dictionary", "DICT_4X4_1000", "--inverted")
    done = ipsys("calibrate-lab", log, *board, "--field-of-view", "75", "--json")
    assert done.code == 0, done.err
    found = json.loads(done.out)
    for camera, focal_px in zip(found["cameras"], (903.5, 640.0), strict=True):
        assert camera["held_out_rmse_px"] < 2.5
        # The reference calibration of the data set.
        assert camera["focal_px"][0] == pytest.approx(focal_px, rel=0.03)
    assert np.sqrt(np.mean(np.square(found["distance_errors_m"]))) < 0.0006
    assert found["cameras"][1]["clock_s"] == pytest.approx(0.0235, abs=0.01)
